"""Upright 3-D boxes, given by centre, size (length, width, height) and yaw."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_SIGNS = torch.tensor(
    [[1, 1, -1], [1, -1, -1], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1], [-1, -1, 1], [-1, 1, 1]],
    dtype=torch.float32,
)
EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
"""Pairs of corner indices of `box_corners`: the 12 edges of a wireframe box."""


def box_corners(
    centre: Float[Tensor, "*b 3"], size_lwh: Float[Tensor, "*b 3"], yaw: Float[Tensor, "*b"]
) -> Float[Tensor, "*b 8 3"]:
    """Return the eight corners, m.

    The order is front-left, front-right, rear-right, rear-left of the bottom face, then of the top face.
    """
    local = 0.5 * _SIGNS.to(centre) * size_lwh[..., None, :]
    # Rotate by yaw, then move to the centre
    cos, sin = yaw.cos()[..., None], yaw.sin()[..., None]
    x = cos * local[..., 0] - sin * local[..., 1]
    y = sin * local[..., 0] + cos * local[..., 1]
    return torch.stack([x, y, local[..., 2]], dim=-1) + centre[..., None, :]


def points_in_boxes(
    points: Float[Tensor, "N 3"],
    centre: Float[Tensor, "M 3"],
    size_lwh: Float[Tensor, "M 3"],
    yaw: Float[Tensor, "M"],
) -> Bool[Tensor, "N M"]:
    """Return whether each point lies inside or on the surface of each box."""
    offset = points[:, None] - centre  # [N, M, 3]
    # Offsets in the axes of each box
    cos, sin = yaw.cos(), yaw.sin()
    along = cos * offset[..., 0] + sin * offset[..., 1]
    across = cos * offset[..., 1] - sin * offset[..., 0]
    half = 0.5 * size_lwh
    return (along.abs() <= half[:, 0]) & (across.abs() <= half[:, 1]) & (offset[..., 2].abs() <= half[:, 2])
