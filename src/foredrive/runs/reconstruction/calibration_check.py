"""Check the calibration of a log before its reconstruction."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from foredrive.methods.reconstruction.calibration import (
    CalibrationViews,
    OffsetFit,
    agreement,
    best_camera_delay,
    best_camera_rotation,
    best_lidar_translation,
    calibration_views,
    mean_shift_rad,
    with_images_from,
)
from foredrive.methods.reconstruction.lens_fit import best_camera_lens
from foredrive.methods.reconstruction.sweep_edges import SweepEdges, sweep_edges
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.views import CameraView, SweepView

MIN_ROTATION_RAD, MIN_TRANSLATION_M, MIN_DELAY_S = math.radians(0.4), 0.15, 0.03
"""Minimum rotation (as it moves edges in the image), translation and delay that are reported."""
LARGE_ROTATION_RAD = math.radians(0.7)
"""Rotation from which a reconstruction is visibly worse."""
_MIN_GAIN, _MIN_IMPROVED_SHARE = 0.05, 0.8
"""An offset is accepted if it raises the agreement by at least this much, in at least this share of views."""
_SIMPLER = 0.85
"""Share of the gain of rotations for which one clock or one lidar is the better explanation."""
_SOUND_AGREEMENT, _MIN_LENS_GAIN, _MIN_LENS_SCORE, _MIN_FOCAL_SHARE = 0.5, 0.1, 0.3, 0.05
"""Another lens is looked for where the agreement is below the first number. It is accepted if it raises the
agreement by more than the second over that of any rotation, to more than the third, and differs by more than
the last."""
_MAX_OWN_AGREEMENT, _MIN_DIFFERENCE = 0.15, 0.2
"""Images are assigned to another camera if their agreement with their own camera is below the first number
and that with the other camera is higher by more than the second.
"""


@dataclass(frozen=True)
class CalibrationFinding:
    """A sensor whose pose or clock does not agree with its calibration."""

    text: str
    large: bool
    """False for an offset that is seen but hardly matters."""


def calibration_findings(
    names: Sequence[str], cameras: Sequence[CameraView], sweeps: Sequence[SweepView], tracks: ActorTracks
) -> list[CalibrationFinding]:
    """Return a finding for each sensor whose pose does not agree with its calibration; none if all agree.

    Without enough evidence (no lidar, tiny images) it returns nothing.

    Args:
        names: names of the rig's cameras.
        cameras: views with images, of all cameras.
        sweeps: lidar sweeps of the same drive.
        tracks: tracks of the moving actors.
    """
    edges = sweep_edges(sweeps, tracks)
    by_camera = {name: [v for v in cameras if v.sensor == number] for number, name in enumerate(names)}
    paired = {
        name: pairs
        for name, views in by_camera.items()
        if (pairs := calibration_views(views, edges)) is not None
    }
    exchanged = {
        name: other
        for name, views in paired.items()
        if (other := _exchanged_camera(name, views, by_camera, edges)) is not None
    }
    findings = [
        CalibrationFinding(f"the images of camera {name} fit the pose of {other}", large=True)
        for name, other in exchanged.items()
    ]
    rest = {name: views for name, views in paired.items() if name not in exchanged}
    rotations = {name: best_camera_rotation(views) for name, views in rest.items()}
    translation = best_lidar_translation(list(rest.values()))
    if (
        translation is not None
        and _is_significant(translation, float(translation.offset.norm()), MIN_TRANSLATION_M)
        and translation.gain > _SIMPLER * sum(fit.gain for fit in rotations.values()) / len(rotations)
    ):
        return [*findings, CalibrationFinding(_translation(translation), large=True)]
    for name, views in rest.items():
        findings += _camera_findings(name, views, rotations[name])
    return findings


def _camera_findings(name: str, views: CalibrationViews, rotation: OffsetFit) -> list[CalibrationFinding]:
    """Return what explains a camera's images better than its calibration: a lens, a rotation or a clock."""
    lens = _lens(views, rotation)
    if lens is not None:
        return [CalibrationFinding(f"camera {name} {lens}", large=True)]
    shift_rad = mean_shift_rad(views, rotation.offset)
    turned = _is_significant(rotation, shift_rad, MIN_ROTATION_RAD)
    delay = best_camera_delay(views)
    delayed = _is_significant(delay, abs(float(delay.offset)), MIN_DELAY_S)
    if delayed and delay.gain > _SIMPLER * rotation.gain:
        return [CalibrationFinding(f"camera {name} {_delay(delay)}", large=True)]
    if turned:
        return [CalibrationFinding(f"camera {name} {_rotation(rotation)}", shift_rad >= LARGE_ROTATION_RAD)]
    return []


