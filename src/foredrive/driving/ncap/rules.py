"""Rules of a safety test: everything in which the paper, the released code and we differ.

docs/safety-tests.md compares them field by field. Sources: Ljungbergh et al., "NeuroNCAP: Photorealistic
Closed-loop Safety Testing for Autonomous Driving", ECCV 2024 (the paper), and the public repository
atonderski/neuro-ncap at ecdcf28 (the released code). `PAPER` has the values of the released code, except
where that code does not do what it intends: `reference`, `pose_feedback`, `unchecked_end_s`.
"""

import enum
import math
from dataclasses import dataclass
from typing import Literal

from foredrive.driving.collisions import EgoContact
from foredrive.driving.dynamics import EGO, Vehicle
from foredrive.driving.ncap.outcome import BEST, LEFT_WAY_SCORE
from foredrive.errors import InputError
from foredrive.scene import Category
from foredrive.scene.boxes import VEHICLES

PACIFICA = Vehicle(
    wheelbase_m=3.089,
    length_m=4.018,
    width_m=1.85,
    axle_to_centre_m=0.5,
    max_steering_rad=math.pi / 3,
    max_steering_radps=math.inf,
    max_acceleration_mps2=6.0,
    max_braking_mps2=6.0,
    max_jerk_mps3=math.inf,
)
"""Vehicle of the released code: it moves with the wheelbase of nuPlan's Chrysler Pacifica, and collides with
another, smaller box, whose middle is only 0.5 m in front of the rear axle."""


class Reference(enum.StrEnum):
    """How the reference speed of an impact is found. All are speeds relative to the target actor."""

    AFTER_4_S = "after_4_s"
    """The log's ego vehicle and the actor 4 s after the first key frame of the run: the paper's."""
    LOG_END = "log_end"
    """The log's last two key frames, and the actor after 4 s. The released code means `AFTER_4_S`, but the
    condition that should guard the log's end is inverted."""
    NO_ACTION = "no_action"
    """The impact of a vehicle that follows the log's path at constant speed in this very run."""


@dataclass(frozen=True)
class Rules:
    """Rules of a safety test.

    Raises:
        InputError: the step does not fit the controller.
    """

    name: str
    reference: Reference
    vehicle: Vehicle
    """Motion, limits, and the box that collides."""
    controller: Literal["lqr", "own"]
    """lqr: nuPlan's LQR tracker and kinematic bicycle (`nuplan_lqr`). own: `driving.controller`, which
    smooths the plan, and `driving.dynamics`, whose actuators lag."""
    step_s: float
    """Time between two commands of the controller, s."""
    pose_feedback: bool
    """Whether the controller knows how far the vehicle has come on the plan. The released code puts the
    vehicle back to the plan's origin at each command. The own controller always knows."""
    stops_below_m: float
    """A plan whose last point is nearer than this, m, means: stop."""
    latency_s: float
    """Time from an observation until the plan made from it takes effect, s."""
    categories: frozenset[Category]
    """Actors that count in collisions."""
    struck_counts: bool
    """Whether an impact counts if the actor comes from behind the ego vehicle."""
    moving_stay: bool
    """The moving actors of the log outside the scenario take part. Parked vehicles always are."""
    unchecked_end_s: float
    """Time at the end of a run in which collisions are not looked for, s."""
    left_way_score: float
    """Score of a run that leaves the way without a collision."""

    def __post_init__(self) -> None:
        if self.step_s != {"lqr": 0.1, "own": 0.05}[self.controller]:
            raise InputError(
                f"{self.name}: the controller {self.controller} has no step of {self.step_s:g} s"
            )

    @property
    def contact(self) -> EgoContact:
        """Return what counts as a collision."""
        return EgoContact(self.vehicle, self.categories, self.struck_counts)


RELEASED = Rules(
    name="released",
    reference=Reference.LOG_END,
    vehicle=PACIFICA,
    controller="lqr",
    step_s=0.1,
    pose_feedback=False,
    stops_below_m=1.0,
    latency_s=0.0,
    categories=VEHICLES,
    struck_counts=True,
    moving_stay=False,
    unchecked_end_s=0.5,
    left_way_score=BEST,
)
PAPER = Rules(
    name="paper",
    reference=Reference.AFTER_4_S,
    vehicle=PACIFICA,
    controller="lqr",
    step_s=0.1,
    pose_feedback=True,
    stops_below_m=1.0,
    latency_s=0.0,
    categories=VEHICLES,
    struck_counts=True,
    moving_stay=False,
    unchecked_end_s=0.0,
    left_way_score=BEST,
)
OURS = Rules(
    name="ours",
    reference=Reference.NO_ACTION,
    vehicle=EGO,
    controller="own",
    step_s=0.05,
    pose_feedback=True,
    stops_below_m=0.25,
    latency_s=0.1,
    categories=VEHICLES | {Category.PEDESTRIAN},
    struck_counts=False,
    moving_stay=True,
    unchecked_end_s=0.0,
    left_way_score=LEFT_WAY_SCORE,
)
RULES = {rules.name: rules for rules in (PAPER, RELEASED, OURS)}
