"""Recordings as they are: moving mounts, clocks that differ, and holes in the path."""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import made_bags
import numpy as np
import pytest
from made_bags import FRAMES, START_NS, Change, Messages, Recording, converted, pose_at

from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.formats.bag_messages import Placed
from foredrive.data.formats.bag_topics import read_topics, topics_file
from foredrive.data.formats.frame_tree import FrameTree
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
PAN_RADPS = 0.8


def shifted(message: Any, by_ns: int) -> Any:
    """A message with another stamp."""
    stamp = message.header.stamp
    t_ns = stamp.sec * 10**9 + stamp.nanosec + by_ns
    stamp.sec, stamp.nanosec = t_ns // 10**9, t_ns % 10**9
    return message


def first_points(log: Log) -> np.ndarray:
    """The first point of each sweep in the ego frame, which has no time of its own within the sweep."""
    sweeps = [read_sweep(log, k) for k in range(len(log))]
    return np.stack([sweep[0].points_ego[0].numpy() for sweep in sweeps if sweep is not None])


AHEAD = made_bags.POINTS[0, :3] + made_bags.LIDAR_M


def in_world(made: Messages, cloud: Any, t_s: float) -> Any:
    """A cloud registered in the world: moved there by the pose at its time."""
    cells = cloud.data.copy().view("<f4").reshape(len(made_bags.POINTS), 6)
    xyz = cells[:, :3] + np.array(made_bags.LIDAR_M, np.float32)
    T = pose_at(t_s)
    cells[:, :3] = xyz @ T[:3, :3].T + T[:3, 3]
    header = made.header(cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec, "odom")
    return dataclasses.replace(cloud, header=header, data=cells.reshape(-1).view(np.uint8))


@pytest.mark.parametrize("raw_too", [False, True])
def test_a_registered_cloud_goes_to_the_vehicle_by_the_pose_at_its_time(
    raw_too: bool, tmp_path: Path
) -> None:
    """Both topics have as many messages; the registered one comes first in the alphabet."""

    def change(made: Messages, recording: Recording) -> Recording:
        rows = []
        for topic, t_ns, message in recording:
            if topic == "/lidar/points":
                rows.append(("/cloud_registered", t_ns, in_world(made, message, (t_ns - START_NS) * 1e-9)))
            if topic != "/lidar/points" or raw_too:
                rows.append((topic, t_ns, message))
        return rows

    log, notices = converted(tmp_path, change)
    points = first_points(log)
    assert len(points) == FRAMES
    np.testing.assert_allclose(points, np.tile(AHEAD, (FRAMES, 1)), atol=2e-4)
    topics = read_topics(topics_file(tmp_path / "drive"))
    assert topics.lidar is not None
    assert topics.lidar.topic == ("/lidar/points" if raw_too else "/cloud_registered")
    assert any("odom does not move with base_link" in each for each in notices) != raw_too


def pan_at(t_s: float) -> np.ndarray:
    """T_ego_pan of a unit that turns about z."""
    T = np.eye(4)
    c, s = np.cos(PAN_RADPS * t_s), np.sin(PAN_RADPS * t_s)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = 0.5, 0.0, 1.0
    return T


def test_sensors_on_a_pan_unit_have_the_mount_of_their_time(tmp_path: Path) -> None:
    def change(made: Messages, recording: Recording) -> Recording:
        rows = [row for row in recording if row[0] != "/tf_static"]
        static = [
            made.transform(START_NS, "pan", "lidar", (0.0, 0.0, 0.3), UPRIGHT),
            made.transform(START_NS, "pan", "camera_optical", (0.2, 0.0, 0.0), made_bags.OPTICAL),
        ]
        rows.append(("/tf_static", START_NS, made.tf(*static)))
        for k in range(-2, 30):
            t_ns = START_NS + k * 20_000_000
            half = 0.5 * PAN_RADPS * k * 0.02
            turn = (0.0, 0.0, float(np.sin(half)), float(np.cos(half)))
            rows.append(
                ("/tf", t_ns, made.tf(made.transform(t_ns, "base_link", "pan", (0.5, 0.0, 1.0), turn)))
            )
        return sorted(rows, key=lambda row: row[1])

    log, notices = converted(tmp_path, change)
    point = np.array([*(made_bags.POINTS[0, :3] + [0.0, 0.0, 0.3]), 1.0])
    expected = np.stack([(pan_at(0.1 * k) @ point)[:3] for k in range(FRAMES)])
    np.testing.assert_allclose(first_points(log), expected, atol=1e-4)
    camera = read_camera(log, 3, pinhole_cameras(log)["front"], (16, 32), with_image=True)
    at_exposure = np.linalg.inv(pose_at(0.3)) @ pose_at(0.32) @ pan_at(0.32)
    optical = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    np.testing.assert_allclose(camera.T_ego_cam[:3, :3].numpy(), at_exposure[:3, :3] @ optical, atol=1e-4)
    np.testing.assert_allclose(camera.T_ego_cam[:3, 3].numpy(), (at_exposure @ [0.2, 0, 0, 1])[:3], atol=1e-3)
    assert sum("moves on the vehicle" in each for each in notices) == 2


