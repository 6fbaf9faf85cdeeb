"""Triton kernels where an offset exceeds 2³¹. The memory is zero; only pages that are written take room."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from foredrive.ops.hash_grid import grid_levels

Op = Callable[..., Tensor]

CHANNELS = 64
SIDE = 2048
LAYERS = 9  # 9 · 2048 · 2048 · 64 = 2.4e9 numbers


def nearly_empty(size: int) -> Tensor:
    try:
        return torch.from_numpy(np.zeros(size, np.float16))
    except MemoryError:
        pytest.skip(f"no {size * 2 / 1e9:.0f} GB of address space")


@pytest.mark.parametrize("items", [1, LAYERS])
def test_a_volume_is_read_behind_2_31_numbers(items: int, triton_op: Callable[[str, str], Op]) -> None:
    attend = triton_op("volume_triton", "attend_volume_triton")
    volume = nearly_empty(LAYERS * SIDE * SIDE * CHANNELS).view(items, -1, SIDE, SIDE, CHANNELS)
    ramp = torch.arange(CHANNELS) / CHANNELS
    # Two voxels of the last layer, along x
    volume[-1, -1, -1, -2:] = torch.stack([ramp, 3 * ramp])
    layer = volume.shape[1] - 0.5
    points = torch.tensor([SIDE - 1.25, SIDE - 0.5, layer]).expand(items, 1, 1, 1, 3)
    points, weights = points.clone().requires_grad_(), torch.ones(items, 1, 1, 1, requires_grad=True)
    found = attend(volume, points, weights)
    torch.testing.assert_close(found[-1, 0], 1.5 * ramp, rtol=4e-3, atol=1e-3)
    assert not found[:-1].any()
    slope, value = torch.autograd.grad(found.sum(), [points, weights])
    torch.testing.assert_close(slope[-1, 0, 0, 0, 0], 2 * ramp.sum(), rtol=4e-3, atol=0)
    torch.testing.assert_close(value[-1].sum(), 1.5 * ramp.sum(), rtol=4e-3, atol=0)


@pytest.mark.parametrize("cameras", [1, LAYERS])
def test_a_map_is_lifted_behind_2_31_numbers(cameras: int, triton_op: Callable[[str, str], Op]) -> None:
    lift = triton_op("lifting_triton", "lift_triton")
    images = nearly_empty(LAYERS * SIDE * SIDE * CHANNELS).view(1, cameras, -1, CHANNELS)
    height = images.shape[2] // SIDE
    ramp = torch.arange(CHANNELS) / CHANNELS
    images[0, -1, -2:] = torch.stack([ramp, 3 * ramp])
    # The last camera alone sees the query, at the last pixel; its offset leads a quarter pixel back
    visible = torch.zeros(1, cameras, 1, dtype=torch.bool)
    visible[0, -1] = True
    uv = torch.tensor([1 - 0.5 / SIDE, 1 - 0.5 / height]).expand(1, cameras, 1, 2)
    offsets = torch.tensor([-0.25, 0.0]).view(1, 1, 1, 1, 1, 2).requires_grad_()
    weights = torch.ones(1, 1, 1, 1, 1, requires_grad=True)
    found = lift(images, ((height, SIDE, 0),), uv, visible, offsets, weights)
    torch.testing.assert_close(found[0, 0], 2.5 * ramp, rtol=4e-3, atol=1e-3)
    slope, value = torch.autograd.grad(found.sum(), [offsets, weights])
    torch.testing.assert_close(slope[..., 0].sum(), 2 * ramp.sum(), rtol=4e-3, atol=0)
    torch.testing.assert_close(value.sum(), 2.5 * ramp.sum(), rtol=4e-3, atol=0)


def test_a_table_is_read_behind_2_31_numbers(triton_op: Callable[[str, str], Op]) -> None:
    read = triton_op("hash_grid_triton", "read_hash_grid_triton")
    levels = grid_levels(1, 1290, 1290, 32)  # 1291³ rows, dense
    assert levels[0].rows > 2**31
    table = nearly_empty(levels[0].rows)[:, None]
    table[-2:, 0] = torch.tensor([1.0, 3.0])
    # A quarter of a cell before the cube's last corner, along x
    place = torch.tensor([[1 - 0.25 / 1290, 1.0, 1.0]])
    torch.testing.assert_close(read(table, place, levels), torch.tensor([[2.5]]), rtol=1e-3, atol=0)
