"""Speed of set likelihoods, compared with Murty's algorithm on SciPy and with the best assignment alone.

Times are CPU times of one thread, so that other programs matter less, and the minimum of several runs:
`foredrive bench sets-speed`.
"""

import functools
import itertools
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from benchmarks.common.benchmark import Benchmark
from foredrive.engine.provenance import peak_rss_gib
from foredrive.sets import (
    BoxDensity,
    LabelledBoxes,
    MultiBernoulli,
    PoissonMultiBernoulli,
    UniformPoisson,
    set_nll,
)
from foredrive.sets.assignment import k_best_assignments
from foredrive.tasks.detection.files import read_detections
from foredrive.tasks.detection.score import ScoreConfig, score_frames
from foredrive.tasks.detection.summary import summarise_scores

SIZES = {
    "100x50": (100, 50, 100.0),
    "900x200": (900, 200, 100.0),
    "900x200_dense": (900, 200, 25.0),
    "900x200_densest": (900, 200, 10.0),
}
"""Number of detections, number of objects, and side of their square, m."""
K, CLASSES = 25, 10
STD = np.array([0.4, 0.4, 0.2, 0.15, 0.15, 0.15])
FRAMES, DETECTIONS = 6019, 200
"""Number of frames of nuScenes' validation set, and detections per frame."""

Costs = tuple[np.ndarray, np.ndarray]


