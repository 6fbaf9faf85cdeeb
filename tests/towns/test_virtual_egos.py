"""Short logs from virtual egos: what is in them, and that equal seeds give equal bytes."""

import dataclasses
import functools
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import shapely
import shapely.affinity
import torch
from file_digests import digests
from miniature import miniature

from foredrive.data import ClipConfig, ClipDataset
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.clip_config import TaskTruthConfig
from foredrive.data.commands import route_at
from foredrive.data.labels import make_labels
from foredrive.data.lidar import frames_with_lidar
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.data.recorded_labels import recorded_labels
from foredrive.data.truth.affordances import read_affordances
from foredrive.runs.build import build_agent
from foredrive.runs.train.baselines import fit_baselines
from foredrive.runs.train.kept_volumes import KeptVolumes
from foredrive.scene import Category, VoxelSpec
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns import virtual_egos
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.virtual_egos import FORESEEN, IMAGES, LATER, record_virtual_egos
from foredrive.towns.world import World

SMALL = SensorSuite(camera_rig((24, 40)), None)
COUNT = 18
"""More than come from one window of the traffic."""

GRID = VoxelSpec(lower_m=(-16.0, -16.0, -1.0), voxel_m=1.0, shape_zyx=(4, 32, 32))


@pytest.fixture(scope="module")
def logs(world02: World, tmp_path_factory: pytest.TempPathFactory) -> list[LogPath]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(virtual_egos, "World", lambda town, seed, conditions: world02)
        out = tmp_path_factory.mktemp("egos")
        return record_virtual_egos("Town02", 3, COUNT, out, SMALL, occupancy=GRID)


def test_each_log_has_images_first_and_then_its_future(logs: list[LogPath]) -> None:
    assert [path.name for path in logs[:2]] == [f"town-egos_train/Town02_seed3_ego{k:04d}" for k in range(2)]
    log = Log(logs[5])
    assert np.diff(log.t_us).tolist() == [500_000] * (IMAGES + LATER - 1)
    cameras = pinhole_cameras(log)
    assert len(cameras) == 6
    for camera in cameras.values():
        frames, _ = log.rows(camera.modality_key)
        assert frames.tolist() == list(range(IMAGES))
    shown = read_camera(log, IMAGES - 1, cameras["PCAM_F0"], (24, 40), with_image=True)
    assert shown.image is not None
    assert float(shown.image.float().std()) > 5.0


def test_the_ego_is_no_box_and_drives_along_its_route(logs: list[LogPath]) -> None:
    """Its own car would stand over the rear axle. Lateral offsets are those that were drawn, below 1.5 m."""
    moved_m = []
    for path in logs:
        log = Log(path)
        for frame in (0, IMAGES + LATER - 1):
            boxes = read_boxes(log, frame)
            assert boxes is not None
            middle_m = boxes.centre[:, :2] - boxes.centre.new_tensor([1.4, 0.0])
            vehicles = boxes.category != int(Category.PEDESTRIAN)
            assert float(middle_m[vehicles].norm(dim=-1).min()) > 1.5
            arc_m, xyz, progress_m = route_at(log, frame) or pytest.fail("no route")
            beside = np.array([np.interp(progress_m, arc_m, xyz[:, axis]) for axis in range(2)])
            assert np.linalg.norm(beside - log.T_world_ego[frame, :2, 3]) < 1.5
        moved_m.append(np.linalg.norm(log.T_world_ego[-1, :3, 3] - log.T_world_ego[0, :3, 3]))
        speed_mps = np.linalg.norm(np.diff(log.T_world_ego[:, :3, 3], axis=0), axis=-1) / 0.5
        assert np.abs(speed_mps - 0.5 * (log.speed_mps[1:] + log.speed_mps[:-1])).max() < 0.8
    assert np.median(moved_m) > 5.0


def test_the_labels_of_the_last_image_are_known(logs: list[LogPath]) -> None:
    """They need 4 s of boxes after it, and lights on the route."""
    lights = 0
    for path in logs:
        seen = read_affordances(Log(path), IMAGES - 1)
        assert bool(seen.lead_known)
        assert bool(seen.light_known)
        lights += int(seen.light) > 0
    assert lights >= COUNT // 4


