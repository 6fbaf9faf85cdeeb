"""The tracking protocols in use on nuScenes, as data, and their figures.

All are nuScenes' own evaluation; UniAD and SparseDrive differ in the boxes that they hand to it. Facts read
in the public code:
- nuScenes: nuscenes-devkit 1.2.0, eval/tracking (algo.py, metrics.py, evaluate.py), tracking_nips_2019.json
- UniAD: OpenDriveLab/UniAD, uniad/detectors/uniad_track.py (boxes of tracks with a score of at least
  `filter_score_thresh`), configs/stage2_e2e/base_e2e.py
- SparseDrive: swc-17/SparseDrive, datasets/nuscenes_3d_dataset.py (`tracking_threshold`),
  configs/sparsedrive_small_stage2.py

In nuScenes, MOTAR is 1 - false / matches: its other terms cancel, and switches are no matches in it. Recall
counts switches as found. Neither MOTA nor MOTAR is below 0.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.ops.threads import in_parallel
from foredrive.tasks.objects.object_rows import (
    MAX_BOXES,
    TRACKING_CLASSES,
    Frames,
    ObjectRows,
    Region,
    counted,
)
from foredrive.tasks.tracking.clear import (
    MATCH,
    ClearCounts,
    ClearEvents,
    Layout,
    TrackRows,
    count_events,
    follow,
    lay_out,
    near_pairs,
)


def whole_tracks(boxes: ObjectRows, frames: Frames) -> ObjectRows:
    """Return boxes with the mean score of their track, and with the gaps of tracks filled.

    A track's score is averaged over its own boxes, before gaps are filled. A filled box has the class of the
    next box of its track. Filled boxes come after the others of their frame, in the order in which their
    tracks begin. Rows are returned in the order of frames.

    Source: nuscenes-devkit 1.2.0, eval/tracking/loaders.py, create_tracks and interpolate_tracks. There the
    weight of the next box is the share of time that is left until it, not that which has passed since the
    last one. So the boxes of a gap of two or more frames run backwards. It is kept here: published figures
    have it.
    """
    boxes = boxes[np.argsort(boxes.frame, kind="stable")]
    identity = _identities(boxes, frames)
    # The score of a box is replaced by the mean of its track
    boxes = dataclasses.replace(boxes, score=mean_scores(identity, boxes.score))
    # Boxes by track, then by frame: neighbours are successive boxes of a track
    order = np.lexsort((boxes.frame, identity))
    left, right = order[:-1], order[1:]
    gap = boxes.frame[right] - boxes.frame[left] - 1
    # There is no gap between two tracks
    gap[identity[left] != identity[right]] = 0
    left, right = np.repeat(left, gap), np.repeat(right, gap)
    # Number of each filled box within its gap
    since = np.arange(len(left)) - np.repeat(np.cumsum(gap) - gap, gap)
    filled = _between(boxes[left], boxes[right], boxes.frame[left] + 1 + since, frames)
    # First row of each track in the order of frames
    begins = np.full(identity.max(initial=-1) + 1, len(boxes))
    np.minimum.at(begins, identity, np.arange(len(boxes)))
    every = _joined(boxes, filled)
    # Filled boxes come after those of the file, in the order in which their tracks begin
    rank = np.concatenate([np.full(len(boxes), -1), begins[identity[left]]])
    return every[np.lexsort((np.arange(len(every)), rank, every.frame))]


def mean_scores(identity: Int[ndarray, "n"], score: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Return the mean score of each box's track.

    Tracks of the same length are averaged together by `numpy.mean`, so that the last digits are those of
    the mean of each track alone: thresholds are scores.
    """
    order = np.argsort(identity, kind="stable")
    track, start, length = np.unique(identity[order], return_index=True, return_counts=True)
    mean = np.zeros(track.max(initial=-1) + 1)
    for count in np.unique(length):
        # Rows of all tracks of this length, one track a row
        rows = start[length == count, None] + np.arange(count)
        mean[track[length == count]] = np.ascontiguousarray(score[order][rows]).mean(axis=1)
    return mean[identity]


def _identities(boxes: ObjectRows, frames: Frames) -> Int[ndarray, "n"]:
    """Return a number of each track that no other scene has."""
    scene_and_track = np.stack([frames.scene[boxes.frame], boxes.track], axis=1)
    return np.unique(scene_and_track, axis=0, return_inverse=True)[1].reshape(-1)


def _between(left: ObjectRows, right: ObjectRows, frame: Int[ndarray, "n"], frames: Frames) -> ObjectRows:
    """Return the boxes of gaps, weighted as the devkit weights them; angles go the shorter way round."""
    time, end, begin = (frames.time_us[k] for k in (frame, right.frame, left.frame))
    # The devkit's weight of the next box: share of time left until it (see `whole_tracks`)
    ratio = (end - time) / (end - begin)

    def mix(a: Float[ndarray, "n ..."], b: Float[ndarray, "n ..."]) -> Float[ndarray, "n ..."]:
        weight = ratio.reshape(-1, *[1] * (a.ndim - 1))
        return (1.0 - weight) * a + weight * b

    # The shorter way round, in -π to π
    turn = np.angle(np.exp(1j * (right.yaw - left.yaw)))
    return dataclasses.replace(
        right,
        frame=frame,
        centre=mix(left.centre, right.centre),
        size_lwh=mix(left.size_lwh, right.size_lwh),
        yaw=left.yaw + ratio * turn,
        velocity=mix(left.velocity, right.velocity),
        score=mix(left.score, right.score),
        from_ego=mix(left.from_ego, right.from_ego),
    )


