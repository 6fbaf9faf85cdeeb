"""Figures on disk and on the screen."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

from foredrive.errors import InputError
from foredrive.files import atomic_path, latest

Value = float | int | str | None
Summary = Mapping[str, Value]
"""Figures under flat dotted keys, as in summary.json; None where nothing could be counted."""
Figures = dict[str, Value]
"""A summary while it is put together."""


def write_json(path: Path, content: object, indent: int | None = 2) -> None:
    """Write JSON whole or not at all; NaN and infinity, which JSON does not have, become null."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(_finite(content), indent=indent, allow_nan=False) + "\n")


def write_summary(path: Path, summary: Summary) -> None:
    """Write a flat summary (dotted keys) as JSON, keys in their given order."""
    write_json(path, dict(summary))


def read_summary(path: Path) -> Figures:
    """Read what `write_summary` wrote."""
    try:
        summary = json.loads(latest(path).read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a summary that can be read") from error
    if not isinstance(summary, dict):
        raise InputError(f"{path}: not a summary: expected a JSON object")
    return summary


def numbers(summary: Summary) -> dict[str, float]:
    """Return the figures that are finite numbers; words, and what could not be counted, are left out."""
    return {
        key: float(value)
        for key, value in summary.items()
        if isinstance(value, float | int) and math.isfinite(value)
    }


def _finite(value: object) -> object:
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
