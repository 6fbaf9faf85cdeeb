"""The voxel walk against an exact, slow reference: overlap of each beam with each voxel."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from foredrive.data.beam_casting import FREE, OCCUPIED, UNKNOWN, box_of_points, cast_beams

SHAPE_ZYX = (4, 5, 6)
TOUCHING = 1e-6
"""Overlaps this short (fractions of the beam) may or may not count: corners and faces."""


def overlap(origin: np.ndarray, end: np.ndarray, free_until: float) -> np.ndarray:
    """Length of the part of one beam inside each voxel, as a fraction of origin to end; negative: apart."""
    out = np.empty(SHAPE_ZYX)
    for z, y, x in np.ndindex(SHAPE_ZYX):
        enter, leave = 0.0, free_until
        for o, d, low in zip(origin, end - origin, (x, y, z), strict=True):
            if d == 0:
                leave = leave if low <= o < low + 1 else -np.inf
            else:
                near, far = sorted([(low - o) / d, (low + 1 - o) / d])
                enter, leave = max(enter, near), min(leave, far)
        out[z, y, x] = leave - enter
    return out


coordinate = st.floats(-3.0, 9.0, width=32) | st.integers(-1, 7).map(float)


@settings(max_examples=150, deadline=None)
@given(
    origin=arrays(np.float64, (2, 3), elements=coordinate),
    end=arrays(np.float64, (2, 3), elements=coordinate),
    free_until=st.lists(st.floats(0, 1), min_size=2, max_size=2),
)
def test_a_beam_frees_the_voxels_it_crosses(
    origin: np.ndarray, end: np.ndarray, free_until: list[float]
) -> None:
    state = np.zeros(SHAPE_ZYX, np.uint8)
    state[2, 2, 2] = OCCUPIED
    cast_beams(origin, end, np.array(free_until), state)
    inside = np.max([overlap(o, e, f) for o, e, f in zip(origin, end, free_until, strict=True)], axis=0)
    assert state[2, 2, 2] == OCCUPIED
    inside[2, 2, 2] = 0
    assert (state[inside > TOUCHING] == FREE).all()
    assert (state[inside < -TOUCHING] == UNKNOWN).all()


def test_a_beam_along_an_axis_by_hand() -> None:
    state = np.zeros(SHAPE_ZYX, np.uint8)
    cast_beams(np.array([[-2.0, 1.5, 0.5]]), np.array([[4.0, 1.5, 0.5]]), np.array([0.8]), state)
    assert np.argwhere(state == FREE).tolist() == [[0, 1, 0], [0, 1, 1], [0, 1, 2]]  # up to x = 2.8


def test_a_beam_that_knows_nothing_frees_nothing() -> None:
    state = np.zeros(SHAPE_ZYX, np.uint8)
    inside = np.array([[2.5, 2.5, 1.5]])
    cast_beams(inside, inside, np.array([0.0]), state)
    assert not state.any()


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 0.7])
def test_points_find_their_box(yaw: float) -> None:
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    centre = np.array([[5.0, 1.0, 0.0], [5.5, 1.0, 0.0]])
    half = np.array([[2.0, 1.0, 0.5], [2.0, 1.0, 0.5]])
    local = np.array([[1.9, 0.9, 0.4], [2.1, 0, 0], [0, -1.1, 0], [0, 0, 0.6], [-1.9, 0.9, 0]])
    points = centre[0] + local @ turn.T
    first_alone = box_of_points(points, centre[:1], half[:1], np.array([yaw]))
    assert first_alone.tolist() == [0, -1, -1, -1, 0]
    both = box_of_points(centre + 0.01, centre, half, np.array([yaw, yaw]))
    assert both.tolist() == [0, 1]  # in both boxes: the nearer centre
