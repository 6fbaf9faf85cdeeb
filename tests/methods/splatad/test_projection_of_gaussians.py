"""Projections of Gaussians against their points, projected one by one."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from foredrive.geometry.projection import distort, distortion_jacobian, project
from foredrive.geometry.se3 import exp_se3, inverse_se3, sensor_twist, transform_points
from foredrive.methods.splatad import Gaussians, project_camera, project_lidar
from foredrive.methods.splatad.camera import SPREAD_PX2
from foredrive.methods.splatad.lidar import SPREAD_RAD2
from foredrive.ops.splat_points import beam_points, pixel_points
from foredrive.ops.splatting import Splats, composite_splats
from foredrive.ops.vectors import ROW, atan2_row, kernel, load_row, store

SIZE_HW = (360, 640)
K = torch.tensor([[500.0, 0, 330], [0, 490, 170], [0, 0, 1]], dtype=torch.float64)
BENT = torch.tensor([-0.3, 0.1, 1e-3, -2e-3, -0.01], dtype=torch.float64)
FLAT = torch.zeros(5, dtype=torch.float64)
LENSES = pytest.mark.parametrize("dist", [FLAT, BENT])
LIDAR_CAM = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
TWIST = torch.tensor([9.0, -1.0, 2.0, 0.1, -0.2, 0.4], dtype=torch.float64)


def some(count: int, *, size_m: float, seed: int = 0, ahead_m: float = 12.0) -> Gaussians:
    """Gaussians of all shapes in a box before the camera (z forward)."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    place = (torch.rand(count, 3, generator=rng, dtype=torch.float64) - 0.5) * torch.tensor([10.0, 5.0, 8.0])
    return Gaussians(
        mean_m=place + torch.tensor([0.0, 0.0, ahead_m]),
        quaternion=normal(count, 4),
        log_scale=math.log(size_m) + 0.5 * normal(count, 3),
        opacity_logit=normal(count),
        feature=normal(count, 3),
    )


