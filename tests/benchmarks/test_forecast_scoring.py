"""The scenes of the benchmark of motion are of the size that it states, and not trivial."""

import numpy as np

from benchmarks.common.forecast_scoring import AGENTS, BOXES, scene
from foredrive.tasks.motion.protocols import PROTOCOLS
from foredrive.tasks.motion.scores import score_motion


def test_scenes_have_their_boxes_and_are_partly_found() -> None:
    predicted, true = scene(np.random.default_rng(0), 20)
    assert np.bincount(predicted.frame).tolist() == [BOXES] * 20
    assert len(true.frame) == 20 * AGENTS
    scores = score_motion(predicted, true, PROTOCOLS["uniad"])["car"]
    assert 0.3 < scores.matched / scores.agents < 1.0
    assert scores.predictions > 1.2 * scores.matched
    assert scores.min_ade_m < 2.0
