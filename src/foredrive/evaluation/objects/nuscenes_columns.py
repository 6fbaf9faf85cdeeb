"""Columns of boxes in nuScenes' format. Each function names the first box that is wrong."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.evaluation.detections.frames import read_number_rows
from foredrive.scene.boxes import UNKNOWN, Attribute

Box = Mapping[str, Any]


def read_labels(
    boxes: Sequence[Box],
    keys: Sequence[str],
    classes: Sequence[str],
    others: Collection[str],
    names: Sequence[str],
) -> Int[ndarray, "n"]:
    """Return the index of each box's class, from the first of `keys` that it has; -1 for one of `others`."""
    number = {**dict.fromkeys(others, -1), **{name: n for n, name in enumerate(classes)}}
    label = np.zeros(len(boxes), np.int64)
    for n, box in enumerate(boxes):
        name = next((box[key] for key in keys if key in box), None)
        if not isinstance(name, str):
            raise InputError(f"{names[n]} has no {keys[0]}")
        if name not in number:
            raise InputError(f"{names[n]} has the unknown class {name!r}; there are: {', '.join(classes)}")
        label[n] = number[name]
    return label


def read_texts(boxes: Sequence[Box], key: str, names: Sequence[str]) -> list[str]:
    """Return the texts, or whole numbers as texts, that boxes have under `key`."""
    texts = [box.get(key) for box in boxes]
    for n, text in enumerate(texts):
        if not isinstance(text, str | int) or text == "":
            raise InputError(f"{names[n]} has no {key}")
    return [str(text) for text in texts]


def read_scores(
    boxes: Sequence[Box], key: str, names: Sequence[str], *, only_ranks: bool
) -> Float[ndarray, "n"]:
    """Return scores, all in [0, 1] unless they only rank."""
    score = read_number_rows(boxes, key, 1, names)[:, 0]
    wrong = np.flatnonzero(~((score >= 0) & (score <= 1)) & (not only_ranks))
    if len(wrong):
        raise InputError(f"{names[int(wrong[0])]} has the {key} {score[wrong[0]]:g}, which is not in [0, 1]")
    return score


def read_velocities(boxes: Sequence[Box], names: Sequence[str]) -> Float[ndarray, "n 2"]:
    """Return velocities over ground, m/s. NaN, null, or no `velocity` at all: unknown."""
    known = [n for n, box in enumerate(boxes) if _states_velocity(box.get("velocity"))]
    velocity = np.full((len(boxes), 2), np.nan)
    velocity[known] = read_number_rows([boxes[n] for n in known], "velocity", 2, _Chosen(names, known))
    return velocity


def _states_velocity(value: object) -> bool:
    """Return whether a velocity is stated: neither missing nor NaN, which is what the devkit writes."""
    if value is None:
        return False
    return not (isinstance(value, list | tuple) and any(each is None or each != each for each in value))


def read_attributes(boxes: Sequence[Box], names: Sequence[str]) -> Int[ndarray, "n"]:
    """Return indices of attributes; `UNKNOWN` for the empty name, or none."""
    number = {"": int(UNKNOWN), **{each.label: int(each) for each in Attribute}}
    stated = [box.get("attribute_name", "") for box in boxes]
    for n, name in enumerate(stated):
        if name not in number:
            raise InputError(f"{names[n]} has the unknown attribute_name {name!r}")
    return np.array([number[name] for name in stated], dtype=np.int64)


def read_points(boxes: Sequence[Box], names: Sequence[str]) -> Int[ndarray, "n"]:
    """Return the numbers of points that boxes state."""
    stated = [{"num_pts": box.get("num_pts", UNKNOWN)} for box in boxes]
    return read_number_rows(stated, "num_pts", 1, names)[:, 0].astype(np.int64)


class _Chosen(Sequence[str]):
    """Some of the names of boxes, by their numbers."""

    def __init__(self, names: Sequence[str], numbers: Sequence[int]) -> None:
        self._names, self._numbers = names, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: Any) -> Any:
        return self._names[int(self._numbers[index])]
