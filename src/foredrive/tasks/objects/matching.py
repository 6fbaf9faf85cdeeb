"""Average precision of boxes: hits by centre distance (nuScenes) or by overlap (COCO)."""

from collections.abc import Sequence
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

NUSCENES_DISTANCES_M = (0.5, 1.0, 2.0, 4.0)
COCO_OVERLAPS = tuple(np.round(np.arange(0.5, 1.0, 0.05), 2).tolist())


def overlaps(boxes: Float[ndarray, "M 4"], others: Float[ndarray, "N 4"]) -> Float[ndarray, "M N"]:
    """Return the intersection over union of image boxes (x1, y1, x2, y2)."""
    # Corners of the intersection
    low = np.maximum(boxes[:, None, :2], others[:, :2])
    high = np.minimum(boxes[:, None, 2:], others[:, 2:])
    shared = np.clip(high - low, 0.0, None).prod(-1)
    area, other_area = (np.clip(b[:, 2:] - b[:, :2], 0.0, None).prod(-1) for b in (boxes, others))
    either = area[:, None] + other_area - shared
    # Two empty boxes have overlap 0
    return np.divide(shared, either, out=np.zeros_like(shared), where=either > 0)


def descending(score: Float[ndarray, "n"], *, ties_reversed: bool = False) -> Int[ndarray, "n"]:
    """Return indices by descending score. Equal scores keep their order, or reverse it as nuScenes does."""
    if ties_reversed:
        return np.argsort(score, kind="stable")[::-1]
    return np.argsort(-score, kind="stable")


def match_greedily(
    order: Int[ndarray, "M"], closeness: Float[ndarray, "M N"], min_closeness: float
) -> Int[ndarray, "M"]:
    """Match the detections of one frame, in the given order, with the closest object that is left.

    Args:
        order: of detections, as `descending` returns it.
        closeness: larger for better pairs, -inf between classes.
        min_closeness: of a pair.

    Returns:
        The object of each detection; -1: none.
    """
    return _match_greedily(np.ascontiguousarray(order), closeness, min_closeness)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _match_greedily(order, closeness, min_closeness):
    partner = np.full(len(order), -1)
    taken = np.zeros(closeness.shape[1], np.bool_)
    for i in order:
        closest, best = -1, min_closeness
        # The closest object that is left; at the limit itself a pair counts
        for j in range(len(taken)):
            close = closeness[i, j]
            if not taken[j] and (close > best or (closest < 0 and close == best)):
                closest, best = j, close
        if closest >= 0:
            partner[i], taken[closest] = closest, True
    return partner


def match_centres(
    found_frame: Int[ndarray, "m"],
    found_xy: Float[ndarray, "m 2"],
    true_frame: Int[ndarray, "n"],
    true_xy: Float[ndarray, "n 2"],
    distances_m: Sequence[float] = NUSCENES_DISTANCES_M,
) -> Int[ndarray, "T m"]:
    """Match detections of one class with the nearest object of their frame that is left, as nuScenes does.

    Detections take their turns in the order of their rows. True rows may be in any order.

    Returns:
        The true row of each detection at each distance; -1: none is nearer than the distance.
    """
    # Sort detections and objects by frame, so that each frame is a range of rows
    turn = np.argsort(found_frame, kind="stable")
    place = np.argsort(true_frame, kind="stable")
    frames, first = np.unique(found_frame[turn], return_index=True)
    bounds = (np.searchsorted(true_frame[place], frames, side=side) for side in ("left", "right"))
    # A distance equal to the limit is no hit: the next number towards 0 excludes it
    nearness = np.nextafter(-np.array(distances_m), 0.0)
    matched = _match_centres(np.append(first, len(turn)), *bounds, found_xy[turn], true_xy[place], nearness)
    partner = np.empty_like(matched)
    # Back to the callers' rows; -1 selects the appended -1
    partner[:, turn] = np.append(place, -1)[matched]
    return partner


@numba.njit(cache=True, nogil=True)
@no_type_check
def _match_centres(start, true_start, true_stop, found_xy, true_xy, nearness):
    # Arguments: ranges of rows by frame (start; true_start, true_stop), positions in m, least -distances
    matched = np.full((len(nearness), len(found_xy)), -1)
    for f in range(len(start) - 1):
        rows, true_here = np.arange(start[f + 1] - start[f]), true_xy[true_start[f] : true_stop[f]]
        closeness = np.empty((len(rows), len(true_here)))
        for i in rows:
            for j in range(len(true_here)):
                dx, dy = (
                    found_xy[start[f] + i, 0] - true_here[j, 0],
                    found_xy[start[f] + i, 1] - true_here[j, 1],
                )
                closeness[i, j] = -np.sqrt(dx * dx + dy * dy)
        for t in range(len(nearness)):
            taken = _match_greedily(rows, closeness, nearness[t])
            for i in rows:
                if taken[i] >= 0:
                    matched[t, start[f] + i] = true_start[f] + taken[i]
    return matched


def precision_recall(
    hit: Bool[ndarray, "n"], objects: int
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Return precision and recall of the first detections, for each number of them."""
    hits = np.cumsum(hit)
    return hits / np.arange(1, len(hit) + 1), hits / objects


def average_precision_coco(score: Float[ndarray, "n"], hit: Bool[ndarray, "n"], objects: int) -> float:
    """Return the average precision of COCO; NaN without objects.

    It is the mean, at recall 0, 0.01 … 1, of the largest precision at this recall or beyond.
    """
    if objects == 0:
        return float("nan")
    precision, recall = precision_recall(hit[descending(score)], objects)
    # Index of the first detection that reaches each recall; unreached ones select the appended 0
    index = np.searchsorted(recall, np.linspace(0, 1, 101), side="left")
    # Running maximum from the end: the largest precision at this recall or beyond
    return float(np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)[index].mean())


def average_precision_nuscenes(score: Float[ndarray, "n"], hit: Bool[ndarray, "n"], objects: int) -> float:
    """Return the average precision of nuScenes' devkit; NaN without objects.

    It is the mean, at recall 0.11, 0.12 … 1, of the precision above 0.1, divided by 0.9.
    """
    return ranked_precision_nuscenes(hit[descending(score, ties_reversed=True)], objects)


def ranked_precision_nuscenes(hit: Bool[ndarray, "n"], objects: int) -> float:
    """Return `average_precision_nuscenes` of detections that are in order already."""
    if objects == 0:
        return float("nan")
    if not hit.any():
        return 0.0
    precision, recall = precision_recall(hit, objects)
    # Precision at 101 recalls, 0 beyond the largest recall that is reached
    resampled = np.interp(np.linspace(0, 1, 101), recall, precision, right=0.0)
    # Recalls up to 0.10 and precisions up to 0.1 do not count
    return float(np.clip(resampled[11:] - 0.1, 0.0, None).mean() / 0.9)


def mean_of_valid(values: Sequence[float]) -> float:
    """Return the mean over the values that are not NaN, or NaN."""
    valid = [value for value in values if not np.isnan(value)]
    return float(np.mean(valid)) if valid else float("nan")
