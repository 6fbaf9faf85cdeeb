"""Retrieval quality of towers by kind of query and by weather, with confidence intervals over drives."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from benchmarks.common.tower_quality import MOST_SHARE, QUERIES, embed_all
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.data.setting import Place
from foredrive.runs.search.sector_views import LogViews, ViewRow
from foredrive.search.facts import MANY, NOUNS
from foredrive.search.find import collapse
from foredrive.search.phrases import SETTINGS
from foredrive.search.retrieval import draw_sequences, mean_and_interval
from foredrive.search.towers import Towers, embed_prompt
from foredrive.search.zero_shot import class_vectors, classify

RANKS = (1, 10, 100)
KIND_RANK = 10
"""The rank that is reported for each kind of query."""
GAP_S = 5.0
"""Moments of one drive that are closer than this count as one hit, s."""
DRAWS = 1000
LEAST_ANSWERS = 3
"""Minimum number of possible hits of a query; a query with fewer is not used."""
WEATHERS = {
    "clear": ("by day in clear weather", "on a sunny day"),
    **{name: SETTINGS[name] for name in ("night", "rain", "fog")},
}
"""Weather of whole drives, with its names in texts: clear is by day, night has dry roads and clear air."""
THINGS = ("car", "truck", "cyclist", "pedestrian", "crossing pedestrian")
"""Objects that are also queried under one of the other weathers."""
MODALITIES = ("image", "lidar", "joint", "joint_logits", "chance")
"""Modalities. Joint uses the sum of features; joint_logits uses the sum of logits with a text for each
modality (LidarCLIP, 4.2).
"""
ALL, EVERY = "all", "every"


class Ranking(NamedTuple):
    """Hits of S sequences for one query, without those close to a better one.

    Rows are padded to the H hits of the longest with a score of -inf.
    """

    score: Float[np.ndarray, "S H"]
    true: Bool[np.ndarray, "S H"]
    """True if the hit fits the query."""
    could: Int[np.ndarray, "S"]
    """Maximum number of true hits of a sequence."""


def precision_at(
    ranking: Ranking, drawn: Int[np.ndarray, "B S"], ranks: Sequence[int]
) -> Float[np.ndarray, "B K"]:
    """Return P@K = true hits among the best K / min(K, hits that could be true), of each draw of sequences.

    A sequence drawn twice counts as two. NaN where no hit could be true.
    """
    score, true = (of[drawn].reshape(len(drawn), -1) for of in (ranking.score, ranking.true))
    order = np.argsort(-score, axis=1, kind="stable")[:, : max(ranks)]
    hits = np.take_along_axis(true, order, axis=1).cumsum(axis=1)
    could = ranking.could[drawn].sum(axis=1)
    found = [hits[:, min(rank, hits.shape[1]) - 1] / np.minimum(rank, could).clip(min=1) for rank in ranks]
    return np.where((could > 0)[:, None], np.stack(found, axis=1), np.nan)


class Question(NamedTuple):
    """A text, and the facts of the views that match it."""

    kind: str
    """Kind of query: thing, manner, number, place, conditions, or composed (a thing under conditions)."""
    text: str
    lidar_text: str
    """The text for sweeps, which show no light, if each modality has its own text."""
    facts: frozenset[str]


class Judged(NamedTuple):
    """Views with their known facts and their unit vectors."""

    rows: list[ViewRow]
    t_us: Int[np.ndarray, "n"]
    vectors: Mapping[str, Float[np.ndarray, "n D"]]
    """Unit vectors by modality: image, lidar, joint."""

    @classmethod
    def of_logs(cls, logs: Sequence[LogPath], views: Sequence[LogViews], towers: Towers) -> "Judged":
        """Return all views of some logs; `views` is the result of `gather_views` for them."""
        t_us = [
            Log(path).t_us[[row.frame for row in mine.rows]] for path, mine in zip(logs, views, strict=True)
        ]
        return cls([row for log in views for row in log.rows], np.concatenate(t_us), embed_all(views, towers))


def questions() -> list[Question]:
    """Return queries for single facts, and for things under conditions."""
    single = [Question(_kind_of(fact), text, text, frozenset({fact})) for fact, text in QUERIES.items()]
    return single + [
        Question(
            "composed",
            f"{QUERIES[thing]} {WEATHERS[weather][0]}",
            QUERIES[thing],
            frozenset({thing, weather}),
        )
        for weather in list(WEATHERS)[1:]
        for thing in THINGS
    ]


def judge_retrieval(judged: Judged, towers: Towers) -> dict[str, dict[str, float]]:
    """Return P@K by modality under "pool.kind.p_at_K", and its 95 % interval under "..._low" and "..._high".

    Pools are the drives of one weather, and all drives. Of all drives, the kinds of `Question` have P@10 too,
    beside all queries with P@1, P@10 and P@100. The interval resamples drives. "_above_image" is the
    difference to the image tower, over the same resampled drives.
    """
    logs = [row.log for row in judged.rows]
    drives = sorted(set(logs))
    drive = np.array([drives.index(log) for log in logs])
    weather = np.array([weather_of(judged.rows[logs.index(name)]) for name in drives])
    asked = [(question, _rankings(question, judged, drive, towers)) for question in questions()]
    out: dict[str, dict[str, float]] = {modality: {} for modality in MODALITIES}
    for pool in (ALL, *WEATHERS):
        chosen = np.flatnonzero((weather == pool) | (pool == ALL))
        if not len(chosen):
            continue
        kept = [each for each in asked if _fits(*each, pool, judged, np.isin(drive, chosen), chosen)]
        if kept:
            drawn = chosen[draw_sequences(len(chosen), DRAWS, seed=0)]
            for modality, figures in _pooled(kept, drawn, by_kind=pool == ALL).items():
                out[modality] |= {f"{pool}.{name}": value for name, value in figures.items()}
    return out


def judge_naming(judged: Judged, towers: Towers) -> dict[str, dict[str, float]]:
    """Return by modality "zero_shot_accuracy" with its interval, and by weather.

    It is the mean over drives of the share of views whose weather is classified correctly
    (`search.zero_shot`).
    """
    classes, names = class_vectors(towers, WEATHERS), list(WEATHERS)
    logs = np.array([row.log for row in judged.rows])
    weather = {row.log: weather_of(row) for row in judged.rows}
    drawn = draw_sequences(len(weather), DRAWS, seed=0)
    out = {}
    for modality, vectors in judged.vectors.items():
        named = classify(torch.from_numpy(vectors), classes).numpy()
        right = np.array([np.mean(named[logs == log] == names.index(true)) for log, true in weather.items()])
        figures = _with_bounds("zero_shot_accuracy", right[drawn].mean(axis=1))
        for name in names:
            mine = [true == name for true in weather.values()]
            if any(mine):
                figures[f"{name}.zero_shot_accuracy"] = float(right[mine].mean())
        out[modality] = figures
    return out


def weather_of(row: ViewRow) -> str:
    """Return the weather of a row, a key of `WEATHERS`."""
    if row.facts.weather in ("rain", "fog"):
        return row.facts.weather
    return "night" if row.facts.time_of_day == "night" else "clear"


def _kind_of(fact: str) -> str:
    if fact in NOUNS.values():
        return "thing"
    if fact in SETTINGS:
        return "place" if fact in set(Place) else "conditions"
    return "number" if fact.startswith(MANY) else "manner"


def _rankings(
    question: Question, judged: Judged, drive: Int[np.ndarray, "n"], towers: Towers
) -> dict[str, Ranking]:
    """Return a query's ranking for each modality."""
    text, lidar_text = (embed_prompt(towers, words).numpy() for words in (question.text, question.lidar_text))
    scores = {modality: vectors @ text for modality, vectors in judged.vectors.items()}
    scores["joint_logits"] = scores["image"] + judged.vectors["lidar"] @ lidar_text
    scores["chance"] = np.random.default_rng(0).random(len(drive))
    true = _true_of(question, judged)
    answers = _kept(np.where(true, 0.0, np.nan), drive, judged.t_us)
    could = np.bincount(drive[answers], minlength=drive.max() + 1)
    return {modality: _ranking(scores[modality], true, could, drive, judged.t_us) for modality in MODALITIES}


