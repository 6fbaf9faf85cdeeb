"""A check of camera calibration: images against lidar.

A camera is tested in two ways. Lidar points should look the same from the vehicle's position some metres
later; this holds if depth, poses and camera fit together. And where lidar sees one object in front of
another, the image should have an edge (Levinson & Thrun, "Automatic online calibration of cameras and
lasers", RSS 2013). Both scores are highest at the true calibration. They are lower at an error of half a
degree or a decimetre.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, gaussian_gradient_magnitude
from torch import Tensor

from foredrive.geometry.projection import project
from foredrive.geometry.se3 import exp_se3, inverse_se3, transform_points
from foredrive.rendering.seed_points import actor_rows
from foredrive.rendering.tracks import ActorTracks, states_at
from foredrive.rendering.views import CameraView, SweepView
from foredrive.scene import LidarSweep

_ROTATION_RAD, _TRANSLATION_M = math.radians(0.5), 0.1
_ROTATION_STEPS = (((0, 1), 4.0), ((0, 1), 2.0), ((0, 1), 1.0), ((0, 1, 2), 1.0), ((0, 1, 2), 0.5))
_TRANSLATION_STEPS = (((0, 1, 2), 2.0), ((0, 1, 2), 1.0), ((0, 1, 2), 0.5))
"""Steps of the search: axes (of rotation or translation) and step size in the units above."""
_MAX_STEPS = 8.0
"""Bound of the search, in the units above."""
_VIEWS, _MIN_VIEWS = 12, 4
_BASELINE_M = 3.0
"""Driven distance between two compared images, m."""
_MAX_POINTS, _MIN_POINTS = 4000, 50
"""Maximum points used of a sweep and minimum points in an image."""
_WIDTH_PX, _FINE_PX, _COARSE_PX = 480, 1.5, 12.0
"""Maximum image width, its blur, and the scale over which brightness and contrast are normalised."""
_MIN_CONTRAST = 0.02
_SATURATION = 0.95
"""Quantile of the gradient from which on all edges count equally."""
_JUMP_M, _JUMP_SHARE, _NEXT_RAD = 0.5, 0.1, math.radians(0.8)
"""An edge needs a range jump of this many metres plus this share of the range, between beams this close."""
_MAX_STATIC_MPS = 0.3
_MIN_FOCAL = 150.0
"""Minimum focal length, px/rad: coarser images cannot show half a degree."""


@dataclass(frozen=True)
class CalibrationView:
    """An image, a later image of the same place, and the static lidar points in view."""

    view: CameraView
    later: CameraView | None
    appearance: Float[Tensor, "1 1 H W"]
    later_appearance: Float[Tensor, "1 1 H W"] | None
    edge: Float[Tensor, "1 1 H W"]
    T_scene_ego: Float[Tensor, "4 4"]
    """Pose of the sweep's ego frame."""
    points_ego: Float[Tensor, "N 3"]
    edges_ego: Float[Tensor, "E 3"]


@dataclass(frozen=True)
class OffsetFit:
    """Agreement of the sensors as calibrated and after the best offset."""

    score_before: float
    """Score as calibrated: the sum of both tests, typically 0.6 to 1.2; 0 is chance."""
    score_after: float
    """Score with `offset`."""
    offset: Float[Tensor, "3"]
    improved_share: float
    """Share of the views that fit better with `offset`."""


def calibration_views(
    cameras: Sequence[CameraView], sweeps: Sequence[SweepView], tracks: ActorTracks
) -> list[CalibrationView]:
    """Pick views of one camera, evenly spaced along the driven path, or in time if the path is short.

    Args:
        cameras: views in order of time, with images.
        sweeps: sweeps of the same drive.
        tracks: moving actors, which are left out.
    """
    if not cameras or not sweeps or float(_downsampled(cameras[0]).K[0, 0]) < _MIN_FOCAL:
        return []
    position_m = torch.stack([view.T_scene_cam[:3, 3] for view in cameras])
    path_m = F.pad((position_m[1:] - position_m[:-1]).norm(dim=-1).cumsum(0), (1, 0))
    last_m = float(path_m[-1]) - _BASELINE_M
    if last_m > 0:
        starts = torch.searchsorted(path_m, torch.linspace(0, last_m, _VIEWS))
    else:
        starts = torch.linspace(0, len(cameras) - 1, _VIEWS).round().long()
    found = []
    for start in starts.unique().tolist():
        end = int(torch.searchsorted(path_m, path_m[start] + _BASELINE_M))
        view, later = cameras[start], cameras[end] if end < len(cameras) else None
        sweep = min(sweeps, key=lambda other: abs(other.t_s - view.t_s))
        pair = _calibration_view(view, later, sweep, tracks)
        if len(pair.points_ego) >= _MIN_POINTS:
            found.append(pair)
    return found


