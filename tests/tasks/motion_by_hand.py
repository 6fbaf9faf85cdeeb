"""Motion protocols, derived again without vectors: what the fast ones are compared with on random scenes.

Written from the behaviour of the public evaluators (UniAD, SparseDrive, VAD, MFEval), one agent at a time.
"""

import math
from collections import defaultdict

import numpy as np
from scipy.optimize import linear_sum_assignment

from foredrive.scene import Category
from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents

CAR_OF_UNIAD = {
    Category.CAR,
    Category.TRUCK,
    Category.BUS,
    Category.TRAILER,
    Category.CONSTRUCTION_VEHICLE,
    Category.MOTORCYCLE,
    Category.BICYCLE,
}
CAR_OF_VAD = {Category.CAR, Category.TRUCK, Category.BUS, Category.TRAILER}
MOVES_IN_VAD = CAR_OF_VAD | {Category.MOTORCYCLE, Category.BICYCLE, Category.PEDESTRIAN}


def true_future(true: TrueAgents, j: int, horizon: int) -> list[np.ndarray]:
    """The agent's positions up to the first gap."""
    steps = []
    for t in range(horizon):
        if not true.future_valid[j, t]:
            break
        steps.append(true.future_xy[j, t])
    return steps


def errors(futures: np.ndarray, truth: list[np.ndarray]) -> tuple[float, float, float]:
    """minADE, minFDE, and the least of the largest errors."""
    if not truth:
        return 0.0, 0.0, 0.0
    each = [[math.dist(future[t], truth[t]) for t in range(len(truth))] for future in futures]
    return min(map(np.mean, each)), min(e[-1] for e in each), min(map(max, each))


def by_score(score: np.ndarray) -> list[int]:
    """Indices, the best first; of equal scores the later one first."""
    return sorted(range(len(score)), key=lambda i: (score[i], i), reverse=True)


def uniad(predicted: PredictedAgents, true: TrueAgents, name: str, floor: float) -> dict[str, float]:
    wanted, range_m = (CAR_OF_UNIAD, 50.0) if name == "car" else ({Category.PEDESTRIAN}, 40.0)
    agents = [
        j
        for j in range(len(true.frame))
        if true.category[j] in wanted and true.seen[j] and np.hypot(*true.xy[j]) < range_m
    ]
    detections = [
        i
        for i in by_score(predicted.score)
        if predicted.category[i] in wanted
        and predicted.score[i] >= floor
        and np.hypot(*predicted.xy[i]) < range_m
    ]

    def greedy(needs_end: bool) -> dict[int, int]:
        pairs: dict[int, int] = {}
        for i in detections:
            left = [j for j in agents if true.frame[j] == predicted.frame[i] and j not in pairs.values()]
            if not left:
                continue
            j = min(left, key=lambda j: math.dist(predicted.xy[i], true.xy[j]))
            truth = true_future(true, j, 12)
            end = errors(predicted.future_xy[i], truth)[1] if truth else math.inf
            if math.dist(predicted.xy[i], true.xy[j]) < 2.0 and (not needs_end or end < 2.0):
                pairs[i] = j
        return pairs

    pairs = greedy(False)
    false = len(detections) - len(pairs)
    found: dict[str, float] = {"epa": (len(greedy(True)) - 0.5 * false) / len(agents)}
    recall, score, hits = [], [], 0
    running: dict[str, list[float]] = defaultdict(list)
    hit_score, total = [], defaultdict(float)
    for i in detections:
        if i in pairs:
            hits += 1
            ade, fde, worst = errors(predicted.future_xy[i], true_future(true, pairs[i], 12))
            for key, value in (("min_ade_m", ade), ("min_fde_m", fde), ("miss_rate", float(worst > 2.0))):
                total[key] += value
                running[key].append(total[key] / hits)
            hit_score.append(predicted.score[i])
        recall.append(hits / len(agents))
        score.append(predicted.score[i])
    for key in ("min_ade_m", "min_fde_m", "miss_rate"):
        if not pairs:
            found[key] = 1.0
            continue
        at = [float(np.interp(r, recall, score, right=0.0)) for r in np.linspace(0, 1, 101)]
        last = max((n for n, value in enumerate(at) if value != 0), default=0)
        curve = [float(np.interp(a, hit_score[::-1], running[key][::-1])) for a in at]
        found[key] = float(np.mean(curve[11 : last + 1])) if last >= 11 else 1.0
    return found


def vad(predicted: PredictedAgents, true: TrueAgents) -> dict[str, dict[str, float]]:
    count: dict[str, dict[str, float]] = {name: defaultdict(float) for name in ("car", "pedestrian")}

    def name_of(category: int) -> str | None:
        return "car" if category in CAR_OF_VAD else "pedestrian" if category == Category.PEDESTRIAN else None

    for frame in sorted(set(predicted.frame.tolist()) | set(true.frame.tolist())):
        ps = [
            i
            for i in np.flatnonzero(predicted.frame == frame)
            if predicted.score[i] > 0.6
            and abs(predicted.xy[i, 0] - 0.985793) < 35
            and abs(predicted.xy[i, 1]) < 20
        ]
        ts = [
            j
            for j in np.flatnonzero(true.frame == frame)
            if true.seen[j] and abs(true.xy[j, 0] - 0.985793) < 30 and abs(true.xy[j, 1]) < 15
        ]
        cost = np.full((len(ps), len(ts)), 1e6)
        for a, i in enumerate(ps):
            for b, j in enumerate(ts):
                moves = predicted.category[i] in MOVES_IN_VAD and true.category[j] in MOVES_IN_VAD
                distance = math.dist(predicted.xy[i], true.xy[j])
                if moves and distance <= 2.0:
                    cost[a, b] = distance
        match = {ts[b]: ps[a] for a, b in zip(*linear_sum_assignment(cost), strict=True) if cost[a, b] <= 2.0}
        for i in ps:
            name = name_of(predicted.category[i])
            if name and i not in match.values():
                count[name]["false"] += 1
        for j in ts:
            name, truth = name_of(true.category[j]), true_future(true, j, 6)
            if name is None:
                continue
            count[name]["agents"] += len(truth) == 6
            if j not in match or not truth:
                continue
            ade, fde, _ = errors(predicted.future_xy[match[j]], truth)
            count[name]["ade"] += ade
            count[name]["known"] += 1
            if len(truth) == 6:
                count[name]["fde"] += fde
                count[name]["whole"] += 1
                count[name]["hit" if fde <= 2.0 else "missed"] += 1
    return {
        name: {
            "min_ade_m": c["ade"] / c["known"],
            "min_fde_m": c["fde"] / c["whole"],
            "miss_rate": c["missed"] / c["whole"],
            "epa": (c["hit"] - 0.5 * c["false"]) / c["agents"],
        }
        for name, c in count.items()
    }
