"""Check the calibration of a log before its reconstruction."""

import math
from collections.abc import Mapping, Sequence

from foredrive.rendering.calibration import (
    Fit,
    Glance,
    agreement,
    camera_turn,
    glances,
    lidar_move,
    with_images_of,
)
from foredrive.rendering.tracks import Tracks
from foredrive.rendering.views import CameraView, SweepView

LARGE_RAD, LARGE_M = math.radians(0.7), 0.15
"""Minimum rotation (rad) and shift (m) that are reported."""
_GAIN, _AGREED = 0.03, 0.8
"""An offset is accepted if it raises the agreement by at least `_GAIN`, and does so in at least the share
`_AGREED` of the views.
"""
_POOR, _CLEARLY = 0.5, 0.3
"""Images are assigned to another camera if their own agreement is below `_POOR` and the other's is higher by
more than `_CLEARLY`.
"""


def calibration_doubts(
    names: Sequence[str], cameras: Sequence[CameraView], sweeps: Sequence[SweepView], tracks: Tracks
) -> list[str]:
    """Return a sentence for each sensor whose pose does not agree with its calibration; none if all agree.

    Without enough evidence (no lidar, tiny images) it returns nothing.

    Args:
        names: names of the rig's cameras.
        cameras: views with images, of all cameras.
        sweeps: lidar sweeps of the same drive.
        tracks: tracks of the moving actors.
    """
    views = {name: [v for v in cameras if v.sensor == number] for number, name in enumerate(names)}
    seen = {name: glances(of_one, sweeps, tracks) for name, of_one in views.items()}
    exchanged = {name: other for name in names if (other := _whose_images(name, views, seen, sweeps, tracks))}
    doubts = [f"camera {name}: its images fit the place of {other}" for name, other in exchanged.items()]
    rest = {name: of_one for name, of_one in seen.items() if name not in exchanged}
    turns = {name: fit for name, of_one in rest.items() if (fit := camera_turn(of_one)) is not None}
    turned = {name: fit for name, fit in turns.items() if _believed(fit, LARGE_RAD)}
    moved = lidar_move([glance for of_one in rest.values() for glance in of_one])
    if moved is not None and _believed(moved, LARGE_M) and _gain(moved) > _gain(*turns.values()):
        forward_m, left_m, up_m = moved.offset.tolist()
        return [
            *doubts,
            f"the lidar: it fits the images better {_way(forward_m, 'm forward', 'm back')}, "
            f"{_way(left_m, 'm to the left', 'm to the right')} and {_way(up_m, 'm up', 'm down')} "
            f"(agreement {moved.best:.2f} instead of {moved.given:.2f})",
        ]
    return doubts + [f"camera {name}: {_turned(fit)}" for name, fit in turned.items()]


def _turned(fit: Fit) -> str:
    up, right, clockwise = (math.degrees(angle) for angle in fit.offset.tolist())
    return (
        f"it fits the lidar better turned {_way(up, '° up', '° down')}, "
        f"{_way(right, '° to the right', '° to the left')} and "
        f"{_way(clockwise, '° clockwise', '° counter-clockwise')} "
        f"(agreement {fit.best:.2f} instead of {fit.given:.2f})"
    )


def _way(value: float, ahead: str, back: str) -> str:
    """Return the value with its direction, such as "0.25° up" or "0.25° down"."""
    unit = ahead if value >= 0 else back
    return f"{abs(value):.2f}{unit}" if unit.startswith("°") else f"{abs(value):.2f} {unit}"


def _believed(fit: Fit, large: float) -> bool:
    return float(fit.offset.norm()) >= large and _gain(fit) >= _GAIN and fit.agreed >= _AGREED


def _gain(*fits: Fit) -> float:
    """Return the mean increase of agreement."""
    return sum(fit.best - fit.given for fit in fits) / max(len(fits), 1)


def _whose_images(
    name: str,
    views: Mapping[str, Sequence[CameraView]],
    seen: Mapping[str, Sequence[Glance]],
    sweeps: Sequence[SweepView],
    tracks: Tracks,
) -> str | None:
    """Return the camera whose pose fits a camera's images clearly better; None if there is none."""
    own = agreement(seen[name])
    if own is None or own >= _POOR:
        return None
    there = {
        other: agreement(glances(with_images_of(views[other], views[name]), sweeps, tracks)) or 0.0
        for other in views
        if other != name and views[other]
    }
    best = max(there, key=lambda other: there[other], default=None)
    return best if best is not None and there[best] > own + _CLEARLY else None
