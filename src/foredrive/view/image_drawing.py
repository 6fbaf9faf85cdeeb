"""Points, boxes and paths drawn into camera images."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from foredrive.geometry.boxes import EDGES, box_corners
from foredrive.geometry.projection import pixels_to_rays, project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import Boxes, CameraRig
from foredrive.view.palette import box_colour, rgb255

NEAR_M = 0.1
SUPERSAMPLING = 2
STEPS_PER_LINE = 24  # Lens distortion bends straight edges
FRONT_CROSS = ((0, 5), (1, 4))  # Diagonals of the front face of `box_corners`


@dataclass(frozen=True)
class Camera:
    """One camera at one time."""

    K: Float[Tensor, "3 3"]
    """Intrinsic matrix, px, for images of `size_hw`."""
    T_ego_cam: Float[Tensor, "4 4"]
    dist: Float[Tensor, "5"]
    size_hw: tuple[int, int]

    @classmethod
    def of(cls, rig: CameraRig, index: int) -> "Camera":
        """Take camera `index` of a rig without leading dimensions."""
        return cls(rig.K[index], rig.T_ego_cam[index], rig.dist[index], rig.size_hw)

    def resized(self, size_hw: tuple[int, int]) -> "Camera":
        """Return the same camera for images of another size."""
        scale = torch.tensor([size_hw[1] / self.size_hw[1], size_hw[0] / self.size_hw[0], 1.0])
        return Camera(self.K * scale.to(self.K)[:, None], self.T_ego_cam, self.dist, size_hw)

    def from_ego(self, points_ego: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Transform points to the camera frame."""
        return transform_points(inverse_se3(self.T_ego_cam).to(points_ego), points_ego)