def samples(gaussians: Gaussians, count: int = 4000) -> Tensor:
    """Points [N count 3] whose mean and covariance are exactly those of the Gaussians."""
    draws = torch.randn(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    draws = torch.cat([draws, -draws])
    whitened = draws @ torch.linalg.inv(torch.linalg.cholesky(draws.T @ draws / len(draws))).T
    return gaussians.mean_m[:, None] + torch.einsum("ijn,sj->nsi", gaussians.factor(), whitened)


def covariance_of(values: Tensor) -> Tensor:
    centred = values - values.mean(1, keepdim=True)
    return centred.transpose(1, 2) @ centred / values.shape[1]


def inverse_of(splats: Splats) -> Tensor:
    xx, xy, yy = splats.inverse_covariance.unbind(-1)
    return torch.stack([xx, xy, xy, yy], -1).unflatten(-1, (2, 2))


def angles_and_range(points: Tensor) -> Tensor:
    x, y, z = points.unbind(-1)
    return torch.stack([torch.atan2(y, x), torch.atan2(z, (x * x + y * y).sqrt()), points.norm(dim=-1)], -1)


def test_covariance_of_a_gaussian() -> None:
    """Standard deviations 1, 2, 3 m; a quarter turn about z takes x to y. The quaternion may be long."""
    turned = Gaussians(
        mean_m=torch.zeros(1, 3),
        quaternion=torch.tensor([[3.0, 0.0, 0.0, 3.0]]),
        log_scale=torch.tensor([[1.0, 2.0, 3.0]]).log(),
        opacity_logit=torch.zeros(1),
        feature=torch.zeros(1, 0),
    )
    factor = turned.factor()[..., 0]
    torch.testing.assert_close(factor @ factor.T, torch.diag(torch.tensor([4.0, 1.0, 9.0])))


@LENSES
def test_camera_projects_gaussians_as_their_points(dist: Tensor) -> None:
    them = some(40, size_m=0.01)
    splats = project_camera(them, torch.eye(4, dtype=torch.float64), K, dist, SIZE_HW, compensate=False)
    assert len(splats.mean) == 40
    uv, depth, _ = project(them.mean_m, K, dist, SIZE_HW)
    torch.testing.assert_close(splats.mean, uv)
    torch.testing.assert_close(splats.range_m, depth)
    torch.testing.assert_close(splats.opacity, them.opacity_logit.sigmoid())
    points, _, inside = project(samples(them).flatten(0, 1), K, dist, SIZE_HW)
    assert inside.all()
    expected = covariance_of(points.unflatten(0, (40, -1))) + SPREAD_PX2 * torch.eye(2)
    torch.testing.assert_close(torch.linalg.inv(inverse_of(splats)), expected, rtol=0.01, atol=0.01)


def test_lidar_projects_gaussians_as_their_points() -> None:
    them = some(40, size_m=0.02)
    T = LIDAR_CAM
    splats = project_lidar(them, T, compensate=False)
    seen = angles_and_range(samples(them) @ T[:3, :3].T)
    torch.testing.assert_close(
        torch.cat([splats.mean, splats.range_m[:, None]], -1),
        angles_and_range(transform_points(T, them.mean_m)),
    )
    covariance = covariance_of(seen)
    angles = covariance[:, :2, :2] + SPREAD_RAD2 * torch.eye(2)
    torch.testing.assert_close(
        inverse_of(splats) @ angles, torch.eye(2, dtype=torch.float64).expand(40, 2, 2), rtol=0, atol=0.01
    )
    slope = torch.linalg.solve(angles, covariance[:, :2, 2])  # regression of the range on blurred angles
    torch.testing.assert_close(splats.range_slope, slope, rtol=0.01, atol=0.01 * float(slope.abs().mean()))


@pytest.mark.parametrize("sensor", ["camera", "bent camera", "lidar"])
def test_splats_move_as_points_do(sensor: str) -> None:
    """Gaussians and sensor move; the splats' velocities are the differences of positions."""
    them = some(30, size_m=0.05)
    velocity = torch.randn(30, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64) * 5
    T = exp_se3(torch.tensor([0.3, 0.2, 0.1, 0.05, 0.1, -0.1], dtype=torch.float64))
    dist = BENT if sensor == "bent camera" else FLAT
    if sensor == "lidar":
        T = T @ LIDAR_CAM

    def look(gaussians: Gaussians, T: Tensor, twist: Tensor | None = None) -> Splats:
        if sensor == "lidar":
            return project_lidar(gaussians, T, velocity_mps=velocity, twist_lidar=twist)
        return project_camera(gaussians, T, K, dist, SIZE_HW, velocity_mps=velocity, twist_cam=twist)

    def at(t_s: float) -> Splats:
        moved = Gaussians(
            them.mean_m + t_s * velocity, them.quaternion, them.log_scale, them.opacity_logit, them.feature
        )
        return look(moved, inverse_se3(exp_se3(t_s * TWIST)) @ T)

    splats, before, after = look(them, T, TWIST), at(-1e-4), at(1e-4)
    assert len(splats.mean) == len(before.mean) == 30
    torch.testing.assert_close(splats.velocity, (after.mean - before.mean) / 2e-4, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(
        splats.range_rate_mps, (after.range_m - before.range_m) / 2e-4, rtol=1e-5, atol=1e-5
    )


MOTIONS = st.tuples(*[st.floats(-3, 3)] * 6).map(lambda xi: torch.tensor(xi, dtype=torch.float64))


@settings(max_examples=20, deadline=None)
@given(MOTIONS)
def test_a_common_motion_changes_nothing(xi: Tensor) -> None:
    """Scene and sensor moved together look the same."""
    them, T = some(20, size_m=0.1), torch.eye(4, dtype=torch.float64)
    velocity = them.feature * 3
    M = exp_se3(xi)
    w, x, y, z = them.quaternion.unbind(-1)
    half = 0.5 * xi[3:].norm()
    axis = xi[3:] * (torch.sinc(half / math.pi) / 2)
    a, (b, c, d) = half.cos(), axis
    turned = torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        -1,
    )
    moved = Gaussians(
        transform_points(M, them.mean_m), turned, them.log_scale, them.opacity_logit, them.feature
    )
    for see in SENSORS:
        here = see(them, T, velocity)
        there = see(moved, T @ inverse_se3(M), velocity @ M[:3, :3].T)
        for one, other in zip(here, there, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6 * float(one.abs().max()))


SENSORS: list[Callable[[Gaussians, Tensor, Tensor], Splats]] = [
    lambda g, T, v: project_camera(g, T, K, BENT, SIZE_HW, velocity_mps=v, twist_cam=TWIST),
    lambda g, T, v: project_lidar(g, T, velocity_mps=v, twist_lidar=TWIST),
]


@settings(max_examples=20, deadline=None)
@given(st.floats(-math.pi, math.pi))
def test_a_turned_lidar_sees_the_same_at_other_azimuths(yaw: float) -> None:
    them = some(20, size_m=0.3)
    turn = exp_se3(torch.tensor([0.0, 0, 0, 0, 0, yaw], dtype=torch.float64))
    straight, turned = project_lidar(them, LIDAR_CAM), project_lidar(them, turn @ LIDAR_CAM)
    difference = turned.mean - straight.mean - torch.tensor([yaw, 0.0], dtype=torch.float64)
    assert ((difference / (2 * math.pi)).round() * 2 * math.pi - difference).abs().max() < 1e-9
    for name in ("inverse_covariance", "opacity", "range_m", "range_slope"):
        torch.testing.assert_close(getattr(turned, name), getattr(straight, name), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("see", SENSORS)
def test_gradients(see: Callable[[Gaussians, Tensor, Tensor], Splats]) -> None:
    """Every field of the splats, by every parameter and by the sensor's pose, against finite differences."""
    them = some(3, size_m=0.2)
    inputs = [them.mean_m, them.quaternion, them.log_scale, them.opacity_logit, them.feature]
    T = exp_se3(torch.tensor([0.3, 0.2, 0.1, 0.05, 0.1, -0.1], dtype=torch.float64))

    def fields(*values: Tensor) -> tuple[Tensor, ...]:
        *gaussians, pose, velocity = values
        return tuple(see(Gaussians(*gaussians), exp_se3(pose) @ T, velocity))

    inputs += [torch.zeros(6, dtype=torch.float64), torch.ones(3, 3, dtype=torch.float64)]
    assert torch.autograd.gradcheck(fields, [value.requires_grad_() for value in inputs])


@pytest.mark.parametrize("see", SENSORS)
def test_compensated_splats_weigh_what_thin_ones_would(
    see: Callable[[Gaussians, Tensor, Tensor], Splats],
) -> None:
    """Opacity times area is what it is without ε."""
    them, T = some(10, size_m=0.03), torch.eye(4, dtype=torch.float64)
    splats = see(them, T, them.feature)
    area = torch.linalg.det(inverse_of(splats)) ** -0.5
    epsilon = SPREAD_PX2 if splats.range_slope.abs().sum() == 0 else SPREAD_RAD2
    thin = torch.linalg.det(torch.linalg.inv(inverse_of(splats)) - epsilon * torch.eye(2)).sqrt()
    torch.testing.assert_close(
        splats.opacity * area, them.opacity_logit.sigmoid() * thin, rtol=1e-5, atol=1e-9
    )


def test_what_lies_behind_or_aside_is_left_out() -> None:
    behind = some(10, size_m=0.1, ahead_m=-12.0)
    T = torch.eye(4, dtype=torch.float64)
    splats = project_camera(behind, T, K, FLAT, SIZE_HW)
    assert len(splats.mean) == 0
    assert splats.feature.shape == (0, 3)
    assert not composite_splats(splats, pixel_points((8, 8))).alpha.any()
    aside = some(10, size_m=0.1)
    aside = Gaussians(
        aside.mean_m + torch.tensor([80.0, 0, 0]), *(getattr(aside, name) for name in list(vars(aside))[1:])
    )
    assert len(project_camera(aside, T, K, FLAT, SIZE_HW).mean) == 0
    above = some(1, size_m=0.1)
    above = Gaussians(
        torch.tensor([[0.01, 0, 9]], dtype=torch.float64),
        *(getattr(above, name) for name in list(vars(above))[1:]),
    )
    assert len(project_lidar(above, T).mean) == 0


@LENSES
def test_far_outside_a_bent_image_projections_go_on_straight(dist: Tensor) -> None:
    """The polynomial alone would fold a point at 75° back into the image."""
    wide = some(1, size_m=5.0)
    wide = Gaussians(
        torch.tensor([[15.0, 0.0, 4.0]], dtype=torch.float64),
        wide.quaternion,
        torch.full((1, 3), math.log(5.0), dtype=torch.float64),
        wide.opacity_logit,
        wide.feature,
    )
    splats = project_camera(wide, torch.eye(4, dtype=torch.float64), K, dist, SIZE_HW)
    assert splats.mean[0, 0] > SIZE_HW[1]


def test_distortion_jacobian_is_the_derivative() -> None:
    xy = torch.rand(7, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    whole = torch.autograd.functional.jacobian(lambda at: distort(at, BENT).sum(0), xy).permute(1, 0, 2)
    xx, cross, yy = distortion_jacobian(xy, BENT).unbind(-1)
    torch.testing.assert_close(torch.stack([xx, cross, cross, yy], -1), whole.flatten(1))


def test_twist_of_a_sensor() -> None:
    T = exp_se3(torch.tensor([1.5, 0.2, 1.1, 0.3, -0.2, 0.5], dtype=torch.float64))
    step = inverse_se3(T) @ exp_se3(1e-6 * TWIST) @ T  # the sensor's own motion while the ego frame moves
    twist = sensor_twist(T, TWIST)
    torch.testing.assert_close(step, exp_se3(1e-6 * twist), rtol=0, atol=1e-11)


def differences(splats: Splats, truth: Splats) -> list[float]:
    """Return for each field the largest difference from the truth, relative to the splat's own size there."""
    relative = []
    for value, true in zip(splats, truth, strict=True):
        ours, theirs = (field.detach().double().reshape(len(field), -1) for field in (value, true))
        scale = theirs.abs().amax(-1, keepdim=True).clamp_min(theirs.abs().median().clamp_min(1e-12))
        relative.append(float(((ours - theirs).abs() / scale).max()))
    return relative


class Motion(NamedTuple):
    """A drive of the sensor past moving Gaussians: everything that has a gradient."""

    gaussians: Gaussians
    T_sensor_scene: Tensor
    velocity_mps: Tensor
    twist: Tensor

    def leaves(self) -> list[Tensor]:
        of = self.gaussians
        shape = [of.mean_m, of.quaternion, of.log_scale, of.opacity_logit, of.feature]
        return [*shape, self.T_sensor_scene, self.velocity_mps, self.twist]


def motion(count: int, ahead_m: float, dtype: torch.dtype) -> Motion:
    rng = torch.Generator().manual_seed(3)
    velocity_mps = 5 * torch.randn(count, 3, generator=rng, dtype=torch.float64)
    T = exp_se3(torch.tensor([0.3, -0.2, 0.4, 0.1, 0.2, -0.3], dtype=torch.float64))

    def leaf(tensor: Tensor) -> Tensor:
        return tensor.to(dtype).detach().requires_grad_()

    gaussians = some(count, size_m=0.2, ahead_m=ahead_m).map_tensors(leaf)
    return Motion(gaussians, leaf(T), leaf(velocity_mps), leaf(TWIST))


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("dist", [None, FLAT, BENT])
def test_kernels_compute_the_same_values_and_gradients(dist: Tensor | None, moving: bool) -> None:
    """Double precision has no kernel; 1,003 Gaussians do not fill the last block of sixteen."""

    def projected(dtype: torch.dtype) -> tuple[Splats, tuple[Tensor, ...]]:
        of = motion(1003, 1.0 if dist is None else 6.0, dtype)
        moves = {"velocity_mps": of.velocity_mps} if moving else {}
        if dist is None:
            scan_s = torch.linspace(-0.05, 0.05, 720, dtype=torch.float64).to(dtype) if moving else None
            splats = project_lidar(
                of.gaussians, of.T_sensor_scene, twist_lidar=of.twist, scan_s=scan_s, **moves
            )
        else:
            lens = K.to(dtype), dist.to(dtype), SIZE_HW
            twist = of.twist if moving else None
            splats = project_camera(of.gaussians, of.T_sensor_scene, *lens, twist_cam=twist, **moves)
        rng = torch.Generator().manual_seed(5)
        weights = [torch.randn(field.shape, generator=rng, dtype=torch.float64).to(dtype) for field in splats]
        total = torch.stack([(field * weight).mean() for field, weight in zip(splats, weights, strict=True)])
        gradients = torch.autograd.grad(total.sum(), of.leaves(), allow_unused=True)
        return splats, tuple(torch.zeros(1) if each is None else each for each in gradients)

    (truth, true_gradients), (kernel, gradients) = projected(torch.float64), projected(torch.float32)
    assert len(kernel.opacity) == len(truth.opacity) > 500
    assert max(differences(kernel, truth)) < 2e-3
    for found, true in zip(gradients, true_gradients, strict=True):
        assert float((found - true).abs().max()) <= 1e-5 * float(true.abs().max())


def test_a_kernel_projects_nothing_and_the_same_with_two_threads() -> None:
    of = motion(5000, 12.0, torch.float32)
    nowhere = of.gaussians[torch.zeros(5000, dtype=torch.bool)]
    lens = K.float(), FLAT.float(), SIZE_HW
    assert project_camera(nowhere, of.T_sensor_scene, *lens).mean.shape == (0, 2)
    assert project_lidar(nowhere, of.T_sensor_scene).feature.shape == (0, 3)
    before, drawn = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            splats = project_camera(
                of.gaussians, of.T_sensor_scene, *lens, velocity_mps=of.velocity_mps, twist_cam=of.twist
            )
            loss = torch.stack([field.square().mean() for field in splats]).sum()
            drawn.append([*splats, *torch.autograd.grad(loss, of.leaves())])
    finally:
        torch.set_num_threads(before)
    for one, two in zip(*drawn, strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize(
    "field", ["quaternion", "log_scale", "opacity_logit", "feature", "velocity_mps", "twist"]
)
def test_what_has_diverged_is_refused_and_not_drawn(field: str) -> None:
    """Kernels neither hide NaN behind a bound nor read a scan time at an index that is none."""
    of = motion(100, 1.0, torch.float32)
    values = getattr(of, field) if field in ("velocity_mps", "twist") else getattr(of.gaussians, field)
    with torch.no_grad():
        values[0] = torch.nan
        splats = project_lidar(
            of.gaussians,
            of.T_sensor_scene,
            velocity_mps=of.velocity_mps,
            twist_lidar=of.twist,
            scan_s=torch.linspace(-0.05, 0.05, 720),
        )
        beams = beam_points(torch.linspace(-0.5, 0.5, 40), torch.zeros(40), torch.zeros(40))
        with pytest.raises(ValueError, match="is not finite"):
            composite_splats(splats, beams)


@kernel
def angles_of(y: np.ndarray, x: np.ndarray, angle_rad: np.ndarray) -> None:
    for first in range(0, x.size, ROW):
        store(angle_rad, first, atan2_row(load_row(y, first), load_row(x, first)))


def test_angles_are_right_in_all_octants_and_on_the_axes() -> None:
    around = np.linspace(-np.pi, np.pi, 1601)[1:]
    far = 10.0 ** np.linspace(-6, 6, 1600)
    x, y = (far * np.cos(around)).astype(np.float32), (far * np.sin(around)).astype(np.float32)
    x[:5], y[:5] = [0, 0, 0, 3, -3], [0, 2, -2, 0, 0]
    angle_rad = np.zeros_like(x)
    angles_of(y, x, angle_rad)
    assert np.abs(angle_rad - np.arctan2(y.astype(float), x.astype(float))).max() < 3e-7
