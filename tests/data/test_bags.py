"""Bags of ROS 1 and 2 become logs: written by a library, mapped by the proposed YAML."""

from pathlib import Path

import made_bags
import numpy as np
import pytest
import torch
import yaml
from rosbags.rosbag2 import StoragePlugin

from foredrive.cli.main import main
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.formats.bag_images import read_image
from foredrive.data.formats.bag_messages import (
    Placed,
    read_calibration,
    read_cloud,
    seconds_since_stamp,
    time_unit,
)
from foredrive.data.formats.bag_proposal import propose_topics
from foredrive.data.formats.bag_topics import read_topics, topics_file
from foredrive.data.formats.convert import convert
from foredrive.data.formats.frame_tree import FrameTree
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.notices import read_notices
from foredrive.errors import InputError


def ros1(folder: Path) -> Path:
    made_bags.write_ros1(folder / "drive.bag")
    return folder / "drive.bag"


def ros2_sqlite(folder: Path) -> Path:
    made_bags.write_ros2(folder / "drive")
    return folder / "drive"


def ros2_mcap(folder: Path) -> Path:
    made_bags.write_ros2(folder / "folder", StoragePlugin.MCAP)
    (file,) = (folder / "folder").glob("*.mcap")
    return file.rename(folder / "drive.mcap")


