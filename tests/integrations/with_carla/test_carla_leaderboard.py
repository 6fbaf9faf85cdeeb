"""An agent by the leaderboard's interface: what it sees, what it is told, and where it drives."""

import enum
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from carla_stand_in import lat_lon

from foredrive.driving.dynamics import STEP_S
from foredrive.driving.route_progress import RouteProgress
from foredrive.errors import InputError
from foredrive.integrations.carla.leaderboard import GPS, IMU, LIDAR, SPEED, GlobalPlan, LeaderboardDriver
from foredrive.scene import BicycleState, Clip, Command, Trajectory
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar

SIZE = (9, 16)


class RoadOption(enum.Enum):
    """As CARLA's `agents` package has it, which no wheel brings."""

    LEFT = 1
    RIGHT = 2
    STRAIGHT = 3
    LANEFOLLOW = 4
    CHANGELANELEFT = 5


def point(x: float, y: float, option: RoadOption, yaw_deg: float = 0.0) -> tuple[Any, RoadOption]:
    """Return a point of our world as the leaderboard has it: y and yaw are mirrored."""
    location, rotation = SimpleNamespace(x=x, y=-y, z=0.0), SimpleNamespace(yaw=-yaw_deg)
    return SimpleNamespace(location=location, rotation=rotation), option


PLAN = [
    point(0.0, 0.0, RoadOption.LANEFOLLOW),
    point(50.0, 0.0, RoadOption.LEFT),  # into a junction
    point(60.0, 10.0, RoadOption.LANEFOLLOW, 90.0),  # out of it
    point(60.0, 60.0, RoadOption.CHANGELANELEFT, 90.0),
    point(57.0, 90.0, RoadOption.LANEFOLLOW, 90.0),
    point(57.0, 150.0, RoadOption.LANEFOLLOW, 90.0),
]
BY_SATELLITE = [
    (dict(zip(("lat", "lon"), lat_lon(p.location.x, -p.location.y, 42.0, 2.0), strict=True)) | {"z": 0.0}, o)
    for p, o in PLAN
]


@pytest.mark.parametrize(
    ("done_m", "command"),
    [
        (0.0, Command.STRAIGHT),
        (29.0, Command.STRAIGHT),
        (31.0, Command.LEFT),  # the turn begins in 19 m
        (63.0, Command.LEFT),  # in the turn, 14.1 m long
        (66.0, Command.STRAIGHT),
        (93.0, Command.STRAIGHT),
        (96.0, Command.LEFT),  # a change of lanes ahead
        (150.0, Command.STRAIGHT),
        (204.0, Command.STRAIGHT),
    ],
)
def test_commands_come_from_the_route(done_m: float, command: Command) -> None:
    assert GlobalPlan(PLAN).command(RouteProgress(done_m=done_m)) is command


def test_the_line_of_a_route_is_smooth_and_straight_before_a_turn() -> None:
    turn = GlobalPlan(PLAN)._xy
    assert np.abs(turn[turn[:, 0] < 49.5][:, 1]).max() < 1e-9
    after = turn[(turn[:, 1] > 10.5) & (turn[:, 1] < 59.5)]
    assert np.abs(after[:, 0] - 60.0).max() < 1e-9
    corner = turn[(turn[:, 0] > 50.0) & (turn[:, 1] < 10.0)]
    assert np.abs(np.hypot(corner[:, 0] - 50.0, corner[:, 1] - 10.0) - 10.0).max() < 0.3  # an arc
    bend = [
        point(50 * math.sin(a), 50 - 50 * math.cos(a), RoadOption.LANEFOLLOW, math.degrees(a))
        for a in np.radians(np.arange(0.0, 181.0, 45.0))  # 38 m apart: a chord would be 3.8 m off
    ]
    away_m = np.hypot(*(GlobalPlan(bend)._xy - [0.0, 50.0]).T) - 50.0
    assert np.abs(away_m).max() < 0.05


class Straight:
    """Plans to go straight ahead at a speed; remembers what it saw."""

    def __init__(self, speed_mps: float) -> None:
        self.speed_mps, self.seen = speed_mps, list[Clip]()

    def act(self, observation: Clip) -> Trajectory:
        self.seen.append(observation)
        xy = torch.zeros(1, 1, 6, 2)
        xy[..., 0] = self.speed_mps * 0.5 * torch.arange(1, 7)
        return Trajectory(
            xy=xy,
            yaw=torch.zeros(1, 1, 6),
            valid=torch.ones(1, 1, 6, dtype=torch.bool),
            log_prob=torch.zeros(1, 1),
            dt_s=0.5,
        )


def sensed(driver: LeaderboardDriver, ego: BicycleState, frame: int) -> dict[str, tuple[int, Any]]:
    """What the leaderboard hands over of a vehicle in our world."""
    compass = 0.5 * math.pi - ego.yaw_rad
    data: dict[str, tuple[int, Any]] = {
        GPS: (frame, np.array([*lat_lon(ego.x_m, ego.y_m, 42.0, 2.0), 0.3])),
        IMU: (frame, np.array([0.0, 0.0, 9.8, 0.0, 0.0, 0.0, compass])),
        SPEED: (frame, {"speed": ego.speed_mps}),
    }
    for spec in driver.sensors():
        if spec["type"] == "sensor.camera.rgb":
            bgra = np.zeros((*SIZE, 4), dtype=np.uint8)
            bgra[..., 2] = frame % 256  # red
            data[spec["id"]] = (frame, bgra)
    return data


