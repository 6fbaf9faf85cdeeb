"""Random scenes of agents with futures, and small ones by hand, for tests of motion protocols."""

import numpy as np

from foredrive.scene import Category
from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents

STEPS, FUTURES = 12, 6


def random_truth(rng: np.random.Generator, frames: int = 12, agents: int = 25) -> TrueAgents:
    """Agents that drive on with some turn; a third of the futures ends early, some at once."""
    n = frames * agents
    xy = rng.uniform(-45, 45, (n, 2))
    velocity = rng.normal(0, 4, (n, 2)) * (rng.random((n, 1)) < 0.6)
    t = 0.5 * np.arange(1, STEPS + 1)
    future = xy[:, None] + velocity[:, None] * t[:, None] + rng.normal(0, 0.3, (n, 1, 2)) * t[:, None] ** 2
    known = np.where(rng.random(n) < 0.35, rng.integers(0, STEPS, n), STEPS)
    return TrueAgents(
        frame=np.repeat(np.arange(frames), agents),
        category=rng.choice([*range(Category.PEDESTRIAN + 1), Category.PEDESTRIAN, Category.BARRIER], n),
        xy=xy,
        future_xy=future,
        future_valid=np.arange(STEPS) < known[:, None],
        seen=rng.random(n) < 0.9,
    )


def random_predictions(
    rng: np.random.Generator, true: TrueAgents, *, apart_m: float = 0.9, drift_m: float = 0.5
) -> PredictedAgents:
    """Most agents detected within a metre or two, some with another class; clutter; scores with ties."""
    found = np.flatnonzero(rng.random(len(true.frame)) < 0.8)
    clutter = rng.integers(0, len(true.frame), len(true.frame) // 3)
    source = np.concatenate([found, clutter])
    n = len(source)
    is_clutter = np.arange(n) >= len(found)
    shift = np.where(is_clutter[:, None], rng.normal(0, 8, (n, 2)), rng.normal(0, apart_m, (n, 2)))
    drift = rng.normal(0, drift_m, (n, FUTURES, 1, 2)) * np.arange(1, STEPS + 1)[:, None]
    category = true.category[source].copy()
    other = rng.random(n) < 0.1
    category[other] = rng.integers(0, Category.PEDESTRIAN + 1, other.sum())
    return PredictedAgents(
        frame=true.frame[source],
        category=category,
        score=np.round(rng.beta(2, 1.5, n), 2),
        xy=true.xy[source] + shift,
        future_xy=(true.future_xy[source] + shift[:, None])[:, None] + drift,
        probability=rng.dirichlet(np.ones(FUTURES), n),
    )


def one_agent(
    category: Category = Category.CAR,
    at: tuple[float, float] = (10.0, 0.0),
    speed_mps: float = 2.0,
    known: int = STEPS,
) -> TrueAgents:
    """An agent that drives along x, known for some steps."""
    xy = np.array([at])
    x = at[0] + 0.5 * speed_mps * np.arange(1, STEPS + 1)
    return TrueAgents(
        frame=np.array([0]),
        category=np.array([int(category)]),
        xy=xy,
        future_xy=np.stack([x, np.full(STEPS, at[1])], axis=1)[None],
        future_valid=(np.arange(STEPS) < known)[None],
        seen=np.array([True]),
    )


def perfect(true: TrueAgents, score: float = 0.9) -> PredictedAgents:
    """Each agent detected where it is, with its own future."""
    n = len(true.frame)
    return PredictedAgents(
        frame=true.frame,
        category=true.category,
        score=np.full(n, score),
        xy=true.xy,
        future_xy=np.repeat(true.future_xy[:, None], FUTURES, axis=1),
        probability=np.full((n, FUTURES), 1 / FUTURES),
    )


def joined(*agents: PredictedAgents) -> PredictedAgents:
    """The predictions one after the other."""
    fields = PredictedAgents.__dataclass_fields__
    return PredictedAgents(**{name: np.concatenate([getattr(a, name) for a in agents]) for name in fields})


def joined_truth(*agents: TrueAgents) -> TrueAgents:
    """The agents one after the other."""
    fields = TrueAgents.__dataclass_fields__
    return TrueAgents(**{name: np.concatenate([getattr(a, name) for a in agents]) for name in fields})
