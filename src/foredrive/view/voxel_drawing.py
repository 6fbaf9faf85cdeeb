"""Pictures of voxel grids: a shaded view in perspective, a comparison from above, features as colours."""

import math
from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from foredrive.scene import VoxelSpec
from foredrive.view import palette

SUN = np.array([-0.35, 0.45, 0.82]) / np.linalg.norm([-0.35, 0.45, 0.82])
AMBIENT, DIFFUSE = 0.52, 0.48
RIM_SHADE, RIM_PX = 0.78, 1.6  # Rims of voxels are darker
SUPERSAMPLING = 2


@dataclass(frozen=True)
class Viewpoint:
    """A virtual camera that looks at a grid in the ego frame."""

    position_m: tuple[float, float, float]
    target_m: tuple[float, float, float]
    focal: float
    """Focal length in units of the picture's height."""

    @classmethod
    def behind(cls, spec: VoxelSpec, size_hw: tuple[int, int]) -> "Viewpoint":
        """Return a viewpoint above and behind the vehicle, so that the grid fills a picture of that size."""
        reach = 0.5 * max(spec.shape_zyx[1:]) * spec.voxel_m
        low, high = np.array(spec.lower_m), np.array(spec.upper_m)
        middle = (low + high) / 2
        position = (middle[0] - 1.75 * reach, middle[1] - 0.55 * reach, 1.35 * reach)
        target = (middle[0] - 0.12 * reach, middle[1], 0.0)
        corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(8, 3)
        # How far the corners of the grid are from the middle of a picture with focal length 1
        off_centre = np.abs(cls(position, target, 1.0).project(corners, (1, 1)) - 0.5).max(0)  # [u v]
        # The largest focal length that shows all corners, times 1.45: empty corners may be cut off
        limits = np.array([0.5 * size_hw[1] / size_hw[0], 0.5]) / off_centre
        return cls(position, target, 1.45 * float(limits.min()))

    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Return the rows right, down and forward in the ego frame."""
        # Right is level; down is across both
        forward = np.subtract(self.target_m, self.position_m)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def project(self, points: Float[np.ndarray, "N 3"], size_hw: tuple[int, int]) -> Float[np.ndarray, "N 2"]:
        """Project points in front of the viewpoint to pixels."""
        local = (points - np.array(self.position_m)) @ self.axes().T
        scale = self.focal * size_hw[0]
        return local[:, :2] / local[:, 2:] * scale + np.array([size_hw[1] / 2, size_hw[0] / 2])


def draw_voxels(
    occupied: Bool[Tensor, "Z Y X"],
    spec: VoxelSpec,
    size_hw: tuple[int, int],
    viewpoint: Viewpoint | None = None,
    colours: UInt8[np.ndarray, "Z Y X 3"] | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw occupied voxels as lit cubes with shadows; rays are cast through the grid.

    Args:
        occupied: the voxels to draw.
        spec: position and size of the grid.
        size_hw: size of the picture, px.
        viewpoint: viewpoint; by default above and behind the vehicle.
        colours: RGB per voxel; by default by height.
    """
    viewpoint = viewpoint or Viewpoint.behind(spec, size_hw)
    tint = height_colours(spec) if colours is None else colours
    large_hw = (SUPERSAMPLING * size_hw[0], SUPERSAMPLING * size_hw[1])
    picture = np.full((*large_hw, 3), palette.rgb255(palette.GROUND), dtype=np.uint8)
    origin = (np.array(viewpoint.position_m) - np.array(spec.lower_m)) / spec.voxel_m
    _cast(occupied.numpy(), tint, origin, viewpoint.axes(), viewpoint.focal * large_hw[0], SUN, picture)
    return np.asarray(Image.fromarray(picture).resize(size_hw[::-1], Image.Resampling.BOX))


def height_colours(spec: VoxelSpec) -> UInt8[np.ndarray, "Z Y X 3"]:
    """Return fixed colours of heights, dark (-0.5 m above the ego ground) to bright (4 m)."""
    z = spec.lower_m[2] + (np.arange(spec.shape_zyx[0]) + 0.5) * spec.voxel_m
    rgb = palette.HEIGHT_MAP(0.12 + 0.88 * np.clip((z + 0.5) / 4.5, 0, 1))[:, :3]
    return np.broadcast_to((rgb * 255).astype(np.uint8)[:, None, None], (*spec.shape_zyx, 3))


