"""The commands that README shows are ones the program takes."""

import functools
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest

from foredrive.cli import main as program

README = Path(__file__).parents[2] / "README.md"
COMMANDS = re.findall(r"^foredrive (.+?)(?:\s+#.*)?$", README.read_text(), flags=re.MULTILINE)


def test_there_are_commands() -> None:
    assert {"convert", "view", "record", "train", "evaluate"} <= {line.split()[0] for line in COMMANDS}


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
    verb, then = shlex.split(command)[:2]
    assert called == [f"{verb} {then}" if f"{verb} {then}" in program.VERBS else verb]
