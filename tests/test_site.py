"""The generated pages of the site: tables of benchmarks, links that leave docs/, pages of the API."""

import json
import re
import sys
from pathlib import Path

import pytest

from foredrive.cli.main import VERBS

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "docs" / "site"))

from api_pages import FOLDERS, api_pages  # noqa: E402
from benchmark_pages import (  # noqa: E402
    DECIDING,
    arms_of_today,
    benchmark_page,
    benchmark_pages,
    cell,
    figure_name,
    number,
)
from repository_links import linked_files, rewritten, source_page  # noqa: E402


def entry(mean: float, std: float = 0.0, n: int = 1) -> dict[str, float]:
    return {"mean": mean, "std": std, "min": mean, "max": mean, "n": n}


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.123456, "0.1235"), (2026.0, "2026"), (-0.5, "-0.5"), (4.6e-11, "4.6e-11"), (None, "\N{EN DASH}")],
)
def test_numbers_have_four_digits_and_whole_ones_all(value: float | None, text: str) -> None:
    assert number(value) == text


def test_a_cell_has_the_spread_of_seeds_and_the_interval() -> None:
    figures = {
        "a": entry(0.5, 0.01234, 3),
        "b": entry(0.25),
        "b_low": entry(0.2),
        "b_high": entry(0.3125),
        "c": entry(7.0, 0.0, 3),
        "ds_short": entry(90.0),
        "ds_low_short": entry(84.0),
        "ds_high_short": entry(95.0),
    }
    plain = {
        name: cell(figures, name).replace("\N{NO-BREAK SPACE}", " ")
        for name in ("a", "b", "c", "d", "ds_short")
    }
    assert plain == {
        "a": "0.5 ± 0.012",
        "b": "0.25 [0.2, 0.3125]",
        "c": "7",
        "d": "",
        "ds_short": "90 [84, 95]",
    }


@pytest.mark.parametrize(
    ("part", "text", "unit"),
    [
        ("l2_avg_m", "L2 mean", "m"),
        ("iou_future_500ms", "IoU in 500 ms", ""),
        ("iou_now", "IoU now", ""),
        ("epe_moving_future_1s_mps", "EPE moving in 1 s", "m/s"),
        ("p_at_10_above_image", "P@10 above image", ""),
        ("cpu_s_10min", "CPU time after 10 min", "s"),
        ("camera_mp_per_s", "camera megapixels per s", ""),
        ("above_2deg_pct", "above 2°", "%"),
        ("in_05s", "in 0.5 s", ""),
        ("depth_median_sq_m2", "depth median squared", "m²"),
        ("ds_2_1_long", "driving score 2.1 long", ""),
    ],
)
def test_a_figure_is_named_in_words_with_its_unit(part: str, text: str, unit: str) -> None:
    assert (figure_name(part)[0].replace("\N{NO-BREAK SPACE}", " "), figure_name(part)[1]) == (text, unit)


def content(figures: dict[str, dict[str, dict[str, float]]], name: str = "try") -> dict[str, object]:
    return {
        "name": name,
        "question": "Is it so?",
        "figures": figures,
        "machine.cpu": "CPU",
        "machine.cores": 2,
        "machine.ram_gib": 8.0,
        "machine.gpu": None,
        "version.python": "3.11",
        "version.torch": "2.6",
        "commit": "0123456789ab",
        "command": "python -m foredrive bench try --arms one",
        "runs": [{"commit": "fedcba987654"}, {}],
    }


def test_arms_with_other_figures_have_a_table_of_their_own() -> None:
    arm = {"x_m": entry(1.5), "z": entry(1.0), "y.ap_0.5m": entry(0.5), "y.ap_0.5m.copy": entry(0.25)}
    page = benchmark_page(content({"one": arm, "two": arm | {"x_m": entry(2.5)}, "other": {"w": entry(3.5)}}))
    assert "| | `one` | `two` |\n|---|--:|--:|\n| X, m | 1.5 | 2.5 |\n| Z | 1 | 1 |\n\n" in page
    rows = "| AP 0.5 m | 0.5 | 0.5 |\n| AP 0.5 m, persistence | 0.25 | 0.25 |"
    assert f"## Y\n\n| | `one` | `two` |\n|---|--:|--:|\n{rows}" in page.replace("\N{NO-BREAK SPACE}", " ")
    assert "| | `other` |\n|---|--:|\n| W | 3.5 |" in page
    assert "`0123456`, `fedcba9`" in page
    assert "`foredrive bench try`\n" in page


def test_more_arms_than_figures_are_rows() -> None:
    page = benchmark_page(content({name: {"step_ms": entry(1.0)} for name in ("one", "two")}))
    assert "| | Step, ms |\n|---|--:|\n| `one` | 1 |\n| `two` | 1 |\n" in page


def test_a_long_page_begins_with_what_decides_and_folds_the_rest() -> None:
    name = "ncap"
    few = {key: entry(1.0) for key in DECIDING[name].split()}
    many = {f"uniad.part_{i}.x": entry(float(i)) for i in range(30)}
    page = benchmark_page(content({"one": few | many, "two": few | many}, name))
    short, _, rest = page.partition("## All figures")
    assert "## In short\n\n| | `one` | `two` |\n|---|--:|--:|\n| Score | 1 | 1 |\n" in short
    assert '??? abstract "UniAD"\n\n    | | `one` | `two` |\n' in rest
    assert "    | **Part 7** | | |\n    | X | 7 | 7 |\n" in rest


