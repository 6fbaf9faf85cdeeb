"""Sequences of tracks with similarities: CLEAR MOT by motmetrics 1.4.0, HOTA by trackeval 1.3.0."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from foredrive.tasks.tracking.clear import Candidates, TrackRows

LEAST_SIMILARITY = 0.3


@dataclass(frozen=True)
class Sequence:
    """Identities of true and found boxes by frame, and the similarity of each true with each found one."""

    true: list[np.ndarray]
    found: list[np.ndarray]
    similarity: list[np.ndarray]


def make_sequence(seed: int, frames: int = 30, objects: int = 12, side_m: float = 8.0) -> Sequence:
    """Objects that drift on a small ground, so that tracks compete; found ones change their identity.

    There are frames without true boxes, without found boxes, and without both.
    """
    rng = np.random.default_rng(seed)
    place = rng.uniform(0, side_m, (objects, 2))
    identity = np.arange(objects)
    sequence = Sequence([], [], [])
    for f in range(frames):
        place += rng.normal(0, 0.4, place.shape)
        if rng.random() < 0.3:
            pair = rng.choice(objects, 2, replace=False)
            identity[pair] = identity[pair[::-1]]
        true = np.flatnonzero(rng.random(objects) < (0.0 if f in (3, 9) else 0.8))
        seen = np.flatnonzero(rng.random(objects) < (0.0 if f in (5, 9) else 0.8))
        false = objects + rng.choice(6, int(rng.integers(0, 4)) if f != 5 else 0, replace=False)
        where = np.concatenate(
            [place[seen] + rng.normal(0, 0.5, (len(seen), 2)), rng.uniform(0, side_m, (len(false), 2))]
        )
        apart = np.linalg.norm(place[true][:, None] - where, axis=-1)
        sequence.true.append(true)
        sequence.found.append(np.concatenate([identity[seen], false]))
        sequence.similarity.append(np.clip(1 - apart / 3.0, 0, 1))
    return sequence


def as_rows(sequence: Sequence, least: float = 0.0) -> tuple[TrackRows, TrackRows, Candidates]:
    """Rows for our functions; pairs of a similarity above `least`, with the similarity as their value."""
    true, found = (
        TrackRows(
            np.repeat(np.arange(len(each)), [len(ids) for ids in each]), np.concatenate(each).astype(np.int64)
        )
        for each in (sequence.true, sequence.found)
    )
    rows, columns, values, first, second = [], [], [], 0, 0
    for similarity in sequence.similarity:
        i, j = np.nonzero(similarity > least)
        rows.append(i + first), columns.append(j + second), values.append(similarity[i, j])
        first, second = first + similarity.shape[0], second + similarity.shape[1]
    pairs = (np.concatenate(each) for each in (rows, columns, values))
    return true, found, Candidates(*pairs)


def clear_by_motmetrics(sequence: Sequence) -> dict[str, float]:
    """Counts and figures of CLEAR MOT; distance is 1 - similarity."""
    import motmetrics

    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for true, found, similarity in zip(sequence.true, sequence.found, sequence.similarity, strict=True):
        distance = np.where(similarity > LEAST_SIMILARITY, 1 - similarity, np.nan)
        accumulator.update(true, found, distance)
    metrics = [
        "num_matches", "num_switches", "num_misses", "num_false_positives", "num_fragmentations",
        "mostly_tracked", "mostly_lost", "mota", "motp", "recall", "precision",
    ]  # fmt: skip
    summary = motmetrics.metrics.create().compute(accumulator, metrics=metrics)
    return {name: float(summary[name].iloc[0]) for name in metrics}


def hota_by_trackeval(sequence: Sequence) -> dict[str, Any]:
    """HOTA and its parts at each threshold."""
    from trackeval.metrics import HOTA

    def dense(frames: list[np.ndarray]) -> tuple[list[np.ndarray], int]:
        names = np.unique(np.concatenate(frames))
        return [np.searchsorted(names, each).astype(int) for each in frames], len(names)

    (true, trues), (found, founds) = dense(sequence.true), dense(sequence.found)
    data = {
        "gt_ids": true, "tracker_ids": found, "similarity_scores": sequence.similarity,
        "num_gt_ids": trues, "num_tracker_ids": founds, "num_timesteps": len(true),
        "num_gt_dets": sum(map(len, true)), "num_tracker_dets": sum(map(len, found)),
    }  # fmt: skip
    found = HOTA().eval_sequence(data)
    return {name: np.asarray(value).tolist() for name, value in found.items() if np.ndim(value)}
