"""Reading of per-frame detection scores (`foredrive.sets`) from a file."""

import json
from pathlib import Path

from foredrive.errors import InputError
from foredrive.search.rows import SCORES


def read_scores(path: Path) -> dict[str, dict[str, float]]:
    """Read scores by moment key and name, from a file with one JSON object per line.

    A line is {"frame": "SPLIT/NAME@T_US", "nll": 31.2, "missed": 4.0, …} with any of `rows.SCORES`. Frames
    have the same names as clips (`Example.key`).

    Raises:
        InputError: a line is not such an object.
    """
    scores: dict[str, dict[str, float]] = {}
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
            log, _, t_us = row["frame"].rpartition("@")
            scores[f"{log}@{int(t_us)}"] = {name: float(row[name]) for name in SCORES if name in row}
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(f"{path}: line {number} does not score a frame: {error}") from error
    return scores
