"""Every figure of an evaluation, as it was when it was last looked at: a changed key or formula shows.

After a change that is meant to change them, write them anew and look at the difference:

    FOREDRIVE_WRITE_GOLDEN=1 .venv/bin/python -m pytest tests/tasks/evaluation/test_golden_summary.py
"""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from foredrive.methods.planner.baselines import ConstantVelocity, StandStill
from foredrive.scene import Clip, Example, Trajectory
from foredrive.tasks.evaluation.run import evaluate
from foredrive.tasks.occupancy.scores import OccupancyPrior
from foredrive.tasks.predictor import Prediction

GOLDEN = Path(__file__).with_name("golden_summary.json")
FRAMES, FUTURES = 3, 4
MEASURED = ("wall_s", "peak_rss_gib")


class Guess:
    """Says something arbitrary of everything, the same of the same clip."""

    def predict(self, observed: Clip, asked: object) -> Prediction:
        b, (z, y, x) = len(observed.t_s), (4, 8, 8)
        seeds = (1000 * observed.ego_speed_mps[:, observed.now]).long().tolist()

        def drawn(*shape: int) -> torch.Tensor:
            return torch.stack(
                [torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
            )

        steps = drawn(1, 6, 2).abs().cumsum(dim=2)
        return Prediction(
            occupancy_logit=drawn(FRAMES, z, y, x),
            plan=Trajectory(
                xy=3.0 * steps,
                yaw=0.1 * drawn(1, 6),
                valid=torch.ones(b, 1, 6, dtype=torch.bool),
                log_prob=torch.zeros(b, 1),
                dt_s=0.5,
            ),
            flow_mps=drawn(FRAMES, 3, z, y, x),
            futures=drawn(FUTURES, FRAMES - 1, z, y, x) > 0.5,
            images=drawn(2, 2, 3, 8, 12).sigmoid(),
            image_stride=2,
        )


def test_every_figure_is_what_it_was(make_example: Callable[..., Example]) -> None:
    training = make_example(*range(10, 14))
    prior = OccupancyPrior(FRAMES, training.occupancy.spec)
    now = training.clip.now
    prior.add(training.occupancy[:, now : now + FRAMES])
    baselines = {"stand_still": StandStill(6, 0.5), "constant_velocity": ConstantVelocity(6, 0.5)}
    summary = evaluate(
        Guess(), [make_example(0, 1), make_example(2)], frame_dt_s=0.5, baselines=baselines, prior=prior,
        command_source={"route": 2, "none": 1},
    ).summary  # fmt: skip
    found = {key: value for key, value in summary.items() if key not in MEASURED}
    if os.environ.get("FOREDRIVE_WRITE_GOLDEN"):
        GOLDEN.write_text(json.dumps(found, indent=1) + "\n")
    golden = json.loads(GOLDEN.read_text())
    assert list(found) == list(golden)
    for key, value in found.items():
        assert value == (
            golden[key] if isinstance(value, str) else pytest.approx(golden[key], rel=1e-5, nan_ok=True)
        ), key
