"""The frames of a clip, the labels and the ground truth to read: what recipes say of data.

This module needs nothing of 123D, so that models and their recipes can be imported without it.
"""

import dataclasses
from dataclasses import dataclass
from typing import Literal

from foredrive.scene import VoxelSpec
from foredrive.scene.map_elements import PlaneSpec
from foredrive.scene.semantics import Taxonomy

OccupancySource = Literal["lidar", "accumulated", "recorded"]

UNIAD_RASTER = PlaneSpec((-51.2, -51.2), 0.512, (200, 200))
UNIAD_INSTANCES = PlaneSpec((-50.0, -50.0), 0.5, (200, 200))
"""UniAD's grids, but centred on the rear axle."""


@dataclass(frozen=True)
class TaskTruthConfig:
    """The ground truth to read for the now of each clip. A part that is None is not read."""

    future_steps: int = 12
    """Number of steps of the agents' futures."""
    future_dt_s: float = 0.5
    """Time between the steps of the agents' futures, s."""
    elements_lw_m: tuple[float, float] | None = (60.0, 30.0)
    """Extent of the patch of map elements along x and along y, m: MapTR's by default, and (100, 50) is the
    wide one."""
    raster: PlaneSpec | None = UNIAD_RASTER
    """Grid of the map's raster layers: UniAD's by default."""
    line_px: int = 2
    """Width of lines in the raster layers, cells."""
    semantics: Taxonomy | None = "occ3d"
    """Classes of the semantic voxels, on the grid of the clip's voxels."""
    instances: PlaneSpec | None = UNIAD_INSTANCES
    """Grid of the vehicles over time: UniAD's by default, but centred on the rear axle."""
    instance_steps: int = 4
    """Number of steps of `instances` after now."""
    instance_dt_s: float = 0.5
    """Time between the steps of `instances`, s."""
    rays: bool = False
    """Read the lidar's places and the velocities of voxels, which metrics of rays need."""
    affordances: bool = False
    """Read the next light, the lead vehicle, and the road users that occupy the path over time."""


@dataclass(frozen=True)
class ClipConfig:
    """The frames of a clip and the data to read for them."""

    past_frames: int
    """Number of key frames before now."""
    future_frames: int
    """Number of key frames after now, the targets of training and evaluation."""
    image_hw: tuple[int, int]
    """Height and width of the resized images, px."""
    voxels: VoxelSpec
    """Grid of the voxel labels and of a world model's volume."""
    frame_dt_s: float = 0.5
    """Time between key frames, s."""
    horizon_steps: int = 6
    """Number of steps of the future trajectory and of plans."""
    horizon_dt_s: float = 0.5
    """Time between the steps of the future trajectory and of plans, s."""
    cameras: tuple[str, ...] | None = None
    """Camera names, the log's own or 123D's ("pcam_f0"), in this order; None selects all cameras."""
    now_stride_s: float = 0.5
    """Time between the nows of successive clips, s."""
    future_images: bool = True
    """Read the images of the key frames after now too. If False, they are masked."""
    lidar: bool = False
    """Read lidar sweeps into the clip."""
    map: bool = False
    """Read the patch of the road map around the vehicle at now."""
    occupancy_source: OccupancySource = "lidar"
    """Source of the voxel labels: "lidar" for beams of the frame's own sweep, "accumulated" for those of the
    frames within 3 s too, or "recorded" for the exact occupancy and flow in recordings of towns, which
    includes voxels that no sensor has observed. Evaluations use "lidar" in place of "accumulated"."""
    future_source: Literal["driven", "expert"] = "driven"
    """Source of the future trajectory: "driven" for the recorded path, or "expert" for the expert's plan in
    DAgger demonstrations. Clips without such a plan use the driven path."""
    tasks: TaskTruthConfig | None = None
    """Ground truth of detection, mapping, motion and occupancy heads to read for each now; None: nothing."""
    part_s: tuple[float, float] | None = None
    """Part of each log, (start, end) in s since its start, end exclusive; None: all of it. Only clips with
    now and all later frames inside it are used."""

    @property
    def judged(self) -> "ClipConfig":
        """Return the clips of an evaluation: labels of neighbouring sweeps are for training alone."""
        if self.occupancy_source != "accumulated":
            return self
        return dataclasses.replace(self, occupancy_source="lidar")
