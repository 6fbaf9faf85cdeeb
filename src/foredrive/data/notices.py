"""Notices of a conversion: parts of a raw log that were left out, and values that were assumed.

A converter calls `note`. The conversion collects the notices (`collecting`) and stores them in the folder of
the log, in `notices.json`, from which `foredrive convert` and `foredrive check` read them (`read_notices`).
Outside of a conversion, notices are logged as warnings.
"""

import contextlib
import contextvars
import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from foredrive.errors import InputError

FILE = "notices.json"
EXAMPLES = 3
"""Maximum number of single places that a notice names."""
_log = logging.getLogger(__name__)


@dataclass
class _Notices:
    """Places and their number by subject and text, in the order of their first occurrence."""

    count: dict[tuple[str, str], int] = field(default_factory=dict)
    places: dict[tuple[str, str], list[str]] = field(default_factory=dict)
    once: set[tuple[str, str, str]] = field(default_factory=set)
    """Subject, text and place of what does not count again."""

    def lines(self) -> list[str]:
        """Return one line for each subject and text."""
        return [_line(*key, self.places[key], number) for key, number in self.count.items()]


_collected: contextvars.ContextVar[_Notices | None] = contextvars.ContextVar("notices", default=None)


def note(subject: str, text: str, place: str = "", *, once: bool = False) -> None:
    """Add a notice to those of the current conversion.

    Args:
        subject: topic, camera, file or kind of data that the notice is about.
        text: what happened. With places it is a plural noun, such as "unreadable messages, left out".
        place: where it happened once. Notices of equal subject and text are counted, and a few places named.
        once: do not count the place again, as in a second pass over a file.
    """
    notices = _collected.get()
    if notices is None:
        _log.warning("%s", _line(subject, text, [place] if place else [], 1))
        return
    key = (subject, text)
    if once:
        if (*key, place) in notices.once:
            return
        notices.once.add((*key, place))
    notices.count[key] = notices.count.get(key, 0) + 1
    places = notices.places.setdefault(key, [])
    if place and len(places) < EXAMPLES:
        places.append(place)


@contextlib.contextmanager
def collecting() -> Iterator[None]:
    """Collect the notices of a block, for `write_notices`."""
    token = _collected.set(_Notices())
    try:
        yield
    finally:
        _collected.reset(token)


def write_notices(folder: Path) -> None:
    """Write the notices collected so far into the folder of a log. Without any there is no file."""
    notices = _collected.get()
    if notices is not None and notices.count:
        (folder / FILE).write_text(json.dumps(notices.lines(), indent=1, ensure_ascii=False) + "\n")


def read_notices(folder: Path) -> list[str]:
    """Return the notices of a log's conversion, one line each; none for a log without them.

    Raises:
        InputError: the file is damaged.
    """
    file = folder / FILE
    if not file.is_file():
        return []
    try:
        lines = json.loads(file.read_bytes())
    except (ValueError, OSError, RecursionError) as error:
        raise InputError(f"{file}: cannot be read: {error}") from error
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise InputError(f"{file}: not a list of lines")
    return lines


def _line(subject: str, text: str, places: list[str], number: int) -> str:
    if not places:
        return f"{subject}: {text}"
    more = [f"{number - len(places)} more"] if number > len(places) else []
    return f"{subject}: {text}: {number} ({'; '.join([*places, *more])})"
