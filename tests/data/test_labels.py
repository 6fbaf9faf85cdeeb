"""Voxel labels on geometry that is known in closed form."""

import dataclasses
from pathlib import Path

import numpy as np
import synthetic_log as world
import torch
from arrow_surgery import rewrite_column

from foredrive.data.label_store import LabelStore
from foredrive.data.labels import BOX_MARGIN_M, VoxelLabels, make_labels, voxel_labels
from foredrive.data.lidar import read_sweep
from foredrive.data.log_paths import find_logs
from foredrive.data.logs import Log
from foredrive.scene import Boxes, LidarSweep, VoxelSpec
from foredrive.scene.boxes import unlabelled

SPEC = VoxelSpec((-20.0, -10.0, -0.75), 0.5, (8, 40, 80))


def beams(ends: list[list[float]], returned: list[bool], origin: tuple[float, ...] = (0, 0, 1)) -> LidarSweep:
    end = torch.tensor(ends)
    start = torch.tensor([origin], dtype=torch.float32).expand(len(end), 3)
    along = end - start
    return LidarSweep(
        origin_ego=start,
        dir_ego=along / along.norm(dim=-1, keepdim=True),
        range_m=along.norm(dim=-1),
        returned=torch.tensor(returned),
        intensity=torch.zeros(len(end)),
        dt_s=torch.zeros(len(end)),
        beam=torch.zeros(len(end), dtype=torch.int64),
        valid=torch.ones(len(end), dtype=torch.bool),
    )


def at(grid: torch.Tensor, x: float, y: float, z: float) -> float:
    """The value of the voxel that a point lies in."""
    index = [int(np.floor((p - low) / SPEC.voxel_m)) for p, low in zip((x, y, z), SPEC.lower_m, strict=True)]
    return grid[..., index[2], index[1], index[0]].tolist()


def same(a: VoxelLabels, b: VoxelLabels) -> None:
    for field in dataclasses.fields(VoxelLabels):
        torch.testing.assert_close(getattr(a, field.name), getattr(b, field.name), atol=5e-3, rtol=1e-3)


def test_occupied_free_and_unknown_are_three_things() -> None:
    labels = voxel_labels(beams([[5.2, 0, 1]], [True]), SPEC, None, None)
    assert [at(labels.occupied, x, 0.1, 1.1) for x in (4.1, 5.2, 6.1)] == [False, True, False]
    assert [at(labels.known, x, 0.1, 1.1) for x in (4.1, 5.2, 6.1)] == [True, True, False]
    assert labels.known.sum() == 11  # the voxels from x = 0 to 5.5
    assert not labels.flow_known.any()  # not annotated


def test_the_last_stretch_before_a_return_frees_nothing() -> None:
    """The beam enters the voxel at (5.05, 0.3) 20 cm before its return beside it."""
    labels = voxel_labels(beams([[5.2, 0.51, 1]], [True]), SPEC, None, None)
    assert at(labels.occupied, 5.2, 0.51, 1)
    assert at(labels.known, 4.9, 0.3, 1)
    assert not at(labels.known, 5.05, 0.3, 1)


def test_occupied_wins_over_a_beam_that_passed_through() -> None:
    labels = voxel_labels(beams([[5.1, 0, 1], [4.4, 0, 1]], [True, True]), SPEC, None, None)
    assert at(labels.occupied, 4.4, 0.1, 1.1)


def test_a_miss_frees_up_to_its_free_range_only() -> None:
    sweep = beams([[5.2, 0, 1], [0, 5.2, 1]], [False, False])
    sweep.range_m[1] = 0.0  # nothing is known about this one
    labels = voxel_labels(sweep, SPEC, None, None)
    assert not labels.occupied.any()
    assert at(labels.known, 5.1, 0.1, 1.1)
    assert not at(labels.known, 5.6, 0.1, 1.1)
    assert not at(labels.known, 0.1, 2.1, 1.1)
    assert labels.known.sum() == 11


def test_returns_from_the_ego_vehicle_are_dropped() -> None:
    ends = [[1.0, 0.2, 0.9], [2.0, 0.2, 1.85], [5.2, 3.1, 1], [2.0, 0.2, 2.9]]
    sweep = beams(ends, [True] * 4, origin=(0, 0, 1.9))  # a sensor on the roof
    labels = voxel_labels(sweep, SPEC, None, (np.array([1.5, 0, 0.75]), np.array([4.5, 1.9, 1.5])))
    assert [at(labels.occupied, *end) for end in ends] == [False, False, True, True]
    assert not at(labels.known, 1.0, 0.2, 0.9)


def test_a_sweep_without_points_leaves_everything_unknown() -> None:
    nothing = beams([[1.0, 0, 0]], [True])[torch.zeros(1, dtype=torch.bool)]
    labels = voxel_labels(nothing, SPEC, None, None)
    assert not labels.known.any()


def box(velocity: tuple[float, float]) -> Boxes:
    return Boxes(
        centre=torch.tensor([[5.0, 0.0, 1.0]]),
        size_lwh=torch.tensor([[4.0, 2.0, 2.0]]),
        yaw=torch.zeros(1),
        velocity=torch.tensor([velocity]),
        track_id=torch.zeros(1, dtype=torch.int64),
        category=torch.zeros(1, dtype=torch.int64),
        valid=torch.ones(1, dtype=torch.bool),
        **unlabelled(1),
    )


