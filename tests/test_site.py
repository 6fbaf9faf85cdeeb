"""The generated pages of the site: tables of benchmarks, links that leave docs/, pages of the API."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "docs" / "site"))

from api_pages import FOLDERS, api_pages  # noqa: E402
from benchmark_pages import benchmark_page, benchmark_pages, cell, number  # noqa: E402
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
    }
    plain = {name: cell(figures, name).replace("\N{NO-BREAK SPACE}", " ") for name in ("a", "b", "c", "d")}
    assert plain == {"a": "0.5 ± 0.012", "b": "0.25 [0.2, 0.3125]", "c": "7", "d": ""}


def test_arms_with_other_figures_have_a_table_of_their_own() -> None:
    content = {
        "name": "try",
        "question": "Is it so?",
        "figures": {"one": {"x": entry(1.5)}, "two": {"x": entry(2.5)}, "other": {"y": entry(3.5)}},
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
    page = benchmark_page(content)
    assert "| figure | `one` | `two` |\n|---|--:|--:|\n| `x` | 1.5 | 2.5 |" in page
    assert "| figure | `other` |" in page
    assert "`0123456`, `fedcba9`" in page
    assert "`foredrive bench try`\n" in page


def test_every_results_file_has_a_page_and_a_row() -> None:
    pages = benchmark_pages(ROOT / "benchmarks" / "results")
    names = {file.stem for file in (ROOT / "benchmarks" / "results").glob("*.json")}
    assert set(pages) == {f"benchmarks/{name}.md" for name in (*names, "index")}
    assert all(f"]({name}.md)" in pages["benchmarks/index.md"] for name in names)


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


def test_the_reference_has_what_folders_export_and_no_kernels() -> None:
    pages = api_pages(ROOT / "src" / "foredrive")
    assert {f"api/{folder}.md" for folder in ("scene", "data", "sets", "runs")} <= set(pages)
    assert "write_log" in pages["api/data.md"]
    assert "api/tasks.planning.scores.md" in pages
    assert "api/ops.lifting_kernels.md" not in pages
    assert all(f"## foredrive.{folder}" in pages["api/index.md"] for folder in FOLDERS)
