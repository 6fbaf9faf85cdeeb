"""Labels of pixels and lidar returns in 123D's own classes, and depth."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int, UInt8, UInt16
from py123d.datatypes import DefaultCameraSegmentationLabel as CameraLabel
from py123d.datatypes import DefaultLidarSegmentationLabel as LidarLabel

from foredrive.errors import InputError
from foredrive.scene import CameraRig, Category
from foredrive.scene.actors import ActorState
from foredrive.towns.place.materials import Surface

SKY = -1
"""Value in place of a `Surface` where a ray hit nothing."""
NO_ACTOR = -1
"""Value in place of a track id or a `Category` where a ray hit no road user."""

_CAMERA_LABEL = {
    Surface.ROAD: CameraLabel.ROAD,
    Surface.SIDEWALK: CameraLabel.SIDEWALK,
    Surface.TERRAIN: CameraLabel.TERRAIN,
    Surface.BUILDING: CameraLabel.BUILDING,
    Surface.VEGETATION: CameraLabel.VEGETATION,
    Surface.POLE: CameraLabel.POLE,
    Surface.SIGN: CameraLabel.TRAFFIC_SIGN,
    Surface.SIGNAL: CameraLabel.TRAFFIC_LIGHT,
    Surface.STRUCTURE: CameraLabel.BUILDING,  # as py123d treats KITTI-360's walls and bridges
    Surface.VEHICLE: CameraLabel.VEHICLE,
    Surface.PEDESTRIAN: CameraLabel.PERSON,
    Surface.HIDDEN: CameraLabel.IGNORE,
}
_LIDAR_LABEL = {
    Surface.ROAD: LidarLabel.DRIVABLE_SURFACE,
    Surface.SIDEWALK: LidarLabel.SIDEWALK,
    Surface.TERRAIN: LidarLabel.TERRAIN,
    Surface.VEGETATION: LidarLabel.VEGETATION,
    Surface.VEHICLE: LidarLabel.VEHICLE,
    Surface.PEDESTRIAN: LidarLabel.PERSON,
    Surface.HIDDEN: LidarLabel.IGNORE,
}
"""Labels of surfaces. All other surfaces are man-made."""
_TWO_WHEELED = (Category.BICYCLE, Category.MOTORCYCLE)
_CAMERA_LABEL_OF_CATEGORY = {
    Category.PEDESTRIAN: CameraLabel.PERSON,
    Category.ANIMAL: CameraLabel.OTHER,
    Category.TRAFFIC_CONE: CameraLabel.OTHER,
    Category.BARRIER: CameraLabel.OTHER,
    Category.OTHER: CameraLabel.OTHER,
}
_LIDAR_LABEL_OF_CATEGORY = {
    Category.PEDESTRIAN: LidarLabel.PERSON,
    Category.ANIMAL: LidarLabel.OTHER,
    Category.TRAFFIC_CONE: LidarLabel.TRAFFIC_CONE,
    Category.BARRIER: LidarLabel.BARRIER,
    Category.OTHER: LidarLabel.OTHER,
}


def _tables() -> tuple[UInt8[np.ndarray, "K S"], UInt8[np.ndarray, "K S"]]:
    """Return tables of camera and lidar labels by category and surface.

    The row is the category's number + 1 (0: no road user), the column the surface's number + 1.
    """
    # Row 0 and column 0 stand for no road user and for the sky
    shape = (len(Category) + 1, len(Surface) + 1)
    camera, lidar = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    camera[:, SKY + 1] = CameraLabel.SKY
    for surface in Surface:
        camera[0, surface + 1] = _CAMERA_LABEL[surface]
        lidar[0, surface + 1] = _LIDAR_LABEL.get(surface, LidarLabel.MANMADE)
    for category in Category:
        camera[category + 1, 1:] = _CAMERA_LABEL_OF_CATEGORY.get(category, CameraLabel.VEHICLE)
        lidar[category + 1, 1:] = _LIDAR_LABEL_OF_CATEGORY.get(category, LidarLabel.VEHICLE)
        # Riders of two-wheelers have the surface of a person and a label of their own
        if category in _TWO_WHEELED:
            camera[category + 1, 1:] = CameraLabel.TWO_WHEELER
            camera[category + 1, Surface.PEDESTRIAN + 1] = CameraLabel.RIDER
            lidar[category + 1, 1:] = LidarLabel.TWO_WHEELER
            lidar[category + 1, Surface.PEDESTRIAN + 1] = LidarLabel.RIDER
    return camera, lidar


_CAMERA_TABLE, _LIDAR_TABLE = _tables()


class TrackCategories:
    """A lookup of the `Category` of track ids, -1 for ids that belong to no road user."""

    def __init__(self, actors: Sequence[ActorState]) -> None:
        tracks = np.array([NO_ACTOR, *(actor.track_id for actor in actors)], dtype=np.int64)
        category = np.array([NO_ACTOR, *(int(actor.category) for actor in actors)], dtype=np.int64)
        order = np.argsort(tracks)
        self._tracks, self._category = tracks[order], category[order]

    def __getitem__(self, track_id: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        return self._category[np.searchsorted(self._tracks, track_id)]


def camera_labels(surface: Int[np.ndarray, "*n"], category: Int[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Return `DefaultCameraSegmentationLabel`s by `Surface` (or `SKY`) and `Category` (-1: no road user)."""
    return _CAMERA_TABLE[category + 1, surface + 1]


def lidar_labels(surface: Int[np.ndarray, "*n"], category: Int[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Return `DefaultLidarSegmentationLabel`s in the same way; 0 where a beam hit nothing."""
    return _LIDAR_TABLE[category + 1, surface + 1]


def instance_labels(track_ids: Int[np.ndarray, "*n"]) -> UInt16[np.ndarray, "*n"]:
    """Return the instance numbers: the track ids, or 0 for no road user.

    Raises:
        InputError: a track id exceeds the 16 bits that 123D has for it.
    """
    if track_ids.size and track_ids.max() > np.iinfo(np.uint16).max:
        raise InputError(f"instance images hold track ids up to 65535, got {track_ids.max()}")
    return np.maximum(track_ids, 0).astype(np.uint16)


def z_depth(
    range_m: Float32[np.ndarray, "C H W"], dir_ego: Float32[np.ndarray, "N 3"], rig: CameraRig
) -> Float32[np.ndarray, "C H W"]:
    """Convert distances along the unit rays of pixels to depths along the optical axes, m; infinite for the
    sky."""
    # Third column of the rotation: the optical axis in the ego frame
    axis = rig.T_ego_cam[:, :3, 2].numpy()
    return range_m * np.einsum("cni,ci->cn", dir_ego.reshape(len(axis), -1, 3), axis).reshape(range_m.shape)