@pytest.mark.parametrize("made", [ros1, ros2_sqlite, ros2_mcap])
def test_a_bag_becomes_a_log(made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = made(tmp_path)
    assert main(["convert", "rosbag", str(bag), "--propose"]) == 0
    assert "# /odom: nav_msgs/msg/Odometry, 30 messages" in capsys.readouterr().out
    topics = read_topics(topics_file(bag))
    assert (topics.world_frame, topics.ego_frame, topics.pose) == ("odom", "base_link", "/odom")
    assert topics.cameras["front"].images == "/front/image_raw/compressed"
    assert topics.lidar is not None
    assert topics.lidar.intensity_max == 255.0
    assert not topics.lidar.compensated
    assert main(["convert", "rosbag", str(bag), "--out", str(tmp_path / "out")]) == 0
    check(tmp_path / "out")


def check(out: Path) -> None:
    (folder,) = (out / "logs" / "own_train").iterdir()
    log = Log(next(iter(find(folder))))
    assert np.diff(log.t_us).tolist() == [100_000] * (made_bags.FRAMES - 1)
    for k, T in enumerate(log.T_world_ego):
        np.testing.assert_allclose(T, made_bags.pose_at(0.1 * k), atol=1e-9)
    sweep = read_sweep(log, 1)
    assert sweep is not None
    first, second = sweep[0].points_ego.double().numpy()
    ahead = np.array(made_bags.LIDAR_M)
    np.testing.assert_allclose(first, made_bags.POINTS[0, :3] + ahead, atol=1e-5)
    # the second was seen 50 ms later, from 0.5 m further on the circle
    moved = np.linalg.inv(made_bags.pose_at(0.1)) @ made_bags.pose_at(0.15)
    expected = moved @ [*(made_bags.POINTS[1, :3] + ahead), 1.0]
    np.testing.assert_allclose(second, expected[:3], atol=5e-4)  # poses between messages are on a chord
    assert sweep[0].dt_s.tolist() == pytest.approx([0.0, 0.05])
    assert sweep[0].beam.tolist() == [0, 1]
    assert sweep[0].intensity.tolist() == pytest.approx([60 / 255, 1.0])
    cameras = pinhole_cameras(log)
    camera = read_camera(log, 1, cameras["front"], (16, 32), with_image=True)
    assert camera.exposed_dt_s == pytest.approx(0.02)
    assert camera.image is not None
    assert camera.image.float().mean((1, 2)).tolist() == pytest.approx(made_bags.COLOUR, abs=2)
    torch.testing.assert_close(camera.K, torch.tensor([[50.0, 0, 16], [0, 50, 8], [0, 0, 1]]))
    at_exposure = np.linalg.inv(made_bags.pose_at(0.1)) @ made_bags.pose_at(0.12)
    place = (at_exposure @ [*made_bags.CAMERA_M, 1.0])[:3]
    np.testing.assert_allclose(camera.T_ego_cam[:3, 3].numpy(), place, atol=5e-4)
    assert read_camera(log, 2, cameras["front"], (16, 32), with_image=True).image is None


def find(folder: Path):
    from foredrive.data.log_paths import find_logs

    return find_logs(folder)


def test_raw_images_of_the_yaml(tmp_path: Path) -> None:
    bag = ros2_sqlite(tmp_path)
    propose_topics(bag, topics_file(bag))
    text = topics_file(bag).read_text().replace("/front/image_raw/compressed", "/front/image_raw")
    topics_file(bag).write_text(text.replace("# /front/image_raw:", "#"))
    convert(bag, "rosbag", tmp_path / "out")
    check(tmp_path / "out")


def test_the_ego_frame_can_lie_elsewhere(tmp_path: Path) -> None:
    """The origin of base_link is 0.4 m above the ground and 0.3 m ahead of the axle."""
    bag = ros2_sqlite(tmp_path)
    propose_topics(bag, topics_file(bag))
    written = yaml.safe_load(topics_file(bag).read_text())
    topics_file(bag).write_text(yaml.safe_dump(written | {"ego_origin_m": [-0.3, 0.0, -0.4]}))
    log = Log(convert(bag, "rosbag", tmp_path / "out")[0])
    sweep = read_sweep(log, 0)
    assert sweep is not None
    expected = made_bags.POINTS[0, :3] + made_bags.LIDAR_M + [0.3, 0.0, 0.4]
    np.testing.assert_allclose(sweep[0].points_ego[0].numpy(), expected, atol=1e-5)
    np.testing.assert_allclose(log.T_world_ego[0, :3, 3], [-0.3, 0.0, -0.4], atol=1e-9)


def test_a_bag_without_its_yaml_says_what_to_do(tmp_path: Path) -> None:
    bag = ros1(tmp_path)
    with pytest.raises(InputError, match=r"drive\.bag\.topics\.yaml; write it by: .*--propose"):
        convert(bag, "rosbag", tmp_path / "out")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"cameras": {"front": {"images": "/no", "info": "/front/camera_info"}}},
            "no messages of the topic /no",
        ),
        ({"world_frame": "moon"}, "no transform has the frame 'moon'; there are: base_link"),
        ({"ego_frame": "lidar", "world_frame": "base_link", "pose": None}, "does not move"),
        ({"lidar": {"topic": "/lidar/points", "frame": "roof"}}, "'roof' are not connected"),
        ({"wheels": 4}, r"wheels: Extra inputs"),
        ({"cameras": {}, "lidar": None}, "name neither cameras nor a lidar"),
        ({"name": "../../x"}, "cannot be that of a folder"),
    ],
)
def test_a_wrong_yaml_is_one_line(change: dict, told: str, tmp_path: Path) -> None:
    bag = ros2_sqlite(tmp_path)
    propose_topics(bag, topics_file(bag))
    written = yaml.safe_load(topics_file(bag).read_text())
    topics_file(bag).write_text(yaml.safe_dump(written | change))
    with pytest.raises(InputError, match=told) as refused:
        convert(bag, "rosbag", tmp_path / "out")
    assert "\n" not in str(refused.value)


def test_a_bag_without_poses_is_told(tmp_path: Path) -> None:
    made_bags.write_ros2(tmp_path / "drive", skip=("/odom",))
    propose_topics(tmp_path / "drive", topics_file(tmp_path / "drive"))
    with pytest.raises(InputError, match=r"no transform has the frame|does not move"):
        convert(tmp_path / "drive", "rosbag", tmp_path / "out")


def changed_bag(folder: Path, change, **topics: object) -> Path:
    """A bag whose recording and YAML are changed."""
    made_bags.write_ros2(folder / "drive", change=change)
    bag = folder / "drive"
    propose_topics(bag, topics_file(bag))
    written = yaml.safe_load(topics_file(bag).read_text())
    topics_file(bag).write_text(yaml.safe_dump(written | topics))
    return bag


