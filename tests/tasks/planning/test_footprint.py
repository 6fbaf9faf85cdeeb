"""Ego footprint against boxes: cells as the public rasteriser draws them, polygons as shapely cuts them."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity
from shapely.geometry import Point
from shapely.geometry import box as shapely_box

from foredrive.scene import Boxes, Category
from foredrive.scene.boxes import unlabelled
from foredrive.tasks.planning.protocols import PROTOCOLS, ObstacleGrid, PlanningProtocol
from foredrive.tasks.planning.scores import (
    cells_in_quads,
    grid_hits,
    path_headings,
    polygon_hits,
    rectangle,
)


def some_boxes(rows: list[tuple[float, float, float, float, float]]) -> Boxes:
    """One step of boxes given as x, y, length, width, yaw."""
    x, y, length, width, yaw = torch.tensor(rows, dtype=torch.float32).T
    m = len(rows)
    return Boxes(
        centre=torch.stack([x, y, torch.zeros(m)], dim=-1)[None, None],
        size_lwh=torch.stack([length, width, torch.ones(m)], dim=-1)[None, None],
        yaw=yaw[None, None],
        velocity=torch.zeros(1, 1, m, 2),
        track_id=torch.arange(m)[None, None],
        category=torch.full((1, 1, m), int(Category.CAR)),
        valid=torch.ones(1, 1, m, dtype=torch.bool),
        **unlabelled(1, 1, m),
    )


def hits(
    protocol: PlanningProtocol, xy: tuple[float, float], boxes: Boxes, heading: float = 0.0
) -> tuple[bool, bool]:
    path, yaw = torch.tensor([[xy]], dtype=torch.float64), torch.tensor([[heading]], dtype=torch.float64)
    if protocol.grid is None:
        box, point = polygon_hits(path, yaw, boxes, protocol)
    else:
        box, point = grid_hits(path, yaw, boxes, protocol, protocol.grid)
    return bool(box), bool(point)


def test_cells_are_those_opencv_fills() -> None:
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(0)
    n, size = 500, 48
    corners = rectangle(
        torch.tensor(rng.uniform(14, 34, (n, 2))),
        torch.tensor(np.stack([rng.uniform(0.2, 24, n), rng.uniform(0.2, 8, n)], axis=-1)),
        torch.tensor(np.where(np.arange(n) % 4 == 0, 0.5 * math.pi, rng.uniform(-math.pi, math.pi, n))),
    )
    quads = corners.round().long()  # row, column
    drawn = np.zeros((n, size, size), dtype=np.uint8)
    for image, quad in zip(drawn, quads.numpy(), strict=True):
        cv2.fillPoly(image, [quad[:, ::-1].astype(np.int32)], 1)
    cells = torch.cartesian_prod(torch.arange(size), torch.arange(size))
    ours = cells_in_quads(cells.expand(n, -1, -1), quads).view(n, size, size)
    assert np.array_equal(ours.numpy(), drawn > 0)


@pytest.mark.parametrize("protocol", [PROTOCOLS["stp3"], PROTOCOLS["uniad"], PROTOCOLS["vad"]])
def test_the_half_metre_grid_by_hand(protocol: PlanningProtocol) -> None:
    # At the origin the ego vehicle covers -1.542 … 2.542 m forward and ±0.925 m sideways. Of the cells, whose
    # centres lie at ±0.25, ±0.75, …, it holds those at -1.25 … 2.25 (rows 97 … 104) and ±0.75 (98 … 101).
    # A box of 1 × 1 m at x = 3 has its corners at 2.5 and 3.5 m, grid lines 105 and 107: rows 105 … 107, just
    # ahead of the vehicle. At x = 2.5 it has rows 104 … 106: its first is the vehicle's last.
    assert not hits(protocol, (0.0, 0.0), some_boxes([(3.0, 0.0, 1.0, 1.0, 0.0)]))[0]
    assert hits(protocol, (0.0, 0.0), some_boxes([(2.5, 0.0, 1.0, 1.0, 0.0)]))[0]
    # 2 m to a side it has columns 103 … 105 or 95 … 97, beside the vehicle's 98 … 101.
    assert not hits(protocol, (0.0, 0.0), some_boxes([(0.0, 2.0, 1.0, 1.0, 0.0)]))[0]
    assert not hits(protocol, (0.0, 0.0), some_boxes([(0.0, -2.0, 1.0, 1.0, 0.0)]))[0]
    # A path 0.4 m ahead keeps the rows when rounded down and moves by one, into the box, when rounded up.
    moved = hits(protocol, (0.4, 0.0), some_boxes([(3.0, 0.0, 1.0, 1.0, 0.0)]))[0]
    assert moved == (protocol.title == "VAD")


def test_cells_beyond_the_grid_move_to_its_border() -> None:
    uniad = PROTOCOLS["uniad"]
    at_border = some_boxes([(49.5, 0.0, 1.0, 1.0, 0.0)])
    assert hits(uniad, (70.0, 0.0), at_border) == (True, False)  # the box is clipped, the point is not
    assert not hits(PROTOCOLS["sparsedrive"], (70.0, 0.0), at_border)[0]


def test_a_box_outside_the_grid_is_not_drawn() -> None:
    uniad = PROTOCOLS["uniad"]
    assert not hits(uniad, (60.0, 0.0), some_boxes([(60.5, 0.0, 4.0, 2.0, 0.0)]))[0]
    assert hits(PROTOCOLS["sparsedrive"], (60.0, 0.0), some_boxes([(60.5, 0.0, 4.0, 2.0, 0.0)]))[0]


def test_the_fine_grid_turns_the_vehicle() -> None:
    # Turned left by 90°, the centre lies 1.486 m to the left and the vehicle spans -0.56 … 3.53 m to the left
    # and ±0.925 m forward.
    bev = PROTOCOLS["bevplanner"]
    left, ahead = some_boxes([(0.0, 3.2, 0.4, 0.4, 0.0)]), some_boxes([(3.2, 0.0, 0.4, 0.4, 0.0)])
    assert hits(bev, (0.0, 0.0), left, heading=0.5 * math.pi)[0]
    assert not hits(bev, (0.0, 0.0), ahead, heading=0.5 * math.pi)[0]
    assert hits(bev, (0.0, 0.0), ahead)[0]
    assert not hits(bev, (0.0, 0.0), left)[0]


def test_corners_on_the_fine_grid_move_towards_the_vehicle() -> None:
    # It reaches 3.528 m forward; its last cell has its centre at 3.45 m. Corners at 3.46 m move down to that
    # cell, not on to the next grid line; corners at 3.56 m move to the cell after it.
    bev = PROTOCOLS["bevplanner"]
    assert hits(bev, (0.0, 0.0), some_boxes([(3.96, 0.0, 1.0, 1.0, 0.0)]))[0]
    assert not hits(bev, (0.0, 0.0), some_boxes([(4.06, 0.0, 1.0, 1.0, 0.0)]))[0]


def test_headings_by_each_rule() -> None:
    path = torch.tensor([[[0.8, 0.0], [2.8, 0.0], [2.8, 2.0]]], dtype=torch.float64)
    assert path_headings(path, "now").tolist() == [[0.0, 0.0, 0.0]]
    # The first step is 0.8 m long: too short to tell a heading.
    torch.testing.assert_close(path_headings(path, "step"), path.new_tensor([[0.0, 0.0, 0.5 * math.pi]]))
    # Central differences: (0,0) → (2.8, 0); (0.8, 0) → (2.8, 2); then the last step.
    torch.testing.assert_close(
        path_headings(path, "path"), path.new_tensor([[0.0, 0.25 * math.pi, 0.5 * math.pi]])
    )
    creeping = torch.tensor([[[0.0, 0.2], [0.0, 0.4], [0.0, 0.6]]], dtype=torch.float64)
    assert path_headings(creeping, "path").tolist() == [[0.0, 0.0, 0.0]]


coordinate = st.floats(-8, 8)
size = st.floats(0.2, 6)
angle = st.floats(-math.pi, math.pi)


@settings(deadline=None, max_examples=200)
@given(coordinate, coordinate, size, size, angle, angle)
def test_polygons_agree_with_shapely(
    x: float, y: float, length: float, width: float, yaw: float, heading: float
) -> None:
    def outline(x: float, y: float, length: float, width: float, yaw: float):  # type: ignore[no-untyped-def]
        flat = shapely_box(-length / 2, -width / 2, length / 2, width / 2)
        return affinity.translate(affinity.rotate(flat, yaw, origin=(0, 0), use_radians=True), x, y)

    ego = outline(0.5 * math.cos(heading), 0.5 * math.sin(heading), 4.084, 1.85, heading)
    other = outline(x, y, length, width, yaw)
    box, point = hits(PROTOCOLS["sparsedrive"], (0.0, 0.0), some_boxes([(x, y, length, width, yaw)]), heading)
    if abs(ego.distance(other)) > 1e-4 or ego.intersection(other).area > 1e-4:
        assert box == ego.intersects(other)
    if abs(other.exterior.distance(Point(0, 0))) > 1e-4:
        assert point == other.intersects(Point(0, 0))


@settings(deadline=None, max_examples=100)
@given(st.sampled_from(sorted(PROTOCOLS)), coordinate, coordinate, angle, st.floats(0, 3))
def test_a_larger_vehicle_never_collides_less(
    name: str, x: float, y: float, yaw: float, growth: float
) -> None:
    small = PROTOCOLS[name]
    length_m, width_m = small.ego_size_lw_m
    large = dataclasses.replace(small, ego_size_lw_m=(length_m + growth, width_m + growth))
    boxes = some_boxes([(x, y, 3.0, 1.5, yaw)])
    assert hits(small, (0.0, 0.0), boxes)[0] <= hits(large, (0.0, 0.0), boxes)[0]


@settings(deadline=None, max_examples=100)
@given(coordinate, coordinate, size, size, angle)
def test_a_finer_grid_comes_closer_to_the_polygons(
    x: float, y: float, length: float, width: float, yaw: float
) -> None:
    """The grid is never off by more than its rounding: of the box's corners and of the ego's cells."""
    boxes = some_boxes([(x, y, length, width, yaw)])
    grid = ObstacleGrid(cell_m=0.1, reach_m=50.0, column_axis="left", row_step="down", corner="nearest")
    exact = dataclasses.replace(PROTOCOLS["sparsedrive"], heading="now")
    drawn = dataclasses.replace(exact, grid=grid)
    margin = 0.6
    grown = dataclasses.replace(boxes, size_lwh=boxes.size_lwh + margin)
    shrunk = dataclasses.replace(boxes, size_lwh=(boxes.size_lwh - margin).clamp_min(0))
    assert hits(exact, (0.0, 0.0), grown)[0] or not hits(drawn, (0.0, 0.0), boxes)[0]
    if bool((boxes.size_lwh[..., :2] > margin).all()):
        assert hits(drawn, (0.0, 0.0), boxes)[0] or not hits(exact, (0.0, 0.0), shrunk)[0]


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=PROTOCOLS)
def test_an_empty_street(protocol: PlanningProtocol) -> None:
    nothing = some_boxes([(0.0, 0.0, 4.0, 2.0, 0.0)])[:, :, :0]
    assert hits(protocol, (0.0, 0.0), nothing) == (False, False)