def _joined(a: ObjectRows, b: ObjectRows) -> ObjectRows:
    columns = {name: np.concatenate([column, vars(b)[name]]) for name, column in vars(a).items()}
    return dataclasses.replace(a, **columns)


FRAME_S = 0.5
"""Time of a frame in the devkit's durations, whatever the time stamps say."""


@dataclass(frozen=True)
class TrackingProtocol:
    """The choices that define a tracking protocol."""

    title: str
    classes: tuple[str, ...]
    region: Region
    max_distance_m: float
    """Distance of centres over ground below which boxes may be matched."""
    min_score: float
    """Boxes of a lower score are not handed to the evaluation. It comes before a track's mean score."""
    min_recall: float
    recalls: int
    """Number of recalls, from `min_recall` to 1, at which figures are taken."""
    worst_motp_m: float
    """MOTP at a recall that is not reached."""
    worst_faf: float
    worst_s: float
    """TID and LGD of a class of which nothing is found."""
    max_boxes: int
    """Maximum number of found boxes in a frame of a results file."""


_REACH_M: Final = {
    **dict.fromkeys(("car", "truck", "bus", "trailer"), (50.0, 50.0)),
    **dict.fromkeys(("pedestrian", "motorcycle", "bicycle"), (40.0, 40.0)),
}


def _nuscenes(title: str, min_score: float) -> TrackingProtocol:
    return TrackingProtocol(
        title=title,
        classes=TRACKING_CLASSES,
        region=Region("circle", _REACH_M),
        max_distance_m=2.0,
        min_score=min_score,
        min_recall=0.1,
        recalls=40,
        worst_motp_m=2.0,
        worst_faf=500.0,
        worst_s=20.0,
        max_boxes=MAX_BOXES,
    )


TRACKING_PROTOCOLS: Mapping[str, TrackingProtocol] = {
    "nuscenes": _nuscenes("nuScenes", 0.0),
    "uniad": _nuscenes("UniAD", 0.35),
    "sparsedrive": _nuscenes("SparseDrive", 0.2),
}

_FIGURES = (
    "amota", "amotp", "recall", "motar", "gt", "mota", "motp", "mt", "ml", "faf", "tp", "fp", "fn", "ids",
    "frag", "tid", "lgd",
)  # fmt: skip
SUMMED = ("mt", "ml", "tp", "fp", "fn", "ids", "frag")
"""Figures that are added over classes; the others are averaged over the classes that have them."""


@dataclass(frozen=True)
class TrackingFigures:
    """Figures of nuScenes' tracking evaluation, by the devkit's names (m, s; `faf` per 100 frames)."""

    by_class: Mapping[str, Mapping[str, float]]
    """NaN where a class has no ground truth, or the figure is undefined."""
    all_classes: Mapping[str, float]


def evaluate_tracking(
    predicted: ObjectRows, true: ObjectRows, racks: ObjectRows, frames: Frames, protocol: TrackingProtocol
) -> TrackingFigures:
    """Return the figures of tracks under one protocol.

    Args:
        predicted: labels are indices into the protocol's classes, as those of `true`; -1 is left out.
        racks: bicycle racks; labels do not matter.
        frames: all frames of the scenes, also those without boxes.
    """
    # The protocol's floor on single boxes comes before tracks are averaged and filled
    predicted = predicted[predicted.score >= protocol.min_score]
    whole_true, whole_found = (
        whole_tracks(
            boxes[(boxes.label >= 0) & counted(boxes, racks, protocol.region, protocol.classes)], frames
        )
        for boxes in (true, predicted)
    )
    by_class = {}
    for n, name in enumerate(protocol.classes):
        of_class = whole_true[whole_true.label == n], whole_found[whole_found.label == n]
        by_class[name] = _class_figures(*of_class, frames, protocol)
    return TrackingFigures(by_class, _over_classes(by_class))


def recall_thresholds(
    matched_score: Float[ndarray, "n"], true: int, protocol: TrackingProtocol
) -> Float[ndarray, "R"]:
    """Return the score at which each recall is expected, from recall 1 downwards; NaN: not reached.

    `matched_score` has the scores of all matches (without switches) if every found box takes part.
    """
    recalls = np.linspace(protocol.min_recall, 1.0, protocol.recalls).round(12)
    if len(matched_score) == 0:
        return np.full(len(recalls), np.nan)
    # Scores in descending order: match k is reached at recall k / true
    score = np.sort(matched_score)[::-1]
    reached = np.arange(1, len(score) + 1) / true
    threshold = np.interp(recalls, reached, score, right=0)
    # Recalls beyond the largest one are not reached
    threshold[recalls > reached[-1]] = np.nan
    return threshold[::-1]


