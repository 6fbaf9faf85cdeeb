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

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from foredrive.metrics.object_rows import Frames, ObjectRows, Region, counted
from foredrive.metrics.tracking.clear import (
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
from foredrive.metrics.tracking.interpolation import whole_tracks
from foredrive.ops.threads import in_parallel

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
        classes=("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck"),
        region=Region("circle", _REACH_M),
        max_distance_m=2.0,
        min_score=min_score,
        min_recall=0.1,
        recalls=40,
        worst_motp_m=2.0,
        worst_faf=500.0,
        worst_s=20.0,
        max_boxes=500,
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
    found: ObjectRows, true: ObjectRows, racks: ObjectRows, frames: Frames, protocol: TrackingProtocol
) -> TrackingFigures:
    """Return the figures of tracks under one protocol.

    Args:
        found: labels are indices into the protocol's classes, as those of `true`; -1 is left out.
        racks: bicycle racks; labels do not matter.
        frames: all frames of the scenes, also those without boxes.
    """
    found = found[found.score >= protocol.min_score]
    whole_true, whole_found = (
        whole_tracks(
            boxes[(boxes.label >= 0) & counted(boxes, racks, protocol.region, protocol.classes)], frames
        )
        for boxes in (true, found)
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
    score = np.sort(matched_score)[::-1]
    reached = np.arange(1, len(score) + 1) / true
    threshold = np.interp(recalls, reached, score, right=0)
    threshold[recalls > reached[-1]] = np.nan
    return threshold[::-1]


def _class_figures(
    true: ObjectRows, found: ObjectRows, frames: Frames, protocol: TrackingProtocol
) -> dict[str, float]:
    """Return AMOTA and AMOTP, and the other figures at the threshold of the best MOTA."""
    if len(true) == 0:
        return dict.fromkeys(_FIGURES, math.nan)
    layout = _lay_out(true, found, frames, protocol)
    everything = ClearEvents(*follow(layout, np.ones(len(found), bool)))
    matches = everything.found_row[everything.kind == MATCH]
    threshold = recall_thresholds(found.score[matches], len(true), protocol)
    reached = ~np.isnan(threshold)
    if not reached.any():
        return _nothing_found(layout, protocol)
    counts = _counts_at(layout, found.score, np.unique(threshold[reached]))
    each = [at_threshold(counts[score]) if score in counts else None for score in threshold.tolist()]
    motar, motp = (np.array([math.nan if f is None else f[key] for f in each]) for key in ("motar", "motp"))
    mota = [-math.inf if f is None else f["mota"] for f in each]
    best = each[int(np.argmax(mota))]  # of equal ones, that of the highest recall
    assert best is not None
    return {
        "amota": _average(motar, 0.0),
        "amotp": _average(motp, protocol.worst_motp_m),
        **best,
    }


def _lay_out(true: ObjectRows, found: ObjectRows, frames: Frames, protocol: TrackingProtocol) -> Layout:
    rows = []
    for boxes in (true, found):
        scene_and_track = np.stack([frames.scene[boxes.frame], boxes.track], axis=1)
        track = np.unique(scene_and_track, axis=0, return_inverse=True)[1].reshape(-1)
        rows.append(TrackRows(boxes.frame, track))
    near = near_pairs(
        true.frame, true.centre[:, :2], found.frame, found.centre[:, :2], protocol.max_distance_m
    )
    return lay_out(rows[0], rows[1], near)


def _counts_at(
    layout: Layout, score: Float[ndarray, "m"], thresholds: Float[ndarray, "t"]
) -> dict[float, ClearCounts]:
    """Return the counts of the boxes that have at least each score."""
    counts: dict[float, ClearCounts] = {}

    def job(start: int, stop: int) -> None:
        for threshold in thresholds[start:stop].tolist():
            active: Bool[ndarray, m] = score >= threshold
            counts[threshold] = count_events(layout, ClearEvents(*follow(layout, active)), active)

    in_parallel(job, len(thresholds))
    return counts


def at_threshold(counts: ClearCounts) -> dict[str, float]:
    """Return the devkit's figures of one score threshold."""
    return {
        "recall": counts.recall,
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
        known: Float[ndarray, k] = values[~np.isnan(values)]
        if key in SUMMED:
            every[key] = float(known.sum())
        else:
            every[key] = float(known.mean()) if len(known) else math.nan
    return every
