"""Answering of queries: select candidates, compare, merge neighbours, rank."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.search.embedding import mean_direction
from foredrive.search.index import EXACT_UP_TO, FrameIndex
from foredrive.search.query import ANY_SECTOR, ANY_VIEW, Query
from foredrive.search.rows import FACTS, IndexRow
from foredrive.search.saved import where_tagged
from foredrive.search.tables import quoted
from foredrive.search.target import Target


def k_centre(vectors: Float[ndarray, "n D"], count: int, worth: Float[ndarray, "n"]) -> list[int]:
    """Choose greedily the vector with the largest distance to the chosen ones times its worth (> 0).

    With equal worth this is the greedy 2-approximation of the k-centre problem (Gonzalez 1985; Sener &
    Savarese 2018). The first choice has the largest worth; among equals it is the first.

    Args:
        vectors: unit vectors. Distances are Euclidean.
        count: number to choose, at most n.
    """
    if not len(vectors):
        return []
    chosen = [int(worth.argmax())]
    distance = np.full(len(vectors), np.inf)
    while len(chosen) < min(count, len(vectors)):
        likeness = vectors @ vectors[chosen[-1]]
        # For unit vectors |a - b|² = 2 - 2 a·b. Rounding may make it slightly negative
        distance = np.minimum(distance, np.sqrt(np.maximum(2 - 2 * likeness, 0.0)))
        gain = distance * worth
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
    return chosen


def facility_location(vectors: Float[ndarray, "n D"], count: int, worth: Float[ndarray, "n"]) -> list[int]:
    """Choose greedily the vector that adds most to Σ_i worth_i max_{j chosen} (1 + cos(i, j)) / 2.

    The sum measures how well the chosen vectors represent all. It is monotone and submodular, so the greedy
    result is within 1 - 1/e of the optimum (Nemhauser et al. 1978).

    Args:
        vectors: unit vectors.
        count: number to choose, at most n.
    """
    likeness = (1 + vectors @ vectors.T) / 2
    covered = np.zeros(len(vectors))
    chosen: list[int] = []
    while len(chosen) < min(count, len(vectors)):
        gain = (worth[:, None] * np.maximum(likeness - covered[:, None], 0.0)).sum(0)
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
        covered = np.maximum(covered, likeness[:, chosen[-1]])
    return chosen


CANDIDATES_PER_HIT = 25
"""Number of candidate rows per wanted hit, if not all rows are compared, or for reranking. It is large
because many rows are neighbours or other views of one moment."""
MORE = 4
POOL_PER_HIT = 10
"""Number of hits per wanted hit from which diverse ones are chosen."""
SMALLEST_WORTH = 1e-3


@dataclass(frozen=True)
class Hit:
    """A moment with its best matching view."""

    row: IndexRow
    score: float
    """Score used for ranking."""
    scores: dict[str, float]
    """Cosine with the query by modality, if it exists."""


@dataclass(frozen=True)
class Found:
    """Result of a query."""

    hits: list[Hit]
    compared: int
    """Number of rows that were compared exactly."""
    exact: bool
    """Whether all rows that satisfy the conditions were compared."""
    unlike: bool = False
    """True if the index shows no more of the query's text than of unrelated texts: the hits are then only the
    nearest moments."""


def find(index: FrameIndex, query: Query, target: Target | None, *, exact_up_to: int = EXACT_UP_TO) -> Found:
    """Find the hits of a query, best first. Diverse hits are in order of selection.

    Args:
        target: vectors to compare rows with. None if the query does not compare.
        exact_up_to: maximum number of rows for exact comparison. With more rows, approximate search selects
            the candidates.

    Raises:
        InputError: the condition cannot be parsed, or the query needs data that towers or logs do not have.
    """
    _check(query, target)
    where = _conditions(index, query, target)
    total = index.count(where)
    exact = target is None or total <= exact_up_to
    wanted = query.top * (POOL_PER_HIT if query.diverse else 1)
    limit = wanted * CANDIDATES_PER_HIT
    # Collapsing drops neighbours and other views, so more candidates are read until there are enough hits
    while True:
        limit = min(limit, total)
        rows = _candidates(index, query, target, where, None if exact else limit)
        score = _rank(rows, query, target)
        order = collapse(score, rows["log"].to_pylist(), _column(rows, "t_us"), query.gap_s, wanted)
        # Reranking takes a fixed number of rows, so that more candidates change nothing
        reranked = query.modality == "joint" and query.rule == "rerank"
        if exact or reranked or len(order) >= wanted or limit >= total:
            break
        limit *= MORE
    if not order and query.modality == "lidar" and not index.count("lidar IS NOT NULL"):
        raise InputError(f"{index.uri}: no lidar embeddings; the towers {index.settings.towers} made none")
    if query.diverse is not None:
        order = [order[n] for n in _diverse(rows, order, score, query)]
    kept = rows.take(pa.array(order, pa.int64()))
    hits = map(Hit, IndexRow.all_of(kept), score[order].tolist(), _scores(kept, target, query))
    return Found(list(hits), len(rows), exact)


def collapse(
    score: Float[ndarray, "n"], logs: Sequence[str], t_us: Int[ndarray, "n"], gap_s: float, top: int
) -> list[int]:
    """Return the best rows, best first, at least `gap_s` apart within a log. NaN scores are left out."""
    kept: list[int] = []
    times: dict[str, list[int]] = {}
    for n in np.argsort(-score, kind="stable").tolist():
        if np.isnan(score[n]) or len(kept) == top:
            break  # NaN is sorted last, so no valid row follows
        of_log = times.setdefault(logs[n], [])
        # At least 1 µs: without a gap, the views of one moment still count as one hit
        if all(abs(int(t_us[n]) - other) >= max(gap_s * 1e6, 1) for other in of_log):
            of_log.append(int(t_us[n]))
            kept.append(n)
    return kept


def _check(query: Query, target: Target | None) -> None:
    if query.compares and target is None:
        raise InputError("the query has no text or example to compare with")
    if target is None:
        return
    needs = {"image": ("image",), "lidar": ("lidar",), "joint": ("image", "lidar")}[query.modality]
    if all(getattr(target, name) is None for name in needs):
        raise InputError(f"the example has no {' and no '.join(needs)} to compare with")


def _check_view(index: FrameIndex, query: Query) -> None:
    if not index.count(query.where_view) and index.count():
        views = sorted(set(index.select(None, ["view"])["view"].to_pylist()))
        raise InputError(f"no view {query.view}; there are {', '.join((ANY_VIEW, ANY_SECTOR, *views))}")


def _conditions(index: FrameIndex, query: Query, target: Target | None) -> str | None:
    conditions = [f"({query.where})"] if query.where else []
    if query.where_view is not None:
        _check_view(index, query)
        conditions.append(query.where_view)
    if query.tag is not None:
        conditions.append(where_tagged(index.uri, query.tag))
    if target is not None and target.moment is not None:
        # The example itself and its neighbours in time would be the best hits
        log, t_us = target.moment
        gap_us = max(round(query.gap_s * 1e6), 1)
        near = f"t_us > {t_us - gap_us} AND t_us < {t_us + gap_us}"
        conditions.append(f"NOT (log = {quoted(log)} AND {near})")
    if query.where:
        index.count(query.where)  # Checked separately, so that the error shows the user's text
    return " AND ".join(conditions) or None


def _candidates(
    index: FrameIndex, query: Query, target: Target | None, where: str | None, limit: int | None
) -> pa.Table:
    """Return all rows, or the nearest ones by the modality of the ranking, with embeddings if needed."""
    columns = list(FACTS.names)
    if target is not None or query.diverse is not None:
        columns += ["image", "lidar", *(["joint"] if query.modality == "joint" else [])]
    if target is None or limit is None:
        return index.select(where, columns)
    # The embeddings that rank the rows: sums of logits need both, reranking begins with images
    by: tuple[str, ...] = (query.modality,)
    if query.modality == "joint" and query.rule != "features":
        by = ("image", "lidar") if query.rule == "logits" else ("image",)
    candidates = [
        index.nearest(vector, name, where, columns, limit)
        for name, vector in _vectors(target).items()
        if name in by
    ]
    return candidates[0] if len(candidates) == 1 else _without_twins(pa.concat_tables(candidates))


def _without_twins(rows: pa.Table) -> pa.Table:
    keys = zip(rows["log"].to_pylist(), rows["t_us"].to_pylist(), rows["view"].to_pylist(), strict=True)
    # The dict keeps the last entry of a key, which is the first row in this order
    first = {key: n for n, key in reversed(list(enumerate(keys)))}
    return rows.take(pa.array(sorted(first.values())))


def _rank(rows: pa.Table, query: Query, target: Target | None) -> Float[ndarray, "n"]:
    """Return the ranking score of each row. NaN excludes a row."""
    score = np.zeros(len(rows)) if target is None else _likeness(rows, query, target)
    if query.by is None:
        return score
    # Similarities and the column have different scales, so both are mixed as ranks
    wanted = _column(rows, query.by).astype(float)
    mix = query.mix if target is not None else 1.0
    return (1 - mix) * _by_rank(score) + mix * _by_rank(wanted)


def _likeness(rows: pa.Table, query: Query, target: Target) -> Float[ndarray, "n"]:
    """Return the similarity of rows to the target, by modality and rule of the query (Paper B)."""
    if query.modality != "joint" or query.rule == "features":
        return vectors_of(rows, query.modality) @ _vectors(target)[query.modality]
    if target.image is None or target.lidar is None:
        raise InputError(f"{query.rule} need an image and a sweep, and the example has one of them only")
    image, lidar = vectors_of(rows, "image") @ target.image, vectors_of(rows, "lidar") @ target.lidar
    if query.rule == "logits":  # A row with a single modality counts it twice, to be comparable
        return np.where(np.isnan(lidar), 2 * image, np.where(np.isnan(image), 2 * lidar, image + lidar))
    # NaN excludes all rows but the best by image, which are ranked by lidar
    best = np.argsort(-image, kind="stable")[: query.top * CANDIDATES_PER_HIT]
    again = np.full(len(image), np.nan)
    again[best] = lidar[best]
    return again


def _scores(rows: pa.Table, target: Target | None, query: Query) -> list[dict[str, float]]:
    """Return the cosines of each row with the target by modality.

    The joint value exists only if both modalities do. It follows the rule of the query: the mean for logits,
    and no value for reranking.
    """
    if target is None:
        return [{} for _ in range(len(rows))]
    of_rows = {name: vectors_of(rows, name) for name in ("image", "lidar")}
    vectors = _vectors(target)
    cosines = {name: of_rows[name] @ vectors[name] for name in of_rows if name in vectors}
    if query.rule == "logits" and len(cosines) == 2:
        cosines["joint"] = 0.5 * (cosines["image"] + cosines["lidar"])
    elif query.rule == "features":
        both = mean_direction(np.stack(list(of_rows.values())))
        # A sum is NaN if either part is
        both[np.isnan(of_rows["image"] + of_rows["lidar"]).any(-1)] = np.nan
        cosines["joint"] = both @ vectors["joint"]
    return [
        {name: float(values[n]) for name, values in cosines.items() if not np.isnan(values[n])}
        for n in range(len(rows))
    ]


def _vectors(target: Target) -> dict[str, ndarray]:
    """Return the unit vectors of a target by modality."""
    by_modality = {"image": target.image, "lidar": target.lidar}
    vectors = {name: vector for name, vector in by_modality.items() if vector is not None}
    return {**vectors, "joint": mean_direction(np.stack(list(vectors.values())))}


def _by_rank(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Return ranks scaled from 0 (smallest) to 1 (largest). Equal values have equal ranks, NaN stays NaN."""
    valid = ~np.isnan(values)
    out = np.full(len(values), np.nan)
    _, rank = np.unique(values[valid], return_inverse=True)
    out[valid] = rank / max(rank.max(initial=0), 1)
    return out