def test_damaged_messages_are_left_out_and_counted(tmp_path: Path) -> None:
    """A cut image, a sweep without bytes and a transform without rotation cost themselves alone."""

    def damage(made: made_bags.Messages, recording: made_bags.Recording) -> made_bags.Recording:
        images = [message for topic, _, message in recording if topic.endswith("/compressed")]
        images[1].data = images[1].data[:60]
        sweeps = [message for topic, _, message in recording if topic == "/lidar/points"]
        sweeps[3].data = sweeps[3].data[:-4]
        t_ns = made_bags.START_NS
        wrong = made.transform(t_ns, "base_link", "gps", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.0))
        return [*recording, ("/tf", t_ns, made.tf(wrong))]

    (path,) = convert(changed_bag(tmp_path, damage), "rosbag", tmp_path / "out")
    log = Log(path)
    camera = pinhole_cameras(log)["front"]
    images = [read_camera(log, k, camera, (16, 32), with_image=True).image for k in range(len(log))]
    assert [image is None for image in images] == [
        False,
        True,
        True,
        False,
        False,
    ]  # one was lost before
    assert [read_sweep(log, k) is None for k in range(len(log))] == [False, False, False, True, False]
    notices = read_notices(path.folder)
    starts = (
        "/tf: unreadable messages, left out: 1 (message 0, recorded at 1700000000.000 s: a pose that",
        "/front/image_raw/compressed: unreadable messages, left out: 1 (message 1, 1700000000.120 s: ",
        "/lidar/points: unreadable messages, left out: 1 (message 3, 1700000000.300 s: a point cloud of 2",
    )
    assert all(any(notice.startswith(start) for notice in notices) for start in starts)
    assert any(each.startswith("/front/image_raw/compressed: frames without a message") for each in notices)
    assert len(notices) == 4


