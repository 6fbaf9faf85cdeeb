"""Getting imitators going again: after a while, and only where nobody is seen ahead."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from foredrive.data.batches import stack_records
from foredrive.driving.observation import KeyFrame, make_clip, no_images
from foredrive.driving.restarts import RestartingAgent, is_free_ahead
from foredrive.driving.simple_agents import StraightAgent
from foredrive.scene import Clip, Command, VoxelSpec
from foredrive.scene.actors import boxes_in_ego_frame

SPEC = VoxelSpec(lower_m=(-8.0, -8.0, -1.5), voxel_m=1.0, shape_zyx=(6, 16, 28))


def occupied(*points: tuple[float, float, float]) -> torch.Tensor:
    """Logits of a volume with an occupied voxel at each point."""
    logits = torch.full(SPEC.shape_zyx, -3.0)
    for point in points:
        x, y, z = (torch.tensor(point) - torch.tensor(SPEC.lower_m)).floor().long().tolist()
        logits[z, y, x] = 0.5
    return logits


def seen(speed_mps: float) -> Clip:
    nobody = boxes_in_ego_frame([], np.eye(4))
    frame = KeyFrame(0.0, np.eye(4), speed_mps, no_images(), None, nobody)
    return stack_records([make_clip([frame], None, Command.STRAIGHT)])


@dataclass
class Clock:
    t_s: float = 0.0

    def __call__(self) -> float:
        return self.t_s


def creeps(agent: RestartingAgent, clock: Clock, t_s: float, speed_mps: float) -> bool:
    clock.t_s = t_s
    return float(agent.act(seen(speed_mps)).xy[0, 0, -1, 0]) > 5.0


@pytest.mark.parametrize(
    ("points", "free"),
    [
        ([], True),
        ([(7.2, 0.5, 1.0)], False),
        ([(7.2, -1.2, 1.0)], False),
        ([(7.2, 2.5, 1.0)], True),  # beside
        ([(7.2, 0.5, 0.1)], True),  # the road
        ([(7.2, 0.5, 4.0)], True),  # a bridge
        ([(1.2, 0.5, 1.0)], True),  # on the vehicle
        ([(12.2, 0.5, 1.0)], True),  # far ahead
    ],
)
def test_only_what_is_in_the_box_ahead_is_in_the_way(
    points: list[tuple[float, float, float]], free: bool
) -> None:
    assert is_free_ahead(occupied(*points), SPEC) == free


def test_a_volume_that_ends_before_the_bumper_does_not_tell() -> None:
    behind = VoxelSpec(lower_m=(-8.0, -8.0, -1.5), voxel_m=1.0, shape_zyx=(6, 16, 10))
    assert not is_free_ahead(torch.full(behind.shape_zyx, -3.0), behind)


def test_who_has_not_moved_yet_sets_off_soon_and_who_stopped_later_waits_long() -> None:
    clock = Clock()
    agent = RestartingAgent(StraightAgent(0.0), clock)
    assert [creeps(agent, clock, t, 0.0) for t in (0.0, 0.5, 1.0, 1.5)] == [False, False, True, True]
    assert creeps(agent, clock, 2.0, 2.0)  # still
    assert not creeps(agent, clock, 3.5, 2.0)
    stands = [creeps(agent, clock, 4.0 + t, 0.0) for t in range(0, 22)]
    assert stands.index(True) == 20


def test_it_waits_behind_somebody_and_sets_off_once_he_is_gone() -> None:
    clock = Clock()
    agent = RestartingAgent(StraightAgent(0.0), clock, lambda _: clock.t_s >= 6.0)
    assert not any(creeps(agent, clock, 0.5 * k, 0.0) for k in range(12))
    assert any(creeps(agent, clock, 6.0 + 0.5 * k, 0.0) for k in range(4))


def test_who_drives_is_left_alone() -> None:
    clock = Clock()
    agent = RestartingAgent(StraightAgent(5.0), clock)
    for k in range(60):
        clock.t_s = 0.5 * k
        plan = agent.act(seen(0.0))
        torch.testing.assert_close(plan.xy[0, 0, 0], torch.tensor([2.5, 0.0]))
