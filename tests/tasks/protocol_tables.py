"""Tables of docs/tasks.md: what the same synthetic predictions score under each protocol.

    PYTHONPATH=src:tests python tests/tasks/protocol_tables.py

prints them. A test compares them with the page.
"""

import dataclasses

import numpy as np
from tasks.map_scenes import random_maps
from tasks.motion_scenes import random_predictions, random_truth

from foredrive.tasks.maps.precision import mean_precision, score_maps
from foredrive.tasks.maps.protocols import PROTOCOLS as MAP_PROTOCOLS
from foredrive.tasks.motion.moving import MovingScores, score_moving
from foredrive.tasks.motion.protocols import PROTOCOLS as MOTION_PROTOCOLS
from foredrive.tasks.motion.scores import MotionScores, score_motion

FRAMES, FRAMES_OF_DRIVE = 60, 10


def motion_rows() -> list[str]:
    """Rows of the table of motion forecasts."""
    rng = np.random.default_rng(0)
    true = random_truth(rng, frames=FRAMES)
    predicted = random_predictions(rng, true, apart_m=0.5, drift_m=0.15)
    rows = []
    for protocol in MOTION_PROTOCOLS.values():
        for kind, score in score_motion(predicted, true, protocol).items():
            errors = f"{_of(score)} | {score.epa:.3f}"
            rows.append(f"| {protocol.title} | {kind} | {score.agents} | {score.matched} | {errors} |")
    moving = score_moving(predicted, true)["all"]
    rows.append(f"| MFEval, moving | car, bus, truck | {moving.agents} | | {_of(moving)} | |")
    return rows


def _of(score: MotionScores | MovingScores) -> str:
    return f"{score.min_ade_m:.3f} | {score.min_fde_m:.3f} | {score.miss_rate:.3f}"


def map_rows() -> list[str]:
    """Rows of the tables of vector maps: by protocol, and by the number of points."""
    predicted, true = random_maps(np.random.default_rng(0), frames=FRAMES, lost=0.05)
    drive = np.arange(FRAMES) // FRAMES_OF_DRIVE
    protocols = list(MAP_PROTOCOLS.values())
    plain = MAP_PROTOCOLS["streammapnet"]
    protocols += [
        dataclasses.replace(plain, title=f"{points} points, no buffers", points=points)
        for points in (20, 100)
    ]
    rows = []
    for protocol in protocols:
        figures = []
        for area in ("60x30", "100x50"):
            scores = score_maps(predicted, true, protocol, area, drive=drive)
            at = np.mean([score.ap_at for score in scores.values()], axis=0)
            figures.append(
                f"{at[0]:.3f} | {at[1]:.3f} | {at[2]:.3f} | {mean_precision(scores, protocol):.3f}"
            )
        rows.append(f"| {protocol.title} | {figures[0]} | {figures[1].rsplit(' ', 1)[1]} |")
    return rows


if __name__ == "__main__":
    print("\n".join([*motion_rows(), "", *map_rows()]))
