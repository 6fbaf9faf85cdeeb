"""RayIoU, velocity errors and OccScore: by hand, and beside a count ray by ray."""

import math

import numpy as np
import pytest

from foredrive.errors import InputError
from foredrive.ops.voxel_rays import first_hits_reference
from foredrive.sensors.ray_origins import ray_origins
from foredrive.tasks.occupancy.protocols import (
    GRID,
    OCC3D_CLASSES,
    OPENOCC_CLASSES,
    RAY_PROTOCOLS,
    RayProtocol,
)
from foredrive.tasks.occupancy.score import RayCounts, Seen, cast_rays, count_rays, lidar_rays, score_rays

OPENOCC, SERVER = (RAY_PROTOCOLS[name] for name in ("openocc", "openocc_server"))
CAR, TRUCK, BUILDING = (OPENOCC_CLASSES.index(name) for name in ("car", "truck", "manmade"))
FREE = len(OPENOCC_CLASSES) - 1
LIDAR = np.array([[0.943713, 0.0, 1.84023]])


def seen(label: list[int], range_m: list[float], velocity: list[tuple[float, float]] | None = None) -> Seen:
    return Seen(
        np.array(label, np.uint8),
        np.array(range_m, np.float32),
        None if velocity is None else np.array(velocity, np.float32).reshape(-1, 2),
    )


def test_the_rays_of_the_reference() -> None:
    rays = lidar_rays()
    assert rays.shape == (39 * 360, 3)
    elevation = np.arcsin(rays[::360, 2].astype(np.float64))
    ground_m = -1.0 / np.tan(elevation[:10])
    assert ground_m == pytest.approx(range(1, 11), abs=1e-5)  # where they meet the ground, in sensor heights
    assert np.diff(elevation[8:]) == pytest.approx(math.atan(1 / 9) - math.atan(1 / 10), abs=1e-6)
    assert elevation[-2] < 0.21 <= elevation[-1]
    azimuth = np.rad2deg(np.arctan2(rays[:360, 1], rays[:360, 0])) % 360
    assert azimuth == pytest.approx(range(360), abs=1e-4)


def test_hits_by_class_and_range() -> None:
    true = seen([CAR] * 5 + [BUILDING], [10.0] * 5 + [20.0])
    #             exact, 1 m off, 1.5 m, 4 m, another class; the building is seen as free
    predicted = seen([CAR, CAR, CAR, CAR, TRUCK, FREE], [10.0, 11.0, 8.5, 14.0, 10.0, 20.0])
    scores = score_rays(count_rays(predicted, true, OPENOCC), OPENOCC)
    # A difference of exactly 1 m is no hit at 1 m. Pairs of equal class that are no hit count twice.
    assert scores.iou[:, CAR] == pytest.approx([1 / 8, 3 / 6, 3 / 6])
    assert scores.iou[:, TRUCK].tolist() == [0.0, 0.0, 0.0]  # predicted alone: 0, not left out
    assert scores.iou[:, BUILDING].tolist() == [0.0, 0.0, 0.0]
    assert np.isnan(scores.iou[:, OPENOCC_CLASSES.index("bus")]).all()
    assert scores.rayiou == pytest.approx((1 / 8 + 3 / 6 + 3 / 6) / 9)
    assert math.isnan(scores.mave_mps)
    assert math.isnan(scores.occ_score)


def test_rays_that_are_free_in_the_truth_are_dropped() -> None:
    """A ghost in front of nothing costs nothing, in front of a wall it does."""
    true = seen([BUILDING, BUILDING, FREE, FREE], [20.0, 20.0, 50.0, 50.0])
    ghost_before_nothing = seen([BUILDING, BUILDING, CAR, FREE], [20.0, 20.0, 5.0, 50.0])
    ghost_before_wall = seen([BUILDING, CAR, FREE, FREE], [20.0, 5.0, 50.0, 50.0])
    assert score_rays(count_rays(ghost_before_nothing, true, OPENOCC), OPENOCC).rayiou == 1.0
    assert score_rays(count_rays(ghost_before_wall, true, OPENOCC), OPENOCC).rayiou == 0.25  # 1/2 and 0


def test_velocities_of_hits_or_of_whole_frames() -> None:
    """A car is hit 1 m/s off; a truck lies 3 m off and is no hit at 2 m; a wall stands still."""
    true = seen([CAR, CAR, TRUCK, BUILDING], [10.0] * 4, [(2, 0), (2, 0), (5, 0), (0, 0)])
    predicted = seen([CAR, CAR, TRUCK, BUILDING], [10.0, 11.5, 13.0, 10.0], [(2, 1), (2, 0), (0, 0), (0, 0)])
    hits = score_rays(count_rays(predicted, true, OPENOCC), OPENOCC)
    assert hits.ave_mps[CAR] == pytest.approx(0.5)
    assert math.isnan(hits.ave_mps[TRUCK])
    assert hits.mave_mps == pytest.approx(0.5)
    assert hits.occ_score == pytest.approx(0.9 * hits.rayiou + 0.1 * 0.5)
    # The server's code averages over all rays of a frame in which the class has a hit: (1 + 0 + 5 + 0) / 4.
    server = score_rays(count_rays(predicted, true, SERVER), SERVER)
    assert server.ave_mps[CAR] == pytest.approx(1.5)
    assert server.mave_mps == pytest.approx(1.5)
    assert server.occ_score == pytest.approx(0.9 * server.rayiou)  # 1 - mAVE is below 0
    assert server.rayiou == hits.rayiou


