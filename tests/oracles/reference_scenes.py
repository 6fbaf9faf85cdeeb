"""Seeded data on which published evaluation code and our metrics are compared: see `reference_code.py`."""

from collections.abc import Mapping

import numpy as np
from tasks.map_scenes import random_maps
from tasks.motion_scenes import random_predictions, random_truth

from benchmarks.common.occupancy_scoring import frames, places
from foredrive.tasks.maps.lines import LineSet
from foredrive.tasks.occupancy.protocols import OCC3D_CLASSES

Arrays = dict[str, np.ndarray]
AGENT_FRAMES, MAP_FRAMES = 5, 8


def motion_scene(seed: int) -> Arrays:
    """Agents and predictions of `motion_scenes`, in centimetres, with scores that are all different."""
    rng = np.random.default_rng(seed)
    true = random_truth(rng, AGENT_FRAMES, agents=12)
    predicted = random_predictions(rng, true)
    scores = rng.permutation(len(predicted.score)) / len(predicted.score)
    sides = {"true": vars(true), "predicted": vars(predicted) | {"score": scores}}
    arrays = {f"{side}.{key}": value for side, fields in sides.items() for key, value in fields.items()}
    return {
        key: np.round(value, 2).astype(np.float32) if key.endswith("xy") else value
        for key, value in arrays.items()
        if key != "predicted.probability"
    }


def instance_scene(seed: int) -> Arrays:
    """Four samples of rectangles that move, found with an offset; some change their number, some overlap."""
    rng = np.random.default_rng(seed)
    true, predicted = np.zeros((2, 4, 5, 200, 200), np.uint8)
    for sample in range(4):
        for number in range(1, 26):
            low, size = rng.integers(50, 150, 2), rng.integers(4, 14, 2)
            move, off = rng.integers(-4, 5, 2), rng.integers(-2, 3, 2)
            seen, other = rng.random() < 0.85, number + 30
            for t in range(5):
                corner, (height, width) = low + t * move, size
                true[sample, t, corner[0] : corner[0] + height, corner[1] : corner[1] + width] = number
                name = other if rng.random() < 0.15 else number
                if seen and rng.random() < 0.95:
                    corner, height = corner + off, height + int(rng.integers(0, 2))
                    predicted[sample, t, corner[0] : corner[0] + height, corner[1] : corner[1] + width] = name
    return {"true": true, "predicted": predicted}


def raster_scene(seed: int) -> Arrays:
    """Six frames of the four layers: rectangles, and predictions that are moved and have holes."""
    rng = np.random.default_rng(seed)
    true, predicted = np.zeros((2, 6, 4, 60, 80), bool)
    for frame in range(6):
        for layer in range(4):
            for _ in range(int(rng.integers(0, 5))):
                (r, c), (height, width) = rng.integers(0, 50, 2), rng.integers(1, 20, 2)
                true[frame, layer, r : r + height, c : c + width] = True
                predicted[frame, layer, r + 1 : r + height, c : c + width + 1] = True
    return {"true": true, "predicted": predicted & (rng.random(predicted.shape) < 0.9)}


def map_scene(seed: int) -> Arrays:
    """Lines of `map_scenes`, in centimetres; no true line is a crossing, so that a class is absent.

    In each frame, a short divider is predicted 0.8 m beyond the true one, in its direction: near, but their
    buffers, which are cut off at the ends, do not meet.
    """
    predicted, true = random_maps(np.random.default_rng(seed), frames=MAP_FRAMES)
    true = _with_short(true[np.flatnonzero(true.kind != 1)], 0.0)
    predicted = _with_short(predicted, 0.8)
    arrays: Arrays = {}
    for side, lines in (("predicted", predicted), ("true", true)):
        points = np.round(np.concatenate(lines.lines), 2).astype(np.float32)
        sizes = np.array([len(line) for line in lines.lines])
        fields = {
            "frame": lines.frame,
            "kind": lines.kind,
            "score": lines.score,
            "points": points,
            "sizes": sizes,
        }
        arrays |= {f"{side}.{key}": value for key, value in fields.items()}
    return arrays


def _with_short(lines: LineSet, shift_m: float) -> LineSet:
    """The lines, and in each frame a divider of 0.3 m, 40 m ahead of all others."""
    short = np.array([[40.0 + shift_m, 0.0], [40.3 + shift_m, 0.0]])
    return LineSet(
        frame=np.concatenate([lines.frame, np.arange(MAP_FRAMES)]),
        kind=np.concatenate([lines.kind, np.zeros(MAP_FRAMES, int)]),
        lines=[*lines.lines, *[short] * MAP_FRAMES],
        score=np.concatenate([lines.score, 1 - 0.001 * np.arange(MAP_FRAMES)]),
    )


def line_set(arrays: Mapping[str, np.ndarray], side: str) -> LineSet:
    """The lines of one side of a `map_scene`."""
    points, sizes = arrays[f"{side}.points"].astype(np.float64), arrays[f"{side}.sizes"]
    lines = np.split(points, np.cumsum(sizes)[:-1])
    return LineSet(arrays[f"{side}.frame"], arrays[f"{side}.kind"], lines, arrays[f"{side}.score"])


def ray_scene(seed: int) -> Arrays:
    """Two frames of synthetic streets, each seen from two places."""
    rng = np.random.default_rng(seed)
    drawn = list(frames(rng, 2, OCC3D_CLASSES))
    origins = np.stack([places(rng)[[1, 5]] for _ in drawn])
    return {
        "true": np.stack([frame.true for frame in drawn]),
        "predicted": np.stack([frame.predicted for frame in drawn]),
        "origins_m": np.round(origins, 2),
    }
