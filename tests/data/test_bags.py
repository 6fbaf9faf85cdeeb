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
from foredrive.data.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.raw.bag_messages import Placed, read_calibration, read_cloud, read_image
from foredrive.data.raw.bag_topics import propose_topics, read_topics, topics_file
from foredrive.data.raw.frame_tree import FrameTree
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


@pytest.mark.parametrize("end", [0, 10, 1000, -200])
def test_a_cut_bag_is_named(end: int, tmp_path: Path) -> None:
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
    for values in ({"k": np.zeros(9)}, {"distortion_model": "equidistant", "d": np.ones(4)}):
        with pytest.raises(InputError, match=r"without a calibration|model 'equidistant'"):
            read_calibration(made.info(made_bags.START_NS, **values))


def test_mono16_images_are_scaled_and_bayer_patterns_decoded() -> None:
    made = made_bags.Messages(2)
    image = made.image(made_bags.START_NS)
    image.encoding, image.step, image.width = "mono16", 8, 4
    image.data = np.full(16 * 4, 0x4000, "<u2").view(np.uint8)
    assert read_image(image).tolist() == np.full((16, 4, 3), 0x40).tolist()
    image.encoding, image.step = "bayer_rggb8", 4
    mosaic = np.zeros((16, 4), np.uint8)
    mosaic[::2, ::2] = 200  # red, in the first column of the first row
    image.data = mosaic.reshape(-1)
    assert read_image(image)[8, 2].tolist() == [200, 0, 0]


def test_transforms_in_a_circle_are_refused() -> None:
    T = np.eye(4)
    tree = FrameTree([Placed("a", "b", 0, T), Placed("b", "a", 0, T)])
    with pytest.raises(InputError, match="in a circle"):
        tree.between("a", "b", 0)


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
    assert tree.between("base", "lidar", 750_000)[0, 3] == pytest.approx(1.5)
