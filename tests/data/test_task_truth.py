"""The truth of tasks in clips: off by default, cached, batched; and what a log can judge."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
from flat_street import street
from nuscenes_keyframe import written_keyframe

from foredrive.data import ClipConfig, ClipDataset, LogPath, collate, find_logs
from foredrive.data.clip_config import TaskTruthConfig
from foredrive.data.formats.convert import convert
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.data.maps import write_map
from foredrive.data.modalities import FullOccupancy
from foredrive.data.truth.tasks import tasks_of
from foredrive.scene import VoxelSpec
from foredrive.scene.record import Record
from foredrive.scene.task_truth import TaskTruth

SPEC = VoxelSpec((-4.0, -3.0, -1.0), 0.5, (6, 12, 16))
CONFIG = ClipConfig(0, 0, (12, 24), SPEC, now_stride_s=0.5, tasks=TaskTruthConfig())


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    """The flat log of 4 s with a map, and with recorded voxels."""
    root = tmp_path_factory.mktemp("truth")
    specs = world.cameras()
    maps_dir = write_map(street(), "Flatland", root)
    with LogWriter(root, "flat_train", "log", specs, maps_dir, "Flatland", None) as writer:
        for k in range(41):
            index = np.array([[1, 2, k % 16]])
            full = FullOccupancy(SPEC, index, np.array([-1]), np.zeros((1, 3), np.float32))
            writer.write(dataclasses.replace(world.frame(k, specs), occupancy=full))
    return find_logs(root)[0]


def assert_same(one: Record | None, other: Record | None) -> None:
    assert one is not None
    assert other is not None
    for name, value in vars(one).items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, getattr(other, name)), name
            assert value.dtype == getattr(other, name).dtype
        elif isinstance(value, Record):
            assert_same(value, getattr(other, name))
        else:
            assert value == getattr(other, name)


def test_it_is_read_only_where_it_is_asked_for(log: LogPath) -> None:
    clips = ClipDataset([log], dataclasses.replace(CONFIG, tasks=None), None)
    assert clips[0].truth is None
    some = TaskTruthConfig(raster=None, semantics=None, instances=None, elements_lw_m=None)
    truth = ClipDataset([log], dataclasses.replace(CONFIG, tasks=some), None)[0].truth
    assert truth is not None
    assert truth.futures is not None
    assert truth.elements is truth.raster is truth.semantics is truth.instances is None


def test_a_cached_entry_is_what_was_made(log: LogPath, tmp_path: Path) -> None:
    made = ClipDataset([log], CONFIG, None)[3].truth
    clips = ClipDataset([log], CONFIG, tmp_path)
    for _ in range(2):
        assert_same(made, clips[3].truth)
    assert made is not None
    assert made.elements is not None
    assert made.semantics is not None
    assert len(made.elements.kind) > 5
    assert bool(made.semantics.known.all())


def test_a_damaged_entry_is_made_anew(log: LogPath, tmp_path: Path) -> None:
    clips = ClipDataset([log], CONFIG, tmp_path)
    before = clips[2].truth
    (entry,) = (tmp_path / "truth").rglob("*.truth")
    entry.write_bytes(entry.read_bytes()[:-20])
    assert_same(before, clips[2].truth)
    assert_same(before, ClipDataset([log], CONFIG, tmp_path)[2].truth)


def test_another_configuration_is_another_entry(log: LogPath, tmp_path: Path) -> None:
    wide = dataclasses.replace(CONFIG, tasks=TaskTruthConfig(elements_lw_m=(100.0, 50.0)))
    extents = []
    for config in (CONFIG, wide):
        truth = ClipDataset([log], config, tmp_path)[0].truth
        assert truth is not None
        assert truth.elements is not None
        extents.append(float(truth.elements.vertices[..., 0].abs().max()))
    assert extents == pytest.approx([30.0, 50.0], abs=1e-3)


def test_batches_pad_futures_and_polylines(log: LogPath) -> None:
    clips = ClipDataset([log], CONFIG, None)
    bare, full = clips[0], clips[4]
    assert bare.truth is not None
    assert bare.truth.futures is not None
    assert bare.truth.elements is not None
    without = dataclasses.replace(
        bare.truth, futures=bare.truth.futures[:1], elements=_without_lines(bare.truth)
    )
    batch = collate([dataclasses.replace(bare, truth=without), full]).truth
    assert batch is not None
    assert batch.futures is not None
    assert batch.elements is not None
    assert batch.raster is not None
    assert batch.futures.xy.shape == (2, 2, 12, 2)
    assert batch.futures.valid.any(-1).tolist() == [[True, False], [True, True]]
    assert (batch.elements.kind[0] == -1).all()
    assert batch.elements.known.tolist() == [True, True]
    assert batch.raster.layers.shape == (2, 4, 200, 200)


def _without_lines(truth: TaskTruth) -> Record:
    assert truth.elements is not None
    elements = truth.elements
    return dataclasses.replace(
        elements, vertices=elements.vertices[:0], valid=elements.valid[:0], kind=elements.kind[:0]
    )


def test_futures_belong_to_the_boxes_of_now(log: LogPath) -> None:
    example = ClipDataset([log], CONFIG, None)[0]
    assert example.truth is not None
    futures = example.truth.futures
    assert futures is not None
    moving = example.clip.boxes.track_id[0].tolist().index(11)
    start = example.clip.boxes.centre[0, moving, 0]
    steps = 0.5 * torch.arange(1, 9) * world.MOVING["speed"]
    torch.testing.assert_close(futures.xy[moving, :8, 0], start + steps, atol=1e-3, rtol=0)
    assert futures.valid[moving].tolist() == [True] * 8 + [False] * 4


def test_a_log_says_what_it_can_judge(log: LogPath, flat_log: Path, tmp_path: Path) -> None:
    told = {support.task: support for support in tasks_of(Log(log))}
    assert list(told) == ["detection", "tracking", "map", "motion", "occupancy", "planning"]
    assert all(support.judged for support in told.values())
    assert told["motion"].line == "motion: yes, tracks of up to 4.0 s, so no future of 6 s is whole"
    assert "never others, barrier" in told["occupancy"].line
    bare = {support.task: support.line for support in tasks_of(Log(LogPath(flat_log, tmp_path)))}
    assert bare["map"] == "map: no, it has no map"
    assert bare["occupancy"].startswith("occupancy: yes, vehicles from above (IoU, VPQ)")
    assert "without attributes (no attribute error), visibility" in bare["detection"]
    (path,) = find_logs(world.write(tmp_path, frames=1))
    (path.folder / "box_detections_se3.arrow").unlink()
    none = {support.task: support.line for support in tasks_of(Log(path))}
    assert none["detection"] == "detection: no, it has no boxes"
    assert [task for task, line in none.items() if ": no" not in line] == []


@pytest.mark.real
def test_real_logs_say_what_they_can_judge(real_data: Path, tmp_path: Path) -> None:
    def judged(paths: list[LogPath]) -> set[str]:
        return {support.task for support in tasks_of(Log(paths[0])) if support.judged}

    everything = {"detection", "tracking", "map", "motion", "occupancy", "planning"}
    assert judged(convert(real_data / "pandaset", "pandaset", tmp_path)) == everything - {"map"}
    av2 = convert(real_data / "av2", "av2", tmp_path)
    assert judged(av2) == everything
    keyframe = convert(written_keyframe(real_data, tmp_path), "nuscenes", tmp_path / "out")
    assert judged(keyframe) == {"detection", "occupancy"}
    kitti = convert(real_data / "kitti", "kitti-object", tmp_path)
    assert "map" not in judged(kitti)
    truth = ClipDataset([av2[0]], dataclasses.replace(CONFIG, image_hw=(8, 8)), None)[4].truth
    assert truth is not None
    assert truth.futures is not None
    assert truth.instances is not None
    assert truth.futures.valid.float().mean() > 0.5
    assert bool(truth.instances.valid.all())
    assert truth.instances.track_id.count_nonzero() > 100
