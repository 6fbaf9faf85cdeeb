"""Agents that follow a logged path: the lidar corridor, and the expert that is given the true boxes."""

import dataclasses

import numpy as np
import pytest
import torch

from foredrive.data.batches import stack_records
from foredrive.data.boxes import no_boxes
from foredrive.data.lidar import empty_sweep
from foredrive.driving.collisions import RoadUsers
from foredrive.driving.corridor_agent import CorridorAgent, returns_in_corridor
from foredrive.driving.observation import KeyFrame, make_clip, no_images
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.replay.replay_expert import ReplayExpert
from foredrive.errors import InputError
from foredrive.methods.reconstruction.vehicle import LoggedVehicle
from foredrive.scene import BicycleState, Boxes, CameraRig, Category, Clip, Command, LidarSweep

YAW = 0.7


def logged(speed_mps: float = 8.0) -> LoggedDrive:
    """A log that drives straight, at a heading of `YAW` in the world."""
    times = torch.arange(0.0, 8.05, 0.1)
    T = torch.eye(4).repeat(len(times), 1, 1)
    T[:, 0, 3] = speed_mps * times
    T_world_scene = torch.eye(4, dtype=torch.float64)
    cos, sin = np.cos(YAW), np.sin(YAW)
    T_world_scene[:2, :2] = torch.tensor([[cos, -sin], [sin, cos]])
    T_world_scene[:2, 3] = torch.tensor([100.0, -40.0])
    rig = CameraRig(
        torch.zeros(0, 3, 3),
        torch.zeros(0, 4, 4),
        torch.zeros(0, 5),
        torch.zeros(0),
        (),
        (0, 0),
        torch.zeros(0),
    )
    return LoggedDrive(LoggedVehicle(times, T, T_world_scene, rig, None, None, 50.0), torch.eye(4))


def boxes(*rows: tuple[float, float, float, float, float]) -> Boxes:
    """Cars by x, y, yaw and velocity in the ego frame."""
    values, count = torch.tensor(rows).reshape(-1, 5), len(rows)
    return dataclasses.replace(
        no_boxes(),
        centre=torch.column_stack([values[:, :2], torch.ones(count)]),
        size_lwh=torch.tensor([[4.5, 1.9, 1.6]]).repeat(count, 1),
        yaw=values[:, 2],
        velocity=values[:, 3:],
        track_id=torch.arange(count),
        category=torch.full((count,), int(Category.CAR)),
        valid=torch.ones(count, dtype=torch.bool),
        **{name: torch.full((count,), -1) for name in ("num_points", "attribute", "visibility")},
    )


def returns(*points: tuple[float, float, float]) -> LidarSweep:
    xyz, count = torch.tensor(points).reshape(-1, 3), len(points)
    far = xyz.norm(dim=-1)
    return dataclasses.replace(
        empty_sweep(),
        origin_ego=torch.zeros(count, 3),
        dir_ego=xyz / far[:, None],
        range_m=far,
        returned=torch.ones(count, dtype=torch.bool),
        intensity=torch.ones(count),
        dt_s=torch.zeros(count),
        beam=torch.zeros(count, dtype=torch.int64),
        valid=torch.ones(count, dtype=torch.bool),
    )


def seen(at_m: float, speed_mps: float, sweep: LidarSweep | None = None, near: Boxes | None = None) -> Clip:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(YAW), -np.sin(YAW)], [np.sin(YAW), np.cos(YAW)]]
    T[:2, 3] = [100.0 + at_m * np.cos(YAW), -40.0 + at_m * np.sin(YAW)]
    frame = KeyFrame(0.0, T, speed_mps, no_images(), sweep, no_boxes() if near is None else near)
    return stack_records([make_clip([frame], None, Command.STRAIGHT)])


def test_the_path_ahead_is_in_the_ego_frame_and_goes_on_behind_the_end() -> None:
    clip = seen(at_m=60.0, speed_mps=8.0)
    path = logged().path_ahead(clip.T_world_ego[0, 0].numpy())
    np.testing.assert_allclose(path[:, 1], 0.0, atol=1e-4)
    np.testing.assert_allclose(path[:3, 0], [0.0, 0.5, 1.0], atol=1e-4)
    assert path[-1, 0] == pytest.approx(4.0 + 100.0, abs=0.6)


def test_only_returns_above_the_road_in_the_corridor_count() -> None:
    path = np.column_stack([np.arange(0.0, 60.0, 0.5), np.zeros(120)])
    bumper_m = 1.64855 + 0.5 * 4.89238
    for point, counts in (
        ((20.0, 0.0, 1.0), 1),
        ((20.0, 1.1, 1.0), 1),
        ((20.0, 1.6, 1.0), 0),  # beside
        ((20.0, 0.0, 0.1), 0),  # the road
        ((20.0, 0.0, 3.0), 0),  # a bridge
        ((bumper_m - 0.3, 0.0, 1.0), 0),  # the own hood
        ((bumper_m + 21.5, 0.0, 1.0), 0),  # too far
    ):
        assert returns_in_corridor(returns(point), path, 20.0) == counts, point


