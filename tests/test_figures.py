"""The figures of README and docs are those of the results that docs/figures.yaml names."""

import functools
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from statistics import mean
from typing import Any

import pytest
import yaml
from scipy.stats import ttest_rel

from foredrive.runs.model_card import find_card, read_card

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES = ["README.md", *sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md"))]
PICTURES = sorted(path for kind in ("png", "jpg", "webp") for path in (ROOT / "docs").rglob(f"*.{kind}"))
CARD = re.compile(r"card:(\w+) \| (.+) (\S+)")
SOURCE = re.compile(r"{([^}]+)}")
FORMS = {1: "{}", 2: "{} ± {}", 3: "{} [{}, {}]"}


def ties() -> Iterator[tuple[str, str]]:
    """Yield each page with each text that it has, with {sources} in place of figures."""
    for page, entries in yaml.safe_load((ROOT / "docs" / "figures.yaml").read_text()).items():
        for entry in entries:
            yield from ((page, text) for text in texts(entry))


def texts(entry: str | dict[str, Any]) -> Iterator[str]:
    """Yield the text of an entry, or one for each row of its table."""
    if isinstance(entry, str):
        yield entry
        return
    says = SOURCE.sub(lambda source: f"{{{entry['of']} {source[1]}}}", entry["says"])
    if "rows" not in entry:
        yield says
    for cell, row in entry.get("rows", {}).items():
        yield f"| {cell} {says.replace('@', row)}"


TIES = list(ties())


def plain(text: str) -> str:
    """Return a text without line breaks, bold type and marks of code, with - for the minus."""
    return re.sub(r"\s+", " ", re.sub(r"\*\*|`", "", text).replace("\N{MINUS SIGN}", "-"))


@functools.cache
def results(name: str) -> dict[str, Any]:
    """Return the content of a file of results."""
    content: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text())
    return content


def average(name: str, arms: str, key: str) -> float:
    """Return the mean over the seeds of an arm, then over arms that are joined by commas."""
    return mean(float(results(name)["figures"][arm][key]["mean"]) for arm in arms.split(","))


def seeds(name: str, arm: str, key: str) -> dict[int, float]:
    """Return a figure of each seed of an arm, or of a part of it (ARM@PART)."""
    return {
        run["seed"]: run["figures"][key]
        for run in results(name)["runs"]
        if run["arm"].partition("@")[0] == arm and key in run["figures"]
    }


def numbers(name: str, arm: str, key: str, *how: str) -> list[float]:
    """Return a figure; with its standard deviation, or with its bounds of 95 %."""
    middle = average(name, arm, key)
    match how:
        case ():
            return [middle]
        case ["±"]:
            return [middle, results(name)["figures"][arm][key]["std"]]
        case ["[]"]:
            return [middle, average(name, arm, f"{key}_low"), average(name, arm, f"{key}_high")]
        case ["-", *other]:
            return [middle - average(name, *other)]
        case ["%", *other]:
            return [100 * (middle / average(name, *other) - 1)]
        case ["[-]", *other]:
            first, second = seeds(name, arm, key), seeds(name, *other)
            common = first.keys() & second.keys()
            paired = ttest_rel([first[seed] for seed in common], [second[seed] for seed in common])
            bounds = paired.confidence_interval()
            return [mean(first[seed] - second[seed] for seed in common), bounds.low, bounds.high]
        case [seed]:
            return [seeds(name, arm, key)[int(seed.removeprefix("seed"))]]
    raise AssertionError(f"not a figure: {how}")


def figure(source: str) -> str:
    """Return a figure as its page has it."""
    if card := CARD.fullmatch(source):
        name, title, form = card.groups()
        return format(read_card(find_card(name)).figures[title][1], form)
    *words, form = shlex.split(source)
    times = float(words.pop()[1:]) if words[-1].startswith("*") else 1.0
    values = [times * value for value in numbers(*words)]
    # The sign of a difference stands before its mean alone
    said = [format(values[0], form), *(format(value, form.lstrip("+")) for value in values[1:])]
    return FORMS[len(said)].format(*said)


@pytest.mark.parametrize(("page", "text"), TIES, ids=[f"{page}: {text[:40]}" for page, text in TIES])
def test_a_page_says_what_was_measured(page: str, text: str) -> None:
    said = plain(SOURCE.sub(lambda source: figure(source[1]), text))
    # Digits before or after it would make another number
    alone = rf"(?<![\d.-]){re.escape(said)}(?!\.?\d)"
    assert re.search(alone, plain((ROOT / page).read_text())), f"{page} does not say: {said}"


@pytest.mark.parametrize("picture", PICTURES, ids=lambda path: path.name)
def test_a_picture_is_made_by_committed_code(picture: Path) -> None:
    scripts = "".join(path.read_text() for path in (ROOT / "docs/draw").glob("*.py"))
    by_verb = "".join(path.read_text() for path in (ROOT / "docs").glob("*.md"))
    assert picture.name in scripts or re.search(rf"--(out|save) {picture.stem}\.", by_verb)


@pytest.mark.parametrize("page", PAGES)
def test_results_that_a_page_links_to_are_compared(page: str) -> None:
    linked = re.findall(r"\]\((?:\.\./)*benchmarks/results/([\w-]+)\.json", (ROOT / page).read_text())
    sources = [source for of, text in TIES if of == page for source in SOURCE.findall(text)]
    assert set(linked) <= {source.split()[0] for source in sources}


def test_a_figure_is_rounded_as_its_page_has_it() -> None:
    content = results("ops")["figures"]["warp"]["memory_ratio"]["mean"]
    assert figure("ops warp memory_ratio *100 .0f") == f"{100 * content:.0f}"
    of_seeds = [float(figure(f"sets-training energy pmb_nll seed{seed} .6f")) for seed in range(3)]
    middle = sum(of_seeds) / 3
    std = (sum((value - middle) ** 2 for value in of_seeds) / 2) ** 0.5
    assert figure("sets-training energy pmb_nll ± .1f") == f"{middle:.1f} ± {std:.1f}"


def test_an_interval_of_a_difference_is_paired_by_seed() -> None:
    differences = [
        float(figure(f"sets-training energy pmb_nll seed{seed} .6f"))
        - float(figure(f"sets-training matching pmb_nll seed{seed} .6f"))
        for seed in range(3)
    ]
    middle = sum(differences) / 3
    # 4.303: the 97.5 % quantile of Student's t with two degrees of freedom
    half = 4.303 * (sum((value - middle) ** 2 for value in differences) / 2 / 3) ** 0.5
    said = figure("sets-training energy pmb_nll [-] matching pmb_nll +.2f")
    assert said == f"{middle:+.2f} [{middle - half:.2f}, {middle + half:.2f}]"