@pytest.mark.parametrize("sent_s", [(-5.0, 0.25), (-9.0, -5.0), (7.0,)])
@pytest.mark.parametrize("topic", ["/tf_static", "/tf"])
def test_static_transforms_hold_for_all_times(topic: str, sent_s: tuple[float, ...], tmp_path: Path) -> None:
    """Sent at any time, however often; on /tf, equal transforms are fixed as well."""

    def change(made: Messages, recording: Recording) -> Recording:
        rows = [row for row in recording if row[0] != "/odom"]
        for k in range(-2, 28):
            t_ns = START_NS + k * 20_000_000
            T, half = pose_at(k * 0.02), 0.5 * made_bags.TURN_RADPS * k * 0.02
            turn = (0.0, 0.0, float(np.sin(half)), float(np.cos(half)))
            moved = made.transform(t_ns, "odom", "base_footprint", tuple(T[:3, 3].tolist()), turn)
            rows.append(("/tf", t_ns, made.tf(moved)))
        for at_s in sent_s:
            t_ns = START_NS + round(at_s * 1e9)
            pair = [("map", "odom", 2.0), ("base_footprint", "base_link", 0.4)]
            fixed = [made.transform(t_ns, *pair[0][:2], (2.0, 0.0, 0.0), UPRIGHT)]
            fixed.append(made.transform(t_ns, *pair[1][:2], (0.0, 0.0, 0.4), UPRIGHT))
            rows.append((topic, START_NS, made.tf(*fixed)))
        return sorted(rows, key=lambda row: row[1])

    log, notices = converted(tmp_path, change)
    assert len(log) == FRAMES
    assert not any("frames" in each and "left out" in each for each in notices)
    np.testing.assert_allclose(log.T_world_ego[3, :3, 3], pose_at(0.3)[:3, 3] + [2.0, 0.0, 0.4], atol=1e-9)


def test_a_fixed_transform_yields_to_one_that_moves() -> None:
    def placed(t_us: int, x: float, fixed: bool) -> Placed:
        T = np.eye(4)
        T[0, 3] = x
        return Placed("odom", "base", t_us, T, fixed)

    tree = FrameTree([placed(0, 9.0, True), placed(0, 0.0, False), placed(10**6, 2.0, False)])
    assert tree.pose("odom", "base", np.array([500_000.0]))[0, 0, 3] == 1.0
    assert tree.moves("odom", "base")


def stamps(topic: str, by_s: float | None) -> Change:
    """Stamps of a topic that are ahead of its clock; None: all are 0. It is recorded 10 ms late."""

    def change(made: Messages, recording: Recording) -> Recording:
        for name, _, message in recording:
            if name == topic and by_s is not None:
                shifted(message, round(by_s * 1e9))
            elif name == topic:
                message.header.stamp.sec = message.header.stamp.nanosec = 0
        late = [(name, t_ns + 10_000_000 * (name == topic), message) for name, t_ns, message in recording]
        return sorted(late, key=lambda row: row[1])

    return change


LIDAR, CAMERA = "/lidar/points", "/front/image_raw/compressed"


@pytest.mark.parametrize(
    ("topic", "by_s", "told"),
    [
        (LIDAR, 37.0, r"are 36.990 s ahead of those of other topics, .*; corrected by -37 s"),
        (LIDAR, -18.0, r"are 18.010 s behind .*; corrected by \+18 s"),
        (CAMERA, 7200.0, r"are 7199.990 s ahead .*; corrected by -7200 s"),
        ("/odom", 37.0, r"are 36.990 s ahead .*; corrected by -37 s"),
        (CAMERA, -1_699_999_000.0, r"are 1699999000.010 s behind .*; corrected by that, to within"),
        (CAMERA, None, r"all header stamps are 0 s; the recorder's times were used"),
        ("/odom", None, r"all header stamps are 0 s; the recorder's times were used"),
    ],
)
def test_a_clock_that_is_off_is_corrected_and_told(
    topic: str, by_s: float | None, told: str, tmp_path: Path
) -> None:
    log, notices = converted(tmp_path, stamps(topic, by_s))
    assert len(log) == FRAMES
    (line,) = [each for each in notices if each.startswith(f"{topic}: ") and "stamps" in each]
    assert re.search(told, line), line
    camera = read_camera(log, 1, pinhole_cameras(log)["front"], (16, 32), with_image=True)
    assert camera.image is not None
    exact = by_s is not None and "that" not in told
    assert camera.exposed_dt_s == pytest.approx(0.02, abs=1e-6 if exact else 0.011)
    np.testing.assert_allclose(log.T_world_ego[2], pose_at(0.2), atol=1e-9 if exact else 0.11)


