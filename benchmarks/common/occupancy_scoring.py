"""Occupancy under every protocol: the time of RayIoU, and what one synthetic prediction scores under each.

Scenes are streets of boxes, walls and ground. A prediction has the same objects, moved by up to a voxel or
two, some of them missing, of another class or made up. A second prediction is equal wherever a camera sees,
and occupied behind what it sees, as a model becomes that is trained under the camera mask.
"""

import operator
import time
from collections.abc import Iterator
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from foredrive.data.beam_casting import FREE, cast_beams
from foredrive.ops import voxel_rays
from foredrive.tasks.occupancy.instances_metric import InstanceCounts, count_instances
from foredrive.tasks.occupancy.protocols import (
    GRID,
    OCC3D_CLASSES,
    OPENOCC_CLASSES,
    RAY_PROTOCOLS,
    UNIAD_INSTANCES,
    VOXEL_PROTOCOLS,
    RayProtocol,
)
from foredrive.tasks.occupancy.score import (
    RayCounts,
    Seen,
    cast_rays,
    count_rays,
    count_voxels,
    lidar_rays,
    mean_iou,
    score_rays,
    voxel_ious,
)

FRAMES, PLAIN_FRAMES, TABLE_FRAMES, SAMPLES = 100, 1, 12, 40
OBJECTS = 45
FILLED_VOXELS = 4
"""Depth behind seen surfaces to which the second prediction is occupied."""
CAMERA_M = np.array([1.0, 0.0, 1.6])
LIDAR_M = np.array([0.943713, 0.0, 1.84023])


class Thing(NamedTuple):
    """A box of voxels."""

    low: np.ndarray
    """First voxel, x y z."""
    size: np.ndarray
    label: int
    velocity_mps: tuple[float, float]


def street(rng: np.random.Generator, classes: tuple[str, ...]) -> list[Thing]:
    """Draw the objects of a scene: walls on either side, and things on the road between them."""
    index = {name: n for n, name in enumerate(classes)}
    things = []
    for side in (0, 185):
        for x in range(0, 200, 20):
            size = np.array([rng.integers(12, 21), rng.integers(8, 15), rng.integers(8, 14)])
            label = index["manmade" if rng.random() < 0.6 else "vegetation"]
            things.append(Thing(np.array([x, side, 2]), size, label, (0.0, 0.0)))
    kinds = {
        "car": ((11, 5, 4), 25),
        "truck": ((20, 7, 8), 6),
        "pedestrian": ((2, 2, 4), 8),
        "bicycle": ((5, 2, 4), 3),
        "barrier": ((2, 6, 3), 3),
    }
    for name, (extent, number) in kinds.items():
        for _ in range(number):
            low = np.array([*rng.integers([0, 20], [185, 170]), 2])
            speed = 0.0 if name == "barrier" else float(rng.choice([0.0, 6.0]))
            things.append(Thing(low, np.array(extent), index[name], (speed, 0.0)))
    return things


def guessed(things: list[Thing], rng: np.random.Generator, classes: int) -> list[Thing]:
    """Move, drop, rename and add things, as a detector of middling quality does."""
    out = []
    for thing in things:
        chance = rng.random()
        if chance < 0.12:
            continue
        label = int(rng.integers(0, 8)) if chance < 0.2 else thing.label
        moved = np.round(rng.normal(0, [1.2, 0.7, 0.3])).astype(int)
        velocity = (thing.velocity_mps[0] + float(rng.normal(0, 0.6)), float(rng.normal(0, 0.2)))
        out.append(Thing(thing.low + moved, thing.size, label, velocity))
    for _ in range(3):
        out.append(
            Thing(
                np.array([*rng.integers(20, 170, 2), 2]), np.array([8, 4, 4]), int(rng.integers(0, 8)), (0, 0)
            )
        )
    return out