def test_figures_that_no_two_arms_share_are_rows_with_their_arm() -> None:
    keys = DECIDING["nemo-base"].split()
    figures = {
        "forward": {key: entry(1.0) for key in keys[:2]},
        "speedup": {key: entry(2.0) for key in keys[2:]},
    }
    figures["forward"] |= {f"other_{i}": entry(0.0) for i in range(30)}
    page = benchmark_page(content(figures, "nemo-base"))
    assert "| Peak, GiB | `forward` | 1 |\n| Fast: step CPU time, s | `speedup` | 2 |\n" in page


def test_every_results_file_has_a_page_and_a_row() -> None:
    pages = benchmark_pages(ROOT / "benchmarks" / "results")
    names = {file.stem for file in (ROOT / "benchmarks" / "results").glob("*.json")}
    assert set(pages) == {f"benchmarks/{name}.md" for name in (*names, "index")}
    assert all(f"]({name}.md)" in pages["benchmarks/index.md"] for name in names)


def test_every_long_page_has_figures_that_decide() -> None:
    folder = ROOT / "benchmarks" / "results"
    results = {file.stem: json.loads(file.read_text())["figures"] for file in folder.glob("*.json")}
    # Results without a benchmark have no page
    arms = {name: figures for name, figures in results.items() if benchmark_file(name).is_file()}
    folded = {Path(page).stem for page, text in benchmark_pages(folder, arms).items() if "??? " in text}
    assert folded == DECIDING.keys()
    for name in folded:
        measured = {key for entries in results[name].values() for key in entries}
        assert set(DECIDING[name].split()) <= measured, name


def benchmark_file(name: str) -> Path:
    return ROOT / "benchmarks" / f"{name.replace('-', '_')}.py"


def test_the_arms_of_a_benchmark_are_asked_of_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # For `benchmarks.common`
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "benchmarks" / "a_speed.py").write_text(
        "from benchmarks.common.benchmark import Benchmark\n"
        "BENCHMARK = Benchmark('Is it: fast?', {'one@part': dict, 'two: 2': dict})"
    )
    (tmp_path / "benchmarks" / "script.py").write_text("")
    assert arms_of_today(tmp_path) == {"a-speed": {"one", "two: 2"}}


def test_arms_that_a_benchmark_no_longer_has_are_left_out(tmp_path: Path) -> None:
    figures = {"kept": {"x": entry(1.0)}, "gone": {"x": entry(2.0)}}
    for name in ("try", "removed"):
        (tmp_path / f"{name}.json").write_text(json.dumps(content(figures, name)))
    pages = benchmark_pages(tmp_path, {"try": {"kept"}})
    assert set(pages) == {"benchmarks/index.md", "benchmarks/try.md"}
    assert "gone" not in pages["benchmarks/try.md"]


@pytest.mark.parametrize(
    ("page", "link", "place"),
    [
        ("claims.md", "sets.md#speed", "sets.md#speed"),
        ("claims.md", "../benchmarks/results/ops.json", "benchmarks/ops.md"),
        ("claims.md", "../src/foredrive/scene/clip.py", "source/src/foredrive/scene/clip.py.md"),
        ("how-to/train.md", "../../README.md#limitations", "../readme.md#limitations"),
        ("how-to/index.md", "../../benchmarks/results", "../benchmarks/index.md"),
        ("readme.md", "docs/claims.md", "claims.md"),
        ("readme.md", "docs/hero.png", "hero.png"),
        ("first-hour.md", "tutorials/own_log.py", "tutorials/own_log.md"),
        ("index.md", "https://example.org/a", "https://example.org/a"),
    ],
)
def test_links_lead_to_pages_of_the_site(page: str, link: str, place: str) -> None:
    assert rewritten(f"see [this]({link}) there", page) == f"see [this]({place}) there"


def test_files_that_pages_link_to_are_shown() -> None:
    pages = ["[a](../src/foredrive/scene/clip.py) [b](../benchmarks/results/ops.json) [c](../src/none.py)"]
    assert linked_files(ROOT, pages) == ["src/foredrive/scene/clip.py"]
    assert "class Clip" in source_page(ROOT, "src/foredrive/scene/clip.py")


def test_the_picture_of_the_loop_links_every_verb() -> None:
    linked = re.findall(r'href="how-to/verbs\.html#([\w-]+)"', (ROOT / "docs" / "loop.svg").read_text())
    families = {"fetch-av2" if verb == "fetch av2" else verb.split()[0] for verb in VERBS}
    assert sorted(linked) == sorted(families)


def test_the_reference_has_what_folders_export_and_no_kernels() -> None:
    pages = api_pages(ROOT / "src" / "foredrive")
    assert {f"api/{folder}.md" for folder in ("scene", "data", "sets", "runs")} <= set(pages)
    assert "write_log" in pages["api/data.md"]
    assert "api/tasks.planning.scores.md" in pages
    assert "api/ops.lifting_kernels.md" not in pages
    assert all(f"## foredrive.{folder}" in pages["api/index.md"] for folder in FOLDERS)