def test_people_and_cyclists_come_onto_the_route(logs: list[LogPath]) -> None:
    """Those who are added have sizes of their own; they begin at least 3 m beside the route."""
    onto = 0
    for path in logs:
        log = Log(path)
        _, xyz, _ = route_at(log, 0) or pytest.fail("no route")
        beside_m = []
        for frame in range(len(log)):
            boxes = read_boxes(log, frame)
            assert boxes is not None
            added = torch.isin(boxes.size_lwh[:, 1], torch.tensor([0.6, 0.55])) & (
                boxes.size_lwh[:, 2] > 1.69
            )
            T = torch.from_numpy(log.T_world_ego[frame]).float()
            for centre in boxes.centre[added] @ T[:3, :3].T + T[:3, 3]:
                beside_m.append(np.linalg.norm(xyz[:, :2] - centre[:2].numpy(), axis=-1).min())
        onto += bool(beside_m) and beside_m[0] > 2.5 and min(beside_m) < 1.5
    assert onto >= COUNT // 4


def test_cyclists_wait_and_then_cross(logs: list[LogPath]) -> None:
    """A cyclist who is added stands, or rides on at one speed of 3.5 to 6 m/s."""
    speeds = []
    for path in logs:
        log = Log(path)
        tracks = [read_boxes(log, frame) for frame in range(len(log))]
        for boxes in tracks:
            assert boxes is not None
            inserted = (boxes.category == int(Category.BICYCLE)) & (boxes.size_lwh[:, 2] - 1.7).abs().lt(1e-4)
            speeds += boxes.velocity[inserted].norm(dim=-1).tolist()
    moving = [speed for speed in speeds if speed > 0.1]
    assert moving
    assert len(moving) < len(speeds)
    assert min(moving) > 3.4
    assert max(moving) < 6.1


def test_clips_are_those_that_see_something(logs: list[LogPath]) -> None:
    """With two frames of history, and a grid that is not needed here, each log gives four clips."""
    spec = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=2.0, shape_zyx=(2, 8, 8))
    config = ClipConfig(past_frames=2, future_frames=0, image_hw=(24, 40), voxels=spec)
    clips = ClipDataset(logs, config, None)
    assert len(clips) == COUNT * (IMAGES - 2)
    clip = clips.clip(3)
    assert bool(clip.image_valid.all())
    assert clip.t_s.tolist() == pytest.approx([-1.0, -0.5, 0.0])
    assert bool(clip.future.valid.all())


def test_no_demonstration_leads_through_anybody(logs: list[LogPath]) -> None:
    """Egos do not see the people who were added. A future through one of them is masked, and few others."""
    clips, through = ClipDataset(logs, ClipConfig(1, 0, (24, 40), GRID), None), 0
    for index in range(len(clips)):
        number, frames = clips.frames_of(index)
        met_s, clear_m = _nearest_person(clips.logs[number], frames[1], seconds=5.0)
        valid = bool(clips.clip(index).future.valid.any())
        through += not valid and met_s < 5.0
        assert not (valid and met_s < 3.0)
        assert valid or clear_m < 1.0
        assert clips.demonstration(index)[1].valid.any() == valid
    assert through > 0
    assert clips.touching >= through


@pytest.mark.slow
def test_no_future_of_200_logs_touches_anybody(tmp_path: Path) -> None:
    """The outlines are compared every 0.05 s by shapely, without the package's own test of contact."""
    rig = camera_rig((8, 12))
    sensors = SensorSuite(dataclasses.replace(rig[[0]], names=rig.names[:1]), None)
    towns = ("Town01", "Town05")
    paths = [path for town in towns for path in record_virtual_egos(town, 0, 100, tmp_path, sensors)]
    clips, touched = ClipDataset(paths, ClipConfig(1, 0, (8, 12), GRID), None), 0
    for index in range(len(clips)):
        number, frames = clips.frames_of(index)
        steps = range(frames[1], frames[1] + 6)
        meets = any(_outlines_meet(clips.logs[number], step) for step in steps)
        assert not (meets and clips.demonstration(index)[1].valid.any())
        touched += meets
    assert len(clips) == 200 * (IMAGES - 1)
    assert touched > 100


