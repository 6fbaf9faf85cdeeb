"""Help of every verb."""

import dataclasses
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml

from foredrive.cli import main as program
from foredrive.cli.main import main

OPTIONS = Path(__file__).with_name("options.yaml")


@pytest.mark.parametrize("verb", list(program.VERBS))
def test_help_explains_every_flag(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*verb.split(), "--help"])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    function = program.VERBS[verb]
    assert (function.__doc__ or "").split("\n")[0] in " ".join(said.split())
    for explained, name in flags_of(function):
        sentence = inspect.cleandoc(explained.__doc__ or "").partition(f"\n    {name}: ")[2].split()[:3]
        assert len(sentence) == 3, f"{verb}: no sentence about {name}"
        assert " ".join(sentence) in " ".join(said.replace("│", " ").split())


def test_the_program_alone_prints_its_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([])
    assert ended.value.code == 0
    assert "The learning loop of autonomous driving" in capsys.readouterr().out


def test_help_has_no_line_breaks_of_the_source() -> None:
    """The parser joins the lines of a paragraph, but not before a dash, and not those of an argument."""
    documented = """Do it.

    With the flag
    --more it does more.

    Args:
        first: It is long and needs
            two lines.
        second: Short.
    """
    joined = ["Do it.", "", "With the flag --more it does more.", "", "Args:"]
    arguments = ["    first: It is long and needs two lines.", "    second: Short."]
    assert program._reflowed(documented).splitlines() == [*joined, *arguments]


def test_options_are_those_of_the_release() -> None:
    """A script of someone else breaks when an option goes: `options.yaml` changes on purpose, by hand."""
    options = {
        verb: [written(owner.__annotations__[name], name) for owner, name in flags_of(function)]
        for verb, function in program.VERBS.items()
    }
    assert options == yaml.safe_load(OPTIONS.read_text())


def written(kind: Any, name: str) -> str:
    """Name of an argument on the command line."""
    named = [mark.name for mark in getattr(kind, "__metadata__", ()) if getattr(mark, "name", None)]
    return (named or [name.replace("_", "-")])[0]


def flags_of(verb: Any) -> Iterator[tuple[Any, str]]:
    """A verb's flags, those of its groups too, and whose docstring explains each."""
    for name, kind in verb.__annotations__.items():
        group = get_args(kind)[0] if get_args(kind) else kind
        if dataclasses.is_dataclass(group):
            yield from flags_of(group)
        elif name != "return":
            yield verb, name
