"""CARLA's left-handed frames and ours: hand-computed poses, round trips, and CARLA's own matrices."""

import math

import numpy as np
import pytest

from foredrive.driving.dynamics import EGO
from foredrive.errors import InputError
from foredrive.integrations.carla.frames import (
    MIRROR,
    camera_pose,
    ego_in_actor,
    matrix_of,
    pose_of,
    yaw_of_compass,
)
from foredrive.integrations.carla.sensors import (
    camera_attributes,
    camera_specs,
    image_of,
    lidar_attributes,
    lidar_pose,
    sweep_of,
)
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar


def turned(yaw_deg: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Right-handed, to the left."""
    cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    T = np.eye(4)
    T[:2, :2] = [[cos, -sin], [sin, cos]]
    T[:3, 3] = at
    return T


def test_left_becomes_a_negative_yaw_and_a_negative_y() -> None:
    pose = pose_of(turned(90.0, (10.0, 4.0, 0.5)))
    assert pose == pytest.approx((10.0, -4.0, 0.5, 0.0, 0.0, -90.0))


def test_nose_up_and_right_side_down_are_positive_in_carla() -> None:
    up = math.radians(10.0)
    T = np.eye(4)
    T[:3, 0] = [math.cos(up), 0.0, math.sin(up)]  # forward, upwards
    T[:3, 2] = [-math.sin(up), 0.0, math.cos(up)]
    assert pose_of(T) == pytest.approx((0, 0, 0, 0, 10.0, 0))
    T = np.eye(4)
    T[:3, 1] = [0.0, math.cos(up), math.sin(up)]  # the left side upwards
    T[:3, 2] = [0.0, -math.sin(up), math.cos(up)]
    assert pose_of(T) == pytest.approx((0, 0, 0, 10.0, 0, 0))


def test_poses_round_trip_through_carlas_own_transform() -> None:
    carla = pytest.importorskip("carla")
    for roll, pitch, yaw in ((0, 0, 30), (5, -7, 120), (-40, 60, -170), (12, -88, 3)):
        transform = carla.Transform(carla.Location(3, -2, 1), carla.Rotation(pitch, yaw, roll))
        T = matrix_of(transform)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
        assert pose_of(T) == pytest.approx((3, -2, 1, roll, pitch, yaw), abs=2e-4)
        # A point 2 m ahead, 1 m to the right, .5 m up, as CARLA moves it and as we do.
        theirs = transform.transform(carla.Location(2.0, 1.0, 0.5))
        ours = T @ [2.0, -1.0, 0.5, 1.0]
        assert (ours[0], -ours[1], ours[2]) == pytest.approx((theirs.x, theirs.y, theirs.z), abs=1e-4)


def test_a_matrix_is_mirrored_twice() -> None:
    """Without CARLA: a transform that turns to the right, by its matrix."""

    class Turned:
        def get_matrix(self) -> list[list[float]]:  # yaw 90° in CARLA: forward is its +y, our right
            return [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]

    T = matrix_of(Turned())
    np.testing.assert_allclose(T, turned(-90.0, (1.0, -2.0, 3.0)), atol=1e-12)
    np.testing.assert_allclose(MIRROR @ T @ MIRROR, Turned().get_matrix(), atol=1e-12)


def test_the_rear_axle_lies_behind_the_middle_of_the_box() -> None:
    """An actor at (10, 0), its nose to our left (north): the axle is 1.65 m south of it."""
    axle = turned(90.0, (10.0, 0.0, 0.0)) @ ego_in_actor()
    assert tuple(axle[:3, 3]) == pytest.approx((10.0, -EGO.axle_to_centre_m, 0.0))
    assert ego_in_actor(0.25)[0, 3] == pytest.approx(0.25 - EGO.axle_to_centre_m)


def test_compass_points_clockwise_from_north() -> None:
    for compass_deg, yaw_deg in ((0, 90), (90, 0), (180, -90), (270, 180), (45, 45)):
        yaw = math.degrees(yaw_of_compass(math.radians(compass_deg)))
        assert math.remainder(yaw - yaw_deg, 360.0) == pytest.approx(0.0, abs=1e-9)


def test_cameras_are_mounted_where_our_rig_has_them() -> None:
    specs = {spec["id"]: spec for spec in camera_specs(camera_rig((90, 160)), ego_in_actor())}
    front, left, back = (specs[name] for name in ("PCAM_F0", "PCAM_L0", "PCAM_B0"))
    placed = [front[key] for key in ("x", "y", "z", "roll", "pitch", "yaw")]
    assert placed == pytest.approx([1.70 - EGO.axle_to_centre_m, 0.0, 1.60, 0.0, 0.0, 0.0], abs=1e-5)
    assert left["yaw"] == pytest.approx(-55.0, abs=1e-4)  # to the left
    assert left["y"] == pytest.approx(-0.49, abs=1e-6)
    assert abs(back["yaw"]) == pytest.approx(180.0, abs=1e-4)
    assert (front["fov"], back["fov"]) == pytest.approx((70.0, 110.0), abs=1e-3)
    # The leaderboards allow nothing further than 3 m from the actor's origin.
    assert max(math.hypot(s["x"], s["y"], s["z"]) for s in specs.values()) < 3.0
    attributes = camera_attributes(front)
    assert attributes["image_size_x"] == "160"
    assert float(attributes["fov"]) == pytest.approx(70.0, abs=1e-3)
    assert all(isinstance(value, str) for value in attributes.values())


def test_a_camera_that_looks_up_has_a_positive_pitch() -> None:
    up = math.radians(20.0)
    forward, right = np.array([math.cos(up), 0.0, math.sin(up)]), np.array([0.0, -1.0, 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)  # x right, y down, z forward
    assert camera_pose(T, np.eye(4)) == pytest.approx((0, 0, 0, 0, 20.0, 0), abs=1e-9)


@pytest.mark.parametrize("flaw", ["K", "dist", "readout_s"])
def test_cameras_that_carla_has_not_are_refused(flaw: str) -> None:
    rig = camera_rig((90, 160))
    of_third = getattr(rig, flaw)[2:3].view(-1)
    of_third[4 if flaw == "K" else 0] += 0.05  # K: the focal length along v
    with pytest.raises(InputError, match=rig.names[2]):
        camera_specs(rig, np.eye(4))


def test_pictures_come_as_rgb() -> None:
    sent = np.zeros((2, 3, 4), dtype=np.uint8)
    sent[1, 2] = [10, 20, 30, 255]  # blue, green, red, alpha
    image = image_of(sent)
    assert image.shape == (3, 2, 3)
    assert image[:, 1, 2].tolist() == [30, 20, 10]


def test_a_lidar_point_to_the_right_of_the_sensor_is_to_the_right_of_the_vehicle() -> None:
    lidar = roof_lidar(channels=4, azimuth_steps=60)
    points = np.array([[10.0, 0.0, 0.0, 0.7], [0.0, 5.0, -1.0, 0.2], [0.3, 0.0, 0.0, 1.0]], dtype=np.float32)
    sweep = sweep_of(points, np.array([1, 2, 0, 0]), lidar)
    x, y, z = lidar.T_ego_lidar[:3, 3].tolist()
    np.testing.assert_allclose(sweep.points_ego[0], [x + 10.0, y, z], atol=1e-5)
    np.testing.assert_allclose(sweep.points_ego[1], [x, y - 5.0, z - 1.0], atol=1e-5)
    assert sweep.beam.tolist() == [0, 1, 1]
    assert sweep.returned.tolist() == [True, True, False]  # the last is the vehicle's own roof
    assert sweep.intensity.tolist() == pytest.approx([0.7, 0.2, 1.0])
    nothing = sweep_of(np.zeros((0, 4), dtype=np.float32), np.zeros(4, dtype=np.int64), lidar)
    assert nothing.range_m.shape == (0,)


def test_a_lidar_turns_once_a_step() -> None:
    lidar = roof_lidar(channels=32, azimuth_steps=720)
    attributes = lidar_attributes(lidar)
    assert attributes["points_per_second"] == str(32 * 720 * 20)
    assert attributes["rotation_frequency"] == "20.0"
    assert (attributes["upper_fov"], attributes["lower_fov"]) == ("10.67", "-30.67")
    assert lidar_pose(lidar, ego_in_actor()) == pytest.approx((0.94 - EGO.axle_to_centre_m, 0, 1.84, 0, 0, 0))
