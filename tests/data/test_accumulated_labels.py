"""Labels from several sweeps on geometry that is known in closed form."""

from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch

from foredrive.data.label_store import LabelStore, accumulated_labels
from foredrive.data.labels import VoxelLabels, make_labels
from foredrive.data.log_paths import find_logs
from foredrive.data.logs import Log
from foredrive.scene import VoxelSpec

SPEC = VoxelSpec((-10.0, -10.0, -0.75), 0.5, (8, 40, 80))
NOW = 30


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """Six seconds: the ego vehicle passes the parked box, whose far side it then sees."""
    root = tmp_path_factory.mktemp("accumulated")
    world.write(root, frames=61)
    return Log(find_logs(root)[0])


@pytest.fixture(scope="module")
def labels(log: Log) -> tuple[VoxelLabels, VoxelLabels]:
    return make_labels(log, NOW, SPEC), accumulated_labels(log, NOW, SPEC)


def inside(box: dict[str, np.ndarray], margin_m: float) -> np.ndarray:
    """Voxels whose centre lies in a box, in the ego frame of now."""
    t_s = NOW * world.PERIOD_US * 1e-6
    offset = SPEC.centres_m().numpy() + world.driven(t_s) - box["centre"] - [box["speed"] * t_s, 0, 0]
    return (np.abs(offset) <= box["size"] / 2 + margin_m).all(-1)


def test_the_own_sweep_decides_what_it_has_observed(labels: tuple[VoxelLabels, VoxelLabels]) -> None:
    own, accumulated = labels
    assert torch.equal(accumulated.occupied[own.known], own.occupied[own.known])
    assert accumulated.known[own.known].all()
    assert torch.equal(accumulated.flow_mps, own.flow_mps)
    assert torch.equal(accumulated.flow_known, own.flow_known)
    assert not (accumulated.occupied & ~accumulated.known).any()


def test_the_hidden_side_of_a_parked_car_is_labelled(labels: tuple[VoxelLabels, VoxelLabels]) -> None:
    own, accumulated = labels
    shell = torch.from_numpy(inside(world.PARKED, 0.25) & ~inside(world.PARKED, -0.5))
    shell &= SPEC.centres_m()[..., 2] > 0.5
    assert (accumulated.occupied & ~own.known & shell).sum() >= 15


def test_added_voxels_are_true(labels: tuple[VoxelLabels, VoxelLabels]) -> None:
    """Added occupied voxels touch a surface that stands still, and no free one lies in a solid."""
    own, accumulated = labels
    added = (accumulated.known & ~own.known).numpy()
    centres = SPEC.centres_m().numpy()
    touches = (np.abs(centres[..., 2]) <= 0.25 + 1e-6) | inside(world.PARKED, 0.26)
    occupied = accumulated.occupied.numpy() & added
    assert occupied.sum() > 100
    assert touches[occupied].mean() > 0.99
    solid = inside(world.PARKED, -0.25) | (centres[..., 2] < -0.25)
    assert not (added & ~occupied & solid).any()


def test_what_moves_leaves_no_trail(labels: tuple[VoxelLabels, VoxelLabels]) -> None:
    _, accumulated = labels
    above = SPEC.centres_m().numpy()[..., 2] > 0.5
    lane = np.abs(SPEC.centres_m().numpy()[..., 1] - world.MOVING["centre"][1]) <= 1.0
    trail = accumulated.occupied.numpy() & above & lane & ~inside(world.MOVING, 0.3)
    assert not trail.any()


def test_the_cache_keeps_the_sources_apart(log: Log, tmp_path: Path) -> None:
    own, accumulated = make_labels(log, NOW, SPEC), accumulated_labels(log, NOW, SPEC)
    for _ in range(2):  # made, then read
        assert torch.equal(LabelStore(tmp_path, SPEC).labels(log, NOW).known, own.known)
        assert torch.equal(
            LabelStore(tmp_path, SPEC, "accumulated").labels(log, NOW).known, accumulated.known
        )