def filled(things: list[Thing], classes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return labels [Z Y X] and velocities [Z Y X 2] of things on a flat road."""
    labels = np.full(GRID.shape_zyx, len(classes) - 1, np.uint8)
    labels[:2] = classes.index("driveable_surface")
    velocity = np.zeros((*GRID.shape_zyx, 2), np.float32)
    for low, size, label, velocity_mps in things:
        (x, y, z), (x_end, y_end, z_end) = np.maximum(low, 0), np.maximum(low + size, 0)
        labels[z:z_end, y:y_end, x:x_end] = label
        velocity[z:z_end, y:y_end, x:x_end] = velocity_mps
    return labels, velocity


def rays_from(places_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return start and direction of RayIoU's rays, in voxels."""
    start = np.repeat((places_m - GRID.lower_m) / GRID.voxel_m, len(lidar_rays()), axis=0)
    return start, np.tile(lidar_rays().astype(np.float64), (len(places_m), 1))


def seen_from(places_m: np.ndarray, labels: np.ndarray, free: int) -> np.ndarray:
    """Return the voxels that rays from some places cross, or in which they end."""
    state = np.zeros(GRID.shape_zyx, np.uint8)
    start, direction = rays_from(places_m)
    ends = voxel_rays.first_hits(start, direction, labels != free)
    cast_beams(start, start + direction * ends.distance[:, None], np.ones(len(start)), state)
    seen = state == FREE
    seen.reshape(-1)[ends.voxel[ends.voxel >= 0]] = True
    return seen


class Frame(NamedTuple):
    """Truth, masks and two predictions of a frame."""

    true: np.ndarray
    true_mps: np.ndarray
    camera: np.ndarray
    lidar: np.ndarray
    predicted: np.ndarray
    predicted_mps: np.ndarray
    thick: np.ndarray
    """The prediction, occupied behind what a camera sees."""


def places(rng: np.random.Generator) -> np.ndarray:
    """Return eight places of the lidar along a drive."""
    x = np.linspace(-35.0, 35.0, 8) + rng.uniform(-2, 2)
    return LIDAR_M + np.stack([x, 0.3 * rng.normal(size=8), np.zeros(8)], axis=1)


def frames(rng: np.random.Generator, number: int, classes: tuple[str, ...]) -> Iterator[Frame]:
    """Yield frames. What neither lidar nor camera has seen is free in the truth, as in Occ3D's."""
    free = len(classes) - 1
    for _ in range(number):
        things = street(rng, classes)
        solid, true_mps = filled(things, classes)
        lidar = seen_from(places(rng), solid, free)
        true = np.where(lidar, solid, free).astype(np.uint8)
        camera = seen_from(CAMERA_M[None], true, free) & lidar
        predicted, predicted_mps = filled(guessed(things, rng, len(classes)), classes)
        distance, (z, y, x) = distance_transform_edt(predicted == free, return_indices=True)
        behind = ~camera & (distance <= FILLED_VOXELS)
        thick = np.where(behind, predicted[z, y, x], predicted)
        yield Frame(true, true_mps, camera, lidar, predicted, predicted_mps, thick)


def rayiou_speed(seed: int) -> dict[str, float]:
    """Return the time of RayIoU of 100 frames, of one with the plain NumPy walk × 100, and their ratio."""
    rng = np.random.default_rng(seed)
    classes, protocol = OCC3D_CLASSES, RAY_PROTOCOLS["occ3d"]
    free = len(classes) - 1
    pairs = [
        tuple(filled(each, classes)[0] for each in (things, guessed(things, rng, len(classes))))
        for things in (street(rng, classes) for _ in range(FRAMES))
    ]
    origins = [places(rng) for _ in range(FRAMES)]

    def rayiou(count: int) -> float:
        counts = [
            count_rays(cast_rays(o, predicted, free), cast_rays(o, true, free), protocol)
            for o, (true, predicted) in zip(origins[:count], pairs, strict=False)
        ]
        return score_rays(reduce(operator.add, counts), protocol).rayiou

    rayiou(1)  # compiles
    started = time.perf_counter()
    found = rayiou(FRAMES)
    fast_s = time.perf_counter() - started
    started = time.perf_counter()
    for o, pair in zip(origins[:PLAIN_FRAMES], pairs, strict=False):
        for labels in pair:
            voxel_rays.first_hits_reference(*rays_from(o), labels != free)
    plain_s = (time.perf_counter() - started) * FRAMES / PLAIN_FRAMES
    return {
        "rayiou_100_frames_s": fast_s,
        "rayiou_plain_100_frames_s": plain_s,
        "rayiou_speedup": plain_s / fast_s,
        "rayiou": found,
        "threads": torch.get_num_threads(),
    }


def protocols_compared(seed: int) -> dict[str, float]:
    """Return what the two predictions score under every protocol: keys PREDICTION.PROTOCOL.FIGURE."""
    rng = np.random.default_rng(seed)
    figures: dict[str, float] = {}
    for classes in (OCC3D_CLASSES, OPENOCC_CLASSES):
        figures |= _voxels_compared(list(frames(rng, TABLE_FRAMES, classes)), classes, rng)
    return figures | _instances_compared(rng)


def _voxels_compared(
    drawn: list[Frame], classes: tuple[str, ...], rng: np.random.Generator
) -> dict[str, float]:
    figures: dict[str, float] = {}
    origins = [places(rng) for _ in drawn]
    for name in ("predicted", "thick"):
        counts = [
            count_voxels(getattr(frame, name), frame.true, frame.camera, frame.lidar, len(classes))
            for frame in drawn
        ]
        voxels = np.sum(counts, axis=0)
        for key, protocol in VOXEL_PROTOCOLS.items():
            if protocol.classes == classes:
                figures[f"{name}.{key}.miou_pct"] = 100 * mean_iou(voxel_ious(voxels, protocol))
        ends = [
            _seen_by_both(frame, name, o, len(classes) - 1) for frame, o in zip(drawn, origins, strict=True)
        ]
        for key, rays in RAY_PROTOCOLS.items():
            if rays.classes == classes:
                figures |= {f"{name}.{key}.{k}": v for k, v in _ray_figures(ends, rays).items()}
    return figures


def _seen_by_both(frame: Frame, name: str, origins_m: np.ndarray, free: int) -> tuple[Seen, Seen]:
    return (
        cast_rays(origins_m, getattr(frame, name), free, frame.predicted_mps),
        cast_rays(origins_m, frame.true, free, frame.true_mps),
    )


def _ray_figures(ends: list[tuple[Seen, Seen]], protocol: RayProtocol) -> dict[str, float]:
    counts: RayCounts = reduce(operator.add, (count_rays(*pair, protocol) for pair in ends))
    scores = score_rays(counts, protocol)
    figures = {"rayiou_pct": 100 * scores.rayiou}
    for threshold_m, iou in zip(protocol.thresholds_m, scores.iou, strict=True):
        figures[f"rayiou_{threshold_m:g}m_pct"] = 100 * mean_iou(iou)
    if protocol.moving:
        figures |= {"mave_mps": scores.mave_mps, "occ_score": scores.occ_score}
    return figures


def _instances_compared(rng: np.random.Generator) -> dict[str, float]:
    """Return IoU and VPQ of moving rectangles: with kept numbers, and with some that change."""
    totals: dict[tuple[str, str], InstanceCounts] = {}
    for _ in range(SAMPLES):
        true = np.zeros((5, 200, 200), np.int64)
        kept, changed = np.zeros_like(true), np.zeros_like(true)
        for number in range(1, 31):
            low, move = rng.integers(0, 190, 2), rng.choice([0, 0, 4, 10])
            size, off = rng.choice([10, 14]), np.round(rng.normal(0, 0.9, 2)).astype(int)
            found, swaps = rng.random() < 0.85, rng.random(5) < 0.1
            new = number
            for t in range(5):
                r, c = low[0] + t * move, low[1]
                true[t, r : r + size, c : c + 5] = number
                new = new + 100 if swaps[t] else new
                if found:
                    r, c = np.maximum([low[0] + off[0] + t * move, low[1] + off[1]], 0)
                    kept[t, r : r + size, c : c + 5], changed[t, r : r + size, c : c + 5] = number, new
        for name, predicted in (("kept_numbers", kept), ("changed_numbers", changed)):
            for where, counts in count_instances(predicted, true, UNIAD_INSTANCES).items():
                key = (name, where)
                totals[key] = totals[key] + counts if key in totals else counts
    return {
        f"{name}.uniad.{figure}_{where}_pct": 100 * getattr(counts, figure)
        for (name, where), counts in totals.items()
        for figure in ("iou", "vpq")
    }