def _ranking(
    score: Float[np.ndarray, "n"],
    true: Bool[np.ndarray, "n"],
    could: Int[np.ndarray, "S"],
    drive: Int[np.ndarray, "n"],
    t_us: Int[np.ndarray, "n"],
) -> Ranking:
    kept = _kept(score, drive, t_us)
    by_drive = [[row for row in kept if drive[row] == number] for number in range(len(could))]
    longest = max(map(len, by_drive))
    scores = np.full((len(could), longest), -np.inf)
    hits = np.zeros((len(could), longest), dtype=bool)
    for number, rows in enumerate(by_drive):
        scores[number, : len(rows)], hits[number, : len(rows)] = score[rows], true[rows]
    return Ranking(scores, hits, could)


def _kept(
    score: Float[np.ndarray, "n"], drive: Int[np.ndarray, "n"], t_us: Int[np.ndarray, "n"]
) -> list[int]:
    """Return the rows that have no better row of their drive within `GAP_S`."""
    return collapse(score, [str(number) for number in drive], t_us, GAP_S, len(score))


def _true_of(question: Question, judged: Judged) -> Bool[np.ndarray, "n"]:
    return np.array([question.facts <= row.facts.facts for row in judged.rows])


def _fits(
    question: Question,
    rankings: Mapping[str, Ranking],
    pool: str,
    judged: Judged,
    inside: Bool[np.ndarray, "n"],
    chosen: Int[np.ndarray, "s"],
) -> bool:
    """Return whether a query can be evaluated on a pool."""
    if pool != ALL and question.kind in ("conditions", "composed"):
        return False
    share = _true_of(question, judged)[inside].mean()
    return bool(share <= MOST_SHARE and rankings["image"].could[chosen].sum() >= LEAST_ANSWERS)


