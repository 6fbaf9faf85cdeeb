"""The lens that explains a camera's images: those that were undistorted twice, cut or scaled have another."""

import dataclasses
import math
from dataclasses import dataclass

from foredrive.methods.reconstruction.calibration import (
    CalibrationViews,
    OffsetFit,
    agreement,
    best_camera_rotation,
)

FOCAL_SCALES = tuple(0.7 + 0.02 * step for step in range(41))
"""Focal lengths that are tried, as shares of the calibrated one: 0.7 to 1.5."""
_LENS_STEP_RAD = math.radians(0.5)
"""Resolution of the images in which focal lengths are compared."""


@dataclass(frozen=True)
class LensFit:
    """The lens that explains a camera's images best, with the rotation that is left."""

    focal_scale: float
    """Focal length, as a share of the calibrated one."""
    undistorted: bool
    """Whether the images fit better without the calibrated distortion."""
    rotation: OffsetFit


def best_camera_lens(views: CalibrationViews) -> LensFit:
    """Find the focal length, and whether with or without distortion, that fits best; then the rotation."""

    def other_lens(scale: float, undistorted: bool) -> CalibrationViews:
        K = views.K.clone()
        K[:, 0, 0] *= scale
        K[:, 1, 1] *= scale
        return dataclasses.replace(views, K=K, dist=views.dist * (0.0 if undistorted else 1.0))

    lenses = [(scale, False) for scale in FOCAL_SCALES]
    lenses += [(scale, True) for scale in FOCAL_SCALES] if bool(views.dist.any()) else []
    best = max(lenses, key=lambda lens: agreement(other_lens(*lens), _LENS_STEP_RAD))
    return LensFit(*best, best_camera_rotation(other_lens(*best)))