def to_image(rgb: Float[Tensor, "3 H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Return RGB from 0 to 1 as bytes."""
    return (255 * rgb.clamp(0, 1)).round().byte().permute(1, 2, 0).cpu().numpy()


def write_text(
    pen: ImageDraw.ImageDraw, corner_px: tuple[int, int], text: str, size: int, colour: str
) -> None:
    """Write one line of text below and to the right of a point."""
    pen.text(corner_px, text, fill=colour, font=ImageFont.load_default(size=size))


def resize(image: UInt8[np.ndarray, "H W 3"], size_hw: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Resample an image; small images are enlarged smoothly."""
    return np.asarray(Image.fromarray(image).resize(size_hw[::-1], Image.Resampling.LANCZOS))


def draw_points_on_image(
    image: UInt8[np.ndarray, "H W 3"],
    points_ego: Float[Tensor, "N 3"],
    colours: UInt8[np.ndarray, "N 3"],
    camera: Camera,
    radius_px: float = 0.8,
    alpha: float = 0.6,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a round dot at every point in the camera's view, near dots over far ones.

    Hidden points are drawn too: a lidar sees past surfaces that hide points from a camera, and a wrong
    calibration shows there.
    """
    uv, depth, visible = project(camera.from_ego(points_ego), camera.K, camera.dist, camera.size_hw)
    shown = visible.numpy()
    order = np.argsort(-depth.numpy()[shown])
    centre, colour = uv.numpy()[shown][order], colours[shown][order]
    reach = int(np.ceil(radius_px))
    dv, du = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    # Every pixel of a square around each point, then those whose centre (+0.5) is within the radius
    pixel = np.floor(centre).astype(int)[:, None] + np.stack([du.ravel(), dv.ravel()], -1)  # [N, S, 2]
    distance = np.linalg.norm(pixel + 0.5 - centre[:, None], axis=-1)
    height, width = image.shape[:2]
    inside = (pixel >= 0).all(-1) & (pixel[..., 0] < width) & (pixel[..., 1] < height)
    point, offset = np.nonzero(inside & (distance <= radius_px))
    u, v = pixel[point, offset].T
    painted = image.copy()
    # Where dots overlap, the last assignment counts, which is that of the nearest point
    painted[v, u] = (1 - alpha) * image[v, u] + alpha * colour[point]
    return painted


def draw_boxes_on_image(
    image: UInt8[np.ndarray, "H W 3"],
    boxes: Boxes,
    camera: Camera,
    width_px: float = 1.6,
    colour: str | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw boxes as wire frames; the front face is crossed.

    Args:
        image: RGB of the camera's size.
        boxes: without leading dimensions, in the ego frame.
        camera: the camera that took the image.
        width_px: width of the lines.
        colour: colour of all lines; by default that of each category.
    """
    kept = boxes[boxes.valid]
    corners_ego = box_corners(kept.centre, kept.size_lwh, kept.yaw)
    corners = camera.from_ego(corners_ego.flatten(0, 1)).unflatten(0, (-1, 8))
    far_first = corners[..., 2].mean(-1).argsort(descending=True).tolist()
    lines = []
    for index in far_first:
        rgb = rgb255(colour or box_colour(int(kept.category[index])))
        for pairs, width in ((EDGES, width_px), (FRONT_CROSS, 0.6 * width_px)):
            segments = corners[index][torch.tensor(pairs)]  # [S, 2, 3]
            lines += [(line, rgb, width) for line in _projected_lines(segments, camera)]
    return _draw_lines(image, lines)


def draw_path_on_image(
    image: UInt8[np.ndarray, "H W 3"],
    path_ego: Float[Tensor, "T 3"],
    camera: Camera,
    colour: str,
    width_m: float = 0.2,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a path on the ground: a ribbon, and a disc at every point but the first."""
    if len(path_ego) < 2:
        return image
    turn = torch.linspace(0, 2 * torch.pi, 25)[:-1]
    circle = torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], -1) * width_m
    shapes = _ribbon(path_ego, width_m) + [point + circle for point in path_ego[1:]]
    overlay = Image.new("L", (image.shape[1] * SUPERSAMPLING, image.shape[0] * SUPERSAMPLING))
    draw = ImageDraw.Draw(overlay)
    for polygon in shapes:
        cam = camera.from_ego(polygon)
        uv, depth, inside = project(cam, camera.K, camera.dist, camera.size_hw)
        # Distortion is defined only inside the image
        drawable = inside if bool(camera.dist.any()) else depth > NEAR_M
        if bool(drawable.all()):
            draw.polygon([tuple(p) for p in (uv * SUPERSAMPLING).tolist()], fill=255)
    return _blend(image, overlay, rgb255(colour), 0.85)


def _ribbon(path: Float[Tensor, "T 3"], width_m: float) -> list[Float[Tensor, "4 3"]]:
    """Return quadrilaterals along a path, short enough to be dropped one by one at the near plane."""
    pieces = []
    for start, end in pairwise(path):
        along = end - start
        length = float(along.norm())
        if length < 1e-3:
            continue
        across = torch.tensor([-along[1], along[0], 0.0]) / length * width_m / 2
        cuts = torch.linspace(0, 1, max(2, int(length / 0.25) + 1))[:, None]
        spine = start + cuts * along
        left, right = spine + across, spine - across
        pieces += [torch.stack([left[i], left[i + 1], right[i + 1], right[i]]) for i in range(len(cuts) - 1)]
    return pieces


def _projected_lines(segments_cam: Float[Tensor, "S 2 3"], camera: Camera) -> list[Float[Tensor, "2 2"]]:
    """Return the ends (u, v) of the segments' visible parts, cut finer where distortion bends them."""
    seen, kept = _clip_to_view(segments_cam, camera)
    if not bool(kept.any()):
        return []
    bent = bool(camera.dist.any())
    steps = torch.linspace(0, 1, STEPS_PER_LINE if bent else 2)[:, None]
    points = seen[kept][:, :1] * (1 - steps) + seen[kept][:, 1:] * steps  # [S, K, 3]
    uv, _, inside = project(points.flatten(0, 1), camera.K, camera.dist, camera.size_hw)
    uv, inside = uv.unflatten(0, points.shape[:2]), inside.unflatten(0, points.shape[:2])
    pieces = torch.stack([uv[:, :-1], uv[:, 1:]], dim=2)  # [S, K-1, 2, 2]
    # Distortion is defined only inside the image; an ideal pinhole camera may draw beyond the image
    return list(pieces[inside[:, :-1] & inside[:, 1:]] if bent else pieces.flatten(0, 1))


def _clip_to_view(
    segments_cam: Float[Tensor, "S 2 3"], camera: Camera
) -> tuple[Float[Tensor, "S 2 3"], Tensor]:
    """Clip segments to the near plane and the sides of the viewing frustum; also return which remain.

    Segments are clipped in 3-D, before the division by depth. Otherwise an edge that passes beside or behind
    the camera would run across the picture.
    """
    height, width = camera.size_hw
    border = torch.tensor([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    rays = pixels_to_rays(border, camera.K, camera.dist)
    slopes = rays[:, :2] / rays[:, 2:]
    (left, top), (right, bottom) = slopes.amin(0).tolist(), slopes.amax(0).tolist()
    planes = torch.tensor(  # Inside is where normal · p >= offset
        [[0, 0, 1], [1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]], dtype=segments_cam.dtype
    )
    offset = torch.tensor([NEAR_M, 0, 0, 0, 0])
    signed = segments_cam @ planes.T - offset  # [S, 2, P]
    start, end = signed[:, 0], signed[:, 1]
    # Where each plane cuts the segment, from 0 to 1 along it (Liang-Barsky)
    crossing = start / torch.where(start == end, torch.ones_like(start), start - end)
    enter = torch.where(start < 0, crossing, torch.zeros_like(start)).amax(-1)
    leave = torch.where(end < 0, crossing, torch.ones_like(start)).amin(-1)
    # A segment with both ends outside of one plane is outside
    kept = (enter < leave) & ~((start < 0) & (end < 0)).any(-1)
    ends = torch.stack([enter, leave], -1)[..., None]  # [S, 2, 1]
    return segments_cam[:, :1] + ends * (segments_cam[:, 1:] - segments_cam[:, :1]), kept


def _draw_lines(
    image: UInt8[np.ndarray, "H W 3"],
    lines: list[tuple[Float[Tensor, "2 2"], tuple[int, int, int], float]],
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw anti-aliased lines: enlarge the image, draw, and average it down."""
    if not lines:
        return image
    size = (image.shape[1] * SUPERSAMPLING, image.shape[0] * SUPERSAMPLING)
    canvas = Image.fromarray(image).resize(size, Image.Resampling.NEAREST)
    draw = ImageDraw.Draw(canvas)
    for points, rgb, width in lines:
        # In PIL, pixel centres are at whole numbers
        points_px = [tuple(p) for p in (points * SUPERSAMPLING - 0.5).tolist()]
        draw.line(points_px, fill=rgb, width=max(1, round(width * SUPERSAMPLING)))
    return np.asarray(canvas.resize((image.shape[1], image.shape[0]), Image.Resampling.BOX))


def _blend(
    image: UInt8[np.ndarray, "H W 3"], overlay: Image.Image, rgb: tuple[int, int, int], alpha: float
) -> UInt8[np.ndarray, "H W 3"]:
    """Paint one colour where a supersampled mask covers the image."""
    small = overlay.resize((image.shape[1], image.shape[0]), Image.Resampling.BOX)
    cover = np.asarray(small, dtype=np.float32)[..., None] / 255 * alpha
    return (image * (1 - cover) + np.array(rgb, dtype=np.float32) * cover).round().astype(np.uint8)
