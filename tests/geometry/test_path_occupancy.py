"""Cells of a path that bends, and footprints that are turned, by hand."""

import math

import torch

from foredrive.geometry.path_occupancy import cells_covered

PATH = torch.tensor([[0.0, 0.0], [10.0, 0.0], [10.0, 20.0], [0.0, 0.0]])
"""Ten metres ahead, then twenty to the left; the last point is padding."""
VALID = torch.tensor([True, True, True, False])


def covered(xy: list[list[float]], yaw: float, size_lw: tuple[float, float]) -> list[set[int]]:
    """Cells of 2 m from 4 m along the path on, 1 m to either side, at each of some times."""
    times = len(xy)
    cells = cells_covered(
        torch.tensor(xy)[None],
        torch.full((1, times), yaw),
        torch.ones(1, times, dtype=torch.bool),
        torch.tensor([size_lw]),
        PATH,
        VALID,
        4.0,
        1.0,
        12,
        2.0,
    )
    return [set(at_time.nonzero()[:, 0].tolist()) for at_time in cells[0]]


def test_a_car_that_drives_round_the_corner_covers_the_cells_there() -> None:
    """Its middle is 15.5 m along the path, its ends 13.5 and 17.5 m: 9.5 to 13.5 m from the first cell on."""
    assert covered([[10.0, 5.5]], math.pi / 2, (4.0, 1.8)) == [{4, 5, 6}]


def test_the_ends_of_a_long_vehicle_across_the_path_are_joined() -> None:
    """A lorry of 14 m along the second leg, half a metre beside it: from 13 to 27 m along the path."""
    assert covered([[10.5, 10.0]], math.pi / 2, (14.0, 2.5)) == [set(range(4, 12))]


def test_a_turned_cyclist_enters_with_a_corner_and_leaves() -> None:
    """He rides at 45 degrees over the first leg; before and after, no part is within a metre of it.

    At (6, 1.2) his right side enters at x = 5.77 and his front left corner is at (6.85, 0.78).
    """
    xy = [[4.0, 3.0], [6.0, 1.2], [9.0, -2.1]]
    assert covered(xy, -math.pi / 4, (1.8, 0.6)) == [set(), {0, 1}, set()]


def test_who_stands_beyond_the_end_or_behind_the_start_is_not_on_the_path() -> None:
    """The path is 30 m long; 26 m along, somebody stands on it."""
    xy = [[10.0, 22.5], [-3.0, 0.0], [10.0, 16.0]]
    assert covered(xy, math.pi / 2, (1.0, 1.0)) == [set(), set(), {10, 11}]