def draw_comparison(
    predicted: Bool[Tensor, "Z Y X"],
    label: Bool[Tensor, "Z Y X"],
    valid: Bool[Tensor, "Z Y X"],
    spec: VoxelSpec,
    above_m: float,
) -> UInt8[np.ndarray, "X Y 3"]:
    """Draw hits, false alarms, misses, known free and unknown columns from above, one pixel per column.

    Only known voxels whose centre is higher than `above_m` in the ego frame count, because the road would
    hide everything else. Forward points up, left points left.
    """
    z = spec.lower_m[2] + (torch.arange(spec.shape_zyx[0]) + 0.5) * spec.voxel_m
    counts = valid & (z > above_m)[:, None, None]
    truth, guess, seen = (label & counts).any(0), (predicted & counts).any(0), counts.any(0)
    picture = torch.tensor(palette.rgb255(palette.GROUND), dtype=torch.uint8).repeat(*seen.shape, 1)
    for where, colour in (
        (seen, palette.KNOWN_FREE),
        (truth & guess, palette.TRUE_POSITIVE),
        (guess & ~truth, palette.FALSE_POSITIVE),
        (truth & ~guess, palette.FALSE_NEGATIVE),
    ):
        picture[where] = torch.tensor(palette.rgb255(colour), dtype=torch.uint8)
    return _from_above(picture)


def draw_volume_pca(volume: Float[Tensor, "D Z Y X"]) -> UInt8[np.ndarray, "X Y 3"]:
    """Draw features as colours (NeMo, Fig. 3): PCA of the D channels to three, then the mean over height.

    Each channel is stretched from its 1st to its 99th percentile.
    """
    colours = _principal(volume).mean(1)  # [3 Y X]
    return _from_above(_stretched(colours).permute(1, 2, 0))


def pca_colours(
    volume: Float[Tensor, "D Z Y X"], shown: Bool[Tensor, "Z Y X"]
) -> UInt8[np.ndarray, "Z Y X 3"]:
    """Return voxel colours from features: PCA over the shown voxels, with each channel stretched.

    With fewer than three shown voxels, PCA is not defined and all are grey.
    """
    colours = torch.full((3, *shown.shape), 128, dtype=torch.uint8)
    if int(shown.sum()) >= 3:
        colours[:, shown] = _stretched(_principal(volume[:, shown]))
    return colours.permute(1, 2, 3, 0).numpy()


def _principal(features: Float[Tensor, "D *n"]) -> Float[Tensor, "3 *n"]:
    """Return the three principal components of D channels, of fixed sign, so that colours repeat."""
    flat = features.float().flatten(1)
    centred = flat - flat.mean(1, keepdim=True)
    _, vectors = torch.linalg.eigh(centred @ centred.T / centred.shape[1])
    components = vectors[:, -3:].flip(-1)  # Largest variance first
    # The sign of an eigenvector is arbitrary: its largest entry is made positive
    signs = components.gather(0, components.abs().argmax(0, keepdim=True)).sign()
    return ((components * signs).T @ centred).unflatten(1, features.shape[1:])


def _stretched(channels: Float[Tensor, "3 *n"]) -> UInt8[Tensor, "3 *n"]:
    """Stretch each channel from its 1st and 99th percentile to 0 and 255."""
    flat = channels.flatten(1)
    low, high = (torch.from_numpy(np.percentile(flat.numpy(), q, axis=1)).float() for q in (1, 99))
    unit = ((flat - low[:, None]) / (high - low).clamp_min(1e-12)[:, None]).clamp(0, 1)
    return (unit * 255).to(torch.uint8).view(channels.shape)


def _from_above(rows: UInt8[Tensor, "Y X 3"]) -> UInt8[np.ndarray, "X Y 3"]:
    """Turn [Y X] so that x (forward) points up and y (left) points left."""
    return rows.transpose(0, 1).flip(0, 1).contiguous().numpy()


