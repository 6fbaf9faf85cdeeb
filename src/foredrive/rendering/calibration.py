"""Whether cameras look where their calibration says: images against what lidar saw.

Two things are asked of a camera. What lidar saw should look the same from where the vehicle is some metres on
(depth, poses and camera then fit together), and where lidar sees one thing in front of another the image
should have an edge (Levinson & Thrun, "Automatic online calibration of cameras and lasers", RSS 2013). Both
fit best where the camera really looks, and less by half a degree or a decimetre beside.
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
from foredrive.rendering.seed_points import owners
from foredrive.rendering.tracks import Tracks, states_at
from foredrive.rendering.views import CameraView, SweepView
from foredrive.scene import LidarSweep

_TURN_RAD, _MOVE_M = math.radians(0.5), 0.1
_TURN_STEPS = (((0, 1), 4.0), ((0, 1), 2.0), ((0, 1), 1.0), ((0, 1, 2), 1.0), ((0, 1, 2), 0.5))
_MOVE_STEPS = (((0, 1, 2), 2.0), ((0, 1, 2), 1.0), ((0, 1, 2), 0.5))
"""About or along which axes offsets are looked for, and by how many of the units above."""
_REACH = 8.0
"""At most so many."""
_VIEWS, _FEWEST_VIEWS = 12, 4
_ON_M = 3.0
"""How far the vehicle drives between two images that are compared."""
_POINTS, _FEWEST_POINTS = 4000, 50
"""Of a sweep, in an image."""
_WIDTH_PX, _FINE_PX, _COARSE_PX = 480, 1.5, 12.0
"""Width of images at most, their blur, and over how much brightness and contrast are evened out."""
_LEAST_CONTRAST = 0.02
_STRONGEST = 0.95
"""Quantile of the gradient from which on an edge is as good as any."""
_JUMP_M, _JUMP_SHARE, _NEXT_RAD = 0.5, 0.1, math.radians(0.8)
"""What is behind an edge is farther by so much and by a share of the range, in a beam so near."""
_STANDS_MPS = 0.3
_COARSEST = 150.0
"""Pixels per rad of images in which half a degree can be seen."""


@dataclass(frozen=True)
class Glance:
    """An image, one of the same place from further on, and what lidar saw of all that stands there."""

    view: CameraView
    later: CameraView | None
    look: Float[Tensor, "1 1 H W"]
    later_look: Float[Tensor, "1 1 H W"] | None
    edge: Float[Tensor, "1 1 H W"]
    T_scene_ego: Float[Tensor, "4 4"]
    """Of the sweep."""
    points_ego: Float[Tensor, "N 3"]
    edges_ego: Float[Tensor, "E 3"]


@dataclass(frozen=True)
class Fit:
    """How well sensors fit, and would elsewhere."""

    given: float
    """As they are calibrated: agreement over both questions, some 0.6 to 1.2; 0 is chance."""
    best: float
    """With `offset`."""
    offset: Float[Tensor, "3"]
    agreed: float
    """Share of the glances that fit better with it."""


def glances(cameras: Sequence[CameraView], sweeps: Sequence[SweepView], tracks: Tracks) -> list[Glance]:
    """Views of one camera spread over the way that was driven, or over time where that is short.

    Args:
        cameras: in the order of time, with images.
        sweeps: of the same drive.
        tracks: what moves is left out.
    """
    if not cameras or not sweeps or float(_small(cameras[0]).K[0, 0]) < _COARSEST:
        return []
    position_m = torch.stack([view.T_scene_cam[:3, 3] for view in cameras])
    way_m = F.pad((position_m[1:] - position_m[:-1]).norm(dim=-1).cumsum(0), (1, 0))
    last_m = float(way_m[-1]) - _ON_M
    if last_m > 0:
        starts = torch.searchsorted(way_m, torch.linspace(0, last_m, _VIEWS))
    else:
        starts = torch.linspace(0, len(cameras) - 1, _VIEWS).round().long()
    found = []
    for start in starts.unique().tolist():
        end = int(torch.searchsorted(way_m, way_m[start] + _ON_M))
        view, later = cameras[start], cameras[end] if end < len(cameras) else None
        sweep = min(sweeps, key=lambda other: abs(other.t_s - view.t_s))
        glance = _glance(_small(view), None if later is None else _small(later), sweep, tracks)
        if len(glance.points_ego) >= _FEWEST_POINTS:
            found.append(glance)
    return found


def agreement(of_camera: Sequence[Glance]) -> float | None:
    """How well a camera fits as it is calibrated (see `Fit.given`); None where too little is seen to tell."""
    if len(of_camera) < _FEWEST_VIEWS:
        return None
    return float(_scores(of_camera, torch.zeros(6), torch.zeros(3)).mean())


def camera_turn(of_camera: Sequence[Glance]) -> Fit | None:
    """By how much a camera should be turned to fit best: upwards, to its right, clockwise, rad.

    None where too little is seen to tell.
    """
    if len(of_camera) < _FEWEST_VIEWS:
        return None

    def scores(offset: Tensor) -> Tensor:
        return _scores(of_camera, F.pad(offset, (3, 0)), torch.zeros(3))

    return _best(scores, _TURN_RAD, _TURN_STEPS)


def lidar_move(of_cameras: Sequence[Glance]) -> Fit | None:
    """By how much the lidar should be moved for all cameras to fit best: forward, left, up, m.

    None where too little is seen to tell.
    """
    if len(of_cameras) < _FEWEST_VIEWS:
        return None
    return _best(lambda offset: _scores(of_cameras, torch.zeros(6), offset), _MOVE_M, _MOVE_STEPS)


def with_images_of(cameras: Sequence[CameraView], others: Sequence[CameraView]) -> list[CameraView]:
    """Views with the images that another camera took nearest in time."""
    return [
        dataclasses.replace(view, image=min(others, key=lambda other: abs(other.t_s - view.t_s)).image)
        for view in cameras
    ]


def _best(
    scores: Callable[[Float[Tensor, "3"]], Float[Tensor, "G"]],
    unit: float,
    steps: Sequence[tuple[tuple[int, ...], float]],
) -> Fit:
    """Uphill by ever smaller steps, each along the axis that gains most."""
    at, given = torch.zeros(3), scores(torch.zeros(3))
    best = given
    for axes, size in steps:
        while True:
            near = [at + sign * size * unit * F.one_hot(torch.tensor(axis), 3)
                    for axis in axes for sign in (-1.0, 1.0)]  # fmt: skip
            tried = [(scores(there), there) for there in near if float(there.abs().max()) <= _REACH * unit]
            most, there = max(tried, key=lambda pair: float(pair[0].mean()))
            if float(most.mean()) <= float(best.mean()):
                break
            best, at = most, there
    return Fit(float(given.mean()), float(best.mean()), at, float((best > given).float().mean()))


def _scores(some: Sequence[Glance], camera: Float[Tensor, "6"], lidar_m: Float[Tensor, "3"]) -> Tensor:
    """Of each, with the camera (m, rad, its own axes) and the lidar (ego axes) elsewhere."""
    T_cam_moved = exp_se3(camera)
    return torch.tensor([_score(glance, T_cam_moved, lidar_m) for glance in some])


def _score(glance: Glance, T_cam_moved: Float[Tensor, "4 4"], lidar_m: Float[Tensor, "3"]) -> float:
    """How much edge there is at lidar's edges, and how both images correlate at its points."""

    def place(view: CameraView, points_ego: Float[Tensor, "N 3"]) -> tuple[Tensor, Tensor]:
        return _seen_at(view, T_cam_moved, transform_points(glance.T_scene_ego, points_ego + lidar_m))

    uv, inside = place(glance.view, glance.edges_ego)
    score = float(_read(glance.edge, uv[inside]).sum()) / max(int(inside.sum()), _FEWEST_POINTS)
    if glance.later is not None and glance.later_look is not None:
        uv, inside = place(glance.view, glance.points_ego)
        later_uv, later_inside = place(glance.later, glance.points_ego)
        both = inside & later_inside
        if int(both.sum()) >= _FEWEST_POINTS:
            pair = torch.stack([_read(glance.look, uv[both]), _read(glance.later_look, later_uv[both])])
            score += float(torch.corrcoef(pair)[0, 1].nan_to_num())
    return score