def test_half_a_second_may_be_delay_and_is_told(tmp_path: Path) -> None:
    log, notices = converted(tmp_path, stamps(CAMERA, -0.7))
    assert any(f"{CAMERA}: header stamps are 0.710 s behind" in each for each in notices)
    assert any(f"{CAMERA}: none of its 4 messages (" in each for each in notices)
    assert pinhole_cameras(log) == {}


def test_a_simulations_clock_needs_no_correction(tmp_path: Path) -> None:
    """All stamps begin near 0, and the recorder has another clock."""

    def change(made: Messages, recording: Recording) -> Recording:
        for topic, _, message in recording:
            if topic != "/tf_static":
                shifted(message, 10**9 - START_NS)
        return recording

    log, notices = converted(tmp_path, change)
    assert len(log) == FRAMES
    assert not any("stamps" in each for each in notices)


def test_single_stamps_of_zero_are_left_out_and_counted(tmp_path: Path) -> None:
    def change(made: Messages, recording: Recording) -> Recording:
        clouds = [message for topic, _, message in recording if topic == LIDAR]
        clouds[0].header.stamp.sec = clouds[0].header.stamp.nanosec = 0
        return recording

    log, notices = converted(tmp_path, change)
    assert len(log) == FRAMES - 1
    assert any(
        f"{LIDAR}: stamps more than 10 s beside those of their topic, left out: 1" in n for n in notices
    )


def lost_poses(lost: Callable[[float], bool], slower: int = 1, standing: bool = False) -> Change:
    """A recording that lasts `slower` times as long, without the poses of some times."""

    def change(made: Messages, recording: Recording) -> Recording:
        rows = []
        for topic, t_ns, message in recording:
            later_ns = (t_ns - START_NS) * (slower - 1)
            if topic == "/odom" and lost((t_ns + later_ns - START_NS) * 1e-9):
                continue
            if topic == "/odom" and standing:
                pose = message.pose.pose
                pose.position.x = pose.position.y = pose.orientation.z = 0.0
                pose.orientation.w = 1.0
            rows.append(
                (topic, t_ns + later_ns, message if topic == "/tf_static" else shifted(message, later_ns))
            )
        return rows

    return change


@pytest.mark.parametrize(
    ("lost", "kept_s", "told"),
    [
        (lambda t_s: t_s < 0.45, [1, 2, 3, 4], "frames before the first pose, left out: 1 (17"),
        (lambda t_s: t_s > 2.5, [0, 1, 2], "frames after the last pose, left out: 2 (17"),
        (lambda t_s: 0.5 < t_s < 2.5, [0, 3, 4], "frames between poses more than 1 s apart, left out: 2 (17"),
    ],
)
def test_nothing_is_invented_where_there_are_no_poses(
    lost: Callable[[float], bool], kept_s: list[int], told: str, tmp_path: Path
) -> None:
    log, notices = converted(tmp_path, lost_poses(lost, slower=10))
    assert ((log.t_us - START_NS // 1000) // 10**6).tolist() == kept_s
    assert any(f"{LIDAR}: {told}" in each for each in notices)
    # No speed or acceleration over the hole either
    assert log.speed_mps == pytest.approx(np.full(len(log), made_bags.SPEED_MPS / 10), rel=0.05)


def test_a_vehicle_that_stands_needs_no_poses_in_between(tmp_path: Path) -> None:
    log, notices = converted(tmp_path, lost_poses(lambda t_s: 0.5 < t_s < 3.5, slower=10, standing=True))
    assert len(log) == FRAMES
    assert not any("left out" in each for each in notices)


def test_a_camera_frame_with_x_ahead_is_turned_and_told(tmp_path: Path) -> None:
    def change(made: Messages, recording: Recording) -> Recording:
        rows: Recording = []
        for topic, t_ns, message in recording:
            if topic.startswith("/front"):
                message.header.frame_id = "camera_link"
            elif topic == "/tf_static":
                x, w = np.sin(0.05), np.cos(0.05)  # 0.1 rad down
                body = made.transform(
                    t_ns, "base_link", "camera_link", (1.5, 0.2, 1.4), (0.0, float(x), 0.0, float(w))
                )
                message = made.tf(*message.transforms, body)
            rows.append((topic, t_ns, message))
        return rows

    log, notices = converted(tmp_path, change)
    camera = pinhole_cameras(log)["front"]
    axis = read_camera(log, 0, camera, (16, 32), with_image=False).T_ego_cam[:3, 2].numpy()
    yaw = made_bags.TURN_RADPS * 0.02  # until the exposure
    expected = [np.cos(0.1) * np.cos(yaw), np.cos(0.1) * np.sin(yaw), -np.sin(0.1)]
    np.testing.assert_allclose(axis, expected, atol=1e-4)
    assert any("its frame camera_link has z up" in each for each in notices)
