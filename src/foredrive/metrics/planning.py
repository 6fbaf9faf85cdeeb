"""Open-loop planning scores: distance to the driven path and collisions, under a protocol."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.errors import InputError
from foredrive.metrics.footprint import grid_hits, path_headings, polygon_hits
from foredrive.metrics.obstacles import Obstacles
from foredrive.metrics.protocols import HORIZON_STEPS, STEP_S, STEPS, PlanningProtocol
from foredrive.scene import Boxes, Trajectory
from foredrive.scene.record import Record


@dataclass(frozen=True)
class PlanScores(Record):
    """Scores of b plans at 1, 2 and 3 s (H = 3), and masks of those that enter a mean.

    Where a mask is False the values are 0.
    """

    l2_m: Float[Tensor, "b H"]
    """Distance between plan_complete and driven rear axle."""
    collision: Float[Tensor, "b H"]
    """Share of steps (as the protocol has it) at which the ego box touches an obstacle ("obj_box_col")."""
    collision_centre: Float[Tensor, "b H"]
    """The same for the path's point alone ("obj_col")."""
    driven_collision: Float[Tensor, "b H"]
    """The same for the box of the driven vehicle: boxes and paths are not exact."""
    plan_complete: Bool[Tensor, "b"]
    """True if the plan has all its steps, finite. Otherwise it is a failure, not a score."""
    future_complete: Bool[Tensor, "b"]
    """Whether the driven future has all its steps."""
    counted: Bool[Tensor, "b"]
    """Whether the protocol counts the frame."""
    collision_counted: Bool[Tensor, "b"]
    """True if its collisions count too: boxes are annotated at now and at every driven step."""


def score_plan(
    plan: Trajectory, driven: Trajectory, obstacles: Obstacles, protocol: PlanningProtocol
) -> PlanScores:
    """Score plans [b 1 T] against driven futures [b 1 T] under one protocol.

    Args:
        plan: its first six steps of 0.5 s are scored. Its headings (and those of the driven future) place the
            point ahead of the rear axle that some protocols follow.
        driven: rear-axle path, invalid where the log ends.
        obstacles: boxes at the six steps, see `future_obstacles`.
    """
    plan_xy, plan_yaw, plan_valid = _first_steps(plan, "plan")
    driven_xy, driven_yaw, driven_valid = _first_steps(driven, "driven future")
    if obstacles.annotated.shape[1] != STEPS:
        raise InputError(f"expected obstacles at {STEPS} steps, got {obstacles.annotated.shape[1]}")
    plan_complete = (plan_valid & plan_xy.isfinite().all(dim=-1) & plan_yaw.isfinite()).all(dim=-1)
    future_complete = driven_valid.all(dim=-1)
    counted = plan_complete if protocol.frames == "all" else plan_complete & future_complete

    distance_m = torch.where(driven_valid, (plan_xy - driven_xy).norm(dim=-1), 0.0)
    boxes = _relevant_boxes(obstacles, protocol)
    known = driven_valid & obstacles.annotated
    driven_box, _ = _hits(driven_xy, driven_yaw, boxes, protocol)
    plan_box, plan_point = _hits(plan_xy.nan_to_num(), plan_yaw.nan_to_num(), boxes, protocol)
    scored = known & ~driven_box
    collision_counted = counted & obstacles.annotated_now & (obstacles.annotated | ~driven_valid).all(dim=-1)

    def masked(values: Tensor, mask: Tensor) -> Tensor:
        return torch.where(mask[:, None], values, torch.zeros_like(values))

    return PlanScores(
        l2_m=masked(_at_horizons(distance_m, protocol.l2), counted),
        collision=masked(_at_horizons(plan_box & scored, protocol.collision), collision_counted),
        collision_centre=masked(_at_horizons(plan_point & scored, protocol.collision), collision_counted),
        driven_collision=masked(_at_horizons(driven_box & known, protocol.collision), collision_counted),
        plan_complete=plan_complete,
        future_complete=future_complete,
        counted=counted,
        collision_counted=collision_counted,
    )


def _first_steps(path: Trajectory, what: str) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions [b 6 2], headings [b 6] and validity [b 6] of a single trajectory, in float64."""
    if path.xy.dim() != 4 or path.xy.shape[1] != 1 or path.xy.shape[2] < STEPS:
        raise InputError(f"the {what} must be [b 1 T≥{STEPS} 2], got {tuple(path.xy.shape)}")
    if abs(path.dt_s - STEP_S) > 1e-6:
        raise InputError(f"open-loop protocols score steps of {STEP_S} s, the {what} has {path.dt_s} s")
    return path.xy[:, 0, :STEPS].double(), path.yaw[:, 0, :STEPS].double(), path.valid[:, 0, :STEPS]


def _relevant_boxes(obstacles: Obstacles, protocol: PlanningProtocol) -> Boxes:
    """Return the boxes that the protocol counts, relative to the point that it follows."""
    boxes = obstacles.boxes
    seen = {
        "anytime": torch.ones_like(boxes.valid),
        "observed": obstacles.tracked_lately,
        "now": obstacles.tracked_now,
    }[protocol.known]
    wanted = torch.tensor(sorted(protocol.categories), device=boxes.category.device)
    ahead = torch.tensor([protocol.point_forward_m, 0.0, 0.0]).to(boxes.centre)
    return dataclasses.replace(
        boxes, centre=boxes.centre - ahead, valid=boxes.valid & seen & torch.isin(boxes.category, wanted)
    )


def _hits(xy: Tensor, yaw: Tensor, boxes: Boxes, protocol: PlanningProtocol) -> tuple[Tensor, Tensor]:
    """Return whether box and point of a vehicle on a rear-axle path [b T 2] touch a box, both [b T]."""
    lever = torch.stack([yaw.cos() - 1, yaw.sin()], dim=-1)
    path = xy + protocol.point_forward_m * lever
    heading = path_headings(path, protocol.heading)
    if protocol.grid is None:
        return polygon_hits(path, heading, boxes, protocol)
    return grid_hits(path, heading, boxes, protocol, protocol.grid)


def _at_horizons(per_step: Tensor, how: str) -> Float[Tensor, "b H"]:
    """Reduce values of six steps [b 6] to 1, 2 and 3 s."""
    values = per_step.float()
    if how == "mean":
        values = values.cumsum(dim=-1) / torch.arange(1, STEPS + 1, device=values.device)
    elif how == "any":
        values = values.cummax(dim=-1).values
    return values[:, list(HORIZON_STEPS)]
