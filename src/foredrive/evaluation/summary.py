"""Figures on disk and on the screen."""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path

from foredrive.errors import InputError
from foredrive.files import atomic_path

Value = float | int | str | None
_BASELINE = re.compile(r"occupancy\.iou_\w+\.(\w+)")


def write_json(path: Path, content: object) -> None:
    """Write JSON whole or not at all; NaN and infinity, which JSON does not have, become null."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def write_summary(path: Path, summary: Mapping[str, Value]) -> None:
    """Write a flat summary (dotted keys) as JSON, keys in their given order."""
    write_json(path, dict(summary))


def read_summary(path: Path) -> dict[str, Value]:
    """Read what `write_summary` wrote."""
    try:
        summary = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a summary that can be read") from error
    if not isinstance(summary, dict):
        raise InputError(f"{path}: not a summary: expected a JSON object")
    return summary


def _finite(value: object) -> object:
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def occupancy_baselines(summary: Mapping[str, Value]) -> dict[str, str]:
    """Return the keys and titles of all that is judged by the IoU of occupancy beside the model.

    They are the occupancy prior, persistence, ego-compensated persistence and sampled futures.
    """
    found = [match[1] for key in summary if (match := _BASELINE.fullmatch(key))]
    return {name: name.replace("_", " ") for name in dict.fromkeys(found) if "threshold" not in name}