def test_the_server_compares_ranges_in_half_precision() -> None:
    """At 40 m, half precision has steps of 31 mm: 40.99 m becomes 41 m, which is no hit at 1 m any more."""
    true, predicted = seen([CAR], [40.0]), seen([CAR], [40.99])
    assert score_rays(count_rays(predicted, true, OPENOCC), OPENOCC).iou[0, CAR] == 1.0
    assert score_rays(count_rays(predicted, true, SERVER), SERVER).iou[0, CAR] == 0.0


def test_a_wall_is_seen_at_its_far_side() -> None:
    """A wall 10 m ahead, one voxel deep: rays leave it 10.4 m ahead, along their slope."""
    labels = np.full(GRID.shape_zyx, FREE, np.uint8)
    labels[:, :, 125] = BUILDING  # x from 10 to 10.4 m
    found = cast_rays(np.zeros((1, 3)), labels, FREE)
    level = np.flatnonzero((np.abs(lidar_rays()[:, 1]) < 1e-6) & (lidar_rays()[:, 0] > 0))
    level = level[np.argmin(np.abs(lidar_rays()[level, 2]))]
    assert found.label[level] == BUILDING
    assert found.range_m[level] == pytest.approx(10.4 / lidar_rays()[level, 0], abs=1e-4)
    behind = level + 180
    assert found.label[behind] == FREE
    assert found.range_m[behind] == pytest.approx(-40.0 / lidar_rays()[behind, 0], abs=1e-4)


def test_a_ray_that_passes_beside_reads_the_first_voxel() -> None:
    """From 2 m above the grid, rays upwards never enter it: the public code reads voxel (0, 0, 0) then."""
    labels = np.full(GRID.shape_zyx, FREE, np.uint8)
    above = np.array([[0.0, 0.0, 7.4]])
    upwards = lidar_rays()[:, 2] > 0
    found = cast_rays(above, labels, FREE)
    assert (found.label == FREE).all()
    assert (found.range_m[upwards] == np.float32(-1) * np.float32(0.4)).all()
    assert (found.range_m[~upwards][:360] > 0).all()
    labels[0, 0, 0] = BUILDING
    assert (cast_rays(above, labels, FREE).label[upwards] == BUILDING).all()


def test_places_of_the_lidar_along_a_drive() -> None:
    """A drive along x with 5 m a frame; the lidar is 1 m ahead and 2 m above the rear axle."""
    T_world_ego = np.tile(np.eye(4), (30, 1, 1))
    T_world_ego[:, 0, 3] = 100.0 + 5.0 * np.arange(30)
    T_world_ego[:, 1, 3] = -7.0
    T_ego_lidar = np.tile(np.eye(4), (30, 1, 1))
    T_ego_lidar[:, :3, 3] = [1.0, 0.0, 2.0]
    origins = ray_origins(T_world_ego, T_ego_lidar, 10)
    # Frames 3 … 17 are at -34 … 36 m, 2 is at exactly -39 m and 18 at 41 m; 8 of these 15, evenly.
    assert origins[:, 0] == pytest.approx([-34.0, -24.0, -14.0, -4.0, 6.0, 16.0, 26.0, 36.0], abs=1e-4)
    assert origins[:, 1:] == pytest.approx(np.tile([0.0, 2.0], (8, 1)), abs=1e-4)
    few = ray_origins(T_world_ego[:4], T_ego_lidar[:4], 1)
    assert few[:, 0] == pytest.approx([-4.0, 1.0, 6.0, 11.0], abs=1e-4)


