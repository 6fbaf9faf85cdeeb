"""HOTA: detection and association of tracks, averaged over thresholds of similarity.

Source: Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking" (IJCV 2021); the
matching and its order are those of trackeval 1.3.0 (metrics/hota.py).
"""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.optimize import linear_sum_assignment

from foredrive.tasks.tracking.clear import Candidates, TrackRows

ALPHAS = np.arange(0.05, 0.99, 0.05)
"""Least similarities of a match."""
_EPS = np.finfo(float).eps


@dataclass(frozen=True)
class Hota:
    """Figures at each of `ALPHAS`. The published figure of each is its mean."""

    true_positives: Int[ndarray, "A"]
    misses: Int[ndarray, "A"]
    false: Int[ndarray, "A"]
    ass_a: Float[ndarray, "A"]
    """Mean over matches of the overlap of their two tracks: joint matches / boxes of either."""
    ass_re: Float[ndarray, "A"]
    ass_pr: Float[ndarray, "A"]
    loc_a: Float[ndarray, "A"]
    """Mean similarity of matches; 1 without any."""

    @property
    def det_a(self) -> Float[ndarray, "A"]:
        """Matches / (matches + misses + false)."""
        return self.true_positives / np.maximum(1, self.true_positives + self.misses + self.false)

    @property
    def det_re(self) -> Float[ndarray, "A"]:
        """Matches / true boxes."""
        return self.true_positives / np.maximum(1, self.true_positives + self.misses)

    @property
    def det_pr(self) -> Float[ndarray, "A"]:
        """Matches / found boxes."""
        return self.true_positives / np.maximum(1, self.true_positives + self.false)

    @property
    def hota(self) -> Float[ndarray, "A"]:
        """Geometric mean of DetA and AssA."""
        return np.sqrt(self.det_a * self.ass_a)

    def figures(self) -> dict[str, float]:
        """Return the means over `ALPHAS` by name."""
        names = ("hota", "det_a", "ass_a", "det_re", "det_pr", "ass_re", "ass_pr", "loc_a")
        return {name: float(getattr(self, name).mean()) for name in names}


def hota(true: TrackRows, predicted: TrackRows, similar: Candidates) -> Hota:
    """Return HOTA of tracks. Frames and tracks of several sequences have numbers of their own.

    In each frame boxes are matched so that the sum over pairs of similarity times alignment is largest. The
    alignment of two tracks is the overlap of all that they share, before any match.

    Args:
        similar: all pairs of a frame with a similarity (in [0, 1]) above 0.
    """
    true_boxes, true_track = _counts(true.track)
    found_boxes, found_track = _counts(predicted.track)
    both = np.stack([true_track[similar.true_row], found_track[similar.found_row]], axis=1)
    # Distinct pairs of tracks, and the pair of each candidate
    pairs, pair = np.unique(both, axis=0, return_inverse=True)
    # Boxes of both tracks together
    pair, lengths = pair.reshape(-1), true_boxes[pairs[:, 0]] + found_boxes[pairs[:, 1]]
    # Number of frames that two tracks share, weighted by similarity among the alternatives
    shared = np.bincount(pair, _share(similar, len(true), len(predicted)), len(pairs))
    # Alignment: shared frames over the union of both tracks; matching maximises alignment times similarity
    matched = _match(true, similar, (shared / (lengths - shared))[pair] * similar.value)
    # A match counts at all thresholds up to its similarity
    hit = (matched >= 0) & (similar.value >= ALPHAS[:, None] - _EPS)
    # Matches of each pair of tracks, by threshold
    joint = np.stack([np.bincount(pair[row], minlength=len(pairs)) for row in hit])
    hits = hit.sum(1)
    # Each match weighs the overlap of its tracks: joint² sums it over the joint matches
    ass_a, ass_re, ass_pr = (
        (joint * joint / np.maximum(1, whole)).sum(1) / np.maximum(1, hits)
        for whole in (lengths - joint, true_boxes[pairs[:, 0]], found_boxes[pairs[:, 1]])
    )
    return Hota(
        true_positives=hits,
        misses=len(true) - hits,
        false=len(predicted) - hits,
        ass_a=ass_a,
        ass_re=ass_re,
        ass_pr=ass_pr,
        loc_a=np.maximum(1e-10, (hit * similar.value).sum(1)) / np.maximum(1e-10, hits),
    )


def _counts(track: Int[ndarray, "n"]) -> tuple[Int[ndarray, "T"], Int[ndarray, "n"]]:
    """Return the number of boxes of each track, and the tracks numbered from 0."""
    _, number, count = np.unique(track, return_inverse=True, return_counts=True)
    return count, number


def _share(similar: Candidates, true: int, predicted: int) -> Float[ndarray, "P"]:
    """Return the similarity of each pair, divided by the sum over all pairs with one of its two boxes."""
    value = similar.value
    # Similarity of all pairs of the true box and of the found box, the pair itself counted once
    whole = np.bincount(similar.true_row, value, true)[similar.true_row] - value
    whole += np.bincount(similar.found_row, value, predicted)[similar.found_row]
    return np.divide(value, whole, out=np.zeros_like(value), where=whole > _EPS)


def _match(true: TrackRows, similar: Candidates, score: Float[ndarray, "P"]) -> Int[ndarray, "P"]:
    """Return the index of each pair that is matched, else -1."""
    matched = np.full(len(score), -1)
    frame = true.frame[similar.true_row]
    starts = np.flatnonzero(np.diff(frame, prepend=-1))
    # Candidates are in order of frames: each run is one frame
    for start, stop in itertools.pairwise([*starts, len(frame)]):
        rows, row = np.unique(similar.true_row[start:stop], return_inverse=True)
        columns, column = np.unique(similar.found_row[start:stop], return_inverse=True)
        # Table of scores; pairs that are no candidates have score 0 and no index
        table, place = np.zeros((len(rows), len(columns))), np.full((len(rows), len(columns)), -1)
        table[row, column], place[row, column] = score[start:stop], np.arange(start, stop)
        # The largest sum of scores; chosen pairs that are no candidates are dropped
        pairs = place[linear_sum_assignment(table, maximize=True)]
        matched[pairs[pairs >= 0]] = pairs[pairs >= 0]
    return matched
