"""Seeded drives of boxes and tracks, the same for the oracles and for our code."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from foredrive.scene.boxes import Attribute
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES

Box = dict[str, Any]
SHARES = np.array([493, 88, 16, 25, 15, 220, 13, 12, 98, 152]) / 1132
"""Shares of the annotations of nuScenes' training and validation logs, by class (www.nuscenes.org)."""
ATTRIBUTES = sorted(each.label for each in Attribute)
RACK = "static_object.bicycle_rack"


@dataclass(frozen=True)
class Drives:
    """Boxes by sample token, in nuScenes' format but for `name` and `score`."""

    scene_of: dict[str, int] = field(default_factory=dict)
    timestamp: dict[str, int] = field(default_factory=dict)
    ego: dict[str, list[float]] = field(default_factory=dict)
    truth: dict[str, list[Box]] = field(default_factory=dict)
    racks: dict[str, list[Box]] = field(default_factory=dict)
    detections: dict[str, list[Box]] = field(default_factory=dict)
    tracks: dict[str, list[Box]] = field(default_factory=dict)


@dataclass(frozen=True)
class Size:
    """Size of the drives."""

    scenes: int = 3
    frames: int = 12
    objects: int = 30
    """Number of objects of a scene."""
    false: int = 10
    """Largest number of false boxes of a frame."""
    false_frames: int = 1000
    """Frames in which a false track keeps its identity."""
    shares: bool = False
    """True: classes are as frequent as in nuScenes (`SHARES`). False: all alike."""
    reach_m: float = 60.0
    """Objects are at most this far from the start, along each axis."""


def make_drives(seed: int, size: Size = Size(), *, ties: bool = True) -> Drives:
    """Objects that move straight on, seen with gaps, noise, switches of identity, and false boxes.

    With `ties`, scores are rounded to tenths, so that many are equal.
    """
    rng, drives = np.random.default_rng(seed), Drives()
    for scene in range(size.scenes):
        _add_scene(drives, scene, size, rng)
    for token, found in drives.detections.items():
        if ties:
            found = [{**box, "score": round(box["score"], 1)} for box in found]
        drives.detections[token] = found
        drives.tracks[token] = list({box["tracking_id"]: box for box in found}.values())
    return drives