def test_a_topic_without_any_readable_message_is_refused(tmp_path: Path) -> None:
    def damage(made: made_bags.Messages, recording: made_bags.Recording) -> made_bags.Recording:
        for topic, _, message in recording:
            if topic.endswith("/compressed"):
                message.data = message.data[:60]
        return recording

    cameras = {"front": {"images": "/front/image_raw/compressed", "info": "/front/camera_info"}}
    bag = changed_bag(tmp_path, damage, cameras=cameras)
    with pytest.raises(InputError, match=r"/compressed: none of its messages can be read; message 0, 17000"):
        convert(bag, "rosbag", tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.arrow"))


def test_poses_a_microsecond_beside_frames_and_messages_out_of_order(tmp_path: Path) -> None:
    """Doubles of seconds since 1970 are 0.24 µs apart: a difference of 1 µs may come out as 0.95."""

    def change(made: made_bags.Messages, recording: made_bags.Recording) -> made_bags.Recording:
        for topic, t_ns, message in recording:
            if topic == "/odom":
                late_ns = (t_ns + 1000) % 10**9
                message.header.stamp.nanosec = late_ns
        first, second = [message.header for topic, _, message in recording if topic == "/lidar/points"][1:3]
        first.stamp, second.stamp = second.stamp, first.stamp
        return recording

    (path,) = convert(changed_bag(tmp_path, change), "rosbag", tmp_path / "out")
    log = Log(path)
    assert np.diff(log.t_us).tolist() == [100_000] * (made_bags.FRAMES - 1)
    for k in range(len(log)):
        sweep = read_sweep(log, k)
        assert sweep is not None
    told = "/lidar/points: messages out of order, sorted by their stamps: 1 (message 2, 1700000000.100 s)"
    assert told in read_notices(path.folder)


def test_poses_of_the_named_topic_are_not_mixed_with_transforms(tmp_path: Path) -> None:
    """Wheel odometry, as a transform, is 3 m to the left; the named poses are those of the IMU."""

    def change(made: made_bags.Messages, recording: made_bags.Recording) -> made_bags.Recording:
        upright = (0.0, 0.0, 0.0, 1.0)
        for topic, _, message in recording:
            if topic == "/odom":
                message.child_frame_id = "imu"
        moving = [
            ("/tf", t_ns, made.tf(made.transform(t_ns, "odom", "base_link", (0.1 * k, 3.0, 0.0), upright)))
            for k, t_ns in enumerate(t_ns for topic, t_ns, _ in recording if topic == "/odom")
        ]
        t_ns = made_bags.START_NS
        imu = made.transform(t_ns, "base_link", "imu", (0.5, 0.0, 0.0), upright)
        return sorted([*recording, *moving, ("/tf_static", t_ns, made.tf(imu))], key=lambda row: row[1])

    bag = changed_bag(tmp_path, change, pose="/odom", world_frame="odom", ego_frame="base_link")
    (path,) = convert(bag, "rosbag", tmp_path / "out")
    imu = np.eye(4)
    imu[0, 3] = 0.5
    for k, T in enumerate(Log(path).T_world_ego):
        np.testing.assert_allclose(T, made_bags.pose_at(0.1 * k) @ np.linalg.inv(imu), atol=1e-9)


@pytest.mark.parametrize("frame", ["base_link", "lidar"])
def test_poses_in_a_frame_of_the_vehicle_are_not_proposed(frame: str, tmp_path: Path) -> None:
    """As nuscenes2mcap writes them: the pose of the vehicle in itself. The path is in the transforms."""

    def change(made: made_bags.Messages, recording: made_bags.Recording) -> made_bags.Recording:
        rows = []
        for topic, t_ns, message in recording:
            if topic == "/odom":
                pose = message.pose.pose
                at, turn = pose.position, pose.orientation
                placed = ((at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))
                rows.append(("/tf", t_ns, made.tf(made.transform(t_ns, "map", "base_link", *placed))))
                stamped = made.make(
                    "geometry_msgs/msg/PoseStamped", header=made.header(t_ns, frame), pose=pose
                )
                rows.append(("/pose", t_ns, stamped))
            else:
                rows.append((topic, t_ns, message))
        return rows

    bag = changed_bag(tmp_path, change)
    topics = read_topics(topics_file(bag))
    assert (topics.world_frame, topics.ego_frame, topics.pose) == ("map", "base_link", None)
    (path,) = convert(bag, "rosbag", tmp_path / "out")
    np.testing.assert_allclose(Log(path).T_world_ego[3], made_bags.pose_at(0.3), atol=1e-9)


def test_a_calibration_can_be_given_for_cameras_without_one(tmp_path: Path) -> None:
    """Neither CameraInfo nor transforms of camera and lidar; both stand in the YAML."""
    skip = ("/front/camera_info", "/tf_static", "/front/image_raw")
    made_bags.write_ros2(tmp_path / "drive", skip=skip)
    bag = tmp_path / "drive"
    text = propose_topics(bag, topics_file(bag))
    assert (
        "# /front/image_raw/compressed: sensor_msgs/msg/CompressedImage, 4 messages; left out: it has no C"
        in text
    )
    place = "#   front: {images: /front/image_raw/compressed, intrinsics: {fx: , fy: , cx: , cy: }}"
    assert place in text
    x, y, z, w = made_bags.OPTICAL
    camera = {
        "images": "/front/image_raw/compressed",
        "intrinsics": {"fx": 50.0, "fy": 50.0, "cx": 15.5, "cy": 7.5},
        "mount": {"position_m": list(made_bags.CAMERA_M), "quaternion_wxyz": [w, x, y, z]},
    }
    level = {"position_m": list(made_bags.LIDAR_M), "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
    written = yaml.safe_load(text)
    written["cameras"] = {"front": camera}
    written["lidar"]["mount"] = level
    topics_file(bag).write_text(yaml.safe_dump(written))
    convert(bag, "rosbag", tmp_path / "out")
    check(tmp_path / "out")


def test_each_camera_has_the_calibration_of_its_namespace(tmp_path: Path) -> None:
    """The left camera has none, so it is left out: that of the right one would be wrong."""

    def change(made: made_bags.Messages, recording: made_bags.Recording) -> made_bags.Recording:
        names = {"/front/camera_info": "/right/camera_info", "/front/image_raw": "/right/image_raw"}
        names["/front/image_raw/compressed"] = "/left/image_raw/compressed"
        for topic, _, message in recording:
            if topic == "/front/image_raw/compressed":
                message.header.frame_id = "left_optical"
        return [(names.get(topic, topic), t_ns, message) for topic, t_ns, message in recording]

    made_bags.write_ros2(tmp_path / "drive", change=change)
    text = propose_topics(tmp_path / "drive", topics_file(tmp_path / "drive"))
    topics = read_topics(topics_file(tmp_path / "drive"))
    assert [(camera.images, camera.info) for camera in topics.cameras.values()] == [
        ("/right/image_raw", "/right/camera_info")
    ]
    assert "/left/image_raw/compressed: sensor_msgs/msg/CompressedImage, 4 messages; left out" in text


def test_a_fisheye_is_not_proposed(tmp_path: Path) -> None:
    def change(made: made_bags.Messages, recording: made_bags.Recording) -> made_bags.Recording:
        for topic, _, message in recording:
            if topic == "/front/camera_info":
                message.distortion_model = "equidistant"
        return recording

    made_bags.write_ros2(tmp_path / "drive", change=change)
    text = propose_topics(tmp_path / "drive", topics_file(tmp_path / "drive"))
    assert read_topics(topics_file(tmp_path / "drive")).cameras == {}
    assert "4 messages; left out: lenses of the model 'equidistant' are not read" in text


STAMP_S, PERIOD_S = 1_700_000_000.25, 0.1


@pytest.mark.parametrize(
    ("offset_s", "dtype", "unit", "scale"),
    [
        (0.0, "f4", "s", 1.0),
        (0.0, "f4", "ms", 1e3),
        (0.0, "f8", "us", 1e6),
        (0.0, "u4", "ns", 1e9),
        (0.0, "u4", "us", 1e6),
        (STAMP_S, "f8", "s", 1.0),
        (STAMP_S, "f8", "ms", 1e3),
        (STAMP_S, "f8", "ns", 1e9),
        (STAMP_S, "u8", "us", 1e6),
        (STAMP_S, "i8", "ns", 1e9),
    ],
)
def test_the_unit_of_point_times_is_the_one_that_fits(
    offset_s: float, dtype: str, unit: str, scale: float
) -> None:
    dt_s = np.array([0.0, 0.031, 0.0995])
    times = ((offset_s + dt_s) * scale).astype(dtype)
    stamp_us = round(STAMP_S * 1e6)
    assert time_unit(times, stamp_us, PERIOD_S) == unit
    np.testing.assert_allclose(seconds_since_stamp(times, stamp_us, unit), dt_s, atol=2e-6)


def test_point_times_that_fit_no_unit() -> None:
    """Of a short flash ns and s are usual; seconds since the hour, and 32 bits since 1970, say nothing."""
    stamp_us = round(STAMP_S * 1e6)
    assert time_unit(np.array([0, 900], "u4"), stamp_us, PERIOD_S) == "ns"
    assert time_unit(np.array([0.0, 1e-5], "f4"), stamp_us, PERIOD_S) == "s"
    assert time_unit(np.array([1234.5, 1234.6]), stamp_us, PERIOD_S) is None
    assert time_unit(np.array([STAMP_S, STAMP_S], "f4"), stamp_us, PERIOD_S) is None
    with pytest.raises(InputError, match=r"point times in s that are up to 1234.6 s away from the stamp"):
        seconds_since_stamp(np.array([1234.5, 1234.6]), stamp_us, "s")


def test_a_bag_whose_point_times_fit_no_unit_asks_for_it(tmp_path: Path) -> None:
    def change(made: made_bags.Messages, recording: made_bags.Recording) -> made_bags.Recording:
        for topic, _, message in recording:
            if topic == "/lidar/points":
                message.data = message.data.copy()
                cells = message.data.reshape(-1, 24)
                cells[:, 20:24] = np.full((len(cells), 1), 3_000_000_000, "<u4").view(np.uint8)
        return recording

    bag = changed_bag(tmp_path, change)
    with pytest.raises(InputError, match=r"of points in /lidar/points \(3e\+09 to 3e\+09\) fit no unit"):
        convert(bag, "rosbag", tmp_path / "out")
    written = yaml.safe_load(topics_file(bag).read_text())
    written["lidar"]["point_times"] = "none"
    topics_file(bag).write_text(yaml.safe_dump(written))
    (path,) = convert(bag, "rosbag", tmp_path / "out")
    sweep = read_sweep(Log(path), 1)
    assert sweep is not None
    assert sweep[0].dt_s.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("end", [0, 10, 1000])
def test_a_bag_without_a_whole_message_is_named(end: int, tmp_path: Path) -> None:
    bag = ros1(tmp_path)
    bag.write_bytes(bag.read_bytes()[:end])
    code = main(["convert", "rosbag", str(bag), "--propose"])
    assert code == 2


def test_messages_that_do_not_fit_are_refused() -> None:
    made = made_bags.Messages(2)
    image = made.image(made_bags.START_NS)
    image.encoding = "infrared"
    with pytest.raises(InputError, match="encoding 'infrared' are not read"):
        read_image(image)
    image = made.image(made_bags.START_NS)
    image.height = 2**31 - 1
    with pytest.raises(InputError, match="2147483647 x 32 px"):
        read_image(image)
    cloud = made.cloud(made_bags.START_NS)
    cloud.width = 2**32 - 1
    with pytest.raises(InputError, match="4294967295 points"):
        read_cloud(cloud)
    cloud = made.cloud(made_bags.START_NS)
    cloud.fields[0].offset = 23
    with pytest.raises(InputError, match="field 'x'"):
        read_cloud(cloud)
    fisheye = [{"distortion_model": "equidistant", "d": d} for d in (np.ones(4), np.zeros(4))]
    for values in ({"k": np.zeros(9)}, *fisheye):
        with pytest.raises(InputError, match=r"without a calibration|model 'equidistant'"):
            read_calibration(made.info(made_bags.START_NS, **values))


def test_images_of_16_bits_need_a_range_and_bayer_patterns_are_decoded() -> None:
    made = made_bags.Messages(2)
    image = made.image(made_bags.START_NS)
    image.encoding, image.step, image.width = "mono16", 8, 4
    image.data = np.repeat(np.array([7000, 7500, 9000, 9500], "<u2"), 16).view(np.uint8)
    with pytest.raises(InputError, match=r"16 bits \(7000 to 9500\); the YAML needs its `value_range`"):
        read_image(image)
    assert read_image(image, (7000.0, 9000.0))[::4, 0, 0].tolist() == [0, 64, 255, 255]
    image.encoding, image.step = "bayer_rggb8", 4
    mosaic = np.zeros((16, 4), np.uint8)
    mosaic[::2, ::2] = 200  # red, in the first column of the first row
    image.data = mosaic.reshape(-1)
    assert read_image(image)[8, 2].tolist() == [200, 0, 0]


def test_transforms_in_a_circle_are_refused() -> None:
    T = np.eye(4)
    tree = FrameTree([Placed("a", "b", 0, T), Placed("b", "a", 0, T)])
    with pytest.raises(InputError, match="in a circle"):
        tree.between("a", "b", np.array([0]))


def test_a_tree_of_frames_joins_fixed_and_moving_ones() -> None:
    """The map is 100 m off the odometry; the lidar is fixed to the vehicle, which moves by 2 m."""

    def moved(x: float) -> np.ndarray:
        T = np.eye(4)
        T[0, 3] = x
        return T

    tree = FrameTree(
        [
            Placed("map", "odom", 0, moved(100.0)),
            Placed("odom", "base", 0, moved(0.0)),
            Placed("odom", "base", 1_000_000, moved(2.0)),
            Placed("base", "lidar", 500_000, moved(1.5)),
        ]
    )
    assert tree.span_us("map", "base") == (0, 1_000_000)
    poses = tree.pose("map", "base", np.array([0.0, 250_000.0, 2e6]))
    assert poses[:, 0, 3].tolist() == [100.0, 100.5, 102.0]
    assert tree.between("base", "lidar", np.array([750_000]))[0, 0, 3] == pytest.approx(1.5)