@functools.cache
def _outlines_meet(log: Log, frame: int) -> bool:
    """Return whether the vehicle meets a box before the next key frame, both at constant velocity."""
    centre, size = log.ego_box
    shares = np.linspace(0, 1, 11)
    T_world_ego, _ = log.poses_at(np.interp(shares, (0, 1), log.t_us[frame : frame + 2]))
    first, second = (_outlines(log, number) for number in (frame, frame + 1))
    for track in set(first) & set(second):
        (xyz, yaw, box_m), (xyz_after, yaw_after, _) = first[track], second[track]
        turn = (yaw_after - yaw + math.pi) % (2 * math.pi) - math.pi
        for share, T in zip(shares, T_world_ego, strict=True):
            place = xyz + share * (xyz_after - xyz)
            if np.abs(place - T[:3, 3]).max() > 12.0 or abs(place[2] - T[2, 3]) > 2.5:
                continue
            own = _outline(T[:3, :3] @ centre + T[:3, 3], math.atan2(T[1, 0], T[0, 0]), size)
            if own.intersects(_outline(place, yaw + share * turn, box_m)):
                return True
    return False


def _outline(centre_m: np.ndarray, yaw: float, size_m: np.ndarray) -> shapely.Polygon:
    flat = shapely.box(*(-0.5 * size_m[:2]), *(0.5 * size_m[:2]))
    turned = shapely.affinity.rotate(flat, yaw, (0, 0), use_radians=True)
    return shapely.affinity.translate(turned, *centre_m[:2])


@functools.cache
def _outlines(log: Log, frame: int) -> dict[int, tuple[np.ndarray, float, np.ndarray]]:
    """Return world place, yaw and size of each box by its track."""
    boxes, T = read_boxes(log, frame) or pytest.fail("no boxes"), log.T_world_ego[frame]
    xyz = boxes.centre.double().numpy() @ T[:3, :3].T + T[:3, 3]
    yaw = boxes.yaw.double().numpy() + math.atan2(T[1, 0], T[0, 0])
    rows = zip(boxes.track_id.tolist(), xyz, yaw.tolist(), boxes.size_lwh.double().numpy(), strict=True)
    return {track: row for track, *row in rows}


def _nearest_person(log: Log, frame: int, seconds: float) -> tuple[float, float]:
    """When the ego's outline first holds the middle of a person or cyclist, and how near one comes, s, m.

    A person's middle is inside of the box of the vehicle, a coarser test than that of the package.
    """
    centre, size = log.ego_box
    shares, met_s, nearest_m = np.linspace(0, 1, 26), math.inf, math.inf
    for later in range(frame, min(frame + round(seconds / 0.5), len(log) - 1)):
        T_world_ego, _ = log.poses_at(np.interp(shares, (0, 1), log.t_us[later : later + 2]))
        first, second = (_persons(log, number) for number in (later, later + 1))
        for track in set(first) & set(second):
            xy = (1 - shares)[:, None] * first[track] + shares[:, None] * second[track]
            now = np.einsum("sji,sj->si", T_world_ego[:, :2, :2], xy - T_world_ego[:, :2, 3])
            beyond_m = np.linalg.norm(np.maximum(np.abs(now - centre[:2]) - 0.5 * size[:2], 0), axis=-1)
            nearest_m = min(nearest_m, float(beyond_m.min()))
            if (beyond_m == 0).any():
                met_s = min(met_s, 0.5 * (later - frame + float(shares[beyond_m == 0][0])))
    return met_s, nearest_m


@functools.cache
def _persons(log: Log, frame: int) -> dict[int, np.ndarray]:
    """World places of people and cyclists by their tracks."""
    boxes = read_boxes(log, frame) or pytest.fail("no boxes")
    chosen = torch.isin(boxes.category, torch.tensor([int(Category.BICYCLE), int(Category.PEDESTRIAN)]))
    T = log.T_world_ego[frame]
    xyz = boxes.centre[chosen].double().numpy() @ T[:3, :3].T + T[:3, 3]
    return dict(zip(boxes.track_id[chosen].tolist(), xyz[:, :2], strict=True))


def test_a_world_model_learns_from_past_now_and_what_comes(logs: list[LogPath]) -> None:
    """The last image has occupancy three seconds later; road users fill it, who move with their flow."""
    config = ClipConfig(1, FORESEEN, (24, 40), GRID, occupancy_source="recorded", future_images=False)
    clips = ClipDataset(logs, config, None)
    assert len(clips) == COUNT * (IMAGES - 1)
    filled = moving = 0
    for index in range(0, len(clips), 3):
        example, now = clips[index], 1
        boxes = example.clip.boxes
        for frame in (now, now + FORESEEN):
            occupied, flow_mps = example.occupancy.values[frame, 0] > 0, example.flow.values[frame]
            inside = boxes.valid[frame] & (boxes.centre[frame, :, :2].abs() < 14).all(-1)
            inside &= (boxes.category[frame] == int(Category.CAR)) & (boxes.centre[frame, :, 2] < 2.5)
            for row in inside.nonzero()[:, 0].tolist():
                x, y, z = ((boxes.centre[frame, row] - torch.tensor(GRID.lower_m)) / GRID.voxel_m).long()
                around = (slice(z - 1, z + 1), slice(y - 1, y + 2), slice(x - 1, x + 2))
                assert bool(occupied[around].any())
                filled += 1
                if float(speed := boxes.velocity[frame, row].norm()) > 3.0:
                    fastest = flow_mps[(slice(None), *around)].norm(dim=0).max()
                    assert float(fastest) == pytest.approx(float(speed), rel=0.1)
                    moving += 1
    assert filled > 20
    assert moving > 2