def _diverse(rows: pa.Table, order: list[int], score: Float[ndarray, "n"], query: Query) -> list[int]:
    """Return the diverse hits among the collapsed ones, in order of selection."""
    pool = rows.take(pa.array(order, pa.int64()))
    vectors = np.nan_to_num(vectors_of(pool, query.modality))
    worth = np.maximum(_by_rank(score[order]), SMALLEST_WORTH)
    choose = {"k-centre": k_centre, "facility": facility_location}[query.diverse or "k-centre"]
    return choose(vectors, query.top, worth)


def vectors_of(rows: pa.Table, name: str) -> Float[ndarray, "n D"]:
    """Return the embeddings of rows. Missing ones are NaN."""
    dim = rows.schema.field(name).type.list_size
    column = rows[name].combine_chunks()
    if isinstance(column, pa.ChunkedArray):
        column = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    # `values` is the flat child array without the offset of the slice, and with values below nulls
    values = column.values.to_numpy(zero_copy_only=False)
    values = values[column.offset * dim : (column.offset + len(column)) * dim].reshape(-1, dim)
    missing = ~_mask(column.is_valid())
    if missing.any():
        values = values.copy()
        values[missing] = np.nan
    return values


def _mask(column: pa.Array) -> Bool[ndarray, "n"]:
    return np.asarray(column.to_numpy(zero_copy_only=False), dtype=bool)


def _column(rows: pa.Table, name: str) -> ndarray:
    return rows[name].to_numpy()