def test_flow_is_the_boxes_velocity_inside_and_zero_outside() -> None:
    sweep = beams([[3.2, 0, 1], [8.2, 3, 1]], [True, True])
    labels = voxel_labels(sweep, SPEC, box((4.0, -1.0)), None)
    assert at(labels.flow_mps, 3.2, 0.1, 1.1) == [4.0, -1.0, 0.0]
    assert at(labels.flow_mps, 8.2, 3.1, 1.1) == [0.0, 0.0, 0.0]
    assert torch.equal(labels.flow_known, labels.occupied)


def test_flow_of_an_unknown_velocity_is_unknown() -> None:
    sweep = beams([[3.2, 0, 1], [8.2, 3, 1]], [True, True])
    labels = voxel_labels(sweep, SPEC, box((float("nan"), float("nan"))), None)
    assert not at(labels.flow_known, 3.2, 0.1, 1.1)
    assert at(labels.flow_known, 8.2, 3.1, 1.1)
    assert not labels.flow_mps.any()


def test_labels_of_a_log_agree_with_its_geometry(flat_log: Path) -> None:
    """Every occupied voxel touches a surface; no free one lies wholly inside a solid or under the ground."""
    log = Log(find_logs(flat_log)[0])
    labels = make_labels(log, 10, SPEC)
    centres = SPEC.centres_m().numpy() + world.driven(1.0)
    half = SPEC.voxel_m / 2
    in_box = np.zeros(centres.shape[:3], bool)
    touches = np.abs(centres[..., 2]) <= half + 1e-6
    for thing in (world.PARKED, world.MOVING):
        offset = np.abs(centres - thing["centre"] - [thing["speed"] * 1.0, 0, 0])
        in_box |= (offset <= thing["size"] / 2 - half).all(-1)
        touches |= (offset <= thing["size"] / 2 + half + 1e-3).all(-1)
    occupied, free = labels.occupied.numpy(), (labels.known & ~labels.occupied).numpy()
    assert occupied.sum() > 200
    assert touches[occupied].all()
    assert not (free & (in_box | (centres[..., 2] < -half))).any()
    moving = labels.flow_mps.norm(dim=0) > 0
    offset = np.abs(centres - world.MOVING["centre"] - [world.MOVING["speed"], 0, 0])
    assert moving.sum() > 20
    assert (offset[moving.numpy()] <= world.MOVING["size"] / 2 + half + BOX_MARGIN_M).all()
    assert set(labels.flow_mps[0][moving].tolist()) == {3.0}
    assert torch.equal(labels.flow_known, labels.occupied)


def test_misses_make_more_known(flat_log: Path) -> None:
    sweep, misses_known = read_sweep(Log(find_logs(flat_log)[0]), 0)
    assert misses_known
    whole = voxel_labels(sweep, SPEC, None, None)
    returns = voxel_labels(sweep[sweep.returned], SPEC, None, None)
    assert torch.equal(whole.occupied, returns.occupied)
    assert whole.known.sum() > 1.2 * returns.known.sum()


def entries(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.labels"))


def test_labels_are_kept_and_made_anew_when_damaged(flat_log: Path, tmp_path: Path) -> None:
    log = Log(find_logs(flat_log)[0])
    made = LabelStore(None, SPEC).labels(log, 4)
    store = LabelStore(tmp_path, SPEC)
    same(store.labels(log, 4), made)
    (entry,) = entries(tmp_path)
    whole = entry.read_bytes()
    same(store.labels(log, 4), made)  # read back
    for damaged in (whole[:-20], b"", bytes([whole[0] ^ 1]) + whole[1:], whole[:99] + b"\0" + whole[100:]):
        entry.write_bytes(damaged)
        same(store.labels(log, 4), made)
        assert entry.read_bytes() == whole


def test_a_kept_label_answers_for_its_own_inputs_only(tmp_path: Path) -> None:
    folder = world.write(tmp_path / "data", frames=3)
    store = LabelStore(tmp_path / "cache", SPEC)
    path = find_logs(folder)[0]
    store.labels(Log(path), 0)
    store.labels(Log(path), 1)
    LabelStore(tmp_path / "cache", dataclasses.replace(SPEC, voxel_m=0.4)).labels(Log(path), 0)
    assert len(entries(tmp_path / "cache")) == 3
    rewrite_column(
        folder / "box_detections_se3.arrow",
        "box_detections_se3.timestamp_us",
        lambda t: [*t[:-1], t[-1] + 1],
    )
    store.labels(Log(path), 0)
    assert len(entries(tmp_path / "cache")) == 4


def test_a_log_without_lidar_is_unknown_everywhere(tmp_path: Path) -> None:
    folder = world.write(tmp_path, frames=2)
    for file in ("lidar.lidar_top.arrow", "custom.lidar_beams.arrow"):
        (folder / file).unlink()
    labels = make_labels(Log(find_logs(folder)[0]), 0, SPEC)
    assert not labels.known.any()
    assert not labels.flow_known.any()
