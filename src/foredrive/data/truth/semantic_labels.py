"""Semantic voxels from recorded exact occupancy, in the classes of public benchmarks, with masks."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64
from py123d.datatypes import PinholeCameraMetadata

from foredrive.data.beam_casting import FREE, OCCUPIED, SEEN, UNKNOWN, cast_beams
from foredrive.data.cameras import read_camera
from foredrive.data.labels import voxel_labels
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.recorded import read_occupancy
from foredrive.data.recorded_labels import NOTHING, held_voxels
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import Category, VoxelSpec
from foredrive.scene.semantics import VOXEL_CLASSES, SemanticVoxels, Taxonomy

STATIC_CLASSES = (
    "driveable_surface",
    "sidewalk",
    "terrain",
    "manmade",
    "vegetation",
    "manmade",
    "manmade",
    "manmade",
    "car",
    "pedestrian",
    "terrain",
    "manmade",
)
"""The class of each `Surface` of a town by its number, which is -1 minus the category of a recorded voxel."""
CATEGORY_CLASSES = {
    Category.CAR: "car",
    Category.TRUCK: "truck",
    Category.BUS: "bus",
    Category.TRAILER: "trailer",
    Category.CONSTRUCTION_VEHICLE: "construction_vehicle",
    Category.MOTORCYCLE: "motorcycle",
    Category.BICYCLE: "bicycle",
    Category.PEDESTRIAN: "pedestrian",
    Category.ANIMAL: "others",
    Category.TRAFFIC_CONE: "traffic_cone",
    Category.BARRIER: "barrier",
    Category.OTHER: "others",
}
ABSENT_IN_TOWNS = (
    "others",
    "barrier",
    "construction_vehicle",
    "traffic_cone",
    "trailer",
    "other_flat",
)
"""Classes that no recording of a town has. Walls, fences and bridges are man-made there, parking lots and
the paved sides of roads are road or sidewalk."""
_NEARLY_AT_TOP = 0.98
"""Height in a voxel at which a line of sight meets its top."""
_RISING = ("terrain", "driveable_surface", "sidewalk", "vegetation", "manmade")
"""Classes by precedence: a voxel that contains several recorded ones takes the last of them in this order.

Road users win over all."""


def read_semantics(
    log: Log, frame: int, spec: VoxelSpec, taxonomy: Taxonomy, cameras: Sequence[PinholeCameraMetadata]
) -> SemanticVoxels:
    """Read the classes of all voxels at a frame, unbatched. Without a recording nothing is known.

    The masks are those of the exact voxels: the camera mask has the voxels on lines of sight up to the first
    occupied one, the lidar mask those that a beam of the sweep has crossed or hit.

    Args:
        log: the log.
        frame: the frame.
        spec: the grid.
        taxonomy: names of the classes.
        cameras: the cameras of the camera mask.

    Raises:
        InputError: data cannot be read.
    """
    names = VOXEL_CLASSES[taxonomy]
    index = np.full(spec.shape_zyx, len(names) - 1, dtype=np.uint8)
    known = np.zeros(spec.shape_zyx, dtype=bool)
    lidar, camera = known.copy(), known.copy()
    recorded = read_occupancy(log, frame)
    if recorded is not None:
        codes, which = np.unique(recorded.category, return_inverse=True)
        # Class of each recorded category that occurs
        kinds = [_class_name(code) for code in codes.tolist()]
        # The recorded class of highest rank in each voxel of the grid
        held, known = held_voxels(recorded, np.array([_rank(kind) for kind in kinds])[which], spec)
        occupied = known & (held != NOTHING)
        # Numbers in the taxonomy; classes that it lacks get one beyond its end
        number = np.array([names.index(kind) if kind in names else len(names) for kind in kinds])[which]
        # A voxel of a class that the taxonomy lacks is unknown
        known[occupied] &= number[held[occupied]] < len(names)
        index[occupied & known] = number[held[occupied & known]]
        camera = known & _camera_mask(log, frame, occupied, spec, cameras)
        lidar = known & _lidar_mask(log, frame, spec)
    return SemanticVoxels(spec, taxonomy, *(torch.from_numpy(a) for a in (index, known, camera, lidar)))


def _class_name(code: int) -> str:
    """Return the name of the class of a recorded category."""
    return CATEGORY_CLASSES[Category(code)] if code >= 0 else STATIC_CLASSES[-1 - code]


def _rank(kind: str) -> int:
    return _RISING.index(kind) if kind in _RISING else len(_RISING)


def _lidar_mask(log: Log, frame: int, spec: VoxelSpec) -> Bool[np.ndarray, "Z Y X"]:
    read = read_sweep(log, frame)
    if read is None:
        return np.zeros(spec.shape_zyx, dtype=bool)
    return voxel_labels(read[0], spec, None, log.ego_box).known.numpy()


def _camera_mask(
    log: Log,
    frame: int,
    occupied: Bool[np.ndarray, "Z Y X"],
    spec: VoxelSpec,
    cameras: Sequence[PinholeCameraMetadata],
) -> Bool[np.ndarray, "Z Y X"]:
    """Return the voxels that cameras see.

    As in Occ3D, lines of sight go to the centres of occupied voxels in the image. Others go to their tops, so
    that level ground is seen up to the border of the grid, and to the centres of the outermost voxels, so
    that all free space in view is crossed.
    """
    # Voxels are occupied or unknown; beams mark free ones and the first occupied one
    state = np.where(occupied, OCCUPIED, UNKNOWN).astype(np.uint8)
    aims = _aims(occupied, spec)
    for metadata in cameras:
        size_hw = (metadata.height, metadata.width)
        camera = read_camera(log, frame, metadata, size_hw, with_image=False)
        in_camera = transform_points(inverse_se3(camera.T_ego_cam), torch.from_numpy(aims).float())
        # Lines of sight to the aims that the image shows
        in_view = project(in_camera, camera.K, camera.dist, size_hw)[2].numpy()
        ends = (aims[in_view] - np.asarray(spec.lower_m)) / spec.voxel_m
        origin = (camera.T_ego_cam[:3, 3].double().numpy() - np.asarray(spec.lower_m)) / spec.voxel_m
        cast_beams(np.tile(origin, (len(ends), 1)), ends, np.ones(len(ends)), state, True)
    return (state == FREE) | (state == SEEN)


def _aims(occupied: Bool[np.ndarray, "Z Y X"], spec: VoxelSpec) -> Float64[np.ndarray, "N 3"]:
    """Return the centres of occupied and outermost voxels, and the tops of occupied ones, ego frame, m."""
    outer = occupied.copy()
    # The outermost layer of voxels along each axis
    for axis in range(3):
        np.moveaxis(outer, axis, 0)[[0, -1]] = True
    # x, y, z of the centres and tops in voxel units
    centres = np.argwhere(outer)[:, ::-1] + 0.5
    tops = np.argwhere(occupied)[:, ::-1] + [0.5, 0.5, _NEARLY_AT_TOP]
    return np.asarray(spec.lower_m) + np.concatenate([centres, tops]) * spec.voxel_m