def _lens(views: CalibrationViews, rotation: OffsetFit) -> str | None:
    """Return which other lens explains the images much better than any rotation, or None."""
    if agreement(views) > _SOUND_AGREEMENT:
        return None
    lens = best_camera_lens(views)
    fit = lens.rotation
    gain = fit.score_after - max(rotation.score_after, rotation.score_before)
    if (
        gain < _MIN_LENS_GAIN
        or fit.score_after < _MIN_LENS_SCORE
        or abs(lens.focal_scale - 1) < _MIN_FOCAL_SHARE
    ):
        return None
    undistorted = " and no distortion" if lens.undistorted else ""
    return (
        f"fits the lidar better with {lens.focal_scale:.2f} of its focal length{undistorted} (agreement "
        f"{fit.score_after:.2f} instead of {rotation.score_before:.2f}); were the images changed?"
    )


def _rotation(fit: OffsetFit) -> str:
    up, right, clockwise = (math.degrees(angle) for angle in fit.offset.tolist())
    return (
        f"fits the lidar better if it is turned {_directed(up, '°', 'up', 'down')}, "
        f"{_directed(right, '°', 'to the right', 'to the left')} and "
        f"{_directed(clockwise, '°', 'clockwise', 'counter-clockwise')} {_scores(fit)}"
    )


def _delay(fit: OffsetFit) -> str:
    delay_s = _directed(float(fit.offset), " s", "later", "earlier")
    return f"fits the lidar better if its images are from {delay_s} {_scores(fit)}"


def _translation(fit: OffsetFit) -> str:
    forward_m, left_m, up_m = fit.offset.tolist()
    return (
        "the lidar fits the images better if it is moved "
        f"{_directed(forward_m, ' m', 'forward', 'back')}, "
        f"{_directed(left_m, ' m', 'to the left', 'to the right')} and "
        f"{_directed(up_m, ' m', 'up', 'down')} {_scores(fit)}"
    )


def _directed(value: float, unit: str, positive: str, negative: str) -> str:
    """Return the value with its direction, such as "0.25° up" or "0.25° down"."""
    return f"{abs(value):.2f}{unit} {positive if value >= 0 else negative}"


def _scores(fit: OffsetFit) -> str:
    return f"(agreement {fit.score_after:.2f} instead of {fit.score_before:.2f})"


def _is_significant(fit: OffsetFit, size: float, min_size: float) -> bool:
    """Return whether an offset is an optimum, large enough, and better in nearly all views."""
    better = fit.gain >= _MIN_GAIN and fit.improved_share >= _MIN_IMPROVED_SHARE
    return better and size >= min_size and not fit.bounded


def _exchanged_camera(
    name: str,
    views: CalibrationViews,
    by_camera: Mapping[str, Sequence[CameraView]],
    edges: Sequence[SweepEdges],
) -> str | None:
    """Return the camera whose pose fits a camera's images clearly better; None if there is none."""
    own = agreement(views)
    if own >= _MAX_OWN_AGREEMENT:
        return None
    scores = {}
    for other, other_views in by_camera.items():
        if other != name and other_views:
            swapped = calibration_views(with_images_from(other_views, by_camera[name]), edges)
            scores[other] = 0.0 if swapped is None else agreement(swapped)
    best = max(scores, key=lambda other: scores[other], default=None)
    if best is None or scores[best] <= own + _MIN_DIFFERENCE:
        return None
    return best if scores[best] > best_camera_rotation(views).score_after else None
