"""The commands, names and links that README and the pages of docs show are there."""

import ast
import functools
import importlib
import importlib.util
import re
import shlex
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from foredrive.cli import main as program

ROOT = Path(__file__).parents[2]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))


def blocks(page: Path, languages: str) -> list[str]:
    return re.findall(rf"^```(?:{languages})\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def commands(page: Path) -> list[str]:
    in_notebook = page.read_text().replace("# foredrive", "foredrive")
    text = "\n".join(blocks(page, "|bash")) if page.suffix == ".md" else in_notebook
    return re.findall(r"^foredrive (.+?)(?:\s+(?:#.*|> \S+\.\w+.*))?$", text, flags=re.MULTILINE)


COMMANDS = sorted(
    {command for page in (*PAGES, *TUTORIALS) for command in commands(page) if "--help" not in command}
)


def test_there_are_commands() -> None:
    assert {"convert", "view", "record", "train", "evaluate", "render"} <= {
        line.split()[0] for line in COMMANDS
    }


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_is_understood(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    called = []

    def only_called(name: str) -> Callable[..., None]:
        @functools.wraps(program.VERBS[name])
        def verb(*args: object, **kwargs: object) -> None:
            called.append(name)

        return verb

    monkeypatch.setattr(program, "VERBS", {name: only_called(name) for name in program.VERBS})
    assert program.main(shlex.split(command)) == 0
    verb, then, *_ = (*shlex.split(command), "")
    assert called == [f"{verb} {then}" if f"{verb} {then}" in program.VERBS else verb]


def is_installed(module: str) -> bool:
    package = module.partition(".")[0]
    return package == "foredrive" or importlib.util.find_spec(package) is not None


@pytest.mark.parametrize("page", [*PAGES, *TUTORIALS], ids=lambda page: page.stem)
def test_names_in_examples_can_be_imported(page: Path) -> None:
    """Other people's packages are left out where they are not installed."""
    for block in blocks(page, "python") if page.suffix == ".md" else [page.read_text()]:
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and is_installed(node.module or ""):
                module = importlib.import_module(node.module or "")
                for name in node.names:
                    assert hasattr(module, name.name), f"{page.name}: {node.module} has no {name.name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_benchmarks_that_are_named_exist(page: Path) -> None:
    named = re.findall(r"foredrive bench ([a-z][a-z0-9-]+)", page.read_text())
    assert set(named) <= {path.stem.replace("_", "-") for path in (ROOT / "benchmarks").glob("*.py")}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_source_files_that_are_named_exist(page: Path) -> None:
    """A path that begins with another folder is that of a public repository."""
    folders = ("src", "tests", "benchmarks", "docs")
    there = {path.as_posix() for folder in folders for path in (ROOT / folder).rglob("*.py")}
    ours = {*folders, *(path.name for path in (ROOT / "src" / "foredrive").iterdir())}
    for name in re.findall(r"`([a-z0-9_]+/[a-z0-9_/]+\.py)`", page.read_text()):
        known = any(path.endswith(f"/{name}") for path in there)
        assert known or name.split("/")[0] not in ours, f"{page.name}: {name}"
    for name, target in re.findall(r"\[`([a-z0-9_/]+\.py)`\]\(([^)]+)\)", page.read_text()):
        assert target.endswith(f"/{name}"), f"{page.name}: {name} is linked to {target}"


def test_readme_names_the_versions_that_the_package_asks_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (torch,) = (need for need in project["dependencies"] if need.startswith("torch>="))
    lowest, above = re.fullmatch(r"torch>=2\.(\d+),<2\.(\d+)", torch).groups()  # type: ignore[union-attr]
    python, torch = project["requires-python"].removeprefix(">="), f"2.{lowest} to 2.{int(above) - 1}"
    assert f"Python {python} or newer · PyTorch {torch} ·" in (ROOT / "README.md").read_text()


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{page.name}: {link}"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link}"