def test_the_corridor_agent_drives_on_until_something_stands_there_and_keeps_the_corridor() -> None:
    agent = CorridorAgent(logged())
    free = agent.act(seen(0.0, 8.0, returns((60.0, 0.0, 1.0), (60.0, 0.1, 1.0))))
    np.testing.assert_allclose(free.xy[0, 0].numpy(), [[4.0 * k, 0.0] for k in range(1, 7)], atol=1e-3)
    ahead = returns((18.0, 0.0, 1.0), (18.0, 0.1, 1.0))
    assert not agent.act(seen(8.0, 8.0, ahead)).xy.any()
    assert not agent.act(seen(9.0, 1.0, ahead)).xy.any()  # a new corridor at 1 m/s would end 4 m ahead
    single = CorridorAgent(logged()).act(seen(0.0, 8.0, returns((18.0, 0.0, 1.0))))
    assert bool(single.xy.any())
    with pytest.raises(InputError, match="needs a lidar"):
        agent.act(seen(0.0, 8.0))


def test_the_expert_drives_as_fast_as_the_log_where_the_way_is_free() -> None:
    plan = ReplayExpert(logged()).act(seen(0.0, 8.0, near=boxes((15.0, 4.0, 0.0, 8.0, 0.0))))
    np.testing.assert_allclose(plan.xy[0, 0].numpy(), [[4.0 * k, 0.0] for k in range(1, 7)], atol=0.05)


def test_the_expert_passes_one_who_stands_and_stops_if_it_cannot() -> None:
    expert = ReplayExpert(logged())
    beside = expert.act(seen(0.0, 8.0, near=boxes((25.0, 0.0, 0.0, 0.0, 0.0)))).xy[0, 0]
    assert float(beside[:, 1].abs().max()) > 1.5
    wall = boxes(*[(22.0, y, 1.57, 0.0, 0.0) for y in (-8.0, -4.0, 0.0, 4.0, 8.0)])
    stops = expert.act(seen(0.0, 8.0, near=wall)).xy[0, 0]
    assert float(stops[-1, 0]) < 22.0 - 0.95 - 4.1
    assert float(stops[-1, 0] - stops[-2, 0]) < 0.6


def test_the_expert_yields_to_one_who_crosses() -> None:
    """At 8 m/s it would be at x = 16 m after 2 s, as the other is."""
    crossing = boxes((16.0, -14.0, 1.57, 0.0, 6.0))
    plan = ReplayExpert(logged()).act(seen(0.0, 8.0, near=crossing)).xy[0, 0]
    assert abs(float(plan[3, 0]) - 16.0) > 1.0 or abs(float(plan[3, 1])) > 1.0


def test_the_expert_knows_who_will_turn_into_its_path() -> None:
    """Now the other stands 5 m beside the path; after 2 s it is on it, 16 m ahead of the vehicle's start."""
    clip = seen(0.0, 8.0, near=boxes((16.0, 5.0, 1.57, 0.0, 0.0)))
    pose = clip.T_world_ego[0, 0].double().numpy()

    class Told:
        def ego(self) -> BicycleState:
            return BicycleState(0.0, 0.0, 0.0, 8.0)

        def users_in(self, after_s: float) -> RoadUsers:
            foot = pose @ [16.0, 5.0 if after_s < 1.5 else 0.0, 0.0, 1.0]
            return RoadUsers(
                track_id=np.array([1]),
                category=np.array([int(Category.CAR)]),
                foot_m=foot[None, :3],
                yaw=np.array([YAW]),
                half_lw=np.array([[2.2, 0.95]]),
                velocity_mps=np.zeros((1, 2)),
            )

    blind = ReplayExpert(logged()).act(clip).xy[0, 0]
    np.testing.assert_allclose(blind[:, 0].numpy(), [4.0 * k for k in range(1, 7)], atol=0.05)
    told = ReplayExpert(logged(), Told()).act(clip).xy[0, 0]
    assert float(told[3, 1].abs()) > 2.0 or float(told[3, 0]) < 16.0 - 2.2 - 3.9


def test_the_expert_returns_to_the_path_from_beside_it() -> None:
    clip = seen(10.0, 8.0)
    pose = clip.T_world_ego.clone()
    pose[0, 0, :2, 3] += torch.tensor([-np.sin(YAW), np.cos(YAW)]) * 2.0
    plan = ReplayExpert(logged()).act(dataclasses.replace(clip, T_world_ego=pose)).xy[0, 0]
    assert float(plan[-1, 1]) == pytest.approx(-2.0, abs=0.05)
    assert -1.0 < float(plan[0, 1]) <= 0.0
