"""The figures of README and docs/claims.md are those of the results that docs/figures.yaml names."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from foredrive.runs.model_card import find_card, read_card

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
SENTENCES: list[dict[str, Any]] = yaml.safe_load((ROOT / "docs" / "figures.yaml").read_text())
PICTURES = sorted(path for kind in ("png", "jpg", "webp") for path in (ROOT / "docs").rglob(f"*.{kind}"))
CARD = re.compile(r"card:(\w+) \| (.+) (\S+)")
FIGURE = re.compile(
    r"(?P<file>\S+) (?P<arm>\S+) (?P<key>\S+)"
    r"(?: \.(?P<of>std|seed\d+))?(?: \*(?P<times>\d+))?(?: (?P<format>\S+))?"
)


def plain(text: str) -> str:
    """Return a text without line breaks and bold type, with - for the minus."""
    return re.sub(r"\s+", " ", text.replace("**", "").replace("\N{MINUS SIGN}", "-"))


def figure(source: str) -> float | str:
    """Return a figure as its page has it; a number if there is no format."""
    if card := CARD.fullmatch(source):
        name, title, form = card.groups()
        return format(read_card(find_card(name)).figures[title][1], form)
    parts = FIGURE.fullmatch(source)
    assert parts, f"not a figure: {source}"
    content = json.loads((RESULTS / f"{parts['file']}.json").read_text())
    if parts["of"] and parts["of"].startswith("seed"):
        seed = int(parts["of"].removeprefix("seed"))
        (run,) = [run for run in content["runs"] if (run["arm"], run["seed"]) == (parts["arm"], seed)]
        value = run["figures"][parts["key"]]
    else:
        value = content["figures"][parts["arm"]][parts["key"]][parts["of"] or "mean"]
    value *= float(parts["times"] or 1)
    return format(value, parts["format"]) if parts["format"] else value


@pytest.mark.parametrize("sentence", SENTENCES, ids=lambda each: f"{each['page']}: {each['says'][:40]}")
def test_a_sentence_says_what_was_measured(sentence: dict[str, Any]) -> None:
    said = plain(sentence["says"].format(*map(figure, sentence["figures"])))
    assert said in plain((ROOT / sentence["page"]).read_text()), f"{sentence['page']} does not say: {said}"


@pytest.mark.parametrize("picture", PICTURES, ids=lambda path: path.name)
def test_a_picture_is_made_by_committed_code(picture: Path) -> None:
    scripts = "".join(path.read_text() for path in (ROOT / "docs").glob("draw_*.py"))
    by_verb = "".join(path.read_text() for path in (ROOT / "docs").glob("*.md"))
    assert picture.name in scripts or re.search(rf"--(out|save) {picture.stem}\.", by_verb)


@pytest.mark.parametrize("page", ["README.md", "docs/claims.md"])
def test_results_that_a_page_links_to_are_compared(page: str) -> None:
    linked = set(re.findall(r"\]\((?:\.\./)?benchmarks/results/([\w-]+)\.json", (ROOT / page).read_text()))
    sources = [source for each in SENTENCES if each["page"] == page for source in each["figures"]]
    assert linked <= {source.split()[0] for source in sources}


def test_a_figure_is_rounded_as_its_page_has_it() -> None:
    content = json.loads((RESULTS / "ops.json").read_text())["figures"]["warp"]["memory_ratio"]["mean"]
    assert figure("ops warp memory_ratio *100 .0f") == f"{100 * content:.0f}"
    assert figure("ops warp memory_ratio") == content
    seeds = [float(figure(f"sets-training energy pmb_nll .seed{seed} .6f")) for seed in range(3)]
    mean = sum(seeds) / 3
    std = (sum((value - mean) ** 2 for value in seeds) / 2) ** 0.5
    assert figure("sets-training energy pmb_nll .std .1f") == f"{std:.1f}"