def _seen_at(
    view: CameraView, T_cam_moved: Float[Tensor, "4 4"], points_m: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "N 2"], Bool[Tensor, "N"]]:
    points_cam = transform_points(inverse_se3(view.T_scene_cam @ T_cam_moved), points_m)
    uv, _, inside = project(points_cam, view.K, view.dist, view.size_hw)
    return uv, inside


def _read(image: Float[Tensor, "1 1 H W"], uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N"]:
    size_wh = torch.tensor([image.shape[-1], image.shape[-2]])
    return F.grid_sample(image, (2 * uv / size_wh - 1)[None, None], align_corners=False)[0, 0, 0]


def _glance(view: CameraView, later: CameraView | None, sweep: SweepView, tracks: Tracks) -> Glance:
    beams = _standing(sweep, tracks)
    seen = _seen_at(view, torch.eye(4), transform_points(sweep.T_scene_ego, beams.points_ego))[1]
    points_ego = beams.points_ego[seen]
    look = _look(view)
    return Glance(
        view=view,
        later=later,
        look=torch.from_numpy(look)[None, None],
        later_look=None if later is None else torch.from_numpy(_look(later))[None, None],
        edge=torch.from_numpy(_edges(look))[None, None],
        T_scene_ego=sweep.T_scene_ego,
        points_ego=points_ego[:: max(len(points_ego) // _POINTS, 1)],
        edges_ego=_edges_ego(beams),
    )


def _standing(sweep: SweepView, tracks: Tracks) -> LidarSweep:
    """The beams that met what stands."""
    beams = sweep.beams[sweep.beams.returned]
    states = states_at(tracks, sweep.t_s)
    owner = owners(transform_points(sweep.T_scene_ego, beams.points_ego), beams.dt_s, states, tracks)
    moving = states.velocity_mps.norm(dim=-1) > _STANDS_MPS
    return beams[~torch.cat([moving, moving.new_zeros(1)])[owner]]  # STATIC, -1, is the last entry


def _small(view: CameraView) -> CameraView:
    return view.shrunk(max(view.size_hw[1] // _WIDTH_PX, 1))


def _look(view: CameraView) -> Float[np.ndarray, "H W"]:
    """Brightness, with what is bright and what is rich in contrast evened out."""
    assert view.image is not None
    grey = gaussian_filter(view.image.float().mean(0).numpy() / 255, _FINE_PX)
    mean = gaussian_filter(grey, _COARSE_PX)
    variance = gaussian_filter(grey * grey, _COARSE_PX) - mean * mean
    return (grey - mean) / (np.sqrt(variance.clip(min=0.0)) + _LEAST_CONTRAST)


def _edges(look: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """How much it changes, 1 at most, less its mean."""
    change = gaussian_gradient_magnitude(look, 0.5)
    change = (change / max(float(np.quantile(change, _STRONGEST)), 1e-6)).clip(max=1.0)
    return change - change.mean()


def _edges_ego(beams: LidarSweep) -> Float[Tensor, "E 3"]:
    """Returns beside which, in the same channel, a beam met something farther."""
    beams = beams[beams.beam >= 0]
    azimuth = torch.atan2(beams.dir_ego[:, 1], beams.dir_ego[:, 0])
    order = (beams.beam * 10.0 + azimuth).argsort()
    beams, azimuth = beams[order], azimuth[order]
    near = (beams.beam[1:] == beams.beam[:-1]) & ((azimuth[1:] - azimuth[:-1]).abs() < _NEXT_RAD)
    farther_m = beams.range_m[1:] - beams.range_m[:-1]
    least_m = _JUMP_M + _JUMP_SHARE * torch.minimum(beams.range_m[1:], beams.range_m[:-1])
    edge = torch.zeros(len(beams.range_m), dtype=torch.bool)
    edge[:-1] |= near & (farther_m > least_m)
    edge[1:] |= near & (-farther_m > least_m)
    return beams.points_ego[edge]
