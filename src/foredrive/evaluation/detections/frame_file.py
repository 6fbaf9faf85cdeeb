"""Scores of frames as a file that an index reads (`search.scores`)."""

import json
import math
from collections.abc import Iterable
from pathlib import Path

from foredrive.evaluation.detections.score import FrameScore
from foredrive.files import atomic_path


def write_frame_scores(path: Path, scores: Iterable[FrameScore]) -> None:
    """Write one JSON object a line: a frame's name as in the results, its NLL and the NLL's parts, in nats.

    Infinity, which JSON lacks, is written as text ("inf").
    """
    with atomic_path(path) as temporary, temporary.open("w") as file:
        for score in scores:
            parts = {"nll": score.nll, **score.parts}
            scores = {name: value if math.isfinite(value) else str(value) for name, value in parts.items()}
            file.write(json.dumps({"frame": score.name, **scores}) + "\n")
