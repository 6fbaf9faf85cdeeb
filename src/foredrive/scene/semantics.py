"""Semantic voxels: the classes of public benchmarks, and labels in them."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from foredrive.scene.record import Record
from foredrive.scene.voxels import VoxelSpec

Taxonomy = Literal["occ3d", "openocc"]

VOXEL_CLASSES: dict[Taxonomy, tuple[str, ...]] = {
    "occ3d": (
        "others",
        "barrier",
        "bicycle",
        "bus",
        "car",
        "construction_vehicle",
        "motorcycle",
        "pedestrian",
        "traffic_cone",
        "trailer",
        "truck",
        "driveable_surface",
        "other_flat",
        "sidewalk",
        "terrain",
        "manmade",
        "vegetation",
        "free",
    ),
    "openocc": (
        "car",
        "truck",
        "trailer",
        "bus",
        "construction_vehicle",
        "bicycle",
        "motorcycle",
        "pedestrian",
        "traffic_cone",
        "barrier",
        "driveable_surface",
        "other_flat",
        "sidewalk",
        "terrain",
        "manmade",
        "vegetation",
        "free",
    ),
}
"""Classes by their index: Occ3D-nuScenes (Tian et al. 2023) and OpenOcc (Tong et al. 2023, as SparseOcc
evaluates it). Free space is the last class of either."""


@dataclass(frozen=True)
class SemanticVoxels(Record):
    """The class of each voxel in the ego frame at now.

    `known` says where there is truth at all. The masks are subsets of it. They say what the sensors of this
    frame have seen: published protocols score all known voxels, or those of a mask.
    """

    spec: VoxelSpec
    taxonomy: Taxonomy
    index: UInt8[Tensor, "*b Z Y X"]
    """Index in `VOXEL_CLASSES[taxonomy]`. That of free space where not known."""
    known: Bool[Tensor, "*b Z Y X"]
    camera_mask: Bool[Tensor, "*b Z Y X"]
    """Voxels on a line of sight of a camera, up to the first occupied one."""
    lidar_mask: Bool[Tensor, "*b Z Y X"]
    """Voxels that a beam has crossed or hit."""


@dataclass(frozen=True)
class RayTruth(Record):
    """Truth that metrics of rays need beside the semantic voxels."""

    origin_m: Float[Tensor, "*b O 3"]
    """Places of the drive's lidar from which this frame is looked at, in the ego frame at now."""
    origin_valid: Bool[Tensor, "*b O"]
    """False in padding, and everywhere in logs without lidar."""
    velocity_mps: Float[Tensor, "*b 2 Z Y X"]
    """True velocity over ground of the content of each voxel, in the ego axes. 0 where it is free."""