def _add_scene(drives: Drives, scene: int, size: Size, rng: np.random.Generator) -> None:
    n, reach = size.objects, size.reach_m
    start = np.array([*rng.uniform(200, 1500, 2), 0.0])
    shares = SHARES if size.shares else None
    names = [str(name) for name in rng.choice(DETECTION_CLASSES, n, p=shares)]
    place = start + np.c_[rng.uniform(-reach, reach, (n, 2)), rng.normal(1, 0.3, n)]
    speed, lwh = rng.normal(0, 4, (n, 2)), rng.uniform(0.5, 5, (n, 3))
    yaw, sure = rng.uniform(-math.pi, math.pi, n), np.clip(rng.beta(3, 2, n), 0.02, 0.98)
    identity = [f"track{scene}_{k}" for k in range(n)]
    birth, death = rng.integers(0, size.frames // 2, n), rng.integers(size.frames // 2, size.frames + 1, n)
    for f in range(size.frames):
        token = f"s{scene}f{f}"
        ego = start + np.array([3.0 * f, 1.0 * f, 0.0])
        drives.scene_of[token], drives.ego[token] = scene, ego.tolist()
        drives.timestamp[token] = 10**9 * (scene + 1) + 500_000 * f + int(rng.integers(-20_000, 20_000))
        if rng.random() < 0.2:
            k = int(rng.integers(n))
            identity[k] = f"again{scene}_{k}_{f}"
        there = place + np.c_[speed * 0.5 * f, np.zeros(n)]
        true = drives.truth[token] = []
        found = drives.detections[token] = []
        for k in np.flatnonzero((birth <= f) & (f < death)).tolist():
            box = _box(token, there[k], ego, lwh[k], yaw[k], speed[k], names[k])
            more = {"num_pts": int(rng.integers(0, 6)), "attribute_name": _attribute(rng, names[k], 0.1)}
            true.append({**box, **more, "tracking_id": f"true{scene}_{k}"})
            for _ in range(int(rng.choice([0, 1, 2], p=[0.25, 0.65, 0.1]))):
                at, turn = there[k] + rng.normal(0, [0.7, 0.7, 0.2]), rng.normal(0, 0.5)
                box = _box(
                    token, at, ego, lwh[k] * rng.uniform(0.8, 1.2, 3), yaw[k] + turn,
                    speed[k] + rng.normal(0, 1, 2), names[k],
                )  # fmt: skip
                found.append(_found(rng, box, sure[k] + rng.normal(0, 0.1), identity[k]))
        for k in range(int(rng.integers(0, size.false + 1))):
            name, at = (
                str(rng.choice(DETECTION_CLASSES, p=shares)),
                ego + np.array([*rng.uniform(-reach, reach, 2), 1.0]),
            )
            box = _box(token, at, ego, rng.uniform(0.5, 5, 3), rng.uniform(-3, 3), rng.normal(0, 3, 2), name)
            false = f"false{scene}_{k}_{name}_{f // size.false_frames}"
            found.append(_found(rng, box, rng.beta(1, 3), false))
        offsets = np.pad(rng.uniform(-30, 30, (int(rng.integers(0, 3)), 2)), ((0, 0), (0, 1)))
        drives.racks[token] = [
            _box(token, at, ego, rng.uniform(4, 15, 3), 0.3, speed[0], RACK) for at in ego + offsets
        ]


def _found(rng: np.random.Generator, box: Box, score: float, identity: str) -> Box:
    more = {"score": float(np.clip(score, 0, 1)), "attribute_name": _attribute(rng, box["name"], 0.2)}
    return {**box, **more, "tracking_id": identity}


def _attribute(rng: np.random.Generator, name: str, none: float) -> str:
    kind = {"pedestrian": "pedestrian", "bicycle": "cycle", "motorcycle": "cycle"}.get(name, "vehicle")
    if name in ("traffic_cone", "barrier") or rng.random() < none:
        return ""
    return str(rng.choice([each for each in ATTRIBUTES if each.startswith(kind + ".")]))


def _box(
    token: str,
    at: np.ndarray,
    ego: np.ndarray,
    size_wlh: np.ndarray,
    yaw: float,
    speed: np.ndarray,
    name: str,
) -> Box:
    return {
        "sample_token": token,
        "translation": np.round(at, 3).tolist(),
        "size": np.round(size_wlh, 3).tolist(),
        "rotation": [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)],
        "velocity": np.asarray(speed).tolist(),
        "ego_translation": (np.round(at, 3) - ego).tolist(),
        "name": name,
    }


def detection_boxes(boxes: list[Box]) -> list[Box]:
    """Boxes of the detection task, in nuScenes' format."""
    return [_named(box, "detection") for box in boxes]


def tracking_boxes(boxes: list[Box], names: tuple[str, ...]) -> list[Box]:
    """Boxes of some classes for the tracking task, in nuScenes' format."""
    return [_named(box, "tracking") for box in boxes if box["name"] in names]


def _named(box: Box, task: str) -> Box:
    rest = {key: value for key, value in box.items() if key not in ("name", "score")}
    return {**rest, f"{task}_name": box["name"], f"{task}_score": float(box.get("score", -1.0))}


def truth_file(drives: Drives) -> dict[str, Any]:
    """Ground truth in our format: boxes, racks, and the scene, time and ego vehicle of each sample."""
    boxes = {token: detection_boxes(each + drives.racks[token]) for token, each in drives.truth.items()}
    samples = {
        token: {
            "scene_token": f"scene{scene}",
            "timestamp": drives.timestamp[token],
            "ego_translation": drives.ego[token],
        }
        for token, scene in drives.scene_of.items()
    }
    return {"results": boxes, "samples": samples}
