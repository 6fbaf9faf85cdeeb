"""The protocols of occupancy in use on nuScenes, as data.

Facts read in the public code:
- Occ3D: CVPR2023-3D-Occupancy-Prediction, projects/mmdet3d_plugin/datasets/occ_metrics.py (camera mask); the
  same in Tsinghua-MARS-Lab/Occ3D, branch code
- SparseOcc: MCG-NJU/SparseOcc, loaders/old_metrics.py, loaders/ray_metrics.py, loaders/ego_pose_dataset.py,
  lib/dvr/dvr.cu
- OpenOcc: OpenDriveLab/OccNet, branch challenge, projects/mmdet3d_plugin/datasets/ray_metrics.py; its
  evaluation server: tools/ray_iou/ray_casting.py and metric.py
- UniAD: OpenDriveLab/UniAD, uniad/apis/test.py, occ_head_plugin/metrics.py, datasets/nuscenes_e2e_dataset.py,
  pipelines/occflow_label.py; its VPQ is that of wayveai/fiery, fiery/metrics.py

Public figures of one and the same prediction differ in the mask at evaluation: those of Occ3D's table are
under the camera mask, others count all voxels, or those that cameras and lidar have seen. A camera mask in
training raises the mIoU under this mask and lowers RayIoU, which has no mask: voxels behind the first surface
are then never trained to be free. A figure says little without both masks.
"""

from dataclasses import dataclass
from typing import Literal

from foredrive.scene import VoxelSpec
from foredrive.scene.semantics import VOXEL_CLASSES

GRID = VoxelSpec(lower_m=(-40.0, -40.0, -1.0), voxel_m=0.4, shape_zyx=(16, 200, 200))
"""The grid of Occ3D and OpenOcc on nuScenes, in the ego frame."""

OCC3D_CLASSES, OPENOCC_CLASSES = VOXEL_CLASSES["occ3d"], VOXEL_CLASSES["openocc"]
"""The last class of both is free space, which enters no mean."""

Mask = Literal["camera", "lidar"]


@dataclass(frozen=True)
class VoxelProtocol:
    """The choices that define a mean IoU over voxels."""

    title: str
    classes: tuple[str, ...]
    masks: frozenset[Mask]
    """Voxels count that all of these have seen."""
    absent: Literal["everywhere", "in truth"]
    """A class is left out of the mean if neither truth nor prediction has it, or if the truth lacks it."""


_CAMERA: frozenset[Mask] = frozenset({"camera"})

VOXEL_PROTOCOLS: dict[str, VoxelProtocol] = {
    "occ3d": VoxelProtocol("Occ3D", OCC3D_CLASSES, _CAMERA, absent="everywhere"),
    "occ3d_unmasked": VoxelProtocol("Occ3D, all voxels", OCC3D_CLASSES, frozenset(), absent="everywhere"),
    "occ3d_lidar": VoxelProtocol(
        "Occ3D, lidar mask", OCC3D_CLASSES, frozenset({"lidar"}), absent="everywhere"
    ),
    "occ3d_both": VoxelProtocol(
        "Occ3D, camera and lidar mask", OCC3D_CLASSES, _CAMERA | {"lidar"}, absent="everywhere"
    ),
    "sparseocc": VoxelProtocol("SparseOcc", OCC3D_CLASSES, _CAMERA, absent="in truth"),
    "openocc": VoxelProtocol("OpenOcc", OPENOCC_CLASSES, frozenset(), absent="everywhere"),
}


@dataclass(frozen=True)
class RayProtocol:
    """The choices that define a RayIoU: hits of rays with an equal class at nearly the same range.

    Ray for ray, prediction and truth are two ends: a class and a range. Rays that end free in the truth are
    dropped before anything is counted.
    """

    title: str
    classes: tuple[str, ...]
    thresholds_m: tuple[float, ...] = (1.0, 2.0, 4.0)
    """A hit's ranges differ by less. RayIoU is the mean over these and over the classes."""
    moving: frozenset[str] = frozenset()
    """Classes whose velocity is scored."""
    velocity_threshold_m: float = 2.0
    """Velocity errors are those at this threshold."""
    velocity_rays: Literal["hits", "frames with hits"] = "hits"
    """The velocity error of a class is the mean over its hits, or over all rays of frames that hold one."""
    stored: Literal["single", "half"] = "single"
    """Precision in which ranges and velocities are handed to the evaluation."""
    range_weight: float = 0.9
    """Of RayIoU in OccScore; the rest is that of 1 - mAVE."""


_MOVING = frozenset(OPENOCC_CLASSES[:8])

RAY_PROTOCOLS: dict[str, RayProtocol] = {
    "occ3d": RayProtocol("Occ3D, rays as SparseOcc", OCC3D_CLASSES),
    "openocc": RayProtocol("OpenOcc", OPENOCC_CLASSES, moving=_MOVING),
    "openocc_server": RayProtocol(
        "OpenOcc, server", OPENOCC_CLASSES, moving=_MOVING, velocity_rays="frames with hits", stored="half"
    ),
}


@dataclass(frozen=True)
class InstanceProtocol:
    """The choices that define IoU and VPQ of vehicles over time, seen from above."""

    title: str
    cells: int
    """Rows and columns of the square grid around the ego vehicle."""
    cell_m: float
    past_frames: int
    """A sample counts only if its drive has so many key frames before it …"""
    future_frames: int
    """… and so many annotated ones after it, which are scored with it."""
    step_s: float
    ranges: dict[str, tuple[int, int]]
    """First row and column, and those after the last, by name. Instances are cut before they are compared."""
    min_iou: float
    """A pair's IoU is above this, which is at least 0.5: then no instance has two partners."""


UNIAD_INSTANCES = InstanceProtocol(
    title="UniAD",
    cells=200,
    cell_m=0.5,
    past_frames=2,
    future_frames=4,
    step_s=0.5,
    ranges={"near": (70, 130), "far": (0, 200)},
    min_iou=0.5,
)
"""Its truth has the seven `scene.boxes.VEHICLES`, those included that no camera sees."""
