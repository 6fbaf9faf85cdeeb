"""Gaussians in the frame of a sensor, and their footprints on its plane: common to all projections.

Components come first, [3 N] and [3 3 N], as in `Gaussians.factor`.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.geometry.se3 import hat
from foredrive.methods.reconstruction.gaussians import Gaussians

MIN_RATIO = 1e-12
"""Lower bound of the ratio of areas. It keeps a gradient in the compensated opacity."""


class InSensor(NamedTuple):
    """N Gaussians in the frame of a sensor at the time of the splats."""

    position_m: Float[Tensor, "3 N"]
    factor_m: Float[Tensor, "3 3 N"]
    """M of the covariance M Mᵀ, as in `Gaussians.factor`."""
    velocity_mps: Float[Tensor, "3 N"]
    """Velocity relative to the sensor."""
    opacity: Float[Tensor, "N"]
    feature: Float[Tensor, "N D"]


class Footprint(NamedTuple):
    """Covariances on a plane, widened by the size of a pixel or a beam."""

    inverse: Float[Tensor, "N 3"]
    """Inverse of the widened covariance: xx, xy, yy."""
    compensation: Float[Tensor, "N"]
    """√(det Σ / det(Σ + ε)): factor on the opacity that keeps the total weight of the widened splat (Yu et
    al., "Mip-Splatting", 2024)."""


def positions_in_sensor(gaussians: Gaussians, T_sensor_scene: Float[Tensor, "4 4"]) -> Float[Tensor, "3 N"]:
    """Return the centres in the sensor's frame, m."""
    return T_sensor_scene[:3, :3] @ gaussians.mean_m.T + T_sensor_scene[:3, 3:]


def in_sensor(
    gaussians: Gaussians,
    position_m: Float[Tensor, "3 N"],
    chosen: Int[Tensor, "M"],
    T_sensor_scene: Float[Tensor, "4 4"],
    velocity_mps: Float[Tensor, "N 3"] | None,
    twist_sensor: Float[Tensor, "6"] | None,
) -> InSensor:
    """Transform the chosen Gaussians to a sensor's frame. The arguments are those of `project_camera`."""
    # Gather the visible Gaussians first, so that what follows works on few
    if len(chosen) < len(gaussians.mean_m):
        gaussians = gaussians.map_tensors(lambda tensor: tensor.index_select(0, chosen))
        position_m = position_m.index_select(1, chosen)
        velocity_mps = None if velocity_mps is None else velocity_mps.index_select(0, chosen)
    R = T_sensor_scene[:3, :3]
    velocity = torch.zeros_like(position_m) if velocity_mps is None else R @ velocity_mps.T
    if twist_sensor is not None:
        # Velocity relative to the moving and turning sensor: v - v_s - ω × p
        velocity = velocity - twist_sensor[:3, None] - hat(twist_sensor[3:]) @ position_m
    return InSensor(
        position_m,
        (R @ gaussians.factor().flatten(1)).unflatten(1, (3, -1)),
        velocity,
        gaussians.opacity_logit.sigmoid(),
        gaussians.feature,
    )


def through(jacobian: Float[Tensor, "K 3 N"], factor: Float[Tensor, "3 3 N"]) -> Float[Tensor, "K 3 N"]:
    """Return J M for every Gaussian."""
    columns = [column.unbind() for column in factor.unbind(1)]
    # J row (j, k, m) times M column (x, y, z), by fused multiply-add on long vectors
    products = [
        torch.addcmul(torch.addcmul(j * x, k, y), m, z) for j, k, m in jacobian for x, y, z in columns
    ]
    return torch.stack(products).unflatten(0, jacobian.shape[:2])


def footprint(spread: Float[Tensor, "2 3 N"], epsilon: float) -> Footprint:
    """Return footprints with covariance U Uᵀ on the plane, for U = `spread`, plus ε on its diagonal."""
    u, v = spread
    xx, xy, yy = (u * u).sum(0), (u * v).sum(0), (v * v).sum(0)
    (a, b, c), (d, e, f) = u, v
    # Cauchy-Binet: det U Uᵀ is the sum of the squared 2x2 minors of U
    minors = a * e - b * d, a * f - c * d, b * f - c * e
    area = minors[0].square() + minors[1].square() + minors[2].square()  # det U Uᵀ, without cancellation
    # det(Σ + ε I) = det Σ + ε tr Σ + ε²
    widened = area + epsilon * (xx + yy) + epsilon * epsilon
    # Inverse of a symmetric 2x2 matrix
    inverse = torch.stack([yy + epsilon, -xy, xx + epsilon], -1) / widened[:, None]
    return Footprint(inverse, (area / widened).clamp(min=MIN_RATIO).sqrt())
