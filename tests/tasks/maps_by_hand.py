"""Vector protocols, derived again without vectors: what the fast ones are compared with on random maps.

Written from the behaviour of the public evaluators (MapTR, StreamMapNet, MapTracker), one pair at a time.
"""

import numpy as np
from scipy.spatial.distance import cdist
from shapely import LineString

from foredrive.tasks.maps.lines import LineSet


def points_of(line: np.ndarray, count: int) -> np.ndarray:
    shape = LineString(line)
    return np.array([shape.interpolate(d).coords[0] for d in np.linspace(0, shape.length, count)])


def chamfer(line: np.ndarray, other: np.ndarray) -> float:
    distance = cdist(line, other)
    return float((distance.min(1).mean() + distance.min(0).mean()) / 2)


def touching(line: np.ndarray, other: np.ndarray) -> bool:
    wide = [LineString(a).buffer(2.0, cap_style="flat", join_style="mitre") for a in (line, other)]
    return bool(wide[0].intersects(wide[1]))


def area_under(score: list[float], hit: list[bool], objects: int) -> float:
    order = sorted(range(len(score)), key=lambda i: -score[i])
    curve, hits = [(0.0, 0.0)], 0
    for n, i in enumerate(order, start=1):
        hits += hit[i]
        curve.append((hits / objects if objects else 0.0, hits / n))
    total = 0.0
    for k in range(1, len(curve)):
        total += (curve[k][0] - curve[k - 1][0]) * max(p for _, p in curve[k:])
    return total


def precision(
    predicted: LineSet,
    true: LineSet,
    kind: int,
    limit_m: float,
    *,
    points: int,
    buffers: bool = False,
    consistent: bool = False,
    drive: list[int] | None = None,
    first_points: int | None = None,
    drop: bool = False,
) -> float:
    """AP of one class at one distance."""
    score: list[float] = []
    hit: list[bool] = []
    objects = 0
    owner: dict[tuple[int, int], int] = {}
    for frame in range(int(max(predicted.frame.max(), true.frame.max())) + 1):
        ps = [
            i for i in range(len(predicted.lines)) if (predicted.frame[i], predicted.kind[i]) == (frame, kind)
        ]
        ts = [j for j in range(len(true.lines)) if (true.frame[j], true.kind[j]) == (frame, kind)]
        objects += len(ts)
        if drop and not ts:
            continue
        ours = [points_of(predicted.lines[i], points) for i in ps]
        theirs = [true.lines[j] for j in ts]
        if first_points:
            theirs = [points_of(line, first_points) for line in theirs]
        theirs = [points_of(line, points) for line in theirs]
        found: dict[int, int] = {}
        for a in sorted(range(len(ps)), key=lambda a: -predicted.score[ps[a]]):
            distance = [
                100.0 if buffers and not touching(ours[a], other) else chamfer(ours[a], other)
                for other in theirs
            ]
            if distance and min(distance) <= limit_m:
                b = int(np.argmin(distance))
                if b not in found.values():
                    found[a] = b
        for a, i in enumerate(ps):
            right = a in found
            if right and consistent:
                key = (drive[frame] if drive else 0, int(true.identity[ts[found[a]]]))
                right = owner.setdefault(key, int(predicted.identity[i])) == predicted.identity[i]
            score.append(float(predicted.score[i]))
            hit.append(right)
    return area_under(score, hit, objects)
