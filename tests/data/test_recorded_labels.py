"""Recorded occupancy as labels: exact where grids coincide, near elsewhere, unknown beyond the recording."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch

from foredrive.data import ClipConfig, ClipDataset, LogPath
from foredrive.data.log_writer import LogWriter
from foredrive.data.modalities import FullOccupancy
from foredrive.data.recorded_labels import resampled_labels
from foredrive.errors import InputError
from foredrive.scene import VoxelSpec

GRID = VoxelSpec((-4.0, -3.0, -1.0), 0.5, (6, 12, 16))
ROAD, CAR, BUS = (np.zeros(3), np.array([3.0, -1.0, 0.5]), np.array([0.0, 8.0, 0.0]))


def occupancy(*voxels: tuple[tuple[int, int, int], np.ndarray], spec: VoxelSpec = GRID) -> FullOccupancy:
    """Voxels by index z, y, x, and their velocities."""
    index = np.array([index for index, _ in voxels], dtype=np.int64).reshape(-1, 3)
    velocity = np.array([velocity for _, velocity in voxels], dtype=np.float32).reshape(-1, 3)
    category = np.where(velocity.any(axis=1), 0, -1)
    return FullOccupancy(spec, index, category, velocity)


def at(spec: VoxelSpec, *xyz: float) -> tuple[int, ...]:
    """Index z, y, x of the voxel that a point lies in."""
    steps = [int(np.floor((p - low) / spec.voxel_m)) for p, low in zip(xyz, spec.lower_m, strict=True)]
    return tuple(steps[::-1])


def test_on_its_own_grid_it_is_what_was_recorded() -> None:
    labels = resampled_labels(occupancy(((0, 1, 2), ROAD), ((5, 11, 15), CAR)), GRID)
    assert labels.known.all()
    assert labels.occupied.nonzero().tolist() == [[0, 1, 2], [5, 11, 15]]
    assert labels.flow_mps[:, 5, 11, 15].tolist() == CAR.tolist()
    assert labels.flow_mps.count_nonzero() == 3
    assert torch.equal(labels.flow_known, labels.occupied)


def test_a_coarser_voxel_is_occupied_by_any_of_its_parts_and_moves_as_the_fastest() -> None:
    recorded = occupancy(((0, 0, 1), BUS), ((1, 1, 0), CAR), ((1, 0, 0), ROAD), ((4, 11, 15), ROAD))
    coarse = VoxelSpec(GRID.lower_m, 1.0, (3, 6, 8))
    labels = resampled_labels(recorded, coarse)
    assert labels.known.all()
    assert labels.occupied.nonzero().tolist() == [[0, 0, 0], [2, 5, 7]]
    assert labels.flow_mps[:, 0, 0, 0].tolist() == BUS.tolist()
    assert not labels.flow_mps[:, 2, 5, 7].any()


@pytest.mark.parametrize("parts", [2, 3])
def test_finer_and_coarser_by_whole_steps_lose_nothing(parts: int) -> None:
    """Cut into parts and put together again, a recording is as it was."""
    rng = np.random.default_rng(parts)
    flat = rng.choice(np.prod(GRID.shape_zyx), 200, replace=False)
    index = np.stack(np.unravel_index(flat, GRID.shape_zyx), axis=1)
    velocity = np.where(rng.random((200, 1)) < 0.5, rng.normal(0, 5, (200, 3)), 0.0).astype(np.float32)
    recorded = FullOccupancy(GRID, index, np.zeros(200, np.int64), velocity)
    fine = VoxelSpec(GRID.lower_m, GRID.voxel_m / parts, tuple(n * parts for n in GRID.shape_zyx))
    cut = resampled_labels(recorded, fine)
    assert cut.occupied.sum() == 200 * parts**3
    held = cut.occupied.nonzero().numpy()
    flow = cut.flow_mps.permute(1, 2, 3, 0)[cut.occupied].numpy()
    whole = resampled_labels(FullOccupancy(fine, held, np.zeros(len(held), np.int64), flow), GRID)
    again = resampled_labels(recorded, GRID)
    for field in ("occupied", "known", "flow_mps", "flow_known"):
        assert torch.equal(getattr(whole, field), getattr(again, field))


def test_beyond_the_recording_nothing_is_known() -> None:
    shifted = VoxelSpec((-5.0, -3.0, -1.0), 0.5, GRID.shape_zyx)  # two voxels further back
    labels = resampled_labels(occupancy(((0, 0, 0), ROAD), ((0, 0, 15), CAR)), shifted)
    assert not labels.known[..., :2].any()
    assert labels.known[..., 2:].all()
    assert labels.occupied.nonzero().tolist() == [[0, 0, 2]]
    half_out = VoxelSpec((-4.25, -3.0, -1.0), 0.5, GRID.shape_zyx)
    labels = resampled_labels(occupancy(((0, 0, 0), ROAD)), half_out)
    assert not labels.known[..., 0].any()
    assert not (labels.occupied & ~labels.known).any()


def test_grids_that_do_not_coincide_are_off_by_half_a_recorded_voxel_at_most() -> None:
    rng = np.random.default_rng(0)
    index = np.stack([rng.integers(1, n - 1, 40) for n in GRID.shape_zyx], axis=1)
    recorded = occupancy(*((tuple(i), ROAD) for i in index.tolist()))
    other = VoxelSpec((-3.9, -2.7, -0.9), 0.7, (4, 8, 10))
    labels = resampled_labels(recorded, other)
    middles = np.array(GRID.lower_m) + (index[:, ::-1] + 0.5) * GRID.voxel_m
    within = ((middles > other.lower_m) & (middles < other.upper_m)).all(axis=1)
    kept = [bool(labels.occupied[at(other, *m)]) for m in middles[within] if labels.known[at(other, *m)]]
    assert len(kept) > 10
    assert all(kept)  # nothing is lost
    centres = other.centres_m()[labels.occupied].numpy()
    apart = np.abs(centres[:, None] - middles).max(axis=-1).min(axis=1)
    assert apart.max() < 0.5 * other.voxel_m + 0.5 * GRID.voxel_m


def write_log(root: Path, frames: int, recorded_until: int) -> LogPath:
    """The flat log with a voxel that moves along, in the frames before `recorded_until`."""
    specs = world.cameras()
    with LogWriter(root, "flat_train", "log", specs, None, None, None) as writer:
        for k in range(frames):
            full = occupancy(((1, 2, k), CAR)) if k < recorded_until else None
            writer.write(dataclasses.replace(world.frame(k, specs), occupancy=full))
    return LogPath(root / "logs" / "flat_train" / "log", root / "maps")


def config(source: str) -> ClipConfig:
    return ClipConfig(
        past_frames=0,
        future_frames=1,
        image_hw=(12, 24),
        voxels=GRID,
        frame_dt_s=0.1,
        now_stride_s=0.1,
        occupancy_source=source,
    )


def test_examples_carry_it_where_it_is_asked_for(tmp_path: Path) -> None:
    log = write_log(tmp_path, frames=3, recorded_until=3)
    example = ClipDataset([log], config("recorded"), tmp_path / "cache")[1]
    assert example.occupancy.known.all()
    assert example.occupancy.values.nonzero().tolist() == [[0, 0, 1, 2, 1], [1, 0, 1, 2, 2]]
    assert example.flow.values[0, :, 1, 2, 1].tolist() == CAR.tolist()
    assert torch.equal(example.flow.known, example.occupancy.values[:, 0] > 0)
    seen = ClipDataset([log], config("lidar"), tmp_path / "cache")[1]
    assert not seen.occupancy.known.all()
    again = ClipDataset([log], config("recorded"), tmp_path / "cache")[1]  # from the cache, beside lidar's
    for grid in ("occupancy", "flow"):
        one, two = getattr(example, grid), getattr(again, grid)
        assert torch.equal(one.values, two.values)
        assert torch.equal(one.known, two.known)


def test_a_log_or_a_frame_without_it_is_named(flat_log: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"{flat_log}: no recorded occupancy"):
        ClipDataset([LogPath(flat_log, flat_log.parents[2] / "maps")], config("recorded"), None)
    half = ClipDataset([write_log(tmp_path, frames=3, recorded_until=2)], config("recorded"), None)
    assert half[0].occupancy.known.all()
    with pytest.raises(InputError, match="no recorded occupancy at frame 2"):
        half[1]