def scene(m: int, n: int, side_m: float, rng: np.random.Generator) -> tuple[MultiBernoulli, LabelledBoxes]:
    """Draw objects, of which 90 % are detected, half of those twice; all other detections are false."""
    half = side_m / 2

    def places(count: int) -> np.ndarray:
        flat = rng.uniform(-half, half, (count, 2))
        height, size = rng.normal(0, 0.3, (count, 1)), rng.normal([1.5, 0.7, 0.5], 0.1, (count, 3))
        return np.concatenate([flat, height, size], axis=1)

    state, yaw, label = places(n), rng.uniform(-3, 3, n), rng.integers(0, CLASSES, n)
    seen = np.flatnonzero(rng.random(n) < 0.9)
    source = np.concatenate([seen, rng.choice(seen, len(seen) // 2)])[:m]
    clutter = m - len(source)
    mean = np.concatenate([state[source] + STD * rng.normal(size=(len(source), 6)), places(clutter)])
    heading = np.concatenate([yaw[source] + rng.normal(0, 0.15, len(source)), rng.uniform(-3, 3, clutter)])
    logits = np.full((m, CLASSES), -3.0)
    logits[np.arange(m), np.concatenate([label[source], rng.integers(0, CLASSES, clutter)])] = 2.0
    twice = max(len(source) - len(seen), 0)
    chance = np.concatenate(
        [rng.beta(5, 2, len(source) - twice), rng.beta(1, 3, twice), rng.beta(1, 15, clutter)]
    )
    r = torch.as_tensor(np.clip(chance, 1e-4, 1 - 1e-4))
    boxes = BoxDensity(
        torch.as_tensor(mean),
        torch.diag_embed(torch.as_tensor(STD).expand(m, 6)).contiguous(),
        torch.as_tensor(heading),
        torch.full((m,), 40.0, dtype=torch.float64),
    )
    log_class = torch.as_tensor(logits).log_softmax(-1)
    detected = MultiBernoulli(r.log(), torch.log1p(-r), log_class, boxes)
    return detected, LabelledBoxes(torch.as_tensor(label), torch.as_tensor(state), torch.as_tensor(yaw))


def region(side_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of undetected objects."""
    upper = np.array([side_m, side_m, 10.0, 4.0, 4.0, 4.0])
    return -upper, upper


def predicted(size: str, seed: int) -> tuple[PoissonMultiBernoulli, LabelledBoxes]:
    """Return all detections as Bernoullis, the most expensive case, with a uniform background."""
    m, n, side_m = SIZES[size]
    detected, objects = scene(m, n, side_m, np.random.default_rng(seed))
    lower, upper = (torch.as_tensor(bound) for bound in region(side_m))
    rate = torch.full((CLASSES,), 0.5, dtype=torch.float64)
    return PoissonMultiBernoulli(detected, UniformPoisson(rate, lower, upper, True)), objects


def costs(size: str, seed: int) -> Costs:
    """Return the costs of pairs, with objects as rows, and of assigning an object to the background."""
    pmb, objects = predicted(size, seed)
    found = pmb.detected
    log_pair = found.boxes.log_prob(objects) + found.log_label(objects) - found.log_absence[:, None]
    assert pmb.background is not None
    return np.ascontiguousarray(-log_pair.numpy().T), -pmb.background.log_intensity(objects).numpy()


def least_ms(run: Callable[[], object], runs: int = 9) -> float:
    """Return the CPU time of the fastest run, ms, after one run that is not counted."""
    run()
    taken = []
    for _ in range(runs):
        started = time.process_time()
        run()
        taken.append(1e3 * (time.process_time() - started))
    return min(taken)


def likelihood(seed: int, *, background: bool = True) -> dict[str, float]:
    """Measure the PMB-NLL with its parts, or the MB-NLL without a background; also the width of the
    interval.
    """
    torch.set_num_threads(1)
    figures = {}
    for size in SIZES:
        pmb, objects = predicted(size, seed)
        if not background:
            pmb = PoissonMultiBernoulli(pmb.detected)
        figures[f"ms_{size}_k{K}"] = least_ms(functools.partial(set_nll, pmb, objects, k=K))
        result = set_nll(pmb, objects, k=K)
        figures[f"gap_nats_{size}"] = float(result.nll) - result.lower
    return figures


def k_best(seed: int) -> dict[str, float]:
    """Measure the K best assignments, ungated, by our kernel and by Murty on SciPy; they must agree."""
    figures = {}
    for size in ("100x50", "900x200"):
        cost, free = costs(size, seed)
        figures[f"ms_{size}_k{K}"] = least_ms(functools.partial(k_best_assignments, cost, free, K), 5)
        started = time.process_time()
        expected = murty_on_scipy(cost, free, K)
        scipy_ms = 1e3 * (time.process_time() - started)
        np.testing.assert_allclose(k_best_assignments(cost, free, K).cost, expected, atol=1e-6)
        figures[f"scipy_murty_ms_{size}_k{K}"] = scipy_ms
        figures[f"speedup_over_scipy_murty_{size}"] = scipy_ms / figures[f"ms_{size}_k{K}"]
    return figures


def best_only(seed: int) -> dict[str, float]:
    """Measure one assignment by SciPy: the time of a score by Hungarian matching, without densities."""
    figures = {}
    for size in SIZES:
        padded = with_background(*costs(size, seed))
        figures[f"ms_{size}_k1"] = least_ms(functools.partial(linear_sum_assignment, padded))
    return figures


def with_background(cost: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Add one column for each row, its background; forbidden pairs have a high cost."""
    own = np.full((len(free), len(free)), 1e9)
    np.fill_diagonal(own, free)
    return np.concatenate([cost, own], axis=1)


def murty_on_scipy(cost: np.ndarray, free: np.ndarray, k: int) -> np.ndarray:
    """Return the costs of the k best assignments by Murty's partition; solve each subproblem from scratch."""
    whole = with_background(cost, free)
    count = itertools.count()

    def solve(kept: np.ndarray, banned: list[tuple[int, int]]) -> tuple[float, int, np.ndarray, list]:
        problem = whole.copy()
        for row, column in banned:
            problem[row, column] = 1e9
        for row, column in enumerate(kept):
            problem[row, :column] = problem[row, column + 1 :] = 1e9
        rows, columns = linear_sum_assignment(problem)
        return float(problem[rows, columns].sum()), next(count), columns, banned

    waiting = [(*solve(np.zeros(0, int), []), 0)]
    found: list[float] = []
    while waiting and len(found) < k:
        waiting.sort(key=lambda entry: entry[:2])
        total, _, columns, banned, first = waiting.pop(0)
        found.append(total)
        for row in range(first, len(columns)):
            bans = [*banned, (row, int(columns[row]))] if row == first else [(row, int(columns[row]))]
            waiting.append((*solve(columns[:row], bans), row))
    return np.array(found)


def as_boxes(state: np.ndarray, yaw: np.ndarray, label: np.ndarray) -> list[dict]:
    """Return boxes in nuScenes' format."""
    size = np.exp(state[:, [4, 3, 5]])
    rotation = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=1)
    return [
        {"translation": t, "size": s, "rotation": q, "detection_name": f"class_{c}"}
        for t, s, q, c in zip(
            state[:, :3].tolist(), size.tolist(), rotation.tolist(), label.tolist(), strict=True
        )
    ]


def write_validation(folder: Path, seed: int) -> tuple[Path, Path]:
    """Write results with variances, and the ground truth, as files."""
    rng = np.random.default_rng(seed)
    results, truth = folder / "results.json", folder / "truth.json"
    with results.open("w") as found, truth.open("w") as true:
        found.write('{"meta": {}, "results": {')
        true.write('{"meta": {}, "results": {')
        for n in range(FRAMES):
            detected, objects = scene(DETECTIONS, int(rng.integers(5, 60)), 100.0, rng)
            label = detected.log_class.argmax(-1).numpy()
            boxes = as_boxes(detected.boxes.mean.numpy(), np.asarray(detected.boxes.yaw), label)
            for box, r in zip(boxes, detected.log_existence.exp().tolist(), strict=True):
                box |= {"detection_score": r, "covariance": (STD**2).tolist(), "yaw_std": 0.158}
            there = as_boxes(objects.state.numpy(), np.asarray(objects.yaw), objects.label.numpy())
            there = [
                {**box, "ego_translation": box["translation"], "scene_token": f"{n // 40}"} for box in there
            ]
            comma = ", " if n else ""
            found.write(f'{comma}"{n}": {json.dumps(boxes)}')
            true.write(f'{comma}"{n}": {json.dumps(there)}')
        found.write("}}")
        true.write("}}")
    return results, truth


def validation(seed: int) -> dict[str, float]:
    """Measure `foredrive score` on files with as many frames as nuScenes' validation set, on one thread."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        results, truth = write_validation(Path(folder), seed)
        started, wall_started = time.process_time(), time.perf_counter()
        read = read_detections(results, truth)
    reading_s, after_reading_gib = time.process_time() - started, peak_rss_gib()
    scores = score_frames(read, ScoreConfig(k=K))
    frames_s = time.process_time() - started - reading_s
    summarise_scores(read, scores)
    return {
        "validation_size_s": time.process_time() - started,
        "validation_size_wall_s": time.perf_counter() - wall_started,
        "of_which_reading_s": reading_s,
        "of_which_frames_s": frames_s,
        "peak_rss_gib_reading": after_reading_gib,
        "peak_rss_gib": peak_rss_gib(),
        "largest_gap_nats": max(score.gap for score in scores),
    }


BENCHMARK = Benchmark(
    question="How long do set likelihoods take, beside SciPy's assignments?",
    arms={
        "pmb_nll": likelihood,
        "mb_nll": functools.partial(likelihood, background=False),
        "k_best": k_best,
        "hungarian_by_scipy": best_only,
        "validation": validation,
    },
    seeds=(0,),
    config={
        "k": K,
        "sizes": SIZES,
        "frames": FRAMES,
        "detections": DETECTIONS,
        "time": "processor, 1 thread",
    },
)
