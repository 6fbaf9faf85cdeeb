"""Geometry within bfloat16 autocast: positions, rays and poses stay exact."""

import ast
import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn

import foredrive
from foredrive.geometry.se3 import compose_se3, exp_se3, inverse_se3, transform_points
from foredrive.heads.instances_head import InstanceHead, InstanceHeadConfig
from foredrive.heads.plane import Plane, PlanePyramid, cell_middles
from foredrive.heads.proposals import CentreHead
from foredrive.methods.blocks.lift_splat import LiftSplatConfig, LiftSplatEncoder
from foredrive.methods.blocks.lifting import project_to_cameras
from foredrive.methods.blocks.training_rays import thinned_rays
from foredrive.methods.driveworld.planes import warp_plane
from foredrive.scene import Clip, Example, VoxelSpec
from foredrive.sensors import camera_rays

SPEC = VoxelSpec(lower_m=(-25.6, -25.6, -2.0), voxel_m=0.8, shape_zyx=(8, 64, 64))
BF16 = torch.autocast("cpu", torch.bfloat16)


@pytest.fixture
def clip(make_example: Callable[..., Example]) -> Clip:
    """Four cameras whose rotations are no round numbers."""
    clip = make_example(spec=SPEC, batch=1, past=0, future=0, cameras=4).clip
    T_ego_cam = exp_se3(torch.tensor([0.9, -0.3, 0.2, 0.02, 0.05, 0.37])) @ clip.rig.T_ego_cam
    return dataclasses.replace(clip, rig=dataclasses.replace(clip.rig, T_ego_cam=T_ego_cam))


