"""Occupancy forecasts compared with persistence, in towns and on a real log.

`foredrive bench driveworld-forecast`, with the raw PandaSet log in FOREDRIVE_REAL_DATA/pandaset.
Pre-trainings are those of driveworld_ablation and nemo_ablation (common/world_models.py), with the whole
world model. In towns they forecast as they are, up to 2 s (NeMo: 1 s); on the real log they go on learning
from its first frames, for the rest of it, beside training from scratch.
"""

import dataclasses
from collections.abc import Callable

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.forecast import forecasting, judge_forecast
from benchmarks.common.study import JUDGED_EVERY_S, pandaset_log
from benchmarks.common.world_models import (
    DECIDED_BY,
    ROOT,
    config_of,
    of_the_study,
    pretrained,
    share_baselines,
    study_logs,
)
from foredrive.methods.recipe import rescheduled, with_occupancy_source
from foredrive.runs.train.run import train_run

DRIVEWORLD, CARRIED, NEMO = "driveworld_town", "driveworld_town_carried", "nemo_town"
NAMES = (DRIVEWORLD, CARRIED, NEMO)
LEARNED_S, STRIDE_S, REAL_STEPS = 3.95, 0.1, 100
"""End of the training part, s (the first 40 frames of a log at 10 Hz), time between nows, s (every frame),
and steps of training on it.
"""
FRAMES = 2
"""Number of imagined frames, 1 s: the log has 56 frames, and no clip of 2 s begins after the first 40."""
WHOLE_S = 1e6
CONFIG = config_of(DRIVEWORLD, NEMO) | {
    "learned_s": LEARNED_S,
    "stride_s": STRIDE_S,
    "real_steps": REAL_STEPS,
    "frames": FRAMES,
}
IDENTITY = study_identity(CONFIG, DECIDED_BY)


def in_towns(name: str) -> Callable[[int], dict[str, float]]:
    """Return an arm that evaluates a pre-trained world model on the drives of Town05."""

    def measure(seed: int) -> dict[str, float]:
        run = pretrained(of_the_study(name, seed, seed))
        share_baselines(run.recipe, run.recipe.clips.past_frames, run.folder)
        return judge_forecast(run, study_logs().test, (0.0, WHOLE_S), JUDGED_EVERY_S)

    return measure


def on_pandaset(name: str, *, transferred: bool) -> Callable[[int], dict[str, float]]:
    """Return an arm that trains a recipe's world model on the first frames of the real log, and tests on the
    rest.
    """

    def measure(seed: int) -> dict[str, float]:
        log, recipe = pandaset_log(ROOT / "pandaset"), of_the_study(name, seed, seed)
        start = pretrained(recipe).folder if transferred else None
        recipe = with_occupancy_source(recipe, "lidar")
        recipe = dataclasses.replace(recipe, finetune=rescheduled(recipe.finetune, steps=REAL_STEPS))
        learned = forecasting(recipe, (0.0, LEARNED_S), STRIDE_S, FRAMES)
        arm = f"{name}_{'pretrained' if transferred else 'scratch'}_seed{seed}"
        folder = ROOT / "driveworld_forecast" / IDENTITY / arm
        run = train_run(learned, [log], folder, folder.parent / "cache", start)
        return judge_forecast(run, [log], (LEARNED_S, WHOLE_S))

    return measure


BENCHMARK = Benchmark(
    question="Does DriveWorld foresee occupancy better than copies of the present do?",
    arms={f"towns_{name}": in_towns(name) for name in NAMES}
    | {
        f"pandaset_{name}_{'pretrained' if transferred else 'scratch'}": on_pandaset(
            name, transferred=transferred
        )
        for name in NAMES
        for transferred in (True, False)
    },
    config=CONFIG,
    decided_by=DECIDED_BY,
)