@numba.njit(cache=True, error_model="numpy")
@no_type_check  # numba infers the types and needs the bare function
def _march(occupied, origin, direction, cell, step, to_next, per_cell):
    """Find a ray's first occupied voxel (Amanatides & Woo, 1987); the last four arguments are scratch memory.

    It returns the distance in voxels (-1: none) and the axis of the entered face (-1: the ray starts inside).
    `cell` is left at the voxel's x, y, z.
    """
    shape = (occupied.shape[2], occupied.shape[1], occupied.shape[0])
    near, far, axis = 0.0, math.inf, -1
    # Distances at which the ray enters and leaves the grid, and the face through which it enters
    for i in range(3):
        if direction[i] == 0.0:
            if origin[i] < 0 or origin[i] > shape[i]:
                return -1.0, -1
            continue
        one, two = -origin[i] / direction[i], (shape[i] - origin[i]) / direction[i]
        low, high = min(one, two), max(one, two)
        if low > near:
            near, axis = low, i
        far = min(far, high)
    if near >= far:
        return -1.0, -1
    for i in range(3):
        # The first cell, slightly inside of the face; then the distances to the next border of each axis
        point = origin[i] + (near + 1e-9) * direction[i]
        cell[i] = min(max(math.floor(point), 0), shape[i] - 1)
        step[i], per_cell[i], to_next[i] = 0, math.inf, math.inf
        if direction[i] != 0.0:
            step[i] = 1 if direction[i] > 0 else -1
            per_cell[i] = abs(1.0 / direction[i])
            border = cell[i] + 1 if direction[i] > 0 else cell[i]
            to_next[i] = (border - origin[i]) / direction[i]
    distance = near
    while True:
        if occupied[cell[2], cell[1], cell[0]]:
            return distance, axis
        # Go on through the nearest border
        axis = 0 if to_next[0] <= to_next[1] else 1
        if to_next[2] < to_next[axis]:
            axis = 2
        distance = to_next[axis]
        cell[axis] += step[axis]
        if cell[axis] < 0 or cell[axis] >= shape[axis]:
            return -1.0, -1
        to_next[axis] += per_cell[axis]


@numba.njit(cache=True, error_model="numpy")
@no_type_check
def _cast(occupied, colours, origin, axes, focal_px, sun, picture):
    """Paint the pixels [H W 3] whose ray hits a voxel; the viewpoint's `origin` is in voxels."""
    height, width = picture.shape[:2]
    direction, hit, above = np.empty(3), np.empty(3), np.empty(3)
    cell, step = np.empty(3, np.int64), np.empty(3, np.int64)
    to_next, per_cell = np.empty(3), np.empty(3)
    for row in range(height):
        for column in range(width):
            # The ray of a pixel's centre, of unit length, so that distances are in voxels
            u, v = column + 0.5 - width / 2, row + 0.5 - height / 2
            length = math.sqrt(u * u + v * v + focal_px * focal_px)
            for i in range(3):
                direction[i] = (u * axes[0, i] + v * axes[1, i] + focal_px * axes[2, i]) / length
            distance, axis = _march(occupied, origin, direction, cell, step, to_next, per_cell)
            if distance < 0:
                continue
            colour = colours[cell[2], cell[1], cell[0]]
            light, rim = AMBIENT, 1.0
            for i in range(3):
                hit[i] = above[i] = origin[i] + distance * direction[i]
                if i != axis:  # Distance from the nearest rim of the face, in voxels
                    rim = min(rim, hit[i] - math.floor(hit[i]), math.ceil(hit[i]) - hit[i])
            if axis >= 0:
                # The normal of the entered face points against the ray
                facing = -sun[axis] if direction[axis] > 0 else sun[axis]
                # The shadow ray starts just outside of the face. It may overwrite `cell`, which is used up
                above[axis] -= 1e-4 if direction[axis] > 0 else -1e-4
                if facing > 0 and _march(occupied, above, sun, cell, step, to_next, per_cell)[0] < 0:
                    light += DIFFUSE * facing
            if rim * focal_px / distance < RIM_PX:
                light *= RIM_SHADE
            for i in range(3):
                picture[row, column, i] = int(light * colour[i])
