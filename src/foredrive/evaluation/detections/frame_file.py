"""Frames' scores as a file that an index takes (`search.scores`)."""

import json
import math
from collections.abc import Iterable
from pathlib import Path

from foredrive.evaluation.detections.score import FrameScore
from foredrive.files import atomic_path


def write_frame_scores(path: Path, scores: Iterable[FrameScore]) -> None:
    """One JSON object a line: the frame's name as the results have it, its NLL and the NLL's parts, in nats.

    What is not finite is written as a text ("inf"), which JSON has no number for.
    """
    with atomic_path(path) as temporary, temporary.open("w") as file:
        for score in scores:
            parts = {"nll": score.nll, **score.parts}
            told = {name: value if math.isfinite(value) else str(value) for name, value in parts.items()}
            file.write(json.dumps({"frame": score.name, **told}) + "\n")
