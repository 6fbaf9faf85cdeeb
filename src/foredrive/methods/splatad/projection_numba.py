"""Projections of Gaussians without gradients, by the kernels of `projection_kernels`."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.splatad.projection_kernels import (
    OUTPUTS,
    GaussianArrays,
    SensorArrays,
    project_to_camera,
    project_to_lidar,
)
from foredrive.ops.splatting import Splats
from foredrive.ops.threads import in_parallel
from foredrive.ops.vectors import ROW

MIN_BLOCKS = 128
"""Minimum number of blocks per thread."""


def camera_splats(
    gaussians: Gaussians,
    chosen: Int[Tensor, "M"],
    sensor: SensorArrays,
    velocity_mps: Float[Tensor, "N 3"] | None,
    K: Float[Tensor, "3 3"],
    dist: Float[Tensor, "5"],
    limits: Float[Tensor, "4"],
) -> Splats:
    """Return what `camera.project_camera` computes of the chosen Gaussians."""
    intrinsics = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    bent = dist if bool(dist.any()) else dist[:0]
    arrays = [_array(tensor) for tensor in (intrinsics, bent, limits)]

    def project(start: int, stop: int, rows: np.ndarray, of: GaussianArrays, out: np.ndarray) -> None:
        project_to_camera(start, stop, rows, of, sensor, *arrays, out)

    return _splats(gaussians, chosen, velocity_mps, project)


def lidar_splats(
    gaussians: Gaussians,
    chosen: Int[Tensor, "M"],
    sensor: SensorArrays,
    velocity_mps: Float[Tensor, "N 3"] | None,
    scan_s: Float[Tensor, "S"] | None,
) -> Splats:
    """Return what `lidar.project_lidar` computes of the chosen Gaussians."""
    times = _array(torch.zeros(0) if scan_s is None else scan_s)
    turn_s = np.float32(0 if scan_s is None else scan_s.max() - scan_s.min())

    def project(start: int, stop: int, rows: np.ndarray, of: GaussianArrays, out: np.ndarray) -> None:
        project_to_lidar(start, stop, rows, of, sensor, times, turn_s, out)

    return _splats(gaussians, chosen, velocity_mps, project)


def sensor_arrays(
    T_sensor_scene: Float[Tensor, "4 4"], twist: Float[Tensor, "6"] | None, epsilon: float, compensate: bool
) -> SensorArrays:
    """Return a sensor as the kernels take it; without a twist it is static."""
    pose = torch.cat([T_sensor_scene[:3, :3].flatten(), T_sensor_scene[:3, 3]])
    moves = torch.zeros(6) if twist is None else twist
    return SensorArrays(_array(pose), _array(moves), np.float32(epsilon), compensate)


def _splats(
    gaussians: Gaussians,
    chosen: Int[Tensor, "M"],
    velocity_mps: Float[Tensor, "N 3"] | None,
    project: Callable[[int, int, np.ndarray, GaussianArrays, np.ndarray], None],
) -> Splats:
    static = torch.zeros(0, 3)
    fields = (gaussians.mean_m, gaussians.quaternion, gaussians.log_scale, gaussians.opacity_logit)
    arrays = GaussianArrays(*map(_array, (*fields, static if velocity_mps is None else velocity_mps)))
    rows, out = chosen.int().numpy(), np.empty((OUTPUTS, len(chosen)), np.float32)

    def job(start: int, stop: int) -> None:
        project(start, stop, rows, arrays, out)

    in_parallel(job, -(-len(chosen) // ROW), grain=MIN_BLOCKS)
    columns = torch.from_numpy(out)
    feature = gaussians.feature.detach()
    return Splats(
        mean=columns[:2].T,
        inverse_covariance=columns[2:5].T,
        opacity=columns[5],
        range_m=columns[6],
        range_slope=columns[7:9].T,
        velocity=columns[9:11].T,
        range_rate_mps=columns[11],
        feature=feature if len(chosen) == len(feature) else feature.index_select(0, chosen),
    )


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().contiguous().numpy()
