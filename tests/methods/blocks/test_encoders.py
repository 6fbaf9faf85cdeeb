"""The encoders that NeMo's is compared with: where they look, and what they make of it."""

import dataclasses
import math

import pytest
import torch

from foredrive.methods.blocks.averaging import AveragingConfig, AveragingEncoder
from foredrive.methods.blocks.bev import BevConfig, BevEncoder
from foredrive.methods.blocks.lifting import (
    CameraCrossAttention,
    LiftingConfig,
    LiftingEncoder,
    position_code,
    project_to_cameras,
)
from foredrive.methods.blocks.plane_context import PlaneContext, PlaneContextConfig
from foredrive.scene import CameraRig, VoxelSpec

SPEC = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=1.0, shape_zyx=(4, 16, 16))
SIZE_HW = (32, 64)


def rig() -> CameraRig:
    """One camera 1.6 m up that looks ahead, 40 px focal length."""
    T_ego_cam = torch.eye(4)
    T_ego_cam[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_ego_cam[2, 3] = 1.6
    return CameraRig(
        K=torch.tensor([[40.0, 0, 32], [0, 40.0, 16], [0, 0, 1]])[None, None],
        T_ego_cam=T_ego_cam[None, None],
        dist=torch.zeros(1, 1, 5),
        readout_s=torch.zeros(1, 1),
        names=("front",),
        size_hw=SIZE_HW,
    )


SEEN = torch.ones(1, 1, dtype=torch.bool)


def bev_encoder(channels: int, points: int = 1, layers: int = 1) -> BevEncoder:
    config = BevConfig(width=8, heads=2, points=points, pillars=2, layers=layers)
    return BevEncoder(config, SPEC, channels=channels, levels=1)


def test_pillars_stand_on_the_middle_of_their_cells() -> None:
    encoder = bev_encoder(channels=4)
    pillars = encoder.pillars_m.view(16, 16, 2, 3)
    assert pillars[0, 0].tolist() == [[-7.5, -7.5, 0.0], [-7.5, -7.5, 2.0]]
    assert pillars[3, 10, :, :2].tolist() == [[2.5, -4.5]] * 2
    assert encoder.place.view(16, 16, 3)[3, 10].tolist() == [10.5, 3.5, 0.5]


def test_a_cell_hears_of_every_height_above_it() -> None:
    """Half of the image above the horizon, half below: a pillar that reaches both reads their mean."""
    attention = CameraCrossAttention(features=2, channels=2, heads=1, levels=1, points=1, heights=2)
    with torch.no_grad():
        for layer in (attention.value, attention.out):
            layer.weight.copy_(torch.eye(2))
            layer.bias.zero_()
    image = torch.zeros(1, 1, 8, 16, 2)
    image[:, :, :4, :, 0], image[:, :, 4:, :, 1] = 1.0, 1.0
    points = torch.tensor([[6.0, 0.0, 0.6], [6.0, 0.0, 2.6]])  # one metre below the camera, one above
    uv, visible = project_to_cameras(points, rig(), SEEN)
    assert visible.all()
    read = attention(torch.zeros(1, 1, 2), [image], uv, visible)
    torch.testing.assert_close(read, torch.tensor([[[0.5, 0.5]]]))


def test_the_volume_unfolds_from_the_plane() -> None:
    """What the last layer says of a cell's height z lies at z above that cell."""
    encoder = bev_encoder(channels=3)
    with torch.no_grad():
        encoder.unfold.weight.zero_()
        encoder.unfold.bias.copy_(torch.arange(12.0))
        volume = encoder([torch.randn(1, 1, 4, 8, 3)], rig(), SEEN)
    assert volume.shape == (1, 3, *SPEC.shape_zyx)
    assert volume[0, :, 2, 5, 9].tolist() == [6.0, 7.0, 8.0]
    assert volume.is_contiguous(memory_format=torch.channels_last_3d)


def test_averaging_reads_at_the_projection_and_nowhere_else() -> None:
    encoder = AveragingEncoder(AveragingConfig(hidden=2), SPEC, channels=2, levels=2)
    encoder.convolve = torch.nn.Identity()
    rows, columns = torch.meshgrid(torch.arange(8) + 0.5, torch.arange(16) + 0.5, indexing="ij")
    image = torch.stack([columns / 16, rows / 8], dim=-1)[None, None]  # says where in the image it is
    volume = encoder([image, torch.full((1, 1, 2, 4, 2), math.nan)], rig(), SEEN)
    place = volume[0, :, 2, 8, 14]  # the voxel at x 6.5, y 0.5, z 1.5 m
    expected = torch.tensor([(32 - 40 * 0.5 / 6.5) / 64, (16 + 40 * 0.1 / 6.5) / 32])
    torch.testing.assert_close(place, expected, atol=1e-4, rtol=0)
    assert not volume[0, :, :, :, :8].any()  # behind the camera


def test_the_gate_tells_the_voxels_of_one_ray_apart() -> None:
    torch.manual_seed(0)
    encoder = AveragingEncoder(AveragingConfig(hidden=None, gate=8), SPEC, channels=3, levels=1)
    same_everywhere = torch.tensor([0.5, -1.0, 2.0]).expand(1, 1, 8, 16, 3)
    volume = encoder([same_everywhere], rig(), SEEN)
    near, far = volume[0, :, 2, 8, 12], volume[0, :, 2, 8, 15]
    assert not torch.allclose(near, far, atol=1e-3)
    place = position_code(SPEC.centres_m().flatten(0, 2), 28).unflatten(0, SPEC.shape_zyx)[2, 8, 15]
    assert encoder.gate is not None
    scale, shift = encoder.gate(place).chunk(2)
    torch.testing.assert_close(far, same_everywhere[0, 0, 0, 0] * (1 + scale) + shift)


def test_without_self_attention_a_round_is_the_same_but_for_that_attention() -> None:
    torch.manual_seed(0)
    config = LiftingConfig(heads=2, points=1, layers=1)
    whole = LiftingEncoder(config, SPEC, channels=4, levels=1)
    without = LiftingEncoder(dataclasses.replace(config, self_attention=False), SPEC, channels=4, levels=1)
    assert without.load_state_dict(whole.state_dict(), strict=False).missing_keys == []
    whole.layers[0].self_attention = None
    image = torch.randn(1, 1, 8, 16, 4)
    torch.testing.assert_close(without([image], rig(), SEEN), whole([image], rig(), SEEN))


@pytest.mark.parametrize("size_yx", [(8, 8), (7, 10)])
def test_context_adds_to_each_voxel_what_was_meant_for_it(size_yx: tuple[int, int]) -> None:
    """The plane has half the resolution, and Z heights times D channels: c = z·D + d."""
    context = PlaneContext(PlaneContextConfig(widths=(4, 8), blocks=(1, 1)), channels=3, height=2).eval()
    with torch.no_grad():
        context.out.weight.zero_()
        context.out.bias.copy_(torch.arange(24.0))
        volume = torch.randn(2, 3, 2, *size_yx)
        change = context(volume) - volume
    for z, y, x in ((0, 2, 4), (1, 5, 6), (1, 6, 3)):
        expected = [4.0 * (z * 3 + d) + 2 * (y % 2) + x % 2 for d in range(3)]
        torch.testing.assert_close(change[1, :, z, y, x], torch.tensor(expected))


def test_context_reads_the_surroundings() -> None:
    torch.manual_seed(0)
    context = PlaneContext(PlaneContextConfig(widths=(4, 8), blocks=(1, 1)), channels=2, height=2).eval()
    volume = torch.randn(1, 2, 2, 32, 32)
    other = volume.clone()
    other[..., 16, 16] += 1.0
    changed = (context(other) - context(volume)).abs().amax(dim=(0, 1, 2)) > 0
    assert changed[16, 20]
    assert changed[12, 16]
    assert not changed[0].any()


@pytest.mark.parametrize("kind", ["bev", "averaging"])
def test_a_camera_without_an_image_is_not_looked_at(kind: str) -> None:
    torch.manual_seed(0)
    encoder: BevEncoder | AveragingEncoder
    if kind == "bev":
        encoder = bev_encoder(channels=4, points=2, layers=2)
    else:
        encoder = AveragingEncoder(AveragingConfig(hidden=4), SPEC, channels=4, levels=1)
    one, other = torch.randn(2, 1, 1, 8, 16, 4)
    assert torch.equal(encoder([one], rig(), ~SEEN), encoder([other], rig(), ~SEEN))
    assert not torch.allclose(encoder([one], rig(), SEEN), encoder([other], rig(), SEEN))


def test_queries_begin_by_knowing_their_place() -> None:
    """No two voxels begin alike, those that lie together begin more alike than others, whatever the seed."""
    centres = SPEC.centres_m().flatten(0, 2)
    code = position_code(centres, 28)
    apart = torch.cdist(code, code) + 10 * torch.eye(len(code))
    assert float(apart.min()) > 0.1
    away = torch.cdist(centres, centres)
    assert float(apart[(away > 0) & (away < 1.5)].mean()) < 0.7 * float(apart[away > 6].mean())
    torch.manual_seed(1)
    wide = position_code(centres, 40)
    assert torch.equal(wide[:, :28], code)
    assert 0.0 < float(wide[:, 28:].std()) < 0.05
    assert torch.equal(position_code(centres, 8), code[:, :8])
