"""Fit of a driver's planner: the rule on true perception teaches it, without images and with what is seen."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.data.batches import stack_records
from foredrive.data.truth.affordances import PathAhead
from foredrive.driver.agent import Driver
from foredrive.driver.packed import BATCH, PackedClips, join
from foredrive.driver.speed_planner import chosen_labels, profile_numbers, profile_progress
from foredrive.driving.observation import HORIZON_STEPS
from foredrive.driving.speed_rule import FRONT_M, Obstacle, PathView, curve_speed, rule_progress
from foredrive.engine.in_memory_fit import FitSchedule, fit_in_memory
from foredrive.errors import InputError
from foredrive.methods.planner.ego_mlp import ego_speeds
from foredrive.scene.affordances import Affordances, PathEstimate
from foredrive.scene.traffic_light import LightState

FASTEST_MPS = 9.0
ROWS = 512
"""Rows whose numbers are computed together."""


@dataclass(frozen=True)
class PlanFit(FitSchedule):
    """Fit of the planner to the rule, on the truth of the training clips and on what the eyes see of them."""

    steps: int = 6000
    batch_size: int = 256
    lr: float = 2e-3
    weight_decay: float = 1e-3
    speeds: int = 3
    """Speeds at which each clip is driven: its own and random ones."""
    clips: int = 6000
    """Most clips that are used."""
    seen_share: float = 0.5
    """Share of the rows in which the planner reads what the eyes see, in place of the truth."""


def true_estimate(truth: Affordances) -> PathEstimate:
    """Return the truth as an estimate. Unknown lights and unknown cells count as absent."""
    none = torch.full_like(truth.light, int(LightState.NONE))
    light = torch.where(truth.light_known, truth.light, none).long()
    return PathEstimate(torch.eye(4)[light], truth.light_m, (truth.occupied & truth.occupied_known).float())


def rule_of(truth: Affordances, speed_mps: float) -> tuple[Float[np.ndarray, "S"], float]:
    """Return the progress by the rule on the truth at a speed, and the highest speed of the path.

    Args:
        truth: unbatched.
        speed_mps: m/s.
    """
    count = len(truth.path_xy)
    path = PathAhead(truth.path_xy, np.zeros(count), truth.path_valid, FRONT_M, True)
    lead = None
    if bool(truth.lead & truth.lead_known):
        # A lead vehicle without a velocity counts as standing
        lead_mps = float(truth.lead_mps)
        lead = Obstacle(float(truth.lead_m), max(lead_mps, 0.0) if np.isfinite(lead_mps) else 0.0)
    light = LightState(int(truth.light)) if bool(truth.light_known) else LightState.NONE
    occupied = (truth.occupied & truth.occupied_known).numpy()
    progress_m = rule_progress(path, speed_mps, PathView(light, float(truth.light_m), lead, occupied))
    return progress_m, curve_speed(path)


def fit_planner(
    driver: Driver, clips: PackedClips, fit: PlanFit, seed: int, tick: Callable[[], None] = lambda: None
) -> None:
    """Fit the planner of a driver whose eyes are trained.

    Args:
        driver: in evaluation mode; its planner is changed.
        clips: of training.
        fit: schedule.
        seed: seed of the choice of clips and speeds.
        tick: called after each batch of clips that is seen.

    Raises:
        InputError: no clip has a route.
    """
    draws = np.random.default_rng(seed)
    # A random part of the clips
    chosen = draws.permutation(len(clips))[: fit.clips]
    truths: list[PathEstimate] = []
    seen: list[PathEstimate] = []
    speeds: list[float] = []
    limits: list[float] = []
    labels: list[Float[np.ndarray, S]] = []
    for start in range(0, len(chosen), BATCH):
        batch = join([clips[int(index)] for index in chosen[start : start + BATCH]])
        truth, own = true_estimate(batch.truth), ego_speeds(batch.clip)[:, batch.clip.now]
        sight = driver.see(batch.clip).estimate() if fit.seen_share > 0 else truth
        for row in range(len(own)):
            # A path needs two points
            if int(batch.truth.path_valid[row].sum()) < 2:
                continue
            # The clip's own speed and random ones: states that the log does not have
            others = draws.uniform(0.0, FASTEST_MPS, fit.speeds - 1).tolist()
            for speed_mps in (float(own[row]), *others):
                progress_by_rule_m, limit_mps = rule_of(batch.truth[row], speed_mps)
                truths.append(truth[row])
                seen.append(sight[row])
                speeds.append(speed_mps)
                limits.append(limit_mps)
                labels.append(progress_by_rule_m)
        tick()
    if not labels:
        raise InputError("no clip has a route: a planner of speeds has nothing to learn from")
    speed, limit = torch.tensor(speeds), torch.tensor(limits)
    # Numbers of the planner by truth and by sight, computed in parts to bound the memory
    both = {
        by_sight: torch.cat(
            [
                profile_numbers(stack_records(views[k : k + ROWS]), speed[k : k + ROWS], limit[k : k + ROWS])
                for k in range(0, len(views), ROWS)
            ]
        )
        for by_sight, views in ((False, truths), (True, seen))
    }
    rule_m = torch.from_numpy(np.stack(labels)).float()
    progress_m = profile_progress(speed, limit, HORIZON_STEPS)
    # Soft labels by the distance of each profile from the rule
    target = chosen_labels(progress_m, rule_m)
    generator = torch.Generator().manual_seed(seed)

    def loss(rows: Tensor) -> Tensor:
        # One source of perception for the whole batch
        by_sight = bool(torch.rand((), generator=generator) < fit.seen_share)
        logits = driver.planner.logits(both[by_sight][rows])
        return -(target[rows] * logits.log_softmax(-1)).sum(-1).mean()

    fit_in_memory(driver.planner, len(rule_m), loss, fit, seed)
