"""The disturbances of an expert, and the turns of student and expert."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from foredrive.data.batches import stack_records
from foredrive.driving.observation import KeyFrame, make_clip, no_images
from foredrive.driving.simple_agents import StraightAgent
from foredrive.scene import Clip, Command, Trajectory
from foredrive.scene.actors import boxes_in_ego_frame
from foredrive.towns.driving.demonstrations import (
    STEERED_SHARE,
    STEERS_RAD,
    AlternatingStudent,
    DisturbedExpert,
)

STEP_S, HOURS_S = 0.5, 3600.0


@dataclass(frozen=True)
class Steady:
    """An expert whose plan never changes."""

    fixed: Trajectory

    def plan(self) -> Trajectory:
        return self.fixed


@pytest.fixture(scope="module")
def expert(clip: Clip) -> Steady:
    return Steady(StraightAgent(8.0).act(clip))


@pytest.fixture(scope="module")
def clip() -> Clip:
    frame = KeyFrame(0.0, np.eye(4), 5.0, no_images(), None, boxes_in_ego_frame([], np.eye(4)))
    return stack_records([make_clip([frame], None, Command.STRAIGHT)])


def plans(agent_type: type, clip: Clip, seed: int, *agents: object) -> torch.Tensor:
    """Waypoints of all plans of an hour."""
    now = [0.0]
    agent, out = agent_type(*agents, lambda: now[0], seed), []
    while now[0] < HOURS_S:
        plan: Trajectory = agent.act(clip)
        out.append(plan.xy[0, 0])
        now[0] += STEP_S
    return torch.stack(out)


def test_the_expert_is_steered_aside_or_slowed_but_mostly_undisturbed(clip: Clip, expert: Steady) -> None:
    xy = plans(DisturbedExpert, clip, 3, expert)
    gets_m, bears_rad = xy[:, -1].norm(dim=-1), torch.atan2(xy[:, 0, 1], xy[:, 0, 0])
    steered, paced = bears_rad != 0, ~torch.isclose(gets_m, torch.tensor(24.0))
    assert not (steered & paced).any()  # one thing at a time
    low, high = STEERS_RAD
    assert ((bears_rad.abs() > low) & (bears_rad.abs() < high))[steered].all()
    assert 0.4 < (bears_rad[steered] > 0).float().mean() < 0.6
    # 5 s of calm, then 1.5 s aside (.65) or 2.75 s at another pace, rounded up to plans
    begun = torch.diff((steered | paced).int(), prepend=torch.zeros(1)) > 0
    assert 0.2 < (steered | paced).float().mean() < 0.4
    assert (steered & begun).sum() / begun.sum() == pytest.approx(STEERED_SHARE, abs=0.06)
    assert 0 < (gets_m == 0).float().mean() < (gets_m > 25).float().mean() + 0.1  # stands; hurries
    straight = xy / gets_m.clamp_min(1e-6)[:, None, None]
    torch.testing.assert_close(straight[steered, 2] * 6, straight[steered, 5] * 3, rtol=1e-5, atol=1e-5)


def test_the_same_seed_brings_the_same_disturbances(clip: Clip, expert: Steady) -> None:
    first, again, other = (plans(DisturbedExpert, clip, seed, expert) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_student_and_expert_take_turns(clip: Clip, expert: Steady) -> None:
    speed = plans(AlternatingStudent, clip, 0, StraightAgent(2.0), expert)[:, -1, 0] / 3
    is_students = speed == 2.0
    assert ((speed == 8.0) | is_students).all()
    assert 0.6 < is_students.float().mean() < 0.8
    changes = torch.nonzero(torch.diff(is_students.int()))[:, 0] + 1
    assert (changes % 12 == 0).all()  # turns of six seconds


def test_at_a_share_of_one_the_expert_never_drives(clip: Clip, expert: Steady) -> None:
    now = [0.0]
    agent = AlternatingStudent(StraightAgent(2.0), expert, lambda: now[0], 0, share=1.0)
    for now[0] in range(0, 100, 3):
        assert float(agent.act(clip).xy[0, 0, -1, 0]) == 6.0