def test_places_turn_with_the_frame() -> None:
    """The frame that is scored looks along world y: what lies ahead in x is on its right."""
    T_world_ego = np.tile(np.eye(4), (2, 1, 1))
    T_world_ego[0, :2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    T_world_ego[1, 0, 3] = 10.0
    T_ego_lidar = np.tile(np.eye(4), (2, 1, 1))
    T_ego_lidar[:, :3, 3] = [1.0, 0.0, 2.0]
    T_ego_lidar[:, :2, :2] = [[0.0, 1.0], [-1.0, 0.0]]  # a lidar may be turned on its roof
    origins = ray_origins(T_world_ego, T_ego_lidar, 0)
    assert origins == pytest.approx(np.array([[1.0, 0.0, 2.0], [0.0, -11.0, 2.0]]), abs=1e-5)


def test_an_origin_that_is_not_finite_is_named() -> None:
    labels = np.zeros(GRID.shape_zyx, np.uint8)
    with pytest.raises(InputError, match="origin 1 of the rays"):
        cast_rays(np.array([[0.0, 0.0, 1.0], [0.0, np.nan, 1.0]]), labels, FREE)


def a_scene(rng: np.random.Generator, classes: int) -> np.ndarray:
    """Ground, walls and boxes of random classes."""
    labels = np.full(GRID.shape_zyx, classes - 1, np.uint8)
    labels[:2] = rng.integers(10, classes - 1)
    for _ in range(40):
        x, y = rng.integers(0, 190, 2)
        length, width, height = *rng.integers(2, 10, 2), rng.integers(3, 10)
        labels[2:height, y : y + width, x : x + length] = rng.integers(0, classes - 1)
    return labels


def ray_by_ray(
    frames: list[tuple[Seen, Seen]], protocol: RayProtocol
) -> tuple[list[list[float]], float, float]:
    """IoU by threshold and class, mAVE at 2 m and OccScore, one ray at a time, as the public code states."""
    free = len(protocol.classes) - 1
    table: list[list[float]] = []
    for threshold in protocol.thresholds_m:
        row = []
        for k in range(free):
            hits = true_count = predicted_count = 0
            for predicted, true in frames:
                for n in range(len(true.label)):
                    if true.label[n] == free:
                        continue
                    true_count += true.label[n] == k
                    predicted_count += predicted.label[n] == k
                    close = abs(np.float32(predicted.range_m[n]) - np.float32(true.range_m[n])) < threshold
                    hits += true.label[n] == k and predicted.label[n] == k and close
            either = true_count + predicted_count - hits
            row.append(hits / either if either else math.nan)
        table.append(row)
    errors = []
    for name in sorted(protocol.moving):
        k, total, number = protocol.classes.index(name), 0.0, 0
        for predicted, true in frames:
            for n in range(len(true.label)):
                if (
                    true.label[n] == k == predicted.label[n]
                    and abs(predicted.range_m[n] - true.range_m[n]) < 2
                ):
                    total += math.dist(predicted.velocity_mps[n].tolist(), true.velocity_mps[n].tolist())
                    number += 1
        if number:
            errors.append(total / number)
    known = [iou for row in table for iou in row if not math.isnan(iou)]
    mave = sum(errors) / len(errors)
    return table, mave, 0.9 * sum(known) / len(known) + 0.1 * max(1 - mave, 0.0)


def test_random_scenes_as_counted_ray_by_ray() -> None:
    rng = np.random.default_rng(5)
    counts: RayCounts | None = None
    frames = []
    for _ in range(2):
        truth = a_scene(rng, FREE + 1)
        guess = np.where(rng.random(truth.shape) < 0.05, rng.integers(0, FREE + 1, truth.shape), truth)
        flow = rng.normal(size=(2, *GRID.shape_zyx, 2)).astype(np.float32)
        origins = LIDAR + rng.normal(size=(1, 3)) * [5, 5, 0.1]
        pair = (
            cast_rays(origins, guess.astype(np.uint8), FREE, flow[0]),
            cast_rays(origins, truth, FREE, flow[1]),
        )
        some = rng.permutation(len(pair[0].label))[:600]
        pair = tuple(Seen(s.label[some], s.range_m[some], s.velocity_mps[some]) for s in pair)
        frames.append(pair)
        added = count_rays(*pair, OPENOCC)
        counts = added if counts is None else counts + added
    assert counts is not None
    scores = score_rays(counts, OPENOCC)
    table, mave, occ_score = ray_by_ray(frames, OPENOCC)
    for ours, theirs in zip(scores.iou[:, :-1].tolist(), table, strict=True):
        assert ours == pytest.approx(theirs, nan_ok=True, abs=1e-12)
    assert scores.mave_mps == pytest.approx(mave, abs=1e-6)
    assert scores.occ_score == pytest.approx(occ_score, abs=1e-6)


def test_rays_end_where_the_reference_ends() -> None:
    """The whole chain, single-precision ends included, against a walk with every number spelled out."""
    rng = np.random.default_rng(6)
    labels = a_scene(rng, len(OCC3D_CLASSES))
    free = len(OCC3D_CLASSES) - 1
    origin = np.array([[3.217, -8.41, 1.77]])
    found = cast_rays(origin, labels, free)
    lower, step = np.array([-40.0, -40.0, -1.0]), float(np.float32(0.4))
    start = np.float32((origin[0] - lower) / step).astype(np.float64)
    ends = np.float32((lidar_rays().astype(np.float64) + origin[0] - lower) / step).astype(np.float64)
    direction = ends - start
    direction /= np.sqrt((direction**2).sum(axis=1))[:, None]
    walked = first_hits_reference(np.tile(start, (len(ends), 1)), direction, labels != free)
    assert (found.label == labels.reshape(-1)[walked.voxel]).all()
    assert found.range_m == pytest.approx(walked.distance * 0.4, rel=1e-6)
