"""Tables of docs/tasks.md: what the same synthetic predictions score under each protocol.

    PYTHONPATH=src:tests python tests/tasks/protocol_tables.py

prints them. A test compares them with the page.
"""

import numpy as np
from tasks.map_scenes import random_maps
from tasks.motion_scenes import random_predictions, random_truth

from foredrive.tasks.maps.precision import mean_precision, score_maps
from foredrive.tasks.maps.protocols import PROTOCOLS as MAP_PROTOCOLS
from foredrive.tasks.motion.protocols import PROTOCOLS as MOTION_PROTOCOLS
from foredrive.tasks.motion.scores import score_motion

FRAMES, FRAMES_OF_DRIVE = 60, 10


def motion_rows() -> list[str]:
    """Rows of the table of motion forecasts, of cars."""
    rng = np.random.default_rng(0)
    true = random_truth(rng, frames=FRAMES)
    predicted = random_predictions(rng, true, apart_m=0.5, drift_m=0.15)
    rows = []
    for protocol in MOTION_PROTOCOLS.values():
        score = score_motion(predicted, true, protocol)["car"]
        errors = f"{score.min_ade_m:.3f} | {score.min_fde_m:.3f} | {score.miss_rate:.3f} | {score.epa:.3f}"
        rows.append(f"| {protocol.title} | {score.matched} | {errors} |")
    return rows


def map_rows() -> list[str]:
    """Rows of the table of vector maps."""
    predicted, true = random_maps(np.random.default_rng(0), frames=FRAMES, lost=0.05)
    drive = np.arange(FRAMES) // FRAMES_OF_DRIVE
    rows = []
    for protocol in MAP_PROTOCOLS.values():
        figures = [
            f"{mean_precision(score_maps(predicted, true, protocol, area, drive=drive), protocol):.3f}"
            for area in ("60x30", "100x50")
        ]
        rows.append(f"| {protocol.title} | {' | '.join(figures)} |")
    return rows


if __name__ == "__main__":
    print("\n".join([*motion_rows(), "", *map_rows()]))