def angle_deg(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(torch.rad2deg((a - b).norm(dim=-1)).max())


def test_reference_points_move_by_less_than_a_hundredth_of_a_pixel(clip: Clip) -> None:
    """Under autocast they moved by up to 1.9 px of an image of 800 px."""
    rig = clip.rig.map_tensors(lambda tensor: tensor.flatten(0, 1))
    valid = clip.image_valid.flatten(0, 1)
    exact, seen = project_to_cameras(SPEC.centres_m().flatten(0, 2), rig, valid)
    with BF16:
        points, seen_too = project_to_cameras(SPEC.centres_m().flatten(0, 2), rig, valid)
    assert torch.equal(seen, seen_too)
    assert seen.any()
    assert 800 * (points - exact)[seen].abs().max() < 0.01


def test_rays_turn_by_less_than_a_thousandth_of_a_degree(clip: Clip) -> None:
    exact, exact_thin = camera_rays(clip.rig), thinned_rays(clip, 0, 2)
    with BF16:
        rays, thin = camera_rays(clip.rig), thinned_rays(clip, 0, 2)
    assert angle_deg(rays.dir_ego, exact.dir_ego) < 1e-3
    assert angle_deg(thin.direction, exact_thin.direction) < 1e-3


def test_depths_fall_into_the_same_cells(clip: Clip) -> None:
    """Under autocast 1.9 % of them changed their cell."""
    rig = clip.rig.map_tensors(lambda tensor: tensor[:, 0])
    depths = LiftSplatConfig(near_m=1.0, far_m=30.0, step_m=0.5)
    encoder = LiftSplatEncoder(depths, SPEC, channels=4, plane_channels=4, levels=1)
    exact = encoder.cells(rig, (8, 16))
    with BF16:
        told = encoder.cells(rig, (8, 16))
    assert all(torch.equal(a, b) for a, b in zip(exact, told, strict=True))


def test_poses_and_what_they_move_are_exact() -> None:
    T = exp_se3(torch.tensor([12.0, 0.5, 0.1, 0.01, 0.02, 0.3]))
    points = torch.tensor([[31.2, -17.3, 1.1]])
    plane = torch.randn(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    with BF16:
        T_too = exp_se3(torch.tensor([12.0, 0.5, 0.1, 0.01, 0.02, 0.3]))
        assert torch.equal(T, T_too)
        assert torch.equal(compose_se3(inverse_se3(T), T), compose_se3(inverse_se3(T_too), T_too))
        moved = transform_points(T, points)
        carried = warp_plane(plane, T[None], SPEC)
    assert torch.equal(moved, transform_points(T, points))
    assert torch.equal(carried, warp_plane(plane, T[None], SPEC))
    assert (compose_se3(inverse_se3(T), T) - torch.eye(4)).abs().max() < 1e-5


FAR = VoxelSpec(lower_m=(-50.0, -50.0, -1.0), voxel_m=0.4, shape_zyx=(4, 250, 250))
"""Places 50 m away are rounded to a quarter of a metre in bfloat16."""
PLACES_M = torch.rand(1, 300, 2, generator=torch.Generator().manual_seed(0)) * 98 - 49


def ramp(width: int = 1) -> Plane:
    """A plane whose features are x, in metres."""
    x = cell_middles(FAR.lower_m[:2], FAR.voxel_m, FAR.shape_zyx[1:])[:, 0].view(FAR.shape_zyx[1:])
    return Plane(x.expand(1, width, -1, -1).contiguous(), FAR.lower_m[:2], FAR.voxel_m)


def pyramid(width: int = 16) -> PlanePyramid:
    return PlanePyramid(FAR, channels=4, width=width, max_cells=64, past=True)


def test_planes_are_read_where_the_points_are() -> None:
    halves = dataclasses.replace(ramp(), features=ramp().features.bfloat16())
    with BF16:
        read, rounded = ramp().at(PLACES_M), halves.at(PLACES_M)
    assert (read[..., 0] - PLACES_M[..., 0]).abs().max() < 1e-3
    assert torch.equal(rounded, dataclasses.replace(halves, features=halves.features.float()).at(PLACES_M))
    assert torch.equal(halves.middle_m, ramp().middle_m)


def test_planes_of_other_key_frames_are_moved_exactly() -> None:
    """Under autocast cells moved by up to 0.35 m."""
    T = exp_se3(torch.tensor([[2.3, 0.1, 0.0, 0.0, 0.0, 0.07]]))
    planes = pyramid()
    head = InstanceHead(planes, InstanceHeadConfig(steps=1))
    head.pixels = nn.Sequential(nn.Identity())
    query = torch.zeros(1, 1, planes.width)

    def moved() -> tuple[torch.Tensor, torch.Tensor]:
        with torch.no_grad():
            past = planes._moved(ramp().features, T)
            return past, head(query, ramp(16), [ramp(16)], T[:, None]).pixels

    exact = moved()
    with BF16:
        assert all(torch.equal(a, b) for a, b in zip(moved(), exact, strict=True))
    # By hand, in the middle of the plane: x of the past is 2.3 m ahead, and turned
    x, y = cell_middles(FAR.lower_m[:2], FAR.voxel_m, FAR.shape_zyx[1:]).view(250, 250, 2)[120, 90].tolist()
    expected = math.cos(0.07) * x - math.sin(0.07) * y + float(T[0, 0, 3])
    assert float(exact[0][0, 0, 120, 90]) == pytest.approx(expected, abs=1e-3)


def test_centres_lie_where_their_cells_do() -> None:
    head = CentreHead(8, classes=2)
    with torch.no_grad():
        head.out.weight.zero_()
        head.out.bias.zero_()
        with BF16:
            centres = head(ramp(8))
    assert torch.equal(centres.xy[0].flatten(0, 1), ramp().middle_m)


def test_every_sampling_is_in_full_precision() -> None:
    """Each call of grid_sample stands within `full_precision`, so that its places are not rounded."""
    found, bare = 0, []
    for path in sorted(Path(foredrive.__file__).parent.rglob("*.py")):
        tree = ast.parse(path.read_text())
        guarded = {
            id(inner)
            for node in ast.walk(tree)
            if isinstance(node, ast.With) and "full_precision(" in ast.unparse(node.items[0])
            for inner in ast.walk(node)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("grid_sample"):
                found += 1
                bare += [] if id(node) in guarded else [f"{path.name}:{node.lineno}"]
    assert not bare
    assert found >= 8