def agreement(views: Sequence[CalibrationView]) -> float | None:
    """Return the score as calibrated (see `OffsetFit.score_before`), or None if there are too few views."""
    if len(views) < _MIN_VIEWS:
        return None
    return float(_scores(views, torch.zeros(6), torch.zeros(3)).mean())


def best_camera_rotation(views: Sequence[CalibrationView]) -> OffsetFit | None:
    """Find the rotation of a camera that fits best: up, to its right, clockwise, rad.

    Return None if there are too few views.
    """
    if len(views) < _MIN_VIEWS:
        return None

    def scores(offset: Tensor) -> Tensor:
        return _scores(views, F.pad(offset, (3, 0)), torch.zeros(3))

    return _search(scores, _ROTATION_RAD, _ROTATION_STEPS)


def best_lidar_translation(views: Sequence[CalibrationView]) -> OffsetFit | None:
    """Find the translation of the lidar that fits all cameras best: forward, left, up, m.

    Return None if there are too few views.
    """
    if len(views) < _MIN_VIEWS:
        return None
    return _search(lambda offset: _scores(views, torch.zeros(6), offset), _TRANSLATION_M, _TRANSLATION_STEPS)


def with_images_from(cameras: Sequence[CameraView], others: Sequence[CameraView]) -> list[CameraView]:
    """Return the views with the images that another camera took nearest in time."""
    return [
        dataclasses.replace(view, image=min(others, key=lambda other: abs(other.t_s - view.t_s)).image)
        for view in cameras
    ]


def _search(
    scores: Callable[[Float[Tensor, "3"]], Float[Tensor, "G"]],
    unit: float,
    steps: Sequence[tuple[tuple[int, ...], float]],
) -> OffsetFit:
    """Climb by steps of decreasing size, each along the axis that gains most."""
    at, given = torch.zeros(3), scores(torch.zeros(3))
    best = given
    for axes, size in steps:
        while True:
            near = [at + sign * size * unit * F.one_hot(torch.tensor(axis), 3)
                    for axis in axes for sign in (-1.0, 1.0)]  # fmt: skip
            within = [offset for offset in near if float(offset.abs().max()) <= _MAX_STEPS * unit]
            tried = [(scores(offset), offset) for offset in within]
            score, offset = max(tried, key=lambda pair: float(pair[0].mean()))
            if float(score.mean()) <= float(best.mean()):
                break
            best, at = score, offset
    return OffsetFit(float(given.mean()), float(best.mean()), at, float((best > given).float().mean()))


def _scores(
    views: Sequence[CalibrationView], camera: Float[Tensor, "6"], lidar_m: Float[Tensor, "3"]
) -> Tensor:
    """Return the score of each pair with the camera (m, rad, own axes) and the lidar (ego axes) moved."""
    T_cam_moved = exp_se3(camera)
    return torch.tensor([_score(view, T_cam_moved, lidar_m) for view in views])


def _score(pair: CalibrationView, T_cam_moved: Float[Tensor, "4 4"], lidar_m: Float[Tensor, "3"]) -> float:
    """Return the mean edge strength at lidar edges plus the correlation of both images at lidar points."""

    def place(view: CameraView, points_ego: Float[Tensor, "N 3"]) -> tuple[Tensor, Tensor]:
        return _project(view, T_cam_moved, transform_points(pair.T_scene_ego, points_ego + lidar_m))

    uv, inside = place(pair.view, pair.edges_ego)
    score = float(_sample(pair.edge, uv[inside]).sum()) / max(int(inside.sum()), _MIN_POINTS)
    if pair.later is not None and pair.later_appearance is not None:
        uv, inside = place(pair.view, pair.points_ego)
        later_uv, later_inside = place(pair.later, pair.points_ego)
        both = inside & later_inside
        if int(both.sum()) >= _MIN_POINTS:
            now, later = _sample(pair.appearance, uv[both]), _sample(pair.later_appearance, later_uv[both])
            score += float(torch.corrcoef(torch.stack([now, later]))[0, 1].nan_to_num())
    return score