def test_the_agent_sees_key_frames_and_its_plan_is_driven() -> None:
    agent = Straight(5.0)
    driver = LeaderboardDriver(agent, camera_rig(SIZE), None, past_frames=2)
    driver.set_route(BY_SATELLITE, PLAN)
    x_m = speed = 0.0
    throttles = []
    for k in range(200):
        ego = BicycleState(x_m, 0.0, 0.0, speed)
        pedals = driver.step(sensed(driver, ego, k), k * STEP_S)
        throttles.append(pedals.throttle)
        assert pedals.steer == pytest.approx(0.0, abs=0.02)
        speed = max(0.0, speed + (4.0 * pedals.throttle - 8.0 * pedals.brake) * STEP_S)
        x_m += speed * STEP_S
    assert max(throttles[:20]) == 0.0  # until it has a past, it stands
    assert throttles[20] > 0.0
    assert speed == pytest.approx(5.0, abs=0.3)
    assert len(agent.seen) == 18  # at 1.0, 1.5, … 9.5 s
    clip = agent.seen[-1]
    assert clip.t_s[0].tolist() == pytest.approx([-1.0, -0.5, 0.0])
    assert clip.images[0, :, 0, 0, 0, 0].tolist() == [170, 180, 190]  # red comes first
    assert clip.images[0, :, 0, 2].max() == 0
    way = clip.T_world_ego[0, 2, :2, 3] - clip.T_world_ego[0, 0, :2, 3]
    assert way.tolist() == pytest.approx([5.0, 0.0], abs=0.15)
    assert float(clip.ego_speed_mps[0, 2]) == pytest.approx(5.0, abs=0.3)
    assert not clip.boxes_valid.any()
    assert not clip.sweep_valid.any()
    assert not clip.future.valid.any()
    # 35 m on, the turn is 15 m ahead.
    assert [int(c.command[0]) for c in (agent.seen[0], clip)] == [Command.STRAIGHT, Command.LEFT]


def test_two_half_turns_of_the_lidar_are_a_sweep() -> None:
    """One step sees what is ahead, the next what is behind; the lidar's axes are left-handed."""
    agent, lidar = Straight(0.0), roof_lidar()
    driver = LeaderboardDriver(agent, None, lidar, past_frames=0)
    driver.set_route(BY_SATELLITE, PLAN)
    halves = np.array([[[8.0, 3.0, -1.0, 0.5]], [[-9.0, 0.0, 0.5, 0.2]]], dtype=np.float32)
    for k in range(11):
        data = sensed(driver, BicycleState(0.0, 0.0, 0.0, 0.0), k)
        driver.step(data | {LIDAR: (k, halves[k % 2])}, k * STEP_S)
    clip = agent.seen[-1]
    assert clip.sweep_valid.all()
    assert not clip.misses_known.any()
    sweep = clip.sweeps[0, 0]
    xyz = sweep.points_ego[sweep.valid] - lidar.T_ego_lidar[:3, 3]
    assert sorted(xyz.tolist()) == [pytest.approx([-9.0, 0.0, 0.5]), pytest.approx([8.0, -3.0, -1.0])]
    with pytest.raises(InputError, match="without data: LIDAR"):
        driver.step(data, 0.6)


def test_who_is_beside_its_plan_steers_back_the_way_carla_does() -> None:
    """Headed north, with a plan that bends to the left: CARLA's steering is negative."""

    class Left(Straight):
        def act(self, observation: Clip) -> Trajectory:
            plan = super().act(observation)
            plan.xy[..., 1] = 0.05 * plan.xy[..., 0] ** 2
            return plan

    driver = LeaderboardDriver(Left(5.0), camera_rig(SIZE), None, past_frames=0)
    driver.set_route(BY_SATELLITE, PLAN)
    ego = BicycleState(60.0, 20.0, 0.5 * math.pi, 5.0)
    pedals = [driver.step(sensed(driver, ego, k), k * STEP_S) for k in range(3)]
    assert pedals[-1].steer < -0.1


def test_the_sensors_are_what_the_leaderboards_allow() -> None:
    sensors = LeaderboardDriver(Straight(1.0), camera_rig(SIZE), roof_lidar(), 1).sensors()
    kinds = [sensor["type"] for sensor in sensors]
    assert kinds.count("sensor.camera.rgb") == 6
    assert kinds.count("sensor.lidar.ray_cast") == 1
    assert sorted(set(kinds)) == [
        *("sensor.camera.rgb", "sensor.lidar.ray_cast"),
        *("sensor.other.gnss", "sensor.other.imu", "sensor.speedometer"),
    ]
    assert len({sensor["id"] for sensor in sensors}) == len(sensors)
    gps = next(sensor for sensor in sensors if sensor["id"] == GPS)
    assert (gps["x"], gps["y"], gps["z"]) == pytest.approx((-1.64855, 0.0, 0.0))  # at the rear axle
    assert all(math.hypot(s.get("x", 0), s.get("y", 0), s.get("z", 0)) < 3.0 for s in sensors)


def test_what_is_missing_is_named() -> None:
    driver = LeaderboardDriver(Straight(1.0), camera_rig(SIZE), None, 1)
    data = sensed(driver, BicycleState(0.0, 0.0, 0.0, 0.0), 0)
    with pytest.raises(InputError, match="not set a route"):
        driver.step(data, 0.0)
    with pytest.raises(InputError, match="5 in degrees"):
        driver.set_route(BY_SATELLITE[1:], PLAN)
    with pytest.raises(InputError, match="two different points"):
        driver.set_route(BY_SATELLITE[:1], PLAN[:1])
    driver.set_route(BY_SATELLITE, PLAN)
    with pytest.raises(InputError, match="PCAM_B0"):
        driver.step({key: value for key, value in data.items() if key != "PCAM_B0"}, 0.0)
    data["PCAM_L1"] = (0, np.zeros((4, 4, 4), dtype=np.uint8))
    with pytest.raises(InputError, match="PCAM_L1"):
        driver.step(data, 0.0)
