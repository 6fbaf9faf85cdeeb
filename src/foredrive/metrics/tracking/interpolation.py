"""Tracks as nuScenes evaluates them: one score a track, and no gaps."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from foredrive.metrics.object_rows import Frames, ObjectRows


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
    boxes = dataclasses.replace(boxes, score=mean_scores(identity, boxes.score))
    order = np.lexsort((boxes.frame, identity))
    left, right = order[:-1], order[1:]
    gap = boxes.frame[right] - boxes.frame[left] - 1
    gap[identity[left] != identity[right]] = 0
    left, right = np.repeat(left, gap), np.repeat(right, gap)
    since = np.arange(len(left)) - np.repeat(np.cumsum(gap) - gap, gap)
    filled = _between(boxes[left], boxes[right], boxes.frame[left] + 1 + since, frames)
    begins = np.full(identity.max(initial=-1) + 1, len(boxes))
    np.minimum.at(begins, identity, np.arange(len(boxes)))
    every = _joined(boxes, filled)
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
        rows = start[length == count, None] + np.arange(count)
        mean[track[length == count]] = np.ascontiguousarray(score[order][rows]).mean(axis=1)
    return mean[identity]


def _identities(boxes: ObjectRows, frames: Frames) -> Int[ndarray, "n"]:
    """Return a number of each track that no other scene has."""
    scene_and_track = np.stack([frames.scene[boxes.frame], boxes.track], axis=1)
    return np.unique(scene_and_track, axis=0, return_inverse=True)[1].reshape(-1)


def _between(left: ObjectRows, right: ObjectRows, frame: Int[ndarray, "n"], frames: Frames) -> ObjectRows:
    """Return the boxes of gaps, weighted as the devkit weights them; angles go the shorter way round."""
    time, end, begin = (frames.time_us[at] for at in (frame, right.frame, left.frame))
    ratio = (end - time) / (end - begin)

    def mix(a: Float[ndarray, "n ..."], b: Float[ndarray, "n ..."]) -> Float[ndarray, "n ..."]:
        weight = ratio.reshape(-1, *[1] * (a.ndim - 1))
        return (1.0 - weight) * a + weight * b

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
