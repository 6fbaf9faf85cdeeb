"""Agents that record DAgger demonstrations: states off the expert's path, with the expert's plan for each.

A student that learns from faultless drives only has never seen the states that its own mistakes lead to.
There are two remedies. Either the expert is disturbed while it drives (Laskey et al. 2017, "DART"; Codevilla
et al. 2018 add steering noise), or the student drives and the expert labels its states (Ross et al. 2011,
"DAgger").
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from foredrive.scene import Agent, Clip, Trajectory

CALM_S = 5.0
"""Mean time between disturbances, s."""
STEERS_RAD, STEERS_S = (0.06, 0.22), (1.0, 2.0)
"""Range of the heading error of a steered plan, rad, and of its duration, s."""
PACE, PACE_S = (0.0, 1.4), (1.5, 4.0)
"""Range of the factor on the distance of a disturbed plan, and of its duration, s. A factor up to `HALTS`
is set to 0."""
HALTS = 0.25
STEERED_SHARE = 0.65
"""Share of steering disturbances; the others change the pace."""
TURN_S = 6.0
"""Length of a turn, s: student and expert drive for this long before the next draw."""


@runtime_checkable
class Expert(Protocol):
    """An agent that plans from the true state of the simulator, such as `TownExpert`."""

    def plan(self) -> Trajectory:
        """Return the plan of the expert from now on, in the ego frame.

        Repeated calls at one time give the same plan.
        """
        ...


@dataclasses.dataclass(frozen=True)
class _Disturbance:
    until_s: float
    bears_rad: float = 0.0
    pace: float = 1.0


class DisturbedExpert:
    """An `Agent` that drives as the expert but is now and then steered aside, slowed down or sped up.

    Args:
        expert: its plans are disturbed.
        clock: returns the time of the drive, s.
        seed: seed of the disturbances.
    """

    def __init__(self, expert: Expert, clock: Callable[[], float], seed: int) -> None:
        self.expert, self._clock = expert, clock
        self._rng = np.random.default_rng([seed, 0])
        self._begins_s = self._rng.exponential(CALM_S)
        self._now: _Disturbance | None = None

    def act(self, observation: Clip) -> Trajectory:
        """Return the expert's plan with the current disturbance, if there is one."""
        plan, t_s, rng = self.expert.plan(), self._clock(), self._rng
        # The end of a disturbance, then the exponential wait for the next one
        if self._now is not None and t_s >= self._now.until_s:
            self._now, self._begins_s = None, t_s + rng.exponential(CALM_S)
        if self._now is None and t_s >= self._begins_s:
            if rng.random() < STEERED_SHARE:
                bears_rad = rng.uniform(*STEERS_RAD) * rng.choice([-1.0, 1.0])
                self._now = _Disturbance(t_s + rng.uniform(*STEERS_S), bears_rad=bears_rad)
            else:
                pace = rng.uniform(*PACE)
                self._now = _Disturbance(t_s + rng.uniform(*PACE_S), pace=pace if pace > HALTS else 0.0)
        if self._now is None:
            return plan
        # Row vectors: the plan is turned to the left by the heading error and scaled by the pace
        cos, sin = math.cos(self._now.bears_rad), math.sin(self._now.bears_rad)
        turned = self._now.pace * torch.tensor([[cos, sin], [-sin, cos]])
        return dataclasses.replace(plan, xy=plan.xy @ turned.to(plan.xy), yaw=plan.yaw + self._now.bears_rad)


class AlternatingStudent:
    """An `Agent` that alternates between the student and the expert.

    The student drives most of the time. The expert drives in between and so leads it out of dead ends.

    Args:
        student: drives most of the time.
        expert: drives in between.
        clock: returns the time of the drive, s.
        seed: seed of the turns.
        share: share of the turns that the student gets.
    """

    def __init__(
        self,
        student: Agent,
        expert: Expert,
        clock: Callable[[], float],
        seed: int,
        share: float = 0.7,
    ) -> None:
        self._student, self.expert, self._clock = student, expert, clock
        self._share, self._rng = share, np.random.default_rng([seed, 1])
        self._until_s, self._student_drives = -math.inf, True

    def act(self, observation: Clip) -> Trajectory:
        """Return the plan of the agent that has the current turn."""
        if self._clock() >= self._until_s:
            self._until_s = self._clock() + TURN_S
            self._student_drives = bool(self._rng.random() < self._share)
        return self._student.act(observation) if self._student_drives else self.expert.plan()
