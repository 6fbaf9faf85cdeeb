"""Help of every verb."""

import dataclasses
import inspect
from collections.abc import Iterator
from typing import Any, get_args

import pytest

from foredrive.cli import main as program
from foredrive.cli.main import main


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


def flags_of(verb: Any) -> Iterator[tuple[Any, str]]:
    """A verb's flags, those of its groups too, and whose docstring explains each."""
    for name, kind in verb.__annotations__.items():
        group = get_args(kind)[0] if get_args(kind) else kind
        if dataclasses.is_dataclass(group):
            yield from flags_of(group)
        elif name != "return":
            yield verb, name