def _project(
    view: CameraView, T_cam_moved: Float[Tensor, "4 4"], points_m: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "N 2"], Bool[Tensor, "N"]]:
    points_cam = transform_points(inverse_se3(view.T_scene_cam @ T_cam_moved), points_m)
    uv, _, inside = project(points_cam, view.K, view.dist, view.size_hw)
    return uv, inside


def _sample(image: Float[Tensor, "1 1 H W"], uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N"]:
    size_wh = torch.tensor([image.shape[-1], image.shape[-2]])
    return F.grid_sample(image, (2 * uv / size_wh - 1)[None, None], align_corners=False)[0, 0, 0]


def _calibration_view(
    view: CameraView, later: CameraView | None, sweep: SweepView, tracks: ActorTracks
) -> CalibrationView:
    view, later = _downsampled(view), None if later is None else _downsampled(later)
    beams = _static_beams(sweep, tracks)
    seen = _project(view, torch.eye(4), transform_points(sweep.T_scene_ego, beams.points_ego))[1]
    points_ego = beams.points_ego[seen]
    appearance = _appearance(view)
    return CalibrationView(
        view=view,
        later=later,
        appearance=torch.from_numpy(appearance)[None, None],
        later_appearance=None if later is None else torch.from_numpy(_appearance(later))[None, None],
        edge=torch.from_numpy(_edges(appearance))[None, None],
        T_scene_ego=sweep.T_scene_ego,
        points_ego=points_ego[:: max(len(points_ego) // _MAX_POINTS, 1)],
        edges_ego=_edges_ego(beams),
    )


def _static_beams(sweep: SweepView, tracks: ActorTracks) -> LidarSweep:
    """Return the beams that hit static surfaces."""
    beams = sweep.beams[sweep.beams.returned]
    states = states_at(tracks, sweep.t_s)
    owner = actor_rows(transform_points(sweep.T_scene_ego, beams.points_ego), beams.dt_s, states, tracks)
    moving = states.velocity_mps.norm(dim=-1) > _MAX_STATIC_MPS
    return beams[~torch.cat([moving, moving.new_zeros(1)])[owner]]  # STATIC is -1, the last entry


def _downsampled(view: CameraView) -> CameraView:
    return view.shrunk(max(view.size_hw[1] // _WIDTH_PX, 1))


def _appearance(view: CameraView) -> Float[np.ndarray, "H W"]:
    """Return brightness, normalised by local mean and contrast."""
    assert view.image is not None
    grey = gaussian_filter(view.image.float().mean(0).numpy() / 255, _FINE_PX)
    mean = gaussian_filter(grey, _COARSE_PX)
    variance = gaussian_filter(grey * grey, _COARSE_PX) - mean * mean
    return (grey - mean) / (np.sqrt(variance.clip(min=0.0)) + _MIN_CONTRAST)


def _edges(appearance: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Return the gradient magnitude, at most 1, minus its mean."""
    change = gaussian_gradient_magnitude(appearance, 0.5)
    change = (change / max(float(np.quantile(change, _SATURATION)), 1e-6)).clip(max=1.0)
    return change - change.mean()


def _edges_ego(beams: LidarSweep) -> Float[Tensor, "E 3"]:
    """Return the points next to which a beam of the same channel hit something farther."""
    beams = beams[beams.beam >= 0]
    azimuth = torch.atan2(beams.dir_ego[:, 1], beams.dir_ego[:, 0])
    order = (beams.beam * 10.0 + azimuth).argsort()
    beams, azimuth = beams[order], azimuth[order]
    near = (beams.beam[1:] == beams.beam[:-1]) & ((azimuth[1:] - azimuth[:-1]).abs() < _NEXT_RAD)
    farther_m = beams.range_m[1:] - beams.range_m[:-1]
    min_jump_m = _JUMP_M + _JUMP_SHARE * torch.minimum(beams.range_m[1:], beams.range_m[:-1])
    edge = torch.zeros(len(beams.range_m), dtype=torch.bool)
    edge[:-1] |= near & (farther_m > min_jump_m)
    edge[1:] |= near & (-farther_m > min_jump_m)
    return beams.points_ego[edge]
