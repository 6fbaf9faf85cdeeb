"""Masks of map elements: UniAD's intersection over union, and lines drawn as its truth is."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foredrive.metrics.maps.protocols import UNIAD_RASTER
from foredrive.metrics.maps.raster import LAYERS, count_raster, draw_lines, raster_figures
from foredrive.scene.map_elements import ElementKind

NOTHING = np.zeros((1, len(LAYERS), 4, 4), dtype=bool)


def masks(**cells: list[tuple[int, int]]) -> np.ndarray:
    found = NOTHING.copy()
    for name, places in cells.items():
        for row, column in places:
            found[0, LAYERS.index(name), row, column] = True
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


def test_lines_are_drawn_at_their_place() -> None:
    """Along y = 0 from x = 0: row 100, from column 100; 2 px wide in OpenCV covers three rows."""
    line = np.array([[0.0, 0.0], [10.2, 0.0]])
    divider, crossing, boundary = draw_lines([line], [ElementKind.DIVIDER], UNIAD_RASTER)
    rows, columns = np.nonzero(divider)
    assert set(rows.tolist()) == {99, 100, 101}
    # sampled every metre up to 10 m, which is column 100 + floor(10 / .512); the cap is one cell long
    assert (columns.min(), columns.max()) == (99, 120)
    assert not crossing.any()
    assert not boundary.any()


def test_later_classes_erase_what_is_beside_them() -> None:
    """A divider 1 m beside a boundary vanishes under the boundary drawn 6 px wide; 3 m beside it stays."""
    boundary = np.array([[-20.0, 0.0], [20.0, 0.0]])
    near, far = boundary + np.array([0.0, 1.0]), boundary + np.array([0.0, 3.0])
    kinds = [ElementKind.DIVIDER, ElementKind.BOUNDARY]
    drawn = draw_lines([near, boundary], kinds, UNIAD_RASTER)
    assert drawn[0].sum() < 0.5 * draw_lines([near], kinds[:1], UNIAD_RASTER)[0].sum()
    np.testing.assert_array_equal(drawn[2], draw_lines([boundary], kinds[1:], UNIAD_RASTER)[2])
    np.testing.assert_array_equal(
        draw_lines([far, boundary], kinds, UNIAD_RASTER)[0], draw_lines([far], kinds[:1], UNIAD_RASTER)[0]
    )


def test_lines_end_at_the_border() -> None:
    line = np.array([[40.0, 0.0], [90.0, 0.0]])
    (divider, _, _) = draw_lines([line], [ElementKind.DIVIDER], UNIAD_RASTER)
    assert divider[100, 199]
    assert not draw_lines([line + np.array([30.0, 0.0])], [ElementKind.DIVIDER], UNIAD_RASTER).any()
    assert not draw_lines([np.array([[0.0, 0.0], [0.9, 0.0]])], [ElementKind.DIVIDER], UNIAD_RASTER).any()
