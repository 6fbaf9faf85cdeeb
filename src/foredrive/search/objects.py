"""Annotated objects as small views: a crop of an image around the box, and the returns in the box."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import CameraFrame, pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.geometry.boxes import box_corners, points_in_boxes
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import Category, LidarSweep
from foredrive.search.embedding import View
from foredrive.search.sectors import cut_camera

MIN_RETURNS = 10
"""Minimum number of returns of an object. Objects with fewer are far or hidden."""
MIN_SIDE_PX = 16
"""Minimum side of the crop of an image, px of the log's image."""


class ObjectView(NamedTuple):
    """An annotated object in one camera."""

    category: Category
    view: View
    """Square crop of the image, and the returns in the box, in the frame of the camera's sector."""


def read_objects(log: Log, frame: int, side_px: int) -> list[ObjectView]:
    """Read the objects of a moment, once for each camera whose image shows the whole box.

    Args:
        side_px: side to which the crops of images are resized.

    Raises:
        InputError: data cannot be read.
    """
    boxes, lidar = read_boxes(log, frame), read_sweep(log, frame)
    if boxes is None or lidar is None:
        return []
    boxes = boxes[boxes.valid]
    sweep = lidar[0][lidar[0].valid & lidar[0].returned]
    inside = points_in_boxes(sweep.points_ego, boxes.centre, boxes.size_lwh, boxes.yaw)
    seen_enough = inside.sum(0) >= MIN_RETURNS
    corners = box_corners(boxes.centre, boxes.size_lwh, boxes.yaw)
    objects = []
    for metadata in pinhole_cameras(log).values():
        size_hw = (metadata.height, metadata.width)
        camera = read_camera(log, frame, metadata, size_hw, with_image=True)
        if camera.image is None:
            continue
        corners_cam = transform_points(inverse_se3(camera.T_ego_cam), corners.flatten(0, 1))
        uv, _, in_image = project(corners_cam, camera.K, camera.dist, size_hw)
        # A box is shown as a whole if all its eight corners are in the image
        uv, whole = uv.unflatten(0, (-1, 8)), in_image.unflatten(0, (-1, 8)).all(-1)
        for number in (seen_enough & whole).nonzero()[:, 0].tolist():
            view = _object_view(camera, uv[number], sweep[inside[:, number]], side_px)
            if view is not None:
                objects.append(ObjectView(Category(int(boxes.category[number])), view))
    return objects


def _object_view(
    camera: CameraFrame, corners_px: Float[Tensor, "8 2"], returns: LidarSweep, side_px: int
) -> View | None:
    """Return the view of a box. None if it is too small in the image, or too few returns lie in the crop."""
    assert camera.image is not None
    height, width = camera.image.shape[-2:]
    lower, upper = corners_px.amin(0), corners_px.amax(0)
    side = min(int((upper - lower).max().ceil()), height, width)
    if side < MIN_SIDE_PX:
        return None
    # A square around the middle of the box, moved into the image where it would leave it
    left, top = (
        int((middle - side / 2).round().clamp(0, whole - side))
        for middle, whole in zip((lower + upper) / 2, (width, height), strict=True)
    )
    view = View.of_camera(cut_camera(camera, (left, top, left + side, top + side)), returns)
    if view.sweep is None or len(view.sweep.valid) < MIN_RETURNS:
        return None
    assert view.image is not None
    resized = F.interpolate(view.image[None].float(), (side_px, side_px), mode="bilinear", antialias=True)[0]
    return View(view.sector, resized.round().to(torch.uint8), view.sweep)
