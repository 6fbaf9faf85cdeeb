"""Getting imitators going again: after a while, and only where lidar sees nobody ahead."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from foredrive.data.batches import stack_records
from foredrive.scene import Clip, Command, LidarSweep
from foredrive.scene.actors import boxes_in_ego_frame
from foredrive.simulation.observation import KeyFrame, make_clip, no_images
from foredrive.simulation.restarts import RestartingAgent, is_free_ahead
from foredrive.simulation.simple_agents import StraightAgent


def sweep(*points: tuple[float, float, float]) -> LidarSweep:
    """One beam for each point, and one that met nothing."""
    xyz = torch.tensor([*points, (3.0, 0.0, 1.0)])
    range_m, count = xyz.norm(dim=-1), len(xyz)
    returned = torch.ones(count, dtype=torch.bool)
    returned[-1] = False
    return LidarSweep(
        origin_ego=torch.zeros(count, 3),
        dir_ego=xyz / range_m[:, None],
        range_m=range_m,
        returned=returned,
        intensity=torch.zeros(count),
        dt_s=torch.zeros(count),
        beam=torch.zeros(count, dtype=torch.int64),
        valid=torch.ones(count, dtype=torch.bool),
    )


def seen(speed_mps: float, lidar: LidarSweep | None) -> Clip:
    nobody = boxes_in_ego_frame([], np.eye(4))
    frame = KeyFrame(0.0, np.eye(4), speed_mps, no_images(), lidar, nobody)
    return stack_records([make_clip([frame], None, Command.STRAIGHT)])


@dataclass
class Clock:
    t_s: float = 0.0

    def __call__(self) -> float:
        return self.t_s


def creeps(agent: RestartingAgent, clock: Clock, t_s: float, speed_mps: float, lidar: LidarSweep) -> bool:
    clock.t_s = t_s
    return float(agent.act(seen(speed_mps, lidar)).xy[0, 0, -1, 0]) > 5.0


@pytest.mark.parametrize(
    ("points", "free"),
    [
        ([], True),
        ([(7.0, 0.5, 1.0)], False),
        ([(7.0, -1.2, 0.5)], False),
        ([(7.0, 1.6, 1.0)], True),  # beside
        ([(7.0, 0.0, 0.1)], True),  # the road
        ([(7.0, 0.0, 4.0)], True),  # a bridge
        ([(1.0, 0.0, 1.0)], True),  # on the vehicle
        ([(12.0, 0.0, 1.0)], True),  # far ahead
    ],
)
def test_only_what_is_in_the_box_ahead_is_in_the_way(
    points: list[tuple[float, float, float]], free: bool
) -> None:
    assert is_free_ahead(seen(0.0, sweep(*points))) == free


def test_without_lidar_nobody_knows() -> None:
    assert not is_free_ahead(seen(0.0, None))


def test_who_has_not_moved_yet_sets_off_soon_and_who_stopped_later_waits_long() -> None:
    clock = Clock()
    agent, free = RestartingAgent(StraightAgent(0.0), clock), sweep()
    assert [creeps(agent, clock, t, 0.0, free) for t in (0.0, 0.5, 1.0, 1.5)] == [False, False, True, True]
    assert creeps(agent, clock, 2.0, 2.0, free)  # still
    assert not creeps(agent, clock, 3.5, 2.0, free)
    stands = [creeps(agent, clock, 4.0 + t, 0.0, free) for t in range(0, 22)]
    assert stands.index(True) == 20


def test_it_waits_behind_somebody_and_sets_off_once_he_is_gone() -> None:
    clock = Clock()
    agent = RestartingAgent(StraightAgent(0.0), clock)
    blocked, free = sweep((6.0, 0.0, 1.0)), sweep()
    assert not any(creeps(agent, clock, 0.5 * k, 0.0, blocked) for k in range(12))
    assert any(creeps(agent, clock, 6.0 + 0.5 * k, 0.0, free) for k in range(4))


def test_who_drives_is_left_alone() -> None:
    clock = Clock()
    agent = RestartingAgent(StraightAgent(5.0), clock)
    for k in range(60):
        clock.t_s = 0.5 * k
        plan = agent.act(seen(0.0, sweep()))
        torch.testing.assert_close(plan.xy[0, 0, 0], torch.tensor([2.5, 0.0]))