def _pooled(
    kept: Sequence[tuple[Question, Mapping[str, Ranking]]], drawn: Int[np.ndarray, "B s"], *, by_kind: bool
) -> dict[str, dict[str, float]]:
    """Return the metrics of one pool by modality."""
    kinds = np.array([question.kind for question, _ in kept])
    found = {
        modality: np.stack([precision_at(rankings[modality], drawn, RANKS) for _, rankings in kept])
        for modality in MODALITIES
    }
    out = {}
    for modality, values in found.items():
        figures: dict[str, float] = {}
        for kind in (EVERY, *(sorted(set(kinds)) if by_kind else ())):
            mine = (kinds == kind) | (kind == EVERY)
            figures[f"{kind}.questions"] = float(mine.sum())
            means, by_image = _mean(values[mine]), _mean(found["image"][mine])
            for n, rank in enumerate(RANKS):
                if kind != EVERY and rank != KIND_RANK:
                    continue
                figures |= _with_bounds(f"{kind}.p_at_{rank}", means[:, n])
                if kind == EVERY and modality != "image":
                    figures |= _with_bounds(f"{kind}.p_at_{rank}_above_image", means[:, n] - by_image[:, n])
        out[modality] = figures
    return out


def _mean(values: Float[np.ndarray, "Q B K"]) -> Float[np.ndarray, "B K"]:
    """Return the mean over the queries with an answer in a resample; NaN if there are none."""
    there = ~np.isnan(values)
    count = there.sum(axis=0)
    return np.where(count > 0, np.where(there, values, 0).sum(axis=0) / count.clip(min=1), np.nan)


def _with_bounds(name: str, values: Float[np.ndarray, "B"]) -> dict[str, float]:
    value, low, high = mean_and_interval(values)
    return {name: value, f"{name}_low": low, f"{name}_high": high}
