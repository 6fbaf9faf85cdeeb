"""The EPDMS of a plan, and the two-stage aggregation of pseudo-simulation."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from foredrive.driving.epdms import comfort, subscores
from foredrive.driving.epdms.world import EgoBody, EgoMotion, Roads, Surroundings
from foredrive.errors import InputError

MULTIPLIERS = ("nc", "dac", "ddc", "tlc")
WEIGHTS = {"ep": 5.0, "ttc": 5.0, "lk": 2.0, "hc": 2.0, "ec": 2.0}
FORGIVEN = (*MULTIPLIERS, "ttc", "lk")
"""Sub-scores in which a plan may be as bad as the human driver."""
SIGMA2_M2 = 0.1
"""Variance of the kernel by which a follow-up scene counts, m²."""


@dataclass(frozen=True)
class DriverScores:
    """Sub-scores of one plan, each from 0 to 1."""

    nc: float
    """No at-fault collision."""
    dac: float
    """Drivable area compliance."""
    ddc: float
    """Driving direction compliance."""
    tlc: float
    """Traffic light compliance."""
    ep: float
    """Ego progress."""
    ttc: float
    """Time to collision within bound."""
    lk: float
    """Lane keeping."""
    hc: float
    """History comfort."""
    ec: float | None = None
    """Extended comfort. None until a plan 0.5 s earlier is known; then it has no weight."""

    @property
    def multiplied(self) -> float:
        """Return the product of the multipliers."""
        return math.prod(getattr(self, name) for name in MULTIPLIERS)

    @property
    def epdms(self) -> float:
        """Return the score: the multipliers times the weighted mean of the others."""
        # Without extended comfort the weights of the others are normalised
        weights = {name: weight for name, weight in WEIGHTS.items() if getattr(self, name) is not None}
        mean = sum(weight * getattr(self, name) for name, weight in weights.items()) / sum(weights.values())
        return self.multiplied * mean

    def forgiven(self, human: "DriverScores") -> "DriverScores":
        """Return the scores with 1 where the human driver has 0: a rule that the human breaks is not asked.

        EP and HC stay. The devkit scores the human driver without a reference and without a past, so that
        there both are always 1. EC is not among the scores that it compares.
        """
        # Only a complete failure of the human forgives
        changed = {name: 1.0 for name in FORGIVEN if getattr(human, name) == 0.0}
        return dataclasses.replace(self, **changed)


def score_plan(
    ego: EgoMotion,
    past: EgoMotion,
    others: Surroundings,
    roads: Roads,
    reference_m: float,
    body: EgoBody | None = None,
) -> DriverScores:
    """Score a simulated plan. Its extended comfort is not known yet.

    Args:
        ego: the vehicle while it follows the plan.
        past: the vehicle before.
        others: road users at the steps of `ego`.
        reference_m: progress of a reference planner, times the product of its multipliers, m.
        body: outline of the vehicle; None: nuPlan's.

    Raises:
        InputError: the road users are given at fewer steps than the vehicle.
    """
    body = body or EgoBody()
    if len(others.centre_m) < len(ego.yaw_rad):
        raise InputError(
            f"{len(ego.yaw_rad)} steps are scored, but the road users have {len(others.centre_m)}"
        )
    areas = subscores.ego_areas(ego, body, roads)
    multipliers = {
        "nc": subscores.no_at_fault_collision(ego, body, areas, others),
        "dac": subscores.drivable_area_compliance(areas),
        "ddc": subscores.driving_direction_compliance(ego, body, areas, roads),
        "tlc": subscores.traffic_light_compliance(ego, body, others),
    }
    driven_m = subscores.progress_m(ego, body, roads)
    return DriverScores(
        **multipliers,
        ep=subscores.ego_progress(driven_m, math.prod(multipliers.values()), reference_m),
        ttc=subscores.time_to_collision(ego, body, areas, roads, others),
        lk=subscores.lane_keeping(ego, body, roads),
        hc=comfort.history_comfort(past, ego, body),
    )


def follow_up_weights(
    end_m: Float64[np.ndarray, "2"], starts_m: Float64[np.ndarray, "N 2"]
) -> Float64[np.ndarray, "N"]:
    """Return the share of each follow-up scene, by how near it starts to where the first plan ends.

    If the plan ends far from all of them, they count equally, as in the devkit.
    """
    # Gaussian kernel of the distance between the plan's end and each start
    weights = np.exp(-((starts_m - end_m) ** 2).sum(axis=1) / (2 * SIGMA2_M2))
    total = float(weights.sum())
    if np.isclose(total, 0.0):
        return np.full(len(starts_m), 1.0 / len(starts_m))
    return np.asarray(weights / total)


def two_stage_score(
    first: float,
    end_m: Float64[np.ndarray, "2"],
    starts_m: Float64[np.ndarray, "N 2"],
    second: Sequence[float],
) -> float:
    """Return the score of the first stage times the weighted mean of those of the second.

    Args:
        first: EPDMS of the plan at the first scene.
        end_m: last point of that plan, world frame.
        starts_m: starts of the follow-up scenes.
        second: their EPDMS.

    Raises:
        InputError: there is no follow-up scene, or not one score for each.
    """
    if not len(starts_m) or len(starts_m) != len(second):
        raise InputError(f"{len(starts_m)} follow-up scenes need as many scores, got {len(second)}")
    return first * float(follow_up_weights(end_m, starts_m) @ np.asarray(second))