def _class_figures(
    true: ObjectRows, predicted: ObjectRows, frames: Frames, protocol: TrackingProtocol
) -> dict[str, float]:
    """Return AMOTA and AMOTP, and the other figures at the threshold of the best MOTA."""
    if len(true) == 0:
        return dict.fromkeys(_FIGURES, math.nan)
    layout = _lay_out(true, predicted, frames, protocol)
    # All found boxes take part first; their matches give the thresholds of all recalls
    everything = ClearEvents(*follow(layout, np.ones(len(predicted), bool)))
    matches = everything.found_row[everything.kind == MATCH]
    threshold = recall_thresholds(predicted.score[matches], len(true), protocol)
    reached = ~np.isnan(threshold)
    if not reached.any():
        return _nothing_found(layout, protocol)
    # Each threshold is a tracking run of its own
    counts = _counts_at(layout, predicted.score, np.unique(threshold[reached]))
    points = [at_threshold(counts[score]) if score in counts else None for score in threshold.tolist()]
    motar, motp = (np.array([math.nan if f is None else f[key] for f in points]) for key in ("motar", "motp"))
    # Thresholds that are not reached cannot be the best
    mota = [-math.inf if f is None else f["mota"] for f in points]
    best = points[int(np.argmax(mota))]  # of equal ones, that of the highest recall
    assert best is not None
    return {
        "amota": _average(motar, 0.0),
        "amotp": _average(motp, protocol.worst_motp_m),
        **best,
    }


def _lay_out(true: ObjectRows, predicted: ObjectRows, frames: Frames, protocol: TrackingProtocol) -> Layout:
    rows = []
    for boxes in (true, predicted):
        scene_and_track = np.stack([frames.scene[boxes.frame], boxes.track], axis=1)
        track = np.unique(scene_and_track, axis=0, return_inverse=True)[1].reshape(-1)
        rows.append(TrackRows(boxes.frame, track))
    near = near_pairs(
        true.frame, true.centre[:, :2], predicted.frame, predicted.centre[:, :2], protocol.max_distance_m
    )
    return lay_out(rows[0], rows[1], near)


def _counts_at(
    layout: Layout, score: Float[ndarray, "m"], thresholds: Float[ndarray, "t"]
) -> dict[float, ClearCounts]:
    """Return the counts of the boxes that have at least each score."""
    counts: dict[float, ClearCounts] = {}

    def job(start: int, stop: int) -> None:
        # Only boxes of at least this score take part
        for threshold in thresholds[start:stop].tolist():
            active: Bool[ndarray, m] = score >= threshold
            counts[threshold] = count_events(layout, ClearEvents(*follow(layout, active)), active)

    in_parallel(job, len(thresholds))
    return counts


def at_threshold(counts: ClearCounts) -> dict[str, float]:
    """Return the devkit's figures of one score threshold."""
    return {
        "recall": counts.recall,
        # MOTAR of the devkit, in which its other terms cancel
        "motar": max(0.0, 1.0 - counts.false / counts.matches) if counts.matches else math.nan,
        "gt": float(counts.true),
        "mota": max(0.0, counts.mota),
        "motp": counts.motp,
        "mt": float(counts.mostly_tracked),
        "ml": float(counts.mostly_lost),
        "faf": 100.0 * counts.false / counts.frames,
        "tp": float(counts.matches),
        "fp": float(counts.false),
        "fn": float(counts.misses),
        "ids": float(counts.switches),
        "frag": float(counts.fragments),
        "tid": FRAME_S * counts.frames_to_first / counts.tracked if counts.tracked else math.nan,
        "lgd": FRAME_S * counts.longest_gaps / counts.tracked if counts.tracked else math.nan,
    }


def _nothing_found(layout: Layout, protocol: TrackingProtocol) -> dict[str, float]:
    """Return the figures of a class of which no recall is reached: the worst of each."""
    boxes = float(len(layout.true_track))
    return {
        **dict.fromkeys(_FIGURES, 0.0),
        "amotp": protocol.worst_motp_m,
        "motp": protocol.worst_motp_m,
        "gt": boxes,
        "fn": boxes,
        "ml": float(layout.true_track.max() + 1),
        "faf": protocol.worst_faf,
        "tid": protocol.worst_s,
        "lgd": protocol.worst_s,
        **dict.fromkeys(("fp", "ids", "frag"), math.nan),
    }


def _average(values: Float[ndarray, "R"], worst: float) -> float:
    """Return the mean over recalls with the worst value where there is none; NaN if there is none at all."""
    missing = np.isnan(values)
    return math.nan if missing.all() else float(np.where(missing, worst, values).mean())


def _over_classes(by_class: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    every: dict[str, float] = {}
    for key in _FIGURES:
        values = np.array([figures[key] for figures in by_class.values()])
        # Classes without a figure are left out of the mean
        valid: Float[ndarray, k] = values[~np.isnan(values)]
        if key in SUMMED:
            every[key] = float(valid.sum())
        else:
            every[key] = float(valid.mean()) if len(valid) else math.nan
    return every
