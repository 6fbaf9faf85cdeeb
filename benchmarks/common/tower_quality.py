"""Retrieval quality of towers on views that they were not trained on."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.errors import InputError
from foredrive.runs.search.sector_views import LogViews, ViewRow
from foredrive.scene import LidarSweep
from foredrive.search.embedding import mean_direction
from foredrive.search.facts import EMPTY, NOUNS
from foredrive.search.phrases import SETTINGS
from foredrive.search.towers import Towers, embed_prompt, unit
from foredrive.search.zero_shot import class_vectors, classify

LEAST_SHARE, MOST_SHARE = 0.01, 0.6
"""Minimum and maximum share of views with a fact; outside, chance alone would decide the result."""
QUERIES = {
    **{noun: f"a {noun}" for noun in NOUNS.values()},
    **{f"near {noun}": f"a {noun} close by" for noun in NOUNS.values()},
    **{f"crossing {noun}": f"a {noun} crossing the road" for noun in NOUNS.values()},
    **{f"oncoming {noun}": f"an oncoming {noun}" for noun in NOUNS.values()},
    **{f"many {noun}": f"many {noun}s" for noun in NOUNS.values()},
    **{fact: texts[0] for fact, texts in SETTINGS.items()},
    EMPTY: "nobody around",
}
"""The query of each fact."""
KINDS = ("time_of_day", "weather", "place")
"""Facts for zero-shot classification, if the views have at least two of the classes."""


def judge_towers(views: Sequence[LogViews], towers: Towers) -> dict[str, float]:
    """Return the mean average precision of all queries and the zero-shot accuracy, by modality.

    "map_chance" is the value of random ranks; "map_image" and the others are those of the towers.

    Raises:
        InputError: no fact separates the views.
    """
    rows = [row for log in views for row in log.rows]
    vectors = embed_all(views, towers)
    truths = {fact: np.array([fact in row.facts.facts for row in rows]) for fact in QUERIES}
    asked = {fact: true for fact, true in truths.items() if LEAST_SHARE <= true.mean() <= MOST_SHARE}
    if not asked:
        raise InputError("these views have no fact in which they differ: nothing can be asked of them")
    figures = {"views": float(len(rows)), "queries": float(len(asked))}
    figures["map_chance"] = float(np.mean([true.mean() for true in asked.values()]))
    texts = {fact: embed_prompt(towers, QUERIES[fact]).numpy() for fact in asked}
    for modality, found in vectors.items():
        scores = [average_precision(found @ texts[fact], true) for fact, true in asked.items()]
        figures[f"map_{modality}"] = float(np.mean(scores))
        figures |= {f"ap_{modality}.{fact}": score for fact, score in zip(asked, scores, strict=True)}
        figures |= {f"{kind}_{modality}": share for kind, share in _named(rows, found, towers).items()}
    return figures


def average_precision(scores: Float[np.ndarray, "n"], true: Bool[np.ndarray, "n"]) -> float:
    """Return the average precision: the mean precision at the ranks of the true items."""
    ranked = true[np.argsort(-scores, kind="stable")]
    return float((np.cumsum(ranked) / np.arange(1, len(ranked) + 1))[ranked].mean())


def _named(rows: Sequence[ViewRow], found: Float[np.ndarray, "n D"], towers: Towers) -> Mapping[str, float]:
    """Return the mean over classes of the share that is classified correctly."""
    out = {}
    for kind in KINDS:
        labels = [getattr(row.facts, kind) for row in rows]
        classes = {name: SETTINGS[name] for name in sorted({name for name in labels if name is not None})}
        if len(classes) < 2:
            continue
        chosen = classify(torch.from_numpy(found), class_vectors(towers, classes)).numpy()
        right = [np.mean(chosen[[name == want for name in labels]] == n) for n, want in enumerate(classes)]
        out[f"named_{kind}"] = float(np.mean(right))
    return out


def embed_all(views: Sequence[LogViews], towers: Towers) -> dict[str, Float[np.ndarray, "n D"]]:
    """Return the unit vectors of all views by modality."""
    images = []
    for log in views:
        found = torch.zeros(len(log), towers.dim)
        for rows, those in log.images_by_view():
            found[rows] = towers.embed_images(those)
        images.append(found)
    vectors = {"image": unit(torch.cat(images)).numpy()}
    if towers.has_lidar:
        sweeps = [towers.embed_sweeps(_sweep(log.points(row))) for log in views for row in range(len(log))]
        vectors["lidar"] = unit(torch.cat([found for found in sweeps if found is not None])).numpy()
        vectors["joint"] = mean_direction(np.stack([vectors["image"], vectors["lidar"]]))
    return vectors


def _sweep(points: Float[Tensor, "P 4"]) -> LidarSweep:
    """Return the returns as one sweep of beams from the origin."""
    range_m = points[:, :3].norm(dim=-1)
    count = len(points)
    return LidarSweep(
        origin_ego=torch.zeros(1, count, 3),
        dir_ego=(points[:, :3] / range_m.clamp(min=1e-6)[:, None])[None],
        range_m=range_m[None],
        returned=torch.ones(1, count, dtype=torch.bool),
        intensity=points[None, :, 3],
        dt_s=torch.zeros(1, count),
        beam=torch.full((1, count), -1),
        valid=torch.ones(1, count, dtype=torch.bool),
    )
