"""Boxes of many frames as flat arrays, and the rules by which nuScenes' protocols leave boxes out."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from numpy import ndarray

from foredrive.geometry.boxes import points_in_boxes
from foredrive.scene.boxes import UNKNOWN

DETECTION_CLASSES: Final = (
    "car", "truck", "bus", "trailer", "construction_vehicle", "pedestrian", "motorcycle", "bicycle",
    "traffic_cone", "barrier",
)  # fmt: skip
TRACKING_CLASSES: Final = ("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck")
"""nuScenes' classes."""
MAX_BOXES = 500
"""nuScenes' maximum number of boxes in a frame of a results file."""
IN_RACKS = ("bicycle", "motorcycle")
"""Classes that are not counted inside a bicycle rack."""

R = TypeVar("R", bound="ObjectRows")


@dataclass(frozen=True)
class ObjectRows:
    """One box a row, in the order of the file. Detections and ground truth have the same columns."""

    frame: Int[ndarray, "n"]
    """Index of the box's frame."""
    label: Int[ndarray, "n"]
    """Index of its class among the names of the protocol."""
    centre: Float[ndarray, "n 3"]
    """Centre, m, in a frame that does not move within a scene."""
    size_lwh: Float[ndarray, "n 3"]
    yaw: Float[ndarray, "n"]
    velocity: Float[ndarray, "n 2"]
    """Velocity over ground, m/s, in the axes of `centre`. NaN: unknown."""
    attribute: Int[ndarray, "n"]
    """A `scene.boxes.Attribute`; `UNKNOWN`: none."""
    score: Float[ndarray, "n"]
    """Confidence. NaN in the ground truth."""
    num_points: Int[ndarray, "n"]
    """Lidar and radar points in the box; `UNKNOWN`: not counted."""
    from_ego: Float[ndarray, "n 2"]
    """Offset from the ego vehicle over ground, m, in the axes of `centre`. NaN: unknown."""
    track: Int[ndarray, "n"]
    """Identity within the box's scene; -1: none."""

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self: R, which: Shaped[ndarray, "_"] | slice) -> R:
        columns = {field.name: getattr(self, field.name)[which] for field in dataclasses.fields(self)}
        return dataclasses.replace(self, **columns)


def make_rows(
    frame: Int[ndarray, "n"],
    label: Int[ndarray, "n"],
    centre: Float[ndarray, "n 3"],
    size_lwh: Float[ndarray, "n 3"],
    yaw: Float[ndarray, "n"],
    **given: Shaped[ndarray, "n ..."],
) -> ObjectRows:
    """Return rows whose other columns are unknown, unless they are given by name."""
    n = len(frame)
    columns = {
        "velocity": np.full((n, 2), np.nan),
        "attribute": np.full(n, UNKNOWN),
        "score": np.full(n, np.nan),
        "num_points": np.full(n, UNKNOWN),
        "from_ego": np.full((n, 2), np.nan),
        "track": np.full(n, -1),
        **given,
    }
    return ObjectRows(frame, label, centre, size_lwh, yaw, **columns)


@dataclass(frozen=True)
class Frames:
    """The frames that are evaluated, in the order of time within each scene."""

    scene: Int[ndarray, "F"]
    """Index of the frame's scene. The frames of a scene follow each other."""
    time_us: Int[ndarray, "F"]
    """Time of the scene's clock, µs."""

    def __len__(self) -> int:
        return len(self.scene)


@dataclass(frozen=True)
class Region:
    """The ground around the ego vehicle in which a class is counted."""

    shape: Literal["circle", "rectangle"]
    reach_m: dict[str, tuple[float, float]]
    """Half sizes by class along the first and the second axis of `ObjectRows.from_ego`; a circle's radius
    twice."""

    def contains(
        self, label: Int[ndarray, "n"], from_ego: Float[ndarray, "n 2"], classes: Sequence[str]
    ) -> Bool[ndarray, "n"]:
        """Return whether boxes are nearer than the limit of their class. An unknown place is inside.

        A class without a limit, and the label -1, is inside everywhere.
        """
        # The last row serves the label -1, which has no limit
        limits = np.array([*(self.reach_m.get(name, (np.inf, np.inf)) for name in classes), (np.inf, np.inf)])
        limit = limits[label]
        if self.shape == "circle":
            # NaN is not at or beyond the limit, so an unknown place is inside
            return ~(np.linalg.norm(from_ego, axis=1) >= limit[:, 0])
        return ~(np.abs(from_ego) >= limit).any(axis=1)


def inside_racks(boxes: ObjectRows, racks: ObjectRows, classes: Sequence[str]) -> Bool[ndarray, "n"]:
    """Return whether each box is a bicycle or motorcycle whose centre lies in a rack of its frame."""
    inside = np.zeros(len(boxes), bool)
    # Only bicycles and motorcycles in frames that have a rack are tested
    cycles = np.isin(boxes.label, [n for n, name in enumerate(classes) if name in IN_RACKS])
    cycles &= np.isin(boxes.frame, racks.frame)
    for frame in np.unique(boxes.frame[cycles]):
        rows, racks_here = np.flatnonzero(cycles & (boxes.frame == frame)), racks[racks.frame == frame]
        points, centre, size, yaw = (
            torch.as_tensor(values, dtype=torch.float64)
            for values in (boxes.centre[rows], racks_here.centre, racks_here.size_lwh, racks_here.yaw)
        )
        inside[rows] = points_in_boxes(points, centre, size, yaw).any(1).numpy()
    return inside


def counted(
    boxes: ObjectRows, racks: ObjectRows, region: Region, classes: Sequence[str]
) -> Bool[ndarray, "n"]:
    """Return whether a protocol counts each box: in its region, with points, not in a bicycle rack.

    Source: nuscenes-devkit 1.2.0, eval/common/loaders.py, filter_eval_boxes.
    """
    # In range, with at least one point or an unknown number, and not in a rack
    near = region.contains(boxes.label, boxes.from_ego, classes)
    return near & (boxes.num_points != 0) & ~inside_racks(boxes, racks, classes)
