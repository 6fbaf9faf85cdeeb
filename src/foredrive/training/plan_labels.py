"""Exact sub-scores of plans, from the recorded futures, the map, the route and the light of a log.

The rules are those of NAVSIM's (E)PDMS (Dauner et al. 2024; Cao et al. 2025): road users follow their
recorded futures and do not react. Three things differ: steps are those of the plans (0.5 s, not 0.1 s), the
ego vehicle drives the plan itself, and progress is relative to the expert's.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.errors import InputError
from foredrive.geometry.path_frame import along_path
from foredrive.metrics.footprint import overlapping, rectangle
from foredrive.models.plan_vocabulary import Candidates, turn_rates
from foredrive.scene import Boxes, Example
from foredrive.scene.affordances import LATER_STEPS, Affordances
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.map_elements import MapRaster, RasterLayer
from foredrive.scene.traffic_light import LightState
from foredrive.training.joint_tasks import boxes_now

EGO_LENGTH_M, EGO_WIDTH_M, EGO_MIDDLE_M = 4.89, 1.84, 1.65
"""Size of the recording vehicle, and distance from its rear axle to its middle (CARLA's Lincoln MKZ)."""
NEAR_M = 60.0
"""Road users that are further away at now are left out."""
STANDS_MPS = 0.05
"""A standing vehicle is not at fault."""
TTC_S = (0.5, 1.0)
"""Times ahead at which a collision at constant velocity counts; NAVSIM looks 0.95 s ahead."""
MIN_PROGRESS_M = 1.0
"""Where the expert drives less, no plan lacks progress."""
LANE_M, LANE_STEPS = 0.5, 4
"""A plan leaves its lane if it is this far beside the route for this number of steps (2 s), as in EPDMS."""
LIGHT_MARGIN_M = 0.3
MAX_BRAKING, MAX_ACCELERATION, MAX_LATERAL, MAX_YAW_RATE = 4.05, 2.40, 4.89, 0.95
"""Bounds of nuPlan's comfort, m/s² and rad/s."""


class PlanLabels(NamedTuple):
    """Sub-scores of N plans, in the order of `SUB_SCORES`, from 0 to 1, and which of them the log tells."""

    values: Float[Tensor, "b N S"]
    known: Bool[Tensor, "b S"]


class _Traffic(NamedTuple):
    """M road users at T steps."""

    corners: Float[Tensor, "b T M 4 2"]
    yaw: Float[Tensor, "b T M"]
    velocity: Float[Tensor, "b T M 2"]
    xy: Float[Tensor, "b T M 2"]
    there: Bool[Tensor, "b T M"]


@torch.no_grad()
def plan_labels(plans: Candidates, example: Example, dt_s: float) -> PlanLabels:
    """Return the sub-scores of plans.

    Args:
        plans: of b items.
        example: with task truth of futures, affordances and the map's raster.
        dt_s: time of a step of the plans, which is that of the futures.

    Raises:
        InputError: the truth lacks a part, or its steps are others.
    """
    truth, clip = example.truth, example.clip
    if truth is None or truth.futures is None or truth.affordances is None or truth.raster is None:
        raise InputError(
            f"{example.key[0]}: plans are scored by futures, affordances and raster of the truth"
        )
    steps = plans.xy.shape[2]
    if abs(truth.futures.dt_s - dt_s) > 1e-6 or truth.futures.xy.shape[2] < steps or steps > LATER_STEPS:
        raise InputError(f"plans of {steps} steps of {dt_s} s cannot be scored by this truth")
    boxes = boxes_now(clip)
    followed = clip.boxes_valid[:, clip.now] & _followed(boxes, truth.futures, steps)
    traffic = _traffic(boxes, truth.futures, steps, dt_s)
    hit = _collides(plans, traffic, 0.0)
    road, seen = truth.affordances, truth.affordances.path_valid.sum(-1) > 1
    progress_m, beside_m = _along_route(plans.xy, road)
    expert_m, _ = _along_route(clip.future.xy, road)
    expert_m = torch.where(clip.future.valid[:, 0], expert_m[:, 0], 0.0).amax(-1, keepdim=True)
    share = (progress_m[..., -1] / expert_m.clamp_min(MIN_PROGRESS_M)).clamp(0, 1)
    share = torch.where(expert_m < MIN_PROGRESS_M, 1.0, share)
    soon = torch.stack([_collides(plans, traffic, ahead_s) for ahead_s in TTC_S]).any(0)
    values = {
        "no_collision": ~hit.any(-1),
        "drivable": _drivable(plans, truth.raster),
        "light": _keeps_light(progress_m, road),
        "progress": share,
        "time_to_collision": ~(soon | hit).any(-1),
        "lane": beside_m.abs().gt(LANE_M).unfold(-1, min(LANE_STEPS, steps), 1).all(-1).any(-1).logical_not(),
        "comfort": _comfortable(plans, clip.ego_speed_mps[:, clip.now], dt_s),
    }
    always = torch.ones_like(followed)
    known = [followed, truth.raster.known, road.light_known, seen, followed, seen, always]
    return PlanLabels(
        torch.stack([value.to(plans.xy) for value in values.values()], dim=-1), torch.stack(known, dim=-1)
    )


def _followed(boxes: Boxes, futures: AgentFutures, steps: int) -> Bool[Tensor, "b"]:
    """Return whether the log follows road users for as long as the plans last, or has none at now.

    An expert's plan at the end of a log lasts longer than the log.
    """
    return futures.valid[:, :, steps - 1].any(-1) | ~boxes.valid.any(-1)


def _traffic(boxes: Boxes, futures: AgentFutures, steps: int, dt_s: float) -> _Traffic:
    """Return the recorded road users at the steps of the plans."""
    count = min(boxes.yaw.shape[1], futures.xy.shape[1])  # a batch may pad both to different lengths
    near = boxes.valid[:, :count] & (boxes.centre[:, :count, :2].norm(dim=-1) < NEAR_M)
    xy = futures.xy[:, :count, :steps].transpose(1, 2)
    yaw = futures.yaw[:, :count, :steps].transpose(1, 2)
    there = (futures.valid[:, :count, :steps] & near[..., None]).transpose(1, 2)
    size = boxes.size_lwh[:, None, :count, :2].expand(*xy.shape[:3], 2)
    before = torch.cat([boxes.centre[:, None, :count, :2], xy[:, :-1]], dim=1)
    velocity = torch.where(there[..., None], (xy - before) / dt_s, 0.0)
    return _Traffic(rectangle(xy, size, yaw), yaw, velocity, xy, there)


def _collides(plans: Candidates, traffic: _Traffic, ahead_s: float) -> Bool[Tensor, "b N T"]:
    """Return whether a plan touches a road user at a step or, at constant velocities, some time after it.

    Where the ego vehicle stands, or the road user is behind its rear axle, it is not at fault.
    """
    direction = torch.stack([plans.yaw.cos(), plans.yaw.sin()], dim=-1)
    middle = plans.xy + (EGO_MIDDLE_M + ahead_s * plans.speed_mps[..., None]) * direction
    size = middle.new_tensor([EGO_LENGTH_M, EGO_WIDTH_M]).expand_as(middle)
    ego = rectangle(middle, size, plans.yaw)[:, :, :, None]
    moved = ahead_s * traffic.velocity[:, None]
    touching = overlapping(
        plans.yaw[..., None], ego, traffic.yaw[:, None], traffic.corners[:, None] + moved[..., None, :]
    )
    offset = traffic.xy[:, None] - plans.xy[:, :, :, None]
    ahead = (offset * direction[..., None, :]).sum(-1) > 0
    moving = (plans.speed_mps > STANDS_MPS)[..., None]
    return (touching & traffic.there[:, None] & ahead & moving).any(-1)


def _drivable(plans: Candidates, raster: MapRaster) -> Bool[Tensor, "b N"]:
    """Return whether all corners of the ego vehicle stay on the drivable area; outside the raster they do."""
    direction = torch.stack([plans.yaw.cos(), plans.yaw.sin()], dim=-1)
    size = plans.xy.new_tensor([EGO_LENGTH_M, EGO_WIDTH_M]).expand_as(plans.xy)
    corners = rectangle(plans.xy + EGO_MIDDLE_M * direction, size, plans.yaw)
    spec = raster.spec
    cell = ((corners - corners.new_tensor(spec.lower_m)) / spec.cell_m).floor().long()
    rows, columns = spec.shape_yx
    inside = (cell >= 0).all(-1) & (cell[..., 0] < columns) & (cell[..., 1] < rows)
    flat = cell[..., 1].clamp(0, rows - 1) * columns + cell[..., 0].clamp(0, columns - 1)
    layer = raster.layers[:, RasterLayer.DRIVABLE].flatten(1)
    on_road = layer.gather(1, flat.flatten(1)).view(flat.shape)
    return (on_road | ~inside).flatten(2).all(-1)


def _along_route(
    xy: Float[Tensor, "b N T 2"], road: Affordances
) -> tuple[Float[Tensor, "b N T"], Float[Tensor, "b N T"]]:
    """Return the distance along the route and beside it of all waypoints."""
    along_m, left_m = along_path(xy.flatten(1, 2), road.path_xy, road.path_valid)
    return along_m.view(xy.shape[:3]), left_m.view(xy.shape[:3])


def _keeps_light(progress_m: Float[Tensor, "b N T"], road: Affordances) -> Bool[Tensor, "b N"]:
    """Return whether the front bumper never crosses the line in a step at whose end the light is red."""
    crossed = progress_m > road.light_m[:, None, None] + LIGHT_MARGIN_M
    before = torch.zeros_like(crossed)
    before[..., 1:] = crossed[..., :-1]
    before[..., 0] = (road.light_m < -LIGHT_MARGIN_M)[:, None]
    red = (road.light_later[:, : crossed.shape[-1]] == LightState.RED)[:, None]
    there = (road.light != LightState.NONE)[:, None]
    return ~(crossed & ~before & red).any(-1) | ~there


def _comfortable(plans: Candidates, speed_mps: Float[Tensor, "b"], dt_s: float) -> Bool[Tensor, "b N"]:
    """Return whether a plan keeps nuPlan's bounds of acceleration and yaw rate."""
    before = speed_mps[:, None, None].expand(*plans.speed_mps.shape[:2], 1)
    acceleration = torch.cat([before, plans.speed_mps], dim=-1).diff(dim=-1) / dt_s
    yaw_rate = turn_rates(plans, dt_s).abs()
    lateral = yaw_rate * plans.speed_mps
    fine = (acceleration > -MAX_BRAKING) & (acceleration < MAX_ACCELERATION)
    return (fine & (lateral < MAX_LATERAL) & (yaw_rate < MAX_YAW_RATE)).all(-1)
