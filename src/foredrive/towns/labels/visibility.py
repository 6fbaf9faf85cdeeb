"""Visibility: the share of each road user that the cameras see, relative to an unobstructed view."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int, Int64

from foredrive.scene import CameraRig
from foredrive.scene.actors import ActorState
from foredrive.towns.sensing.actor_shapes import Shape, unit_to_world
from foredrive.towns.sensing.capture import SensorSuite

RAYS_PER_CAMERA = 1024
"""Approximate maximum number of rays per camera and road user. A larger road user is sampled by an even grid
of its pixels."""
NEAR_M = 0.1
OBJECT_RADIUS_M = 0.5
"""Maximum distance from the middle of a small object to its surface, m."""
_CORNERS = np.array([[x, y, z, 1.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def visibility(
    actors: Sequence[tuple[ActorState, Shape]],
    sensors: SensorSuite,
    T_world_ego: Float64[np.ndarray, "4 4"],
    pixel_ids: Int[np.ndarray, "C H W"],
) -> Float32[np.ndarray, "M"]:
    """Compute the visible share of each road user's silhouette over all images, 0 (hidden) to 1 (in full
    view).

    The silhouette is that of the shape alone at the frame's time, sampled by the rays of the images. Parts
    outside the images do not count. A road user that covers no pixel centre has 0. nuScenes' visibility
    levels are this share with thresholds at .4, .6 and .8.

    Args:
        actors: the road users with their shapes.
        sensors: the cameras.
        T_world_ego: pose of the vehicle.
        pixel_ids: track id at each pixel.
    """
    out = np.zeros(len(actors), dtype=np.float32)
    # Actors without a pixel are not visible and need no rays
    seen = np.isin([actor.track_id for actor, _ in actors], np.unique(pixel_ids))
    if not seen.any():
        return out
    rows: list[int] = np.flatnonzero(seen).tolist()
    # Map of each unit box into the ego frame: rays are cast in the box
    T_ego_unit = np.linalg.inv(T_world_ego) @ np.array([unit_to_world(actors[m][0]) for m in rows])
    windows = _windows(T_ego_unit, sensors)
    flat_ids = pixel_ids.ravel()
    origin, direction = sensors.pixel_rays[:2]
    for m, T, of_cameras in zip(rows, np.linalg.inv(T_ego_unit), windows, strict=True):
        actor, shape = actors[m]
        pixels, weight = _pixels(of_cameras, sensors.rig.size_hw)
        # Rays of the sampled pixels in the frame of the unit box; the lengths do not matter
        R = T[:3, :3].T.astype(np.float32)
        unit = origin[pixels] @ R + T[:3, 3].astype(np.float32), direction[pixels] @ R
        # Weight of the rays that hit the shape alone, and of those whose pixel shows it
        filled = shape.scene.occluded(*unit) * weight
        if filled.any():
            out[m] = (filled * (flat_ids[pixels] == actor.track_id)).sum() / filled.sum()
    return out


def is_point_visible(
    point_ego: Float64[np.ndarray, "3"], rig: CameraRig, range_m: Float32[np.ndarray, "C H W"]
) -> bool:
    """Return whether a small object is in an image with nothing in front of it.

    Args:
        point_ego: position in the ego frame, m.
        rig: the cameras.
        range_m: distance of the surface at each pixel, m.
    """
    height, width = rig.size_hw
    poses, matrices = rig.T_ego_cam.double().numpy(), rig.K.double().numpy()
    for T_ego_cam, K, ranges in zip(poses, matrices, range_m, strict=True):
        # Into the camera frame, then to pixels
        in_cam = T_ego_cam[:3, :3].T @ (point_ego - T_ego_cam[:3, 3])
        if in_cam[2] < NEAR_M:
            continue
        u, v = (K @ in_cam)[:2] / in_cam[2]
        if 0 <= u < width and 0 <= v < height:
            row, column = int(v), int(u)
            # The farthest of 3×3 pixels: an object thinner than a pixel may be beside it
            around = ranges[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
            if around.max() > np.linalg.norm(in_cam) - OBJECT_RADIUS_M:
                return True
    return False


def _windows(T_ego_unit: Float64[np.ndarray, "M 4 4"], sensors: SensorSuite) -> Int64[np.ndarray, "M C 4"]:
    """Return the row and column ranges of each unit box in each image; empty where it is not visible."""
    rig = sensors.rig
    height, width = rig.size_hw
    T_cam_ego = np.linalg.inv(rig.T_ego_cam.double().numpy())
    # Corners of all boxes in all cameras: [M C 8 3]
    corners = np.einsum("cij,mjk,nk->mcni", T_cam_ego, T_ego_unit, _CORNERS)[..., :3]
    depth = corners[..., 2]
    K = rig.K.double().numpy()
    uvw = np.einsum("cij,mcnj->mcni", K, corners)
    # Bounding box of the projected corners, one pixel wider
    uv = uvw[..., :2] / np.maximum(uvw[..., 2:], NEAR_M)
    low, high = np.floor(uv.min(axis=2)) - 1, np.ceil(uv.max(axis=2)) + 1
    across = (depth.min(axis=-1) < NEAR_M)[..., None]  # it reaches behind the camera: the whole image
    size = np.array([width, height])
    low = np.where(across, 0, low.clip(0, size))
    high = np.where(across, size, high.clip(0, size))
    # Boxes behind the camera have an empty window
    high = np.where((depth.max(axis=-1) < NEAR_M)[..., None], low, high)
    return np.stack([low[..., 1], high[..., 1], low[..., 0], high[..., 0]], axis=-1).astype(np.int64)


def _pixels(
    windows: Int64[np.ndarray, "C 4"], size_hw: tuple[int, int]
) -> tuple[Int64[np.ndarray, "P"], Float32[np.ndarray, "P"]]:
    """Return the flat indices of the sampled pixels, and the number of pixels that each one represents."""
    height, width = size_hw
    pixels, weights = [], []
    for c, (top, bottom, left, right) in enumerate(windows.tolist()):
        area = max(0, bottom - top) * max(0, right - left)
        if area:
            # A grid of about `RAYS_PER_CAMERA` pixels; each stands for step² of them
            step = max(1, int(np.ceil((area / RAYS_PER_CAMERA) ** 0.5)))
            rows, columns = np.arange(top, bottom, step), np.arange(left, right, step)
            pixels.append(((c * height + rows[:, None]) * width + columns).ravel())
            weights.append(np.full(len(rows) * len(columns), step**2, dtype=np.float32))
    if not pixels:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.float32)
    return np.concatenate(pixels), np.concatenate(weights)
