"""Recall of columns that hold a car, on a grid small enough to count by hand."""

import math

import torch

from foredrive.scene import Boxes, Category, VoxelGrid, VoxelSpec
from foredrive.scene.boxes import unlabelled
from foredrive.tasks.occupancy.vehicles_metric import car_columns, count_car_columns, count_found_columns

SPEC = VoxelSpec(lower_m=(-10.0, -10.0, -1.0), voxel_m=1.0, shape_zyx=(3, 20, 20))
"""Two of the three layers have centres at -0.5 and 0.5 m; the third at 1.5 m."""


def boxes(*rows: tuple[float, float, float, Category]) -> Boxes:
    """Cars of 4 by 2 m at (x, y, yaw)."""
    count = len(rows)
    return Boxes(
        centre=torch.tensor([[[x, y, 0.8] for x, y, _, _ in rows]]),
        size_lwh=torch.tensor([4.0, 2.0, 1.6]).expand(1, count, 3),
        yaw=torch.tensor([[yaw for *_, yaw, _ in rows]]),
        velocity=torch.zeros(1, count, 2),
        track_id=torch.arange(count)[None],
        category=torch.tensor([[int(category) for *_, category in rows]]),
        valid=torch.ones(1, count, dtype=torch.bool),
        **unlabelled(1, count),
    )


def grid(*points: tuple[float, float, float], known: bool = True) -> VoxelGrid:
    values = torch.zeros(1, 1, *SPEC.shape_zyx)
    for x, y, z in points:
        values[0, 0, math.floor(z + 1), math.floor(y + 10), math.floor(x + 10)] = 1.0
    return VoxelGrid(SPEC, values, torch.full((1, *SPEC.shape_zyx), known))


def columns(found: torch.Tensor) -> set[tuple[int, int]]:
    """Lower corners (x, y) of the columns."""
    return {(int(x) - 10, int(y) - 10) for _, y, x in found.nonzero().tolist()}


def test_a_column_needs_a_return_in_the_box_of_a_car() -> None:
    truth = boxes((5.0, 0.0, 0.0, Category.CAR), (-5.0, 0.0, 0.0, Category.PEDESTRIAN))
    seen = grid((3.2, 0.5, 0.5), (6.5, -0.5, 1.5), (-5.0, 0.5, 0.5), (5.5, 5.0, 0.5))
    assert columns(car_columns(truth, seen, 20.0)) == {(3, 0), (6, -1)}


def test_the_road_under_a_car_does_not_count() -> None:
    assert not car_columns(boxes((5.0, 0.0, 0.0, Category.CAR)), grid((5.5, 0.5, -0.5)), 20.0).any()


def test_unknown_voxels_do_not_count() -> None:
    seen = grid((5.5, 0.5, 0.5), known=False)
    assert not car_columns(boxes((5.0, 0.0, 0.0, Category.CAR)), seen, 20.0).any()


def test_half_a_voxel_around_the_box_belongs_to_it() -> None:
    """The car ends at y = 1: a return at y = 1.05 is in the column whose centre is 0.5 m outside."""
    truth = boxes((5.5, 0.0, 0.0, Category.CAR))
    assert columns(car_columns(truth, grid((5.5, 1.05, 0.5), (5.5, 2.05, 0.5)), 20.0)) == {(5, 1)}


def test_a_turned_box_covers_other_columns() -> None:
    truth = boxes((0.0, 0.0, 0.5 * math.pi, Category.TRUCK))
    seen = grid((0.5, 2.2, 0.5), (2.2, 0.5, 0.5))
    assert columns(car_columns(truth, seen, 20.0)) == {(0, 2)}


def test_range_is_that_of_the_column_and_any_height_finds_it() -> None:
    truth = boxes((8.0, 0.0, 0.0, Category.CAR))
    seen = grid((6.5, 0.5, 0.5), (9.5, 0.5, 0.5))
    predicted = grid((6.5, 0.5, 1.5), (9.5, 0.5, -0.5)).values[:, 0] > 0.5  # high up; only the road
    hits, total = count_car_columns(predicted, truth, seen, torch.tensor([7.0, 20.0]))
    assert hits.tolist() == [1, 1]
    assert total.tolist() == [1, 2]


def test_precision_counts_observed_columns_alone() -> None:
    """Predicted: a true column at other height, a false one, a piece of road, one not observed."""
    seen = grid((3.5, 0.5, 0.5))
    seen.known[0, :, :, 19] = False
    predicted = grid((3.5, 0.5, 1.5), (5.5, 0.5, 0.5), (6.5, 0.5, -0.5), (9.5, 0.5, 0.5)).values[:, 0] > 0.5
    true, found = count_found_columns(predicted, seen, torch.tensor([4.0, 20.0]))
    assert true.tolist() == [1, 1]
    assert found.tolist() == [1, 2]


def test_all_occupied_finds_every_car_at_the_precision_of_chance() -> None:
    seen = grid((3.5, 0.5, 0.5), (4.5, 0.5, 0.5))
    everything = torch.ones(1, *SPEC.shape_zyx, dtype=torch.bool)
    hits, total = count_car_columns(
        everything, boxes((4.0, 0.0, 0.0, Category.CAR)), seen, torch.tensor([20.0])
    )
    true, found = count_found_columns(everything, seen, torch.tensor([20.0]))
    assert hits.tolist() == total.tolist() == [2]
    assert (true.tolist(), found.tolist()) == ([2], [400])
