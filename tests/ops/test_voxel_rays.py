"""Rays through voxels: cases by hand, and the kernel beside its reference and a literal walk."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from foredrive.ops.voxel_rays import RayEnds, first_hits, first_hits_reference

SHAPE_ZYX = (4, 6, 8)
CASTS = [first_hits, first_hits_reference]


def grid(*occupied_xyz: tuple[int, int, int]) -> np.ndarray:
    out = np.zeros(SHAPE_ZYX, np.bool_)
    for x, y, z in occupied_xyz:
        out[z, y, x] = True
    return out


def flat(x: int, y: int, z: int) -> int:
    return (z * SHAPE_ZYX[1] + y) * SHAPE_ZYX[2] + x


def one(cast, origin: tuple[float, ...], direction: tuple[float, ...], occupied: np.ndarray):
    d = np.array([direction], dtype=np.float64)
    ends = cast(np.array([origin], dtype=np.float64), d / np.linalg.norm(d), occupied)
    return int(ends.voxel[0]), float(ends.distance[0])


@pytest.mark.parametrize("cast", CASTS)
def test_cases_by_hand(cast) -> None:
    occupied = grid((5, 2, 1), (0, 0, 0))
    # Along x from the middle of voxel (1, 2, 1): the ray leaves the hit voxel at x = 6, 4.5 voxels away.
    assert one(cast, (1.5, 2.5, 1.5), (1, 0, 0), occupied) == (flat(5, 2, 1), 4.5)
    # One row beside it, nothing is hit: the ray ends in the last voxel of the grid, at its border x = 8.
    assert one(cast, (1.5, 3.5, 1.5), (1, 0, 0), occupied) == (flat(7, 3, 1), 6.5)
    # From within an occupied voxel, the ray ends where it leaves it.
    assert one(cast, (5.25, 2.5, 1.5), (1, 0, 0), occupied) == (flat(5, 2, 1), 0.75)
    # From outside towards the grid, and past it.
    assert one(cast, (-3.0, 2.5, 1.5), (1, 0, 0), occupied) == (flat(5, 2, 1), 9.0)
    assert one(cast, (-3.0, 2.5, 9.5), (1, 0, 0), occupied) == (-1, -1.0)
    assert one(cast, (1.5, 2.5, 9.5), (0, 0, 1), occupied) == (-1, -1.0)
    # Less than a voxel below the grid, a ray starts in its lowest layer, as in the public renderer.
    voxel, distance = one(cast, (5.5, 2.5, -0.5), (0, 0, 1), grid((5, 2, 0)))
    assert (voxel, distance) == (flat(5, 2, 0), 1.5)


@pytest.mark.parametrize("cast", CASTS)
def test_an_edge_is_crossed_in_the_order_of_the_public_renderer(cast) -> None:
    """Along a diagonal both borders are met at once: the step in y comes first, and that in z before it."""
    beside_x, beside_y = grid((2, 1, 1)), grid((1, 2, 1))
    assert one(cast, (1.5, 1.5, 1.5), (1, 1, 0), beside_x)[0] != flat(2, 1, 1)
    voxel, distance = one(cast, (1.5, 1.5, 1.5), (1, 1, 0), beside_y)
    assert voxel == flat(1, 2, 1)
    assert distance == pytest.approx(math.sqrt(0.5))  # left at once, by its edge
    assert one(cast, (1.5, 1.5, 1.5), (1, 0, 1), grid((1, 1, 2)))[0] == flat(1, 1, 2)
    assert one(cast, (1.5, 1.5, 1.5), (0, 1, 1), grid((1, 1, 2)))[0] == flat(1, 1, 2)


def literal_walk(origin: np.ndarray, d: np.ndarray, occupied: np.ndarray) -> tuple[int, float]:
    """One ray through the grid step by step, at most 1,000 of them, keeping the whole path."""
    size = occupied.shape[::-1]
    at = [int(o) for o in origin]
    step = [1 if c >= 0 else -1 for c in d]
    borders = [(at[k] + (step[k] > 0) - origin[k]) / d[k] if d[k] != 0 else 1e300 for k in range(3)]
    path: list[tuple[tuple[int, ...], float]] = []
    for _ in range(1001):
        inside = all(0 <= at[k] < size[k] for k in range(3))
        if path and not inside:
            break
        here = tuple(at)
        if borders[0] < borders[1]:
            axis = 0 if borders[0] < borders[2] else 2
        else:
            axis = 1 if borders[1] < borders[2] else 2
        if inside:
            path.append((here, borders[axis]))
        at[axis] += step[axis]
        borders[axis] += step[axis] / d[axis] if d[axis] != 0 else 1e300
    for (x, y, z), distance in path:
        if occupied[z, y, x]:
            return flat(x, y, z), distance
    if not path:
        return -1, -1.0
    (x, y, z), distance = path[-1]
    return flat(x, y, z), distance


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.02, 0.3]), st.booleans())
def test_kernel_and_reference_walk_literally(seed: int, share: float, on_lattice: bool) -> None:
    """Rays from inside and outside; on a lattice of half voxels, they run along edges and through corners."""
    rng = np.random.default_rng(seed)
    occupied = rng.random(SHAPE_ZYX) < share
    n = 40
    origin, direction = rng.uniform(-4, 12, (n, 3)), rng.normal(size=(n, 3))
    if on_lattice:
        origin, direction = np.round(2 * origin) / 2, rng.integers(-1, 2, (n, 3)).astype(np.float64)
        direction[(direction == 0).all(axis=1)] = [1.0, 0.0, 0.0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    fast, plain = first_hits(origin, direction, occupied), first_hits_reference(origin, direction, occupied)
    walked = [literal_walk(o, d, occupied) for o, d in zip(origin, direction, strict=True)]
    for ends in (fast, plain):
        assert ends.voxel.tolist() == [voxel for voxel, _ in walked]
        assert ends.distance.tolist() == [distance for _, distance in walked]


def test_the_result_does_not_depend_on_the_number_of_threads() -> None:
    rng = np.random.default_rng(0)
    occupied = rng.random((16, 60, 60)) < 0.01
    origin = rng.uniform(0, 60, (5000, 3)) * [1, 1, 0.25]
    direction = rng.normal(size=(5000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    threads, found = torch.get_num_threads(), list[RayEnds]()
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            found.append(first_hits(origin, direction, occupied))
    finally:
        torch.set_num_threads(threads)
    assert (found[0].voxel == found[1].voxel).all()
    assert (found[0].distance == found[1].distance).all()
