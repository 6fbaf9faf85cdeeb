"""Open-loop planning scores: distance to the driven path and collisions, under a protocol."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene import Boxes, Trajectory
from foredrive.scene.record import Record
from foredrive.tasks.planning.obstacles import Obstacles
from foredrive.tasks.planning.protocols import HORIZON_STEPS, STEP_S, STEPS, ObstacleGrid, PlanningProtocol


def rectangle(
    centre: Float[Tensor, "*b 2"], size_lw: Float[Tensor, "*b 2"], yaw: Float[Tensor, "*b"]
) -> Float[Tensor, "*b 4 2"]:
    """Return corners of rectangles seen from above: front-left, front-right, rear-right, rear-left."""
    # Signs of forward and left for the four corners
    signs = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]]).to(size_lw)
    return centre[..., None, :] + _turn(0.5 * signs * size_lw[..., None, :], yaw[..., None])


def path_headings(path_xy: Float[Tensor, "b T 2"], rule: str) -> Float[Tensor, "b T"]:
    """Return headings of the ego box along a path that starts at the origin, rad; 0 is the heading at now.

    Args:
        rule: "now": 0. "step": direction of the step that leads there, 0 for a step shorter than 1 m. "path":
            central difference, backward at the last step; 0 where first and last step lie within 0.5 m.
    """
    if rule == "now":
        return torch.zeros_like(path_xy[..., 0])
    with_start = torch.cat([torch.zeros_like(path_xy[:, :1]), path_xy], dim=1)
    if rule == "step":
        # Direction of each step; short ones keep the heading at now
        delta = with_start.diff(dim=1)
        moves = delta.norm(dim=-1) >= 1.0
    else:
        # Central differences, with a backward one at the last step
        central = with_start[:, 2:] - with_start[:, :-2]
        delta = torch.cat([central, with_start[:, -1:] - with_start[:, -2:-1]], dim=1)
        moves = ((path_xy[:, -1] - path_xy[:, 0]).norm(dim=-1) >= 0.5)[:, None]
    return torch.where(moves, torch.atan2(delta[..., 1], delta[..., 0]), torch.zeros_like(delta[..., 0]))


def polygon_hits(
    path_xy: Float[Tensor, "b T 2"], heading: Float[Tensor, "b T"], boxes: Boxes, protocol: PlanningProtocol
) -> tuple[Bool[Tensor, "b T"], Bool[Tensor, "b T"]]:
    """Return whether the ego rectangle, and whether the path's point, touches a valid box.

    Touching edges count.
    """
    centre, size_lw, yaw = _seen_from_above(boxes)
    direction = torch.stack([heading.cos(), heading.sin()], dim=-1)
    ego_size = torch.tensor(protocol.ego_size_lw_m).to(path_xy).expand_as(path_xy)
    # The ego box is centred ahead of the followed point
    ego = rectangle(path_xy + protocol.centre_forward_m * direction, ego_size, heading)[:, :, None]
    other = rectangle(centre, size_lw, yaw)  # [b, T, M, 4, 2]
    apart = ~overlapping(heading[..., None], ego, yaw, other)
    # The point in the axes of each box, against its half size
    inside = (_turn(path_xy[:, :, None] - centre, -yaw).abs() <= 0.5 * size_lw).all(dim=-1)
    return (~apart & boxes.valid).any(dim=-1), (inside & boxes.valid).any(dim=-1)


def grid_hits(
    path_xy: Float[Tensor, "b T 2"],
    heading: Float[Tensor, "b T"],
    boxes: Boxes,
    protocol: PlanningProtocol,
    grid: ObstacleGrid,
) -> tuple[Bool[Tensor, "b T"], Bool[Tensor, "b T"]]:
    """Return whether a valid box covers a cell of the ego vehicle, and whether the cell of the path's point.

    The cells are those that public code draws into images, with its rounding. Instead of drawing, the ego
    vehicle's cells are tested against the boxes around them.
    """
    # Boxes as quadrilaterals of grid indices, the path as positions along rows and columns
    quads = _box_quads(boxes, grid)
    path_rc = _to_row_column(path_xy, grid)
    first_m, last = _first_centre_m(grid), _cells(grid) - 1

    # Columns that count to the right mirror the sense of rotation
    turn = (heading if grid.column_axis == "left" else -heading)[..., None]
    template = _ego_template(protocol, grid).to(path_xy)
    # The cells of a vehicle at the origin, turned by the heading and rounded
    template = ((_turn(template, turn) - first_m) / grid.cell_m).round()  # [b, T, P, 2]
    # Moved by the position in cells and rounded again, as the public code does
    moved = template + path_rc[:, :, None] / grid.cell_m
    row = moved[..., 0].ceil() if grid.row_step == "up" else moved[..., 0].floor()
    # Cells beyond the grid move to its border
    ego = torch.stack([row, moved[..., 1].floor()], dim=-1).long().clamp(0, last)

    point = ((path_rc - first_m) / grid.cell_m).floor().long()
    on_grid = ((point >= 0) & (point <= last)).all(dim=-1)
    box_hit = _any_covered(ego, quads, boxes.valid)
    return box_hit, _any_covered(point[:, :, None], quads, boxes.valid) & on_grid


def cells_in_quads(cells: Int[Tensor, "N P 2"], quads: Int[Tensor, "N 4 2"]) -> Bool[Tensor, "N P"]:
    """Return whether cells (row, column) belong to convex quadrilaterals with whole-numbered corners.

    These are the cells of OpenCV's `fillPoly`: the inside, and the outline by Bresenham's rule. The outline
    holds cells less than half a cell off an edge, measured along the axis on which the edge advances less. Of
    cells exactly half a cell off, it holds those that a walk from the edge's lower column has yet to leave.
    """
    # Edges of the quadrilateral, oriented so that the inside is on one side of each
    following = quads.roll(-1, dims=1)
    area = (quads[..., 1] * following[..., 0] - quads[..., 0] * following[..., 1]).sum(dim=1)
    edge = (following - quads) * torch.where(area >= 0, 1, -1)[:, None, None]  # [N, 4, 2], inside on one side
    row, column = edge[:, None, :, 0], edge[:, None, :, 1]
    offset = cells[:, :, None] - quads[:, None]  # [N, P, 4, 2]
    # Cross product of edge and offset: positive on the inside
    inward = column * offset[..., 0] - row * offset[..., 1]
    # Length of the edge along the axis on which it advances more
    reach = edge.abs().amax(dim=-1)[:, None]
    # Cells exactly half a cell off are drawn on one side of the walk only
    tie_counts = torch.where(column.abs() > row.abs(), row > 0, row < 0)
    # Half a cell of tolerance outside of the edge; an edge without length excludes nothing
    drawn = (2 * inward + tie_counts > -reach) | (reach == 0)
    # The bounding box cuts what the tolerance adds beyond the corners
    low, high = quads.amin(dim=1)[:, None], quads.amax(dim=1)[:, None]
    return drawn.all(dim=-1) & ((cells >= low) & (cells <= high)).all(dim=-1)


def _any_covered(
    cells: Int[Tensor, "b T P 2"], quads: Int[Tensor, "b T M 4 2"], valid: Bool[Tensor, "b T M"]
) -> Bool[Tensor, "b T"]:
    """Return whether a valid box covers any of the P cells of a step.

    Few boxes are near a vehicle: only pairs of ego and box whose extents overlap are tested closely.
    """
    # A coarse test by extents leaves few pairs for the exact one
    low, high = cells.amin(dim=2)[:, :, None], cells.amax(dim=2)[:, :, None]  # [b, T, 1, 2]
    near = ((quads.amin(dim=3) <= high) & (quads.amax(dim=3) >= low)).all(dim=-1) & valid
    item, step, box = near.nonzero(as_tuple=True)
    covered = cells_in_quads(cells[item, step], quads[item, step, box]).any(dim=-1)
    hit = torch.zeros(cells.shape[:2], dtype=torch.bool, device=cells.device)
    hit[item[covered], step[covered]] = True
    return hit


def _box_quads(boxes: Boxes, grid: ObstacleGrid) -> Int[Tensor, "b T M 4 2"]:
    """Return corners of boxes as grid indices (row, column)."""
    corners = _to_row_column(rectangle(*_seen_from_above(boxes)), grid)
    if grid.corner == "nearest":
        return ((corners + grid.reach_m) / grid.cell_m).round().long()
    return ((corners - _first_centre_m(grid)) / grid.cell_m).floor().long()


def _ego_template(protocol: PlanningProtocol, grid: ObstacleGrid) -> Float[Tensor, "P 2"]:
    """Return centres (forward, sideways) of the cells inside an ego vehicle whose point is at the origin."""
    length_m, width_m = protocol.ego_size_lw_m
    centres = _first_centre_m(grid) + grid.cell_m * torch.arange(_cells(grid), dtype=torch.float64)
    # Cells whose centres lie inside of the vehicle's rectangle
    forward = centres[(centres - protocol.centre_forward_m).abs() < 0.5 * length_m]
    sideways = centres[centres.abs() < 0.5 * width_m]
    return torch.cartesian_prod(forward, sideways)


def _seen_from_above(boxes: Boxes) -> tuple[Tensor, Tensor, Tensor]:
    """Return centre, length and width, and yaw of boxes, in float64."""
    return boxes.centre[..., :2].double(), boxes.size_lwh[..., :2].double(), boxes.yaw.double()


def overlapping(
    yaw: Float[Tensor, "*#n"],
    corners: Float[Tensor, "*#n 4 2"],
    other_yaw: Float[Tensor, "*#n"],
    other_corners: Float[Tensor, "*#n 4 2"],
) -> Bool[Tensor, "*#n"]:
    """Return whether rectangles overlap or touch others, broadcast.

    Two rectangles are apart if and only if an edge direction of one separates them.
    """
    # Separating axes: the edge directions of either rectangle
    return ~(_apart_along(yaw, corners, other_corners) | _apart_along(other_yaw, corners, other_corners))


def _apart_along(
    yaw: Float[Tensor, "*#n"], ego: Float[Tensor, "*#n 4 2"], other: Float[Tensor, "*#n 4 2"]
) -> Bool[Tensor, "*#n"]:
    """Return whether two rectangles are apart along either axis of a frame turned by `yaw`."""
    # Both rectangles in the turned frame, where the axes are the coordinates
    ego_seen, other_seen = _turn(ego, -yaw[..., None]), _turn(other, -yaw[..., None])
    gap = torch.maximum(
        ego_seen.amin(dim=-2) - other_seen.amax(dim=-2), other_seen.amin(dim=-2) - ego_seen.amax(dim=-2)
    )
    return (gap > 0).any(dim=-1)


def _turn(xy: Tensor, angle: Tensor) -> Tensor:
    """Rotate vectors [..., 2] by angles [...] (broadcast)."""
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([cos * xy[..., 0] - sin * xy[..., 1], sin * xy[..., 0] + cos * xy[..., 1]], dim=-1)


def _to_row_column(xy: Tensor, grid: ObstacleGrid) -> Tensor:
    """Return ego x, y in the axes of rows (forward) and columns, m."""
    return xy if grid.column_axis == "left" else xy * torch.tensor([1.0, -1.0]).to(xy)


def _first_centre_m(grid: ObstacleGrid) -> float:
    return -grid.reach_m + 0.5 * grid.cell_m


def _cells(grid: ObstacleGrid) -> int:
    return round(2 * grid.reach_m / grid.cell_m)


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
    """Tells whether the driven future has all its steps."""
    counted: Bool[Tensor, "b"]
    """Tells whether the protocol counts the frame."""
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

    # Steps without a driven pose add no distance
    distance_m = torch.where(driven_valid, (plan_xy - driven_xy).norm(dim=-1), 0.0)
    boxes = _relevant_boxes(obstacles, protocol)
    annotated = driven_valid & obstacles.annotated
    driven_box, _ = _hits(driven_xy, driven_yaw, boxes, protocol)
    plan_box, plan_point = _hits(plan_xy.nan_to_num(), plan_yaw.nan_to_num(), boxes, protocol)
    # A step at which the driven vehicle itself overlaps a box is not scored
    scored = annotated & ~driven_box
    # Collisions need boxes at now and at every driven step
    collision_counted = counted & obstacles.annotated_now & (obstacles.annotated | ~driven_valid).all(dim=-1)

    def masked(values: Tensor, mask: Tensor) -> Tensor:
        return torch.where(mask[:, None], values, torch.zeros_like(values))

    return PlanScores(
        l2_m=masked(_at_horizons(distance_m, protocol.l2), counted),
        collision=masked(_at_horizons(plan_box & scored, protocol.collision), collision_counted),
        collision_centre=masked(_at_horizons(plan_point & scored, protocol.collision), collision_counted),
        driven_collision=masked(_at_horizons(driven_box & annotated, protocol.collision), collision_counted),
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
    # Boxes of the protocol's classes, relative to the point that it follows
    wanted = torch.tensor(sorted(protocol.categories), device=boxes.category.device)
    ahead = torch.tensor([protocol.point_forward_m, 0.0, 0.0]).to(boxes.centre)
    return dataclasses.replace(
        boxes, centre=boxes.centre - ahead, valid=boxes.valid & seen & torch.isin(boxes.category, wanted)
    )


def _hits(xy: Tensor, yaw: Tensor, boxes: Boxes, protocol: PlanningProtocol) -> tuple[Tensor, Tensor]:
    """Return whether box and point of a vehicle on a rear-axle path [b T 2] touch a box, both [b T]."""
    # Displacement of a point ahead of the rear axle, relative to its place at now
    lever = torch.stack([yaw.cos() - 1, yaw.sin()], dim=-1)
    path = xy + protocol.point_forward_m * lever
    heading = path_headings(path, protocol.heading)
    if protocol.grid is None:
        return polygon_hits(path, heading, boxes, protocol)
    return grid_hits(path, heading, boxes, protocol, protocol.grid)


def _at_horizons(per_step: Tensor, how: str) -> Float[Tensor, "b H"]:
    """Reduce values of six steps [b 6] to 1, 2 and 3 s."""
    values = per_step.float()
    # Mean over the steps up to each horizon
    if how == "mean":
        values = values.cumsum(dim=-1) / torch.arange(1, STEPS + 1, device=values.device)
    elif how == "any":
        # Whether any step up to the horizon collides
        values = values.cummax(dim=-1).values
    return values[:, list(HORIZON_STEPS)]
