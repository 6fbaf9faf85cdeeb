"""Choice of moments from a pool: at random, or by what a strategy looks at. No label of the pool is read."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from foredrive.runs.improve.failures import Failure
from foredrive.search.find import Hit, k_centre, vectors_of
from foredrive.search.index import FrameIndex
from foredrive.search.rows import EMBEDDINGS, FACTS, WHOLE, IndexRow
from foredrive.search.tables import quoted

APART_S = 1.0
"""Least time between two chosen moments of one log, s."""
CANDIDATES = 3
"""Candidates per chosen moment among which the diverse ones are chosen."""
RANDOM, UNCERTAINTY, DIVERSITY = "random", "uncertainty", "diversity"
FAILURES, DIVERSE_FAILURES, ANEW = "failures", "failures-diversity", "anew"
STRATEGIES = (RANDOM, UNCERTAINTY, DIVERSITY, FAILURES, DIVERSE_FAILURES, ANEW)


@dataclass(frozen=True)
class Moments:
    """Whole scenes of an index, one row for each moment, with unit vectors."""

    rows: list[IndexRow]
    vectors: Float[ndarray, "n D"]

    @classmethod
    def of(cls, index: FrameIndex, keys: set[str] | None = None) -> "Moments":
        """Read the moments that have an embedding, in the order of their keys.

        Args:
            keys: only these; None means all.
        """
        table = index.select(f"view = {quoted(WHOLE)}", [*FACTS.names, *EMBEDDINGS]).sort_by("key")
        # `joint` is the mean of image and lidar, or the one that exists
        vectors, rows = vectors_of(table, "joint"), IndexRow.all_of(table)
        kept = [
            n
            for n, row in enumerate(rows)
            if (keys is None or row.key in keys) and not np.isnan(vectors[n]).any()
        ]
        return cls([rows[n] for n in kept], vectors[kept])

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Request:
    """The arguments of a strategy."""

    pool: Moments
    failures: Sequence[Failure]
    before: Moments
    """Moments before the failures."""
    uncertainty: Callable[[], Mapping[str, float]]
    """Returns the uncertainty of the driver about each moment of the pool, by key."""
    budget: int
    rng: np.random.Generator


def choose(strategy: str, request: Request) -> list[Hit]:
    """Return at most `budget` moments of the pool, in the order of choice. Scores are the strategy's own."""
    if not len(request.pool):
        return []
    order, score = _ORDERS[strategy](request)
    rows = request.pool.rows
    return [Hit(rows[n], float(score[n]), {strategy: float(score[n])}) for n in order]


Order = tuple[list[int], Float[ndarray, "n"]]
"""Chosen rows, and the score of every row."""


def _random(request: Request) -> Order:
    order = request.rng.permutation(len(request.pool))
    return _apart(order, request.pool.rows, request.budget), np.zeros(len(request.pool))


def _uncertain(request: Request) -> Order:
    by_key = request.uncertainty()
    score = np.array([by_key[row.key] for row in request.pool.rows])
    return _apart(np.argsort(-score, kind="stable"), request.pool.rows, request.budget), score


def _diverse(request: Request) -> Order:
    worth = np.ones(len(request.pool))
    # The first of equal worth begins; a random one must not depend on the names of logs
    worth[request.rng.integers(len(request.pool))] = 1.001
    chosen = k_centre(request.pool.vectors, request.budget, worth)
    return chosen, _rank_score(chosen, len(request.pool))


def _like_failures(request: Request) -> Order:
    order, likeness = _by_likeness(request)
    return _apart(order, request.pool.rows, request.budget), likeness


def _like_failures_diverse(request: Request) -> Order:
    order, likeness = _by_likeness(request)
    near = np.array(_apart(order, request.pool.rows, CANDIDATES * request.budget))
    chosen = k_centre(request.pool.vectors[near], request.budget, np.ones(len(near)))
    return near[chosen].tolist(), likeness


def before_failure(moments: Moments, failure: Failure) -> list[int]:
    """Return the rows of the moments before a failure."""
    ((start_s, end_s),) = failure.log.parts_s
    return [
        n for n, row in enumerate(moments.rows) if row.log == failure.log.name and start_s <= row.t_s <= end_s
    ]


def _by_likeness(request: Request) -> tuple[Int[ndarray, "n"], Float[ndarray, "n"]]:
    """Return the rows in an order in which failures take turns, and their likeness with the nearest one."""
    of_failure = []
    for failure in request.failures:
        mine = before_failure(request.before, failure)
        if mine:
            # A moment is like a failure if it is like one of the moments before it
            of_failure.append((request.pool.vectors @ request.before.vectors[mine].T).max(1))
    likeness = np.stack(of_failure)
    rank = np.argsort(np.argsort(-likeness, axis=1, kind="stable"), axis=1)
    return np.lexsort((-likeness.max(0), rank.min(0))), likeness.max(0)


_ORDERS: Mapping[str, Callable[[Request], Order]] = {
    RANDOM: _random,
    UNCERTAINTY: _uncertain,
    DIVERSITY: _diverse,
    FAILURES: _like_failures,
    DIVERSE_FAILURES: _like_failures_diverse,
}


def _apart(order: Int[ndarray, "n"], rows: Sequence[IndexRow], count: int) -> list[int]:
    """Return the first rows of an order that are apart in time within their logs."""
    chosen: list[int] = []
    times: dict[str, list[float]] = {}
    for n in order.tolist():
        if len(chosen) == count:
            break
        row = rows[n]
        of_log = times.setdefault(row.log, [])
        if all(abs(row.t_s - other) >= APART_S - 1e-3 for other in of_log):
            of_log.append(row.t_s)
            chosen.append(n)
    return chosen


def _rank_score(chosen: Sequence[int], count: int) -> Float[ndarray, "n"]:
    """Return 1 for the first choice, falling to 0 for rows that are not chosen."""
    score = np.zeros(count)
    score[list(chosen)] = 1 - np.arange(len(chosen)) / max(len(chosen), 1)
    return score
