"""Rendered sweeps against real ones, by the figures of NeuRAD and SplatAD."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

NO_POINTS_M = 200.0
"""Distance of an empty cloud from any point: a lidar's range."""


@dataclass(frozen=True)
class SweepScores:
    """Scores of one sweep; NaN where there is nothing to judge."""

    depth_median_sq_m2: float
    """Median over the beams that returned of the squared error in range."""
    intensity_rmse: float
    """Over the beams that returned."""
    drop_accuracy: float
    """Share of beams whose return, or lack of one, is predicted rightly."""
    chamfer_m2: float
    """Σ of squared distances to the nearest point of the other cloud, both ways, over the number of real
    points."""


def score_sweep(
    *,
    range_m: Float[Tensor, "P"],
    intensity: Float[Tensor, "P"],
    dropped: Bool[Tensor, "P"],
    real_range_m: Float[Tensor, "P"],
    real_intensity: Float[Tensor, "P"],
    returned: Bool[Tensor, "P"],
    origin: Float[Tensor, "P 3"],
    direction: Float[Tensor, "P 3"],
) -> SweepScores:
    """Score a sweep beam by beam, and as a cloud of points.

    Args:
        range_m, intensity, dropped: rendered; ranges of dropped beams count for `depth_median_sq_m2`.
        real_range_m, real_intensity, returned: as recorded.
        origin, direction: of the beams, m, in any frame.
    """
    missing = float("nan")
    error = (range_m - real_range_m)[returned]
    wrong = (intensity - real_intensity)[returned]
    # Dropped beams are left out of the cloud below
    cloud = origin + direction * torch.where(dropped, 0.0, range_m)[:, None]
    real = origin + direction * real_range_m[:, None]
    return SweepScores(
        depth_median_sq_m2=float((error**2).median()) if len(error) else missing,
        intensity_rmse=float((wrong**2).mean().sqrt()) if len(wrong) else missing,
        drop_accuracy=float((dropped != returned).float().mean()) if len(returned) else missing,
        chamfer_m2=chamfer_m2(cloud[~dropped], real[returned]),
    )


def chamfer_m2(cloud_m: Float[Tensor, "N 3"], real_m: Float[Tensor, "M 3"]) -> float:
    """Return Σ squared distances to the nearest point, both ways, over M; NaN if M is 0."""
    if not len(real_m):
        return float("nan")
    if not len(cloud_m):
        return NO_POINTS_M**2
    a, b = cloud_m.numpy(), real_m.numpy()
    # Nearest neighbours both ways
    forth, back = cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]
    return float((np.square(forth).sum() + np.square(back).sum()) / len(b))
