"""Evaluate the towers of an index: zero-shot classification, and retrieval between images and sweeps."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float

from foredrive.data.log_paths import LogPath
from foredrive.errors import InputError
from foredrive.runs.search.indexing import opened_log
from foredrive.search.embedding import embed_views, mean_direction
from foredrive.search.find import vectors_of
from foredrive.search.index import FrameIndex
from foredrive.search.objects import read_objects
from foredrive.search.prompts import (
    OBJECT_TEMPLATES,
    OBJECTS,
    PERIOD_TEMPLATES,
    PERIODS,
    WEATHER_TEMPLATES,
    WEATHERS,
)
from foredrive.search.retrieval import draw_sequences, match_rank, mean_and_interval, mean_of_groups
from foredrive.search.rows import WHOLE
from foredrive.search.towers import Towers
from foredrive.search.zero_shot import class_vectors, classify

RANKS = (1, 5, 10)
DRAWS = 1000
NIGHT = "night"


CLASSES = {
    "objects": list(OBJECTS.values()),
    "weather": list(WEATHERS.values()),
    "period": list(dict.fromkeys(PERIODS.values())),
}
"""Words of the classes of each task. All are candidates, whether the logs have them or not."""


class Share(NamedTuple):
    """A share, and its 95 % interval over logs; without bounds for a single log."""

    value: float
    low: float | None = None
    high: float | None = None


class _SensorPairs(NamedTuple):
    """Pairs of an image and a sweep, with their unit vectors."""

    image: Float[np.ndarray, "n D"]
    lidar: Float[np.ndarray, "n D"]
    logs: list[str]


def evaluate_index(index: FrameIndex, towers: Towers, moments: int) -> dict[str, Share]:
    """Return shares under "TASK.MEASURE.ARM".

    Tasks of classification are objects, weather and period, with "accuracy" over all and "class_accuracy",
    the mean over classes, by image, lidar and their joint direction. Tasks of retrieval are frames (whole
    scenes) and views, with the recall of the same moment by rank, from lidar to image and back.

    Args:
        towers: towers that made the index.
        moments: maximum number of moments whose objects are read from their logs, evenly chosen; 0: none.

    Raises:
        InputError: the index was made by other towers, or has no pair of image and sweep.
    """
    index.check_towers(towers.name, towers.fingerprint)
    columns = ["log", "folder", "maps_dir", "frame", "view", "weather", "time_of_day", "image", "lidar"]
    rows = index.select("image IS NOT NULL AND lidar IS NOT NULL", columns)
    if not len(rows):
        raise InputError(f"{index.uri}: no moment has the embeddings of both an image and a sweep")
    whole = np.array(rows["view"].to_pylist()) == WHOLE
    frames, views = rows.filter(pa.array(whole)), rows.filter(pa.array(~whole))
    shares = _retrieval("frames", _pairs_of(frames)) | _retrieval("views", _pairs_of(views))
    period, weather = views["time_of_day"].to_pylist(), views["weather"].to_pylist()
    weather = [
        name if time_of_day != NIGHT else None for name, time_of_day in zip(weather, period, strict=True)
    ]
    score = functools.partial(_classification, towers=towers)
    shares |= score("period", _pairs_of(views), [PERIODS.get(name) for name in period], PERIOD_TEMPLATES)
    shares |= score("weather", _pairs_of(views), [WEATHERS.get(name) for name in weather], WEATHER_TEMPLATES)
    if moments:
        pairs, nouns = _objects(frames, towers, moments)
        shares |= score("objects", pairs, nouns, OBJECT_TEMPLATES)
    return shares


def _pairs_of(rows: pa.Table) -> _SensorPairs:
    return _SensorPairs(vectors_of(rows, "image"), vectors_of(rows, "lidar"), rows["log"].to_pylist())


def _retrieval(task: str, pairs: _SensorPairs) -> dict[str, Share]:
    """Return the recall of each pair's other half among all, and that of random ranks."""
    ranks = {
        "lidar_to_image": match_rank(pairs.lidar, pairs.image),
        "image_to_lidar": match_rank(pairs.image, pairs.lidar),
    }
    shares = {}
    for k in RANKS:
        for arm, rank in ranks.items():
            shares[f"{task}.recall_at_{k}.{arm}"] = _share((rank <= k).astype(float), pairs.logs)
        shares[f"{task}.recall_at_{k}.chance"] = Share(min(k / len(pairs.logs), 1.0))
    return shares


def _classification(
    task: str, pairs: _SensorPairs, truth: Sequence[str | None], templates: Sequence[str], *, towers: Towers
) -> dict[str, Share]:
    """Return the accuracies of a task. Pairs without truth are left out; nothing if all are of one class."""
    classes = CLASSES[task]
    kept = [n for n, name in enumerate(truth) if name is not None]
    if len({truth[n] for n in kept}) < 2:
        return {}
    true = np.array([classes.index(str(truth[n])) for n in kept])
    logs = [pairs.logs[n] for n in kept]
    texts = class_vectors(towers, {name: (name,) for name in classes}, templates)
    image, lidar = pairs.image[kept], pairs.lidar[kept]
    vectors = {"image": image, "lidar": lidar, "joint": mean_direction(np.stack([image, lidar]))}
    shares = {}
    for arm, arm_vectors in vectors.items():
        right = (classify(torch.from_numpy(arm_vectors), texts).numpy() == true).astype(float)
        shares[f"{task}.accuracy.{arm}"] = _share(right, logs)
        shares[f"{task}.class_accuracy.{arm}"] = _share(right, logs, true)
        for number in sorted(set(true.tolist())):
            mine = true == number
            logs_of = [log for log, chosen in zip(logs, mine, strict=True) if chosen]
            shares[f"{task}.{classes[number]} ({mine.sum()}).{arm}"] = _share(right[mine], logs_of)
    for measure in ("accuracy", "class_accuracy"):
        shares[f"{task}.{measure}.chance"] = Share(1 / len(classes))
    return shares


def _share(values: Float[np.ndarray, "n"], logs: Sequence[str], group: np.ndarray | None = None) -> Share:
    """Return the mean over groups of the mean of a group, with its interval over logs."""
    names, sequence = np.unique(logs, return_inverse=True)
    drawn = draw_sequences(len(names), DRAWS, seed=0)
    means = mean_of_groups(values, np.zeros_like(sequence) if group is None else group, sequence, drawn)
    value, low, high = mean_and_interval(means)
    return Share(value, low, high) if len(names) > 1 else Share(value)


def _objects(frames: pa.Table, towers: Towers, moments: int) -> tuple[_SensorPairs, list[str | None]]:
    """Embed the objects of evenly chosen moments; return them with the words of their classes."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(moments, len(frames))).round().astype(int))
    vectors, logs, nouns = [], [], []
    for row in frames.select(["log", "folder", "maps_dir", "frame"]).take(pa.array(chosen)).to_pylist():
        log = opened_log(LogPath(Path(row["folder"]), Path(row["maps_dir"])))
        objects = [
            object_view
            for object_view in read_objects(log, row["frame"], towers.image_side_px)
            if object_view.category in OBJECTS
        ]
        if objects:
            vectors.append(embed_views(towers, [object_view.view for object_view in objects]))
            logs += [row["log"]] * len(objects)
            nouns += [OBJECTS[object_view.category] for object_view in objects]
    pairs = np.concatenate(vectors) if vectors else np.zeros((0, 2, towers.dim), np.float32)
    return _SensorPairs(pairs[:, 0], pairs[:, 1], logs), list(nouns)
