"""Motion of as many frames as nuScenes' validation set has, under all protocols: the time it takes.

Agents drive on with some turn, a third of their futures end early. Most are detected within a metre, and the
rest of the 300 boxes of each frame are clutter around them.
"""

import time

import numpy as np

from foredrive.scene import Category
from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents
from foredrive.tasks.motion.moving import score_moving
from foredrive.tasks.motion.protocols import PROTOCOLS
from foredrive.tasks.motion.scores import score_motion

FRAMES, BOXES, AGENTS, FUTURES, STEPS = 6019, 300, 75, 6, 12


def scene(rng: np.random.Generator, frames: int) -> tuple[PredictedAgents, TrueAgents]:
    """Draw agents and predictions."""
    n, t = frames * AGENTS, 0.5 * np.arange(1, STEPS + 1, dtype=np.float32)
    xy = rng.uniform(-50, 50, (n, 2)).astype(np.float32)
    velocity = (rng.normal(0, 4, (n, 2)) * (rng.random((n, 1)) < 0.6)).astype(np.float32)
    bend = rng.normal(0, 0.3, (n, 1, 2)).astype(np.float32)
    future = xy[:, None] + velocity[:, None] * t[:, None] + bend * t[:, None] ** 2
    known = np.where(rng.random(n) < 0.35, rng.integers(0, STEPS, n), STEPS)
    true = TrueAgents(
        frame=np.repeat(np.arange(frames), AGENTS),
        category=rng.integers(0, Category.PEDESTRIAN + 1, n),
        xy=xy.astype(np.float64),
        future_xy=future.astype(np.float64),
        future_valid=np.arange(STEPS) < known[:, None],
        seen=np.ones(n, dtype=bool),
    )
    source = np.repeat(np.arange(n).reshape(frames, AGENTS), BOXES // AGENTS, axis=1).ravel()
    clutter = np.tile(np.arange(BOXES) % (BOXES // AGENTS) > 0, frames)
    shift = rng.normal(0, np.where(clutter, 6.0, 0.5)[:, None], (len(source), 2)).astype(np.float32)
    drift = rng.normal(0, 0.15, (len(source), FUTURES, 1, 2)).astype(np.float32)
    predicted = PredictedAgents(
        frame=true.frame[source],
        category=true.category[source],
        score=np.where(clutter, rng.beta(1, 3, len(source)), rng.beta(3, 1.5, len(source))),
        xy=(xy[source] + shift).astype(np.float64),
        future_xy=(future[source] + shift[:, None])[:, None] + drift * t[:, None],
        probability=np.full((len(source), FUTURES), 1 / FUTURES),
    )
    return predicted, true


def motion_speed(seed: int) -> dict[str, float]:
    """Measure all protocols on one thread."""
    small = scene(np.random.default_rng(seed), 2)
    for protocol in PROTOCOLS.values():  # compiled once
        score_motion(*small, protocol)
    score_moving(*small)
    predicted, true = scene(np.random.default_rng(seed), FRAMES)
    figures = {"frames": float(FRAMES), "boxes": float(len(predicted.frame))}
    started, cpu_started = time.perf_counter(), time.process_time()
    for name, protocol in PROTOCOLS.items():
        began = time.perf_counter()
        score_motion(predicted, true, protocol)
        figures[f"{name}_s"] = time.perf_counter() - began
    began = time.perf_counter()
    score_moving(predicted, true)
    figures["moving_s"] = time.perf_counter() - began
    figures["validation_size_motion_s"] = time.perf_counter() - started
    figures["validation_size_motion_cpu_s"] = time.process_time() - cpu_started
    return figures