def test_heads_learn_from_the_clips_that_have_images(logs: list[LogPath], tmp_path: Path) -> None:
    """The key frames after the images are kept out of the volumes and of their truth alike."""
    recipe = miniature()
    clips = dataclasses.replace(recipe.clips, future_frames=1, tasks=TaskTruthConfig())
    kept = KeptVolumes(build_agent(recipe, fetch=False), logs[:3], clips, ("occupancy",), tmp_path)
    assert len(kept) == 3 * (IMAGES - 1)
    for index in (0, 4, 5, 14):
        number, frame = divmod(index, IMAGES - 1)
        log = Log(logs[number])
        boxes = read_boxes(log, frame + 1)
        assert boxes is not None
        assert kept[index].key == (f"{logs[number].name}@{log.t_us[frame + 1]}",)
        torch.testing.assert_close(kept[index].boxes.centre[kept[index].boxes.valid], boxes.centre)
        assert kept[index].volumes.volume.std() > 0


def test_baselines_learn_from_the_clips_that_have_images(logs: list[LogPath], tmp_path: Path) -> None:
    """Later key frames have no occupancy; the prior counts the clips in which a voxel is filled."""
    recipe = miniature()
    clips = dataclasses.replace(recipe.clips, future_frames=FORESEEN, occupancy_source="recorded")
    few = tuple(logs[:3])
    prior, mlp = fit_baselines(few, dataclasses.replace(recipe, clips=clips), tmp_path, past_frames=1)
    data = ClipDataset(few, clips, None)
    filled = torch.stack([data[index].occupancy.values[1:, 0] for index in range(len(data))])
    assert torch.equal(prior.occupied, filled.sum(dim=0).int())
    assert bool(torch.cat([value.flatten() for value in mlp.parameters()]).isfinite().all())


def test_equal_seeds_give_equal_bytes_and_whole_logs_are_kept(
    logs: list[LogPath], world02: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second log is made first, and again after it was removed: the others make no difference to it."""
    monkeypatch.setattr(virtual_egos, "World", lambda town, seed, conditions: world02)
    again = record_virtual_egos("Town02", 3, 2, tmp_path, SMALL, occupancy=GRID)
    assert [digests(log.folder) for log in again] == [digests(log.folder) for log in logs[:2]]
    shutil.rmtree(again[1].folder)
    marked = again[0].folder / "kept"
    marked.touch()
    record_virtual_egos("Town02", 3, 2, tmp_path, SMALL, occupancy=GRID)
    assert marked.exists()
    assert digests(again[1].folder) == digests(logs[1].folder)


def test_lidar_sweeps_come_with_the_images(
    logs: list[LogPath], world02: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Labels agree with exact occupancy where beams hit; images and boxes are the same as without lidar."""
    monkeypatch.setattr(virtual_egos, "World", lambda town, seed, conditions: world02)
    sensors = dataclasses.replace(SMALL, lidar=roof_lidar())
    (path,) = record_virtual_egos("Town02", 3, 1, tmp_path, sensors, occupancy=GRID)
    log = Log(path)
    assert frames_with_lidar(log).tolist() == list(range(IMAGES))
    seen, exact = make_labels(log, 3, GRID), recorded_labels(log, 3, GRID)
    hit = seen.occupied & seen.known
    hit[:1] = False  # the ground lies between the first two layers
    assert int(hit.sum()) > 30
    assert float(exact.occupied[hit].float().mean()) > 0.8
    without, beside = digests(logs[0].folder), digests(path.folder)
    assert set(without) < set(beside)
    same = [name for name in without if "camera" in name or "box" in name]
    assert len(same) > 6
    assert all(without[name] == beside[name] for name in same)
