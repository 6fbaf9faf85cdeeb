"""Drives that show a pupil what a good driver does where good drivers never get: aside, too slow, too fast.

Who learns from faultless drives alone has never seen what follows on his own mistakes. Either the teacher is
disturbed while he drives (Laskey et al. 2017, "DART"; Codevilla et al. 2018 add steering noise), or the pupil
drives and the teacher says what he would do (Ross et al. 2011, "DAgger").
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from foredrive.scene import Agent, Clip, Trajectory

CALM_S = 5.0
"""Mean time between disturbances."""
STEERS_RAD, STEERS_S = (0.06, 0.22), (1.0, 2.0)
"""How far aside a disturbed plan bears, and for how long."""
PACE, PACE_S = (0.0, 1.4), (1.5, 4.0)
"""The share of the way that a disturbed plan gets, and for how long; below `HALTS` it gets nowhere."""
HALTS = 0.25
STEERED_SHARE = 0.65
"""Of the disturbances; the others are of pace."""
TURN_S = 6.0
"""Pupil and teacher drive for so long before lots are drawn again."""


@runtime_checkable
class Teacher(Protocol):
    """Who knows what to do, as `TownExpert` does."""

    def plan(self) -> Trajectory:
        """What he would do now, in the ego frame; asked twice he says the same."""
        ...


@dataclasses.dataclass(frozen=True)
class _Disturbance:
    until_s: float
    bears_rad: float = 0.0
    pace: float = 1.0


class Disturbed:
    """An `Agent` that is the teacher, now and then steered aside, slowed down or hurried.

    Args:
        teacher: whom it happens to.
        clock: time of the drive, s.
        seed: of what happens when.
    """

    def __init__(self, teacher: Teacher, clock: Callable[[], float], seed: int) -> None:
        self.teacher, self._clock = teacher, clock
        self._rng = np.random.default_rng([seed, 0])
        self._begins_s = self._rng.exponential(CALM_S)
        self._now: _Disturbance | None = None

    def act(self, observation: Clip) -> Trajectory:
        """The agent's plan, as disturbed as it is now."""
        plan, t_s, rng = self.teacher.plan(), self._clock(), self._rng
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
        cos, sin = math.cos(self._now.bears_rad), math.sin(self._now.bears_rad)
        turned = self._now.pace * torch.tensor([[cos, sin], [-sin, cos]])
        return dataclasses.replace(plan, xy=plan.xy @ turned.to(plan.xy), yaw=plan.yaw + self._now.bears_rad)


class Alternating:
    """An `Agent` that is the pupil most of the time, and the teacher between, who gets him out of dead ends.

    Args:
        pupil, teacher: who drives.
        clock: time of the drive, s.
        seed: of who has which turn.
        share: the pupil's, of the turns.
    """

    def __init__(
        self,
        pupil: Agent,
        teacher: Teacher,
        clock: Callable[[], float],
        seed: int,
        share: float = 0.7,
    ) -> None:
        self._pupil, self.teacher, self._clock = pupil, teacher, clock
        self._share, self._rng = share, np.random.default_rng([seed, 1])
        self._until_s, self._is_pupils = -math.inf, True

    def act(self, observation: Clip) -> Trajectory:
        """The plan of whose turn it is."""
        if self._clock() >= self._until_s:
            self._until_s = self._clock() + TURN_S
            self._is_pupils = bool(self._rng.random() < self._share)
        return self._pupil.act(observation) if self._is_pupils else self.teacher.plan()
