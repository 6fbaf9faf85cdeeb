"""Projections of Gaussians by `camera_kernels` and `lidar_kernels`, as an autograd function."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.splatad.camera_kernels import project_to_camera, project_to_camera_backward
from foredrive.methods.splatad.gaussian_kernels import OUTPUTS, SUMS
from foredrive.methods.splatad.lidar_kernels import project_to_lidar, project_to_lidar_backward
from foredrive.ops.splatting import Splats
from foredrive.ops.threads import in_parallel
from foredrive.ops.vectors import ROW

MIN_BLOCKS = 128
"""Minimum number of blocks per thread."""


class GaussianArrays(NamedTuple):
    """Fields of `Gaussians` without features, float32 and contiguous, and their velocities."""

    mean_m: np.ndarray
    quaternion: np.ndarray
    log_scale: np.ndarray
    opacity_logit: np.ndarray
    velocity_mps: np.ndarray
    """Float32[N 3], or Float32[0 3] if all are static."""


class SensorArrays(NamedTuple):
    """A sensor: its pose, its motion, and the size of its pixels or beams."""

    T_sensor_scene: np.ndarray
    """Float32[12]: the rotation row by row, then the position."""
    twist: np.ndarray
    """Float32[6]."""
    epsilon: np.float32
    """Variance that a pixel or a beam adds."""
    compensate: bool
    """True if the opacity is lowered by as much as that widens a splat."""


class SplatGradients(NamedTuple):
    """Gradients with respect to the fields of `Splats` without features, float32 and contiguous."""

    mean: np.ndarray
    inverse_covariance: np.ndarray
    opacity: np.ndarray
    range_m: np.ndarray
    range_slope: np.ndarray
    velocity: np.ndarray
    range_rate_mps: np.ndarray


class Projection(NamedTuple):
    """A sensor's kernels, and what they take besides Gaussians and poses."""

    forward: Callable[..., None]
    backward: Callable[..., None]
    fixed: tuple[Any, ...]
    """Arguments of both behind the sensor."""
    epsilon: float
    """Variance that a pixel or a beam adds."""
    compensate: bool
    """True if the opacity is lowered by as much as that widens a splat."""


def camera_projection(
    K: Float[Tensor, "3 3"],
    dist: Float[Tensor, "5"],
    limits: Float[Tensor, "4"],
    epsilon: float,
    compensate: bool,
) -> Projection:
    """Return the projection of a camera; `limits` are the lower and upper bounds of x/z and y/z."""
    intrinsics = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    fixed = tuple(map(_array, (intrinsics, dist if bool(dist.any()) else dist[:0], limits)))
    return Projection(project_to_camera, project_to_camera_backward, fixed, epsilon, compensate)


def lidar_projection(scan_s: Float[Tensor, "S"] | None, epsilon: float, compensate: bool) -> Projection:
    """Return the projection of a lidar; without scan times the motion is right at time 0."""
    times = _array(torch.zeros(0) if scan_s is None else scan_s)
    turn_s = np.float32(0 if scan_s is None else scan_s.max() - scan_s.min())
    return Projection(project_to_lidar, project_to_lidar_backward, (times, turn_s), epsilon, compensate)


def projected(
    projection: Projection,
    gaussians: Gaussians,
    chosen: Int[Tensor, "M"],
    T_sensor_scene: Float[Tensor, "4 4"],
    velocity_mps: Float[Tensor, "N 3"] | None,
    twist: Float[Tensor, "6"] | None,
) -> Splats:
    """Return the splats of the chosen Gaussians. Gradients reach Gaussians, velocities, pose and twist."""
    velocity = gaussians.mean_m.new_zeros(0, 3) if velocity_mps is None else velocity_mps
    moves = gaussians.mean_m.new_zeros(6) if twist is None else twist
    fields: tuple[Tensor, ...] = _Project.apply(
        projection,
        chosen,
        gaussians.mean_m,
        gaussians.quaternion,
        gaussians.log_scale,
        gaussians.opacity_logit,
        velocity,
        T_sensor_scene,
        moves,
    )
    feature = gaussians.feature
    feature = feature if len(chosen) == len(feature) else feature.index_select(0, chosen)
    return Splats(*(*fields, feature))


class _Project(torch.autograd.Function):
    """Projection for float32 on the CPU. Result and gradients do not depend on the number of threads."""

    @staticmethod
    def forward(
        ctx: Any,
        projection: Projection,
        chosen: Int[Tensor, "M"],
        mean_m: Float[Tensor, "N 3"],
        quaternion: Float[Tensor, "N 4"],
        log_scale: Float[Tensor, "N 3"],
        opacity_logit: Float[Tensor, "N"],
        velocity_mps: Float[Tensor, "n 3"],
        T_sensor_scene: Float[Tensor, "4 4"],
        twist: Float[Tensor, "6"],
    ) -> tuple[Tensor, ...]:
        """Return the fields of `Splats` without features."""
        tensors = (mean_m, quaternion, log_scale, opacity_logit, velocity_mps, T_sensor_scene, twist)
        ctx.save_for_backward(*tensors)
        ctx.projection, ctx.chosen = projection, chosen.int().numpy()
        gaussians, sensor = _arrays(projection, tensors)
        rows, out = ctx.chosen, np.empty((OUTPUTS, len(chosen)), np.float32)

        def job(start: int, stop: int) -> None:
            projection.forward(start, stop, rows, gaussians, sensor, *projection.fixed, out)

        in_parallel(job, -(-len(rows) // ROW), grain=MIN_BLOCKS)
        columns = torch.from_numpy(out)
        return (
            columns[:2].T.contiguous(),
            columns[2:5].T.contiguous(),
            columns[5],
            columns[6],
            columns[7:9].T.contiguous(),
            columns[9:11].T.contiguous(),
            columns[11],
        )

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of Gaussians, velocities, pose and twist."""
        tensors, projection, rows = ctx.saved_tensors, ctx.projection, ctx.chosen
        gaussians, sensor = _arrays(projection, tensors)
        given = SplatGradients(*map(_array, gradients))
        to = [torch.zeros(tensor.shape) for tensor in tensors[:5]]
        written = GaussianArrays(*(tensor.numpy() for tensor in to))
        blocks = -(-len(rows) // ROW)
        wants_pose = any(ctx.needs_input_grad[-2:])
        sums = np.zeros((blocks, SUMS if wants_pose else 0), np.float32)

        def job(start: int, stop: int) -> None:
            projection.backward(start, stop, rows, gaussians, sensor, *projection.fixed, given, written, sums)

        in_parallel(job, blocks, grain=MIN_BLOCKS)
        of_pose: list[Tensor | None] = [None, None]
        if wants_pose:
            total = torch.from_numpy(sums.sum(0, dtype=np.float64)).float()
            T = torch.zeros(4, 4)
            T[:3, :3], T[:3, 3] = total[:9].view(3, 3), total[9:12]
            of_pose = [T, total[12:]]
        in_kind = (grad.to(tensor) for grad, tensor in zip(to, tensors, strict=False))
        return None, None, *in_kind, *of_pose


def _arrays(projection: Projection, tensors: tuple[Tensor, ...]) -> tuple[GaussianArrays, SensorArrays]:
    *gaussians, T, twist = tensors
    pose = torch.cat([T[:3, :3].flatten(), T[:3, 3]])
    sensor = SensorArrays(_array(pose), _array(twist), np.float32(projection.epsilon), projection.compensate)
    return GaussianArrays(*map(_array, gaussians)), sensor


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().contiguous().numpy()
