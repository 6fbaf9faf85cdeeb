"""Finding logs, and what one says about the ego vehicle."""

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
from arrow_surgery import rewrite_column

from foredrive.data.log_paths import LogPath, find_logs
from foredrive.data.logs import Log
from foredrive.errors import InputError


def copy_of(folder: Path, tmp_path: Path) -> LogPath:
    target = tmp_path / "logs" / "flat_train" / "copy"
    shutil.copytree(folder, target)
    return LogPath(target, tmp_path / "maps")


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_a_root_a_split_and_a_log_lead_to_the_log(flat_log: Path, level: int) -> None:
    (found,) = find_logs([flat_log, *flat_log.parents][level])
    assert found.folder == flat_log
    assert found.maps_dir == flat_log.parents[2] / "maps"
    assert found.name == "flat_train/flat"


def test_logs_that_are_being_written_are_not_found(tmp_path: Path) -> None:
    world.write(tmp_path, frames=1, name="done")
    half = tmp_path / "logs" / "flat_train" / ".half.x.part" / "half"
    shutil.copytree(tmp_path / "logs" / "flat_train" / "done", half)
    assert [log.folder.name for log in find_logs(tmp_path)] == ["done"]


def test_no_log_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no 123D log here"):
        find_logs(tmp_path)
    with pytest.raises(InputError, match=r"nowhere: no such folder"):
        find_logs(tmp_path / "nowhere")


def test_ego_poses_times_and_speed(flat_log: Path) -> None:
    log = Log(find_logs(flat_log)[0])
    assert len(log) == 51
    assert log.period_s == pytest.approx(0.1)
    np.testing.assert_allclose(log.T_world_ego[20], world.ego_pose(2.0), atol=1e-9)
    np.testing.assert_allclose(log.speed_mps, world.EGO_SPEED_MPS)
    centre, size = log.ego_box
    assert centre[2] == pytest.approx(size[2] / 2)  # the ego frame lies on the ground
    again = pickle.loads(pickle.dumps(log))
    np.testing.assert_array_equal(again.T_world_ego, log.T_world_ego)


def test_speed_comes_from_the_past_where_it_is_not_logged(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    ego = path.folder / "ego_state_se3.arrow"
    rewrite_column(ego, "ego_state_se3.dynamic_state_se3", lambda rows: [None] * len(rows))
    twice_as_far = lambda rows: [[2 * r[0], *r[1:]] if i == 50 else r for i, r in enumerate(rows)]  # noqa: E731
    rewrite_column(ego, "ego_state_se3.imu_se3", twice_as_far)
    log = Log(path)
    assert np.isnan(log.speed_mps[0])
    np.testing.assert_allclose(log.speed_mps[1:50], world.EGO_SPEED_MPS, rtol=1e-6)  # 49 does not see 50
    assert log.speed_mps[50] > 100


def test_the_driven_future_is_exact_and_ends_with_the_log(flat_log: Path) -> None:
    log = Log(find_logs(flat_log)[0])
    future = log.driven_future(33, steps=6, dt_s=0.5)
    assert future.valid[0].tolist() == [True, True, True, False, False, False]  # 3.3 s + 1.5 s of 5 s
    expected = torch.tensor([[2.5, 0.0], [5.0, 0.0], [7.5, 0.0]])
    torch.testing.assert_close(future.xy[0, :3], expected, atol=1e-5, rtol=0)
    assert not future.xy[0, 3:].any()


def test_the_future_is_in_the_ego_frame_and_turns(tmp_path: Path) -> None:
    """A vehicle on a circle of radius 20 m, at 0.2 rad/s."""
    path = LogPath(world.write(tmp_path, frames=41, specs=[]), tmp_path / "maps")
    ego = path.folder / "ego_state_se3.arrow"
    angle = 0.2 * 0.1 * np.arange(41)
    poses = np.stack([20 * np.sin(angle), 20 * (1 - np.cos(angle)), 0 * angle], -1)
    turns = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], -1)
    rewrite_column(ego, "ego_state_se3.imu_se3", lambda _: np.concatenate([poses, turns], -1).tolist())
    future = Log(path).driven_future(10, steps=4, dt_s=0.73)  # between the log's frames
    ahead = 0.2 * 0.73 * np.arange(1, 5)
    expected = np.stack([20 * np.sin(ahead), 20 * (1 - np.cos(ahead))], -1)
    assert future.valid.all()
    np.testing.assert_allclose(future.xy[0].numpy(), expected, atol=2e-3)  # chords between poses
    np.testing.assert_allclose(future.yaw[0].numpy(), ahead, atol=1e-5)


def test_points_of_the_vehicle_move_on_beyond_the_log(flat_log: Path) -> None:
    log = Log(find_logs(flat_log)[0])
    at = log.t_us[-1] + np.array([-50_000.0, 50_000.0])
    xyz = log.path_of_point(np.array([1.0, 0.0, 2.0]), at)
    expected = world.ego_pose(5.0)[:3, 3] + [1.0, 0.0, 2.0]
    np.testing.assert_allclose(xyz - expected, [[-0.25, 0, 0], [0.25, 0, 0]], atol=1e-6)


def test_a_frame_is_found_within_half_a_period(flat_log: Path) -> None:
    log = Log(find_logs(flat_log)[0])
    frame, found = log.nearest_frames(world.START_US + np.array([-60e3, -40e3, 149e3, 151e3, 5.04e6, 5.06e6]))
    assert frame.tolist() == [0, 0, 1, 2, 50, 50]
    assert found.tolist() == [False, True, True, True, True, False]


def test_a_truncated_file_is_named(flat_log: Path, tmp_path: Path) -> None:
    for name in ("sync.arrow", "camera.pcam_f0.arrow", "lidar.lidar_top.arrow"):
        path = copy_of(flat_log, tmp_path / name)
        file = path.folder / name
        file.write_bytes(file.read_bytes()[:-100])
        with pytest.raises(InputError, match=name):
            Log(path)


def test_a_nan_pose_is_named(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    spoil = lambda rows: [[np.nan] * 7 if i == 3 else row for i, row in enumerate(rows)]  # noqa: E731
    rewrite_column(path.folder / "ego_state_se3.arrow", "ego_state_se3.imu_se3", spoil)
    with pytest.raises(InputError, match=r"ego_state_se3\.arrow: the ego pose of row 3"):
        Log(path)


@pytest.mark.parametrize(
    ("file", "column"),
    [
        ("ego_state_se3.arrow", "ego_state_se3.timestamp_us"),
        ("sync.arrow", "sync.timestamp_us"),
    ],
)
def test_time_that_runs_backwards_is_named(flat_log: Path, tmp_path: Path, file: str, column: str) -> None:
    path = copy_of(flat_log, tmp_path)
    rewrite_column(path.folder / file, column, lambda t: [*t[:5], t[5] - 300_000, *t[6:]])
    with pytest.raises(InputError, match=rf"{file}: time runs backwards at row 5"):
        Log(path)


def test_a_log_without_ego_poses_is_named(flat_log: Path, tmp_path: Path) -> None:
    path = copy_of(flat_log, tmp_path)
    (path.folder / "ego_state_se3.arrow").unlink()
    with pytest.raises(InputError, match="without ego poses"):
        Log(path)
