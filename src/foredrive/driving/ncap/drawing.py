"""What is random in a run of a scenario, drawn from the run's number: the same for every agent.

The draws and their order are those of neuro-ncap (`components/scenario.py` and `engine.py` of its public
repository; numpy's default generator, seeded with the run's number), so that its files give its runs. The
`times` of a jitter are read by nothing there and by nothing here.
"""

import math
from dataclasses import dataclass

import numpy as np

from foredrive.driving.ncap.scenario import Jitter, Polyline, SafetyScenario, ScenarioActor


@dataclass(frozen=True)
class DrawnActor:
    """An actor of one run."""

    name: str
    """Track of the log that is copied."""
    way: Polyline
    yaw_rad: float
    """Heading while the actor stands."""
    is_target: bool


@dataclass(frozen=True)
class DrawnRun:
    """One run of a scenario."""

    start_frame: int
    actors: tuple[DrawnActor, ...]

    @property
    def target(self) -> DrawnActor:
        """Return the actor to which the reference speed refers."""
        return next((actor for actor in self.actors if actor.is_target), self.actors[0])


def draw_run(scenario: SafetyScenario, number: int) -> DrawnRun:
    """Return run `number` of a scenario, from 0. Equal numbers give equal runs."""
    # A separate generator for the start, as in the public code
    start, half = scenario.start_frame, scenario.start_jitter_frames
    if half:
        start = max(0, start + int(np.random.default_rng(number).integers(-half, half + 1)))
    rng, groups, actors = np.random.default_rng(number), set[str](), list[DrawnActor]()
    # Actors in random order: of each group only the first one takes part
    for index in rng.permutation(len(scenario.actors)).tolist():
        actor = scenario.actors[index]
        if actor.group is not None and actor.group in groups:
            continue
        groups |= {actor.group} if actor.group else set()
        actors.append(_drawn(actor, rng, is_target=index == scenario.target))
    return DrawnRun(start, tuple(actors))


def _drawn(actor: ScenarioActor, rng: np.random.Generator, is_target: bool) -> DrawnActor:
    name = actor.names[int(rng.choice(len(actor.names)))]
    way = actor.way if isinstance(actor.way, Polyline) else actor.way.polyline()
    way, turned_rad = _jittered(way, actor.jitter, rng)
    flip_rad = math.pi if name in actor.flipped else 0.0
    return DrawnActor(name, way, actor.yaw_rad + turned_rad + flip_rad, is_target)


def _jittered(way: Polyline, jitter: Jitter, rng: np.random.Generator) -> tuple[Polyline, float]:
    """Return the shifted way and the change of the heading, rad. A half range of 0 draws nothing."""

    def draw(half: float) -> float:
        if half == 0.0:
            return 0.0
        return float(rng.uniform(-half, half) if jitter.uniform else rng.normal(scale=half))

    # The order of the draws is part of the protocol
    along, right = draw(jitter.longitudinal_m), draw(jitter.lateral_m)
    cos, sin = math.cos(jitter.along_rad), math.sin(jitter.along_rad)
    # Right is the direction turned by -90°
    dx, dy = along * cos + right * sin, along * sin - right * cos
    moved = Polyline(way.t_s, tuple((x + dx, y + dy, z) for x, y, z in way.xyz_m))
    return moved, draw(jitter.yaw_rad)
