"""Masks of map elements: UniAD's intersection over union."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foredrive.scene.map_elements import RasterLayer
from foredrive.tasks.maps.map_raster_metric import count_raster, raster_figures

NOTHING = np.zeros((1, len(RasterLayer), 4, 4), dtype=bool)


def masks(**cells: list[tuple[int, int]]) -> np.ndarray:
    found = NOTHING.copy()
    for name, places in cells.items():
        for row, column in places:
            found[0, RasterLayer[name.upper()], row, column] = True
    return found


def test_lanes_are_the_union_of_three_classes() -> None:
    """A divider taken for a boundary is wrong in both classes, and right as a lane."""
    true = masks(divider=[(0, 0), (0, 1)], crossing=[(3, 3)], drivable=[(1, 1), (1, 2)])
    predicted = masks(boundary=[(0, 0)], crossing=[(3, 3), (3, 2)], drivable=[(1, 1)])
    figures = raster_figures(count_raster(predicted, true))
    assert figures["iou_lanes"] == pytest.approx(2 / 4)
    assert figures["iou_divider"] == 0.0
    assert figures["iou_crossing"] == pytest.approx(1 / 2)
    assert figures["iou_drivable"] == pytest.approx(1 / 2)
    assert figures["iou_boundary"] == 0.0


def test_sums_over_frames_come_before_the_quotient() -> None:
    """1 of 1, and 0 of 3 cells: not the mean of 1 and 0."""
    one = count_raster(masks(divider=[(0, 0)]), masks(divider=[(0, 0)]))
    none = count_raster(masks(), masks(divider=[(1, 0), (1, 1), (1, 2)]))
    total = one + none
    assert raster_figures(total)["iou_divider"] == pytest.approx(1 / 4)
    assert total.frames == 2
    assert math.isnan(raster_figures(total)["iou_crossing"])


@given(st.integers(0, 1000))
def test_perfect_masks_and_swapped_masks(seed: int) -> None:
    rng = np.random.default_rng(seed)
    some, other = rng.random((2, 3, 4, 8, 8)) < 0.3
    assert set(raster_figures(count_raster(some, some)).values()) == {1.0}
    assert raster_figures(count_raster(some, other)) == raster_figures(count_raster(other, some))
