"""Clips of the synthetic log: what is in them agrees with its geometry, what is missing is masked."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
from arrow_surgery import rewrite_column, rewrite_metadata
from torch.utils.data import DataLoader

from foredrive.data import ClipConfig, ClipDataset, LogPath, collate, find_logs
from foredrive.data.batches import stack_records
from foredrive.errors import InputError
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import Command, Example, MapPatch, VoxelSpec

SPEC = VoxelSpec((-10.0, -10.0, -0.75), 1.0, (3, 20, 20))


def config(**changes: object) -> ClipConfig:
    values = {"past_frames": 2, "future_frames": 2, "image_hw": (24, 48), "voxels": SPEC} | changes
    return ClipConfig(**values)


def copy_of(folder: Path, tmp_path: Path) -> LogPath:
    target = tmp_path / "logs" / "flat_train" / "copy"
    shutil.copytree(folder, target)
    return LogPath(target, tmp_path / "maps")


def test_key_frames_are_spaced_and_fit_into_the_log(flat_root: Path) -> None:
    clips = ClipDataset(find_logs(flat_root), config(now_stride_s=0.7), None)
    nows = [int(clips[i].key[0].split("@")[1]) - world.START_US for i in range(len(clips))]
    assert nows == [1_000_000, 1_700_000, 2_400_000, 3_100_000, 3_800_000]  # of 5 s
    torch.testing.assert_close(clips[1].clip.t_s, torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0]))
    assert clips[1].clip.now == 2
    assert clips.left_out == {"past": 1, "future": 1, "gap": 0, "unseen": 0}  # 0.3 s and 4.5 s
    with pytest.raises(IndexError):
        clips[5]


def test_a_frame_missing_from_the_log_drops_the_clips_that_need_it(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    gone = lambda rows: [None if i in (20, 21, 22) else r for i, r in enumerate(rows)]  # noqa: E731
    rewrite_column(path.folder / "sync.arrow", "ego_state_se3", gone)
    clips = ClipDataset([path], config(past_frames=0, future_frames=1, frame_dt_s=1.0), None)
    nows = {(int(clips[i].key[0].split("@")[1]) - world.START_US) // 100_000 for i in range(len(clips))}
    assert nows == {0, 5, 15, 25, 30, 35, 40}  # 10 would need 20 or a frame at most 50 ms from it
    assert clips.left_out == {"past": 0, "future": 2, "gap": 2, "unseen": 0}  # 4.5 and 5.0 s; 1.0 and 2.0 s


def test_times_without_image_and_sweep_are_left_out_and_counted(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    gone = lambda rows: [None if i < 16 else r for i, r in enumerate(rows)]  # noqa: E731
    rewrite_column(path.folder / "sync.arrow", "camera.pcam_f0", gone)
    seen = {"cameras": ("ahead",), "past_frames": 0, "future_frames": 1}
    clips = ClipDataset([path], config(**seen), None)
    assert clips.left_out == {"past": 0, "future": 1, "gap": 0, "unseen": 4}  # 0 to 1.5 s
    assert len(clips) == 6
    assert ClipDataset([path], config(**seen, lidar=True), None).left_out["unseen"] == 0


def test_points_inside_a_box_project_onto_its_colour(flat_root: Path) -> None:
    """Camera, lidar and box agree: lidar points in a box hit pixels of its colour, at every frame."""
    example = ClipDataset(find_logs(flat_root), config(image_hw=(48, 96), lidar=True), None)[0]
    clip = example.clip
    checked = 0
    for t in range(len(clip.t_s)):
        points = clip.sweeps.points_ego[t][clip.sweeps.returned[t] & clip.sweeps.valid[t]]
        for box, colour in ((0, world.PARKED_RGB), (1, world.MOVING_RGB)):
            inside = (
                (points - clip.boxes.centre[t, box]).abs() < clip.boxes.size_lwh[t, box] / 2 + 0.01
            ).all(-1)
            above = points[:, 2] > 0.3
            for c in range(2):
                in_camera = transform_points(inverse_se3(clip.rig.T_ego_cam[t, c]), points[inside & above])
                uv, _, seen = project(in_camera, clip.rig.K[t, c], clip.rig.dist[t, c], clip.rig.size_hw)
                pixel = uv[seen].long()
                got = clip.images[t, c][:, pixel[:, 1], pixel[:, 0]].float()
                close = (got - torch.tensor(colour)[:, None]).abs().amax(0) < 90  # borders are mixed
                assert len(close) == 0 or close.float().mean() > 0.7
                checked += len(close)
    assert checked > 100


def test_intrinsics_follow_the_image_size(flat_root: Path) -> None:
    whole = ClipDataset(find_logs(flat_root), config(image_hw=(48, 96)), None)[0].clip.rig.K
    squeezed = ClipDataset(find_logs(flat_root), config(image_hw=(24, 32)), None)[0].clip.rig.K
    torch.testing.assert_close(squeezed[..., 0, :], whole[..., 0, :] / 3)
    torch.testing.assert_close(squeezed[..., 1, :], whole[..., 1, :] / 2)


def test_cameras_are_chosen_by_either_name_and_in_order(flat_root: Path) -> None:
    logs = find_logs(flat_root)
    assert ClipDataset(logs, config(), None).camera_names == ("ahead", "left")
    own = ClipDataset(logs, config(cameras=("left", "ahead")), None)[0].clip
    shared = ClipDataset(logs, config(cameras=("pcam_l0", "pcam_f0")), None)[0].clip
    assert own.rig.names == ("left", "ahead")
    assert shared.rig.names == ("pcam_l0", "pcam_f0")
    assert torch.equal(own.images, shared.images)
    with pytest.raises(InputError, match=r"'behind'; there are: ahead \(pcam_f0\), left \(pcam_l0\)"):
        ClipDataset(logs, config(cameras=("behind",)), None)


def test_what_a_log_lacks_is_masked(tmp_path: Path) -> None:
    with_cameras = find_logs(world.write(tmp_path / "a", frames=21))
    without = find_logs(world.write(tmp_path / "b", frames=21, specs=[]))
    for file in ("box_detections_se3.arrow", "lidar.lidar_top.arrow", "custom.lidar_beams.arrow"):
        (without[0].folder / file).unlink()
    clips = ClipDataset([*with_cameras, *without], config(lidar=True, map=True), None)
    example = clips[len(clips) - 1]
    clip = example.clip
    assert clip.images.shape == (5, 2, 3, 24, 48)
    assert not clip.images.any()
    for mask in (clip.image_valid, clip.boxes_valid, clip.sweep_valid, clip.misses_known):
        assert not mask.any()
    assert not example.occupancy.known.any()
    assert not example.flow.known.any()
    assert clip.ego_speed_valid.all()
    assert clip.map.vertices.shape[0] == 0
    alone = ClipDataset(without, config(), None)[0].clip
    assert alone.images.shape == (5, 0, 3, 24, 48)


def test_a_part_of_a_log_holds_now_and_all_that_comes_after(flat_root: Path) -> None:
    def nows(part_s: tuple[float, float]) -> list[int]:
        clips = ClipDataset(find_logs(flat_root), config(part_s=part_s), None)
        return [int(clips[i].key[0].split("@")[1]) - world.START_US for i in range(len(clips))]

    assert nows((0.0, 3.0)) == [1_000_000, 1_500_000]  # a second is seen before now and one foreseen
    assert nows((3.0, 9.0)) == [3_000_000, 3_500_000, 4_000_000]
    with pytest.raises(InputError, match=r"not into the part \(4\.5, 9\.0\)"):
        nows((4.5, 9.0))


def test_future_images_can_be_left_out(flat_root: Path) -> None:
    clip = ClipDataset(find_logs(flat_root), config(future_images=False), None)[0].clip
    assert clip.image_valid.all(-1).tolist() == [True, True, True, False, False]
    assert not clip.images[3:].any()
    assert (clip.rig.K[3:] == clip.rig.K[:2]).all()  # the calibration is known all the same


def test_an_image_missing_from_a_frame_is_masked(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    gone = lambda rows: [None if i == 10 else r for i, r in enumerate(rows)]  # noqa: E731
    rewrite_column(path.folder / "sync.arrow", "camera.pcam_f0", gone)
    clip = ClipDataset([path], config(), None)[0].clip
    assert clip.image_valid.tolist() == [
        [True, True],
        [True, True],
        [False, True],
        [True, True],
        [True, True],
    ]
    torch.testing.assert_close(clip.rig.T_ego_cam[2], clip.rig.T_ego_cam[1])


def test_sweeps_come_with_their_misses(flat_root: Path) -> None:
    clip = ClipDataset(find_logs(flat_root), config(lidar=True), None)[0].clip
    truth = world.sweep(1.0)
    now = clip.sweeps[2]
    assert clip.misses_known.all()
    assert now.valid.sum() == len(truth.beam)
    assert (now.valid & ~now.returned).sum() == (~truth.returned).sum()
    torch.testing.assert_close(now.origin_ego[0], torch.tensor(world.LIDAR_EGO_M).float(), atol=1e-4, rtol=0)


def left_turn(start_m: float) -> np.ndarray:
    """A route along the driven lane that turns left after `start_m`."""
    return world.WORLD_OFFSET + np.array([[0.0, 0, 0], [start_m, 0, 0], [start_m, 40, 0]])


def test_the_command_comes_from_a_provided_route(tmp_path: Path) -> None:
    logs = find_logs(world.write(tmp_path, frames=41, route_xyz=left_turn(25)))
    clips = ClipDataset(logs, config(past_frames=0, future_frames=0, now_stride_s=1.0), None)
    assert clips.command_source == {"route": 5, "driven_future": 0, "none": 0}
    # the turn is 25, 20, 15, 10 and 5 m ahead; the command looks 20 m ahead
    expected = [Command.STRAIGHT, Command.STRAIGHT, Command.LEFT, Command.LEFT, Command.LEFT]
    assert [int(clips[i].clip.command) for i in range(5)] == expected


@pytest.mark.parametrize("aside_m", [3.5, -3.5])
def test_beside_a_straight_route_the_command_is_straight(tmp_path: Path, aside_m: float) -> None:
    route = world.WORLD_OFFSET + np.array([[0.0, 0, 0], [90, 0, 0]])
    path = find_logs(world.write(tmp_path, frames=41, route_xyz=route))[0]
    overtaking = lambda rows: [[r[0], r[1] + aside_m, *r[2:]] for r in rows]  # noqa: E731
    rewrite_column(path.folder / "ego_state_se3.arrow", "ego_state_se3.imu_se3", overtaking)
    clips = ClipDataset([path], config(past_frames=0, future_frames=0, now_stride_s=1.0), None)
    assert clips.command_source["route"] == 5
    assert [int(clips[i].clip.command) for i in range(5)] == [Command.STRAIGHT] * 5


def test_the_command_comes_from_the_driven_future_without_a_route(tmp_path: Path) -> None:
    path = find_logs(world.write(tmp_path, frames=41))[0]
    sideways = lambda rows: [[r[0], r[1] - 0.05 * i, *r[2:]] for i, r in enumerate(rows)]  # noqa: E731
    rewrite_column(path.folder / "ego_state_se3.arrow", "ego_state_se3.imu_se3", sideways)
    clips = ClipDataset([path], config(past_frames=0, future_frames=0, now_stride_s=1.0), None)
    assert clips.command_source == {"route": 0, "driven_future": 4, "none": 1}
    commands = [(int(c.command), bool(c.command_valid)) for c in (clips[i].clip for i in range(5))]
    # 1.5 m to the right in 3 s, then 1 m in what is left: straight; nothing is left at the end
    assert commands == [(Command.STRAIGHT, True)] * 4 + [(0, False)]
    further = lambda rows: [[r[0], r[1] - 0.05 * i, *r[2:]] for i, r in enumerate(rows)]  # noqa: E731
    copy = copy_of(path.folder, tmp_path / "further")
    rewrite_column(copy.folder / "ego_state_se3.arrow", "ego_state_se3.imu_se3", further)
    clips = ClipDataset([copy], config(past_frames=0, future_frames=0, now_stride_s=1.0), None)
    assert [int(clips[i].clip.command) for i in range(3)] == [Command.RIGHT] * 3  # 3 m, 3 m, 2 m


def test_a_route_derived_from_the_driven_path_is_no_route(tmp_path: Path) -> None:
    folder = world.write(tmp_path, frames=41, route_xyz=left_turn(15))
    rewrite_metadata(folder / "route_position.arrow", lambda metadata: metadata | {"source": "ego_state_se3"})
    clips = ClipDataset(find_logs(folder), config(past_frames=0, future_frames=0), None)
    assert clips.command_source["route"] == 0
    assert clips.command_source["driven_future"] > 0
    assert clips[0].clip.command == Command.STRAIGHT
    assert not clips[0].clip.route_valid.any()


def batch_of(clips: ClipDataset, workers: int) -> Example:
    context = "forkserver" if workers else None
    loader = DataLoader(
        clips, batch_size=3, collate_fn=collate, num_workers=workers, multiprocessing_context=context
    )
    return next(iter(loader))


def test_a_batch_pads_what_differs(tmp_path: Path) -> None:
    folder = world.write(tmp_path, frames=21)
    boxes = "box_detections_se3"
    for column in ("bounding_box_se3", "track_token", "label", "velocity_3d", "num_lidar_points"):
        fewer = lambda rows: [row[:1] if i < 11 else row for i, row in enumerate(rows)]  # noqa: E731
        rewrite_column(folder / f"{boxes}.arrow", f"{boxes}.{column}", fewer)
    clips = ClipDataset(find_logs(folder), config(past_frames=1, future_frames=0, lidar=True), None)
    batch = batch_of(clips, workers=0)
    assert batch.key == tuple(clips[i].key[0] for i in range(3))
    assert batch.clip.boxes.valid.tolist() == [
        [[True, False], [True, False]],
        [[True, False], [True, False]],
        [[True, False], [True, True]],
    ]
    assert batch.clip.images.shape == (3, 2, 2, 3, 24, 48)
    assert batch.occupancy.values.shape == (3, 2, 1, *SPEC.shape_zyx)
    assert batch.flow.values.shape == (3, 2, 3, *SPEC.shape_zyx)
    assert batch.clip.now == 1
    assert batch.clip.rig.names == ("ahead", "left")


def test_padding_is_no_channel_and_no_kind_of_line() -> None:
    beams = stack_records([world.sweep(0.0)[:3], world.sweep(0.0)[:5]])
    assert beams.beam[:, 3:].tolist() == [[-1, -1], [0, 0]]
    assert beams.valid.tolist() == [[True] * 3 + [False] * 2, [True] * 5]
    lines = [MapPatch(torch.zeros(n, 2, 3), torch.ones(n, 2) > 0, torch.zeros(n).long()) for n in (1, 2)]
    assert stack_records(lines).kind.tolist() == [[0, -1], [0, 0]]


def test_items_that_do_not_go_together_are_refused(flat_root: Path) -> None:
    logs = find_logs(flat_root)
    one = ClipDataset(logs, config(cameras=("left",)), None)[0]
    other = ClipDataset(logs, config(cameras=("ahead",)), None)[0]
    with pytest.raises(InputError, match="differ in names"):
        collate([one, other])


def test_workers_read_the_same(flat_root: Path, tmp_path: Path) -> None:
    clips = ClipDataset(find_logs(flat_root), config(), tmp_path)
    here, there = batch_of(clips, workers=0), batch_of(clips, workers=1)
    assert torch.equal(here.clip.images, there.clip.images)
    assert torch.equal(here.occupancy.known, there.occupancy.known)
    assert here.key == there.key


def test_kept_frames_are_the_same_and_made_anew_when_damaged(flat_root: Path, tmp_path: Path) -> None:
    logs = find_logs(flat_root)
    plain = ClipDataset(logs, config(), None)[0].clip
    clips = ClipDataset(logs, config(), tmp_path)
    for _ in range(2):  # as it is made, and as it is kept
        kept_clip = clips[0].clip
        for name in ("images", "image_valid", "boxes_valid"):
            assert torch.equal(getattr(kept_clip, name), getattr(plain, name))
        for part in ("rig", "boxes"):
            for name, value in vars(getattr(plain, part)).items():
                same = getattr(getattr(kept_clip, part), name)
                assert torch.equal(same, value) if isinstance(value, torch.Tensor) else same == value
    kept = sorted(tmp_path.rglob("*.frame"))
    assert len(kept) == 5
    sizes = [file.stat().st_size for file in kept]
    kept[0].write_bytes(b"not a frame")
    kept[1].write_bytes(kept[1].read_bytes()[:-10])
    again = ClipDataset(logs, config(), tmp_path)[0].clip
    assert torch.equal(again.images, plain.images)
    assert torch.equal(again.rig.T_ego_cam, plain.rig.T_ego_cam)
    assert [file.stat().st_size for file in kept] == sizes


def test_a_kept_frame_is_of_its_log_its_cameras_and_its_size(flat_log: Path, tmp_path: Path) -> None:
    path, cache = copy_of(flat_log, tmp_path), tmp_path / "cache"
    before = ClipDataset([path], config(), cache)[0].clip
    count = len(list(cache.rglob("*.frame")))
    one = ClipDataset([path], config(cameras=before.rig.names[1:]), cache)[0].clip
    assert torch.equal(one.images[:, 0], before.images[:, 1])
    small = ClipDataset([path], config(image_hw=(12, 24)), cache)[0].clip
    assert small.images.shape[-2:] == (12, 24)
    assert len(list(cache.rglob("*.frame"))) == 3 * count
    os.utime(path.folder / "camera.pcam_f0.arrow", (1, 1))  # written anew
    ClipDataset([path], config(), cache)[0]
    assert len(list(cache.rglob("*.frame"))) == 4 * count


def test_frames_that_need_no_shrinking_are_not_kept(flat_root: Path, tmp_path: Path) -> None:
    ClipDataset(find_logs(flat_root), config(image_hw=(48, 96)), tmp_path)[0]
    assert not list(tmp_path.rglob("*.frame"))
