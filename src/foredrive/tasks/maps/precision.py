"""Average precision of map elements under a protocol."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.scene.map_elements import ElementKind
from foredrive.tasks.frames import rows_by_frame
from foredrive.tasks.maps.lines import CLASSES, LineSet, chamfer_distances, resample
from foredrive.tasks.maps.protocols import Area, VectorProtocol
from foredrive.tasks.objects.matching import descending, mean_of_valid, precision_recall

_UNTOUCHED_M = 100.0
"""Distance of a pair whose buffers do not touch, as MapTR has it: farther than any match."""


@dataclass(frozen=True)
class MapPrecision:
    """Average precision of one class."""

    ap: float
    """Mean over the distances; 0 without truth."""
    ap_at: tuple[float, ...]
    """By distance."""
    true: int
    predicted: int


def score_maps(
    predicted: LineSet,
    true: LineSet,
    protocol: VectorProtocol,
    area: Area,
    *,
    drive: Int[ndarray, "F"] | None = None,
    classes: Sequence[ElementKind] = CLASSES,
) -> dict[ElementKind, MapPrecision]:
    """Return the average precision of each class over a whole data set.

    Args:
        drive: number of the drive of each frame, which identities belong to; frames are numbered in the
            order of time. None: all frames are of one drive.

    Raises:
        InputError: the protocol follows identities, and there are none, or one twice in a frame.
    """
    if protocol.identity:
        for elements, what in ((predicted, "predicted"), (true, "true")):
            check_identities(elements, what)
    return {kind: _score_class(predicted, true, protocol, area, drive, kind) for kind in classes}


def mean_precision(scores: dict[ElementKind, MapPrecision], protocol: VectorProtocol) -> float:
    """Return the mean over classes as the protocol takes it; NaN if it has none to count."""
    left_out = protocol.absent_classes == "left_out"
    return mean_of_valid([score.ap for score in scores.values() if score.true or not left_out])


def average_precision_area(score: Float[ndarray, "n"], hit: Bool[ndarray, "n"], objects: int) -> float:
    """Return the area under the precision that is the largest at a recall or beyond; 0 without objects."""
    if objects == 0 or not hit.any():
        return 0.0
    precision, recall = precision_recall(hit[descending(score)], objects)
    # Largest precision at each recall or beyond, by a running maximum from the end
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    # Area: steps of recall times precision
    return float((np.diff(recall, prepend=0.0) * envelope).sum())


def check_identities(elements: LineSet, what: str) -> None:
    """Raise an InputError unless elements have identities, each of a class once a frame at most."""
    if elements.identity is None:
        raise InputError(f"{what} map elements have no identities, which C-mAP needs")
    # One row for each element; a repeated row is an identity that is there twice
    key = np.stack([elements.frame, elements.kind, elements.identity], axis=1)
    unique, count = np.unique(key, axis=0, return_counts=True)
    if (count > 1).any():
        frame, kind, identity = unique[count > 1][0].tolist()
        name = ElementKind(kind).name.lower()
        raise InputError(f"frame {frame} has {what} {name} {identity} twice: identities are unique")


def _score_class(
    predicted: LineSet,
    true: LineSet,
    protocol: VectorProtocol,
    area: Area,
    drive: Int[ndarray, "F"] | None,
    kind: ElementKind,
) -> MapPrecision:
    ours, theirs = (np.flatnonzero(elements.kind == kind) for elements in (predicted, true))
    predicted, true = predicted[ours], true[theirs]
    objects = len(true.lines)
    # C-mAP as released drops predictions of a class in frames without truth of it
    if protocol.frames_without_truth == "dropped":
        predicted = predicted[np.flatnonzero(np.isin(predicted.frame, true.frame))]
    distances_m = protocol.distances_m[area]
    matched = _match(predicted, true, protocol, distances_m)
    if protocol.identity:
        matched = np.stack([_claimed(row, predicted, true, drive) for row in matched])
    aps = tuple(average_precision_area(predicted.score, row >= 0, objects) for row in matched)
    return MapPrecision(float(np.mean(aps)), aps, objects, len(predicted.lines))


def _match(
    predicted: LineSet, true: LineSet, protocol: VectorProtocol, distances_m: Sequence[float]
) -> Int[ndarray, "D M"]:
    """Return the true element that each prediction finds at each distance; -1: none."""
    matched = np.full((len(distances_m), len(predicted.lines)), -1)
    # All lines have the same number of points at equal distances
    lines = predicted.resampled(protocol.points)
    others = _resampled_truth(true, protocol)
    rows, columns = rows_by_frame(predicted.frame), rows_by_frame(true.frame)
    for frame in rows.keys() & columns.keys():
        ours, theirs = rows[frame], columns[frame]
        distance_m = _distances(lines[ours], others[theirs], protocol, max(distances_m))
        # Each prediction is compared with its nearest true element only
        nearest = distance_m.argmin(1)
        nearest_m = distance_m.min(1)
        order = descending(predicted.score[ours])
        # For each limit, the best scored of the predictions that share a true element is the hit
        for row, limit_m in enumerate(distances_m):
            near = order[nearest_m[order] <= limit_m]
            element, first = np.unique(nearest[near], return_index=True)
            matched[row, ours[near[first]]] = theirs[element]
    return matched


def _resampled_truth(true: LineSet, protocol: VectorProtocol) -> Float[ndarray, "N P 2"]:
    if protocol.true_points_first is None:
        return true.resampled(protocol.points)
    # MapTracker resamples the truth twice: a coarse line first
    coarse = true.resampled(protocol.true_points_first)
    return np.array([resample(line, protocol.points) for line in coarse]).reshape(-1, protocol.points, 2)


def _distances(
    lines: Float[ndarray, "m P 2"],
    others: Float[ndarray, "n P 2"],
    protocol: VectorProtocol,
    at_most_m: float,
) -> Float[ndarray, "m n"]:
    distance_m = chamfer_distances(lines, others, at_most_m=at_most_m)
    if protocol.buffer_m is None:
        return distance_m
    # Only pairs in reach need the costly test of buffers
    i, j = np.nonzero(distance_m <= at_most_m)
    near, other = (
        shapely.buffer(shapely.linestrings(points), protocol.buffer_m, cap_style="flat", join_style="mitre")
        for points in (lines, others)
    )
    apart = ~shapely.intersects(near[i], other[j])
    distance_m[i[apart], j[apart]] = _UNTOUCHED_M
    return distance_m


def _claimed(
    row: Int[ndarray, "M"],
    predicted: LineSet,
    true: LineSet,
    drive: Int[ndarray, "F"] | None,
) -> Int[ndarray, "M"]:
    """Leave each true element to the predicted identity that finds it first in its drive."""
    assert predicted.identity is not None
    assert true.identity is not None
    hits = np.flatnonzero(row >= 0)
    # Predictions in order of time
    hits = hits[np.argsort(predicted.frame[hits], kind="stable")]
    frame = predicted.frame[hits]
    # A true element is identified by drive and identity
    key = np.stack([np.zeros_like(frame) if drive is None else drive[frame], true.identity[row[hits]]])
    _, first, element = np.unique(key, axis=1, return_index=True, return_inverse=True)
    identity = predicted.identity[hits]
    kept = row.copy()
    # Later predictions of another identity are false
    kept[hits[identity != identity[first[element.ravel()]]]] = -1
    return kept
