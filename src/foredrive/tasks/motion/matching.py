"""Pairs of predicted and true agents, frame by frame."""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Int
from numpy import ndarray

from foredrive.tasks.frames import rows_by_frame
from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents
from foredrive.tasks.objects.matching import descending

_APART = 1e6
"""Cost of a pair that is too far apart: more than any sum of distances."""


def match_by_score(
    predicted: PredictedAgents,
    true: TrueAgents,
    *,
    within_m: float,
    end_within_m: float = np.inf,
    horizon: int = 0,
) -> tuple[Int[ndarray, "M"], Int[ndarray, "M"]]:
    """Match each prediction, the best scored first, with the nearest agent of its frame that is left.

    A prediction tries that agent alone. It takes it if the agent is nearer than `within_m` and, with a
    finite `end_within_m`, one of its futures ends nearer than that to the last known step of the agent's.

    Returns:
        The order of the predictions (equal scores reversed, as in nuScenes' devkit), and the agent of each
        prediction; -1: none.
    """
    order = descending(predicted.score, ties_reversed=True)
    # Agents sorted by frame: those of a frame are a range of rows
    by_frame = np.argsort(true.frame, kind="stable")
    frames = int(max(predicted.frame.max(initial=-1), true.frame.max(initial=-1))) + 1
    start = np.searchsorted(true.frame[by_frame], np.arange(frames + 1))
    steps = true.steps_known(horizon)[by_frame]
    partner = _match_by_score(
        order,
        predicted.frame,
        predicted.xy,
        start,
        true.xy[by_frame],
        within_m,
        predicted.future_xy,
        true.future_xy[by_frame],
        steps,
        end_within_m,
    )
    # Rows of the kernel back to the caller's; without agents nothing is found
    return order, np.where(partner >= 0, by_frame[partner], -1) if len(by_frame) else partner


def match_by_distance(predicted: PredictedAgents, true: TrueAgents, *, within_m: float) -> Int[ndarray, "M"]:
    """Return the agent of each prediction: as many pairs of at most `within_m` as possible, the nearest.

    -1: none. Scores and classes do not matter.
    """
    from scipy.optimize import linear_sum_assignment  # not on every machine with a GPU
    from scipy.spatial.distance import cdist  # not on every machine with a GPU

    partner = np.full(len(predicted.frame), -1)
    rows, columns = rows_by_frame(predicted.frame), rows_by_frame(true.frame)
    for frame, row in rows.items():
        column = columns.get(frame)
        if column is None:
            continue
        distance_m = cdist(predicted.xy[row], true.xy[column])
        # Only rows and columns with a partner enter the assignment
        near = distance_m <= within_m
        row, column = row[near.any(1)], column[near.any(0)]
        # Pairs out of reach are dearer than all others together, so as many pairs as possible are made
        cost = np.where(near, distance_m, _APART)[np.ix_(near.any(1), near.any(0))]
        i, j = linear_sum_assignment(cost)
        hit = cost[i, j] < _APART
        partner[row[i[hit]]] = column[j[hit]]
    return partner


@numba.njit(cache=True, nogil=True)
@no_type_check
def _match_by_score(
    order, frame, xy, start, true_xy, within_m, future_xy, true_future_xy, steps, end_within_m
):
    # Positions in m; start delimits the agents of each frame; steps counts known steps
    partner = np.full(len(order), -1)
    taken = np.zeros(len(true_xy), np.bool_)
    for i in order:
        # Nearest agent that is left; no other one is tried
        nearest, nearest_m = -1, np.inf
        for j in range(start[frame[i]], start[frame[i] + 1]):
            x, y = xy[i, 0] - true_xy[j, 0], xy[i, 1] - true_xy[j, 1]
            distance_m = np.sqrt(x * x + y * y)
            if not taken[j] and distance_m < nearest_m:
                nearest, nearest_m = j, distance_m
        if nearest < 0 or nearest_m >= within_m:
            continue
        if end_within_m < np.inf:
            # The nearest end of all futures, at the last known step of the agent
            last, end_m = steps[nearest] - 1, np.inf
            if last >= 0:
                for k in range(future_xy.shape[1]):
                    x = future_xy[i, k, last, 0] - true_future_xy[nearest, last, 0]
                    y = future_xy[i, k, last, 1] - true_future_xy[nearest, last, 1]
                    end_m = min(end_m, np.sqrt(x * x + y * y))
            if end_m >= end_within_m:
                continue
        partner[i], taken[nearest] = nearest, True
    return partner
