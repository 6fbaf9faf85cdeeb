"""The types that every part of Foredrive reads and writes, and the protocols between the parts."""

from typing import TYPE_CHECKING

from foredrive.lazy import on_demand

if TYPE_CHECKING:
    from foredrive.scene.boxes import Attribute, Boxes, Category, Visibility
    from foredrive.scene.clip import Clip, Command, Example
    from foredrive.scene.detections import Detections
    from foredrive.scene.frames import Frames, last_frames
    from foredrive.scene.map_patch import MapKind, MapPatch
    from foredrive.scene.protocols import (
        Agent,
        Belief,
        BicycleState,
        Control,
        Decoded,
        DriveProgress,
        Event,
        RayRenderer,
        Rendered,
        RenderedRays,
        Renderer,
        Simulator,
        Step,
        Task,
        WorldModel,
    )
    from foredrive.scene.rig import CameraRig
    from foredrive.scene.sweep import LidarSweep
    from foredrive.scene.trajectory import Trajectory
    from foredrive.scene.voxels import VoxelGrid, VoxelSpec

__all__ = [
    "Agent",
    "Attribute",
    "Belief",
    "BicycleState",
    "Boxes",
    "CameraRig",
    "Category",
    "Clip",
    "Command",
    "Control",
    "Decoded",
    "Detections",
    "DriveProgress",
    "Event",
    "Example",
    "Frames",
    "LidarSweep",
    "MapKind",
    "MapPatch",
    "RayRenderer",
    "Rendered",
    "RenderedRays",
    "Renderer",
    "Simulator",
    "Step",
    "Task",
    "Trajectory",
    "Visibility",
    "VoxelGrid",
    "VoxelSpec",
    "WorldModel",
    "last_frames",
]

__getattr__ = on_demand(
    __name__,
    {
        "boxes": ("Attribute", "Boxes", "Category", "Visibility"),
        "clip": ("Clip", "Command", "Example"),
        "detections": ("Detections",),
        "frames": ("Frames", "last_frames"),
        "map_patch": ("MapKind", "MapPatch"),
        "protocols": (
            "Agent",
            "Belief",
            "BicycleState",
            "Control",
            "Decoded",
            "Event",
            "RayRenderer",
            "Rendered",
            "RenderedRays",
            "Renderer",
            "Simulator",
            "DriveProgress",
            "Step",
            "Task",
            "WorldModel",
        ),
        "rig": ("CameraRig",),
        "sweep": ("LidarSweep",),
        "trajectory": ("Trajectory",),
        "voxels": ("VoxelGrid", "VoxelSpec"),
    },
)
