"""Check the calibration of a log before its reconstruction."""

import math
from collections.abc import Mapping, Sequence

from foredrive.rendering.calibration import (
    CalibrationView,
    OffsetFit,
    agreement,
    best_camera_rotation,
    best_lidar_translation,
    calibration_views,
    with_images_from,
)
from foredrive.rendering.tracks import ActorTracks
from foredrive.rendering.views import CameraView, SweepView

MIN_ROTATION_RAD, MIN_TRANSLATION_M = math.radians(0.7), 0.15
"""Minimum rotation (rad) and translation (m) that are reported."""
_MIN_GAIN, _MIN_IMPROVED_SHARE = 0.03, 0.8
"""An offset is accepted if it raises the agreement by at least this much, in at least this share of views."""
_MAX_OWN_AGREEMENT, _MIN_DIFFERENCE = 0.5, 0.3
"""Images are assigned to another camera if their agreement with their own camera is below the first number
and that with the other camera is higher by more than the second.
"""


def calibration_findings(
    names: Sequence[str], cameras: Sequence[CameraView], sweeps: Sequence[SweepView], tracks: ActorTracks
) -> list[str]:
    """Return a sentence for each sensor whose pose does not agree with its calibration; none if all agree.

    Without enough evidence (no lidar, tiny images) it returns nothing.

    Args:
        names: names of the rig's cameras.
        cameras: views with images, of all cameras.
        sweeps: lidar sweeps of the same drive.
        tracks: tracks of the moving actors.
    """
    by_camera = {name: [v for v in cameras if v.sensor == number] for number, name in enumerate(names)}
    pairs = {name: calibration_views(views, sweeps, tracks) for name, views in by_camera.items()}
    exchanged = {
        name: other for name in names if (other := _exchanged_camera(name, by_camera, pairs, sweeps, tracks))
    }
    findings = [f"the images of camera {name} fit the pose of {other}" for name, other in exchanged.items()]
    rest = {name: views for name, views in pairs.items() if name not in exchanged}
    rotations = {name: fit for name, views in rest.items() if (fit := best_camera_rotation(views))}
    translation = best_lidar_translation([view for views in rest.values() for view in views])
    if (
        translation is not None
        and _is_significant(translation, MIN_TRANSLATION_M)
        and _mean_gain(translation) > _mean_gain(*rotations.values())
    ):
        forward_m, left_m, up_m = translation.offset.tolist()
        return [
            *findings,
            "the lidar fits the images better if it is moved "
            f"{_directed(forward_m, ' m', 'forward', 'back')}, "
            f"{_directed(left_m, ' m', 'to the left', 'to the right')} and "
            f"{_directed(up_m, ' m', 'up', 'down')} {_scores(translation)}",
        ]
    return findings + [
        f"camera {name} {_rotation(fit)}"
        for name, fit in rotations.items()
        if _is_significant(fit, MIN_ROTATION_RAD)
    ]


def _rotation(fit: OffsetFit) -> str:
    up, right, clockwise = (math.degrees(angle) for angle in fit.offset.tolist())
    return (
        f"fits the lidar better if it is turned {_directed(up, '°', 'up', 'down')}, "
        f"{_directed(right, '°', 'to the right', 'to the left')} and "
        f"{_directed(clockwise, '°', 'clockwise', 'counter-clockwise')} {_scores(fit)}"
    )


def _directed(value: float, unit: str, positive: str, negative: str) -> str:
    """Return the value with its direction, such as "0.25° up" or "0.25° down"."""
    return f"{abs(value):.2f}{unit} {positive if value >= 0 else negative}"


def _scores(fit: OffsetFit) -> str:
    return f"(agreement {fit.score_after:.2f} instead of {fit.score_before:.2f})"


def _is_significant(fit: OffsetFit, min_offset: float) -> bool:
    large = float(fit.offset.norm()) >= min_offset
    return large and _mean_gain(fit) >= _MIN_GAIN and fit.improved_share >= _MIN_IMPROVED_SHARE


def _mean_gain(*fits: OffsetFit) -> float:
    """Return the mean increase of agreement."""
    return sum(fit.score_after - fit.score_before for fit in fits) / max(len(fits), 1)


def _exchanged_camera(
    name: str,
    by_camera: Mapping[str, Sequence[CameraView]],
    pairs: Mapping[str, Sequence[CalibrationView]],
    sweeps: Sequence[SweepView],
    tracks: ActorTracks,
) -> str | None:
    """Return the camera whose pose fits a camera's images clearly better; None if there is none."""
    own = agreement(pairs[name])
    if own is None or own >= _MAX_OWN_AGREEMENT:
        return None
    scores = {
        other: agreement(calibration_views(with_images_from(views, by_camera[name]), sweeps, tracks)) or 0.0
        for other, views in by_camera.items()
        if other != name and views
    }
    best = max(scores, key=lambda other: scores[other], default=None)
    return best if best is not None and scores[best] > own + _MIN_DIFFERENCE else None
