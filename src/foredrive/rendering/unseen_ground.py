"""Ground that nobody ever saw, under parked vehicles and behind them, made up from the ground beside it.

What is learned ends where sensors could not look; once an actor is taken away, or the ego vehicle drives
elsewhere, holes would show there. These Gaussians are no reconstruction but a guess, added last.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.rendering.gaussians import Gaussians
from foredrive.rendering.rebuilt import RebuiltScene
from foredrive.rendering.scene_graph import STATIC, SceneGraph
from foredrive.rendering.views import CameraView

WITHIN_M = 25.0
"""Of the driven way."""
STEP_M = 0.4
"""Between the Gaussians that are added."""
_HEIGHT_M, _SLOPE = 0.15, 0.04
"""What is ground lies so near to the level of the wheels, and so much more a metre beside the way."""
_CELL_M, _FEWEST = 1.0, 4
"""Ground is known in a cell of this side that holds so many Gaussians."""
_FROM_KNOWN_M = 5.0
"""The farthest that ground is guessed from where it is known."""
_LEVELS, _ALIKE = 8, 64
"""How many of the nearest cells say how high the ground is, how many of the nearest Gaussians how it looks:
their median, since some are hidden themselves and of any colour."""
_VIEWS = 10
"""Most that are looked through, of each camera."""
_BEHIND, _BEHIND_M = 0.02, 0.2
"""How much farther a point lies than what a view shows there, if it is hidden: a share of that, and m."""
_OPAQUE, _MOST_M = 0.3, 0.5
"""Least opacity, and greatest standard deviation, of a Gaussian that shows the ground."""


@torch.no_grad()
def add_unseen_ground(
    scene: RebuiltScene, T_scene_ego: Float[Tensor, "K 4 4"], views: Sequence[CameraView]
) -> None:
    """Put Gaussians of `guessed_ground` into a scene, but for those that a camera would have seen.

    Args:
        scene: that was learned.
        T_scene_ego: poses of the ego vehicle, whose frame stands on the ground.
        views: that were learned from; some of each camera are looked through.
    """
    graph = scene.graph
    ground = guessed_ground(graph.of_actor(STATIC), T_scene_ego)
    seen = torch.zeros_like(ground.opacity_logit, dtype=torch.bool)
    for view in _some_views(views):
        seen |= _seen(scene, graph, view.to(seen.device), ground.mean_m)
    scene.add_standing(ground[~seen])


def guessed_ground(
    standing: Gaussians, T_scene_ego: Float[Tensor, "K 4 4"], step_m: float = STEP_M
) -> Gaussians:
    """Flat Gaussians where there is no ground near the driven way; none where ground is known nowhere.

    Args:
        standing: the static part, learned.
        T_scene_ego: poses of the ego vehicle, whose frame stands on the ground.
        step_m: between those that are added.
    """
    ground = _ground(standing, T_scene_ego)
    xyz = ground.mean_m.double().cpu().numpy()
    level = _levels(xyz)
    if not len(level):
        return ground[:0]
    way = cKDTree(T_scene_ego[:, :2, 3].double().cpu().numpy())
    places = _grid(T_scene_ego[:, :2, 3].double().cpu().numpy(), step_m)
    near = way.query(places)[0] <= WITHIN_M
    near &= cKDTree(level[:, :2]).query(places)[0] <= _FROM_KNOWN_M
    near &= cKDTree(xyz[:, :2]).query(places)[0] > step_m
    places = places[near]
    if not len(places):
        return ground[:0]
    apart, beside = cKDTree(level[:, :2]).query(places, k=range(1, min(_LEVELS, len(level)) + 1))
    share = 1 / (np.asarray(apart) + _CELL_M) ** 2
    z = (share * level[beside, 2]).sum(1) / share.sum(1)
    alike = cKDTree(xyz[:, :2]).query(places, k=range(1, min(_ALIKE, len(xyz)) + 1))[1]
    feature = ground.feature[torch.from_numpy(np.asarray(alike)).to(ground.feature.device)].median(1).values
    flat = torch.tensor([0.6 * step_m, 0.6 * step_m, 0.01]).log()
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0])
    return Gaussians(
        mean_m=torch.from_numpy(np.column_stack([places, z])).to(ground.mean_m),
        quaternion=upright.repeat(len(places), 1).to(ground.mean_m),
        log_scale=flat.repeat(len(places), 1).to(ground.mean_m),
        opacity_logit=torch.full((len(places),), 4.0).to(ground.mean_m),
        feature=feature,
    )


def _some_views(views: Sequence[CameraView]) -> list[CameraView]:
    """At most so many of each camera, spread over the drive."""
    chosen: list[CameraView] = []
    for sensor in sorted({view.sensor for view in views}):
        own = [view for view in views if view.sensor == sensor]
        chosen += own[:: -(-len(own) // _VIEWS)]
    return chosen


def _seen(
    scene: RebuiltScene, graph: SceneGraph, view: CameraView, xyz_m: Float[Tensor, "N 3"]
) -> Bool[Tensor, "N"]:
    """Which points a view shows: those that lie in it and not behind anything."""
    uv, depth_m, inside = project(
        transform_points(inverse_se3(view.T_scene_cam), xyz_m), view.K, view.dist, view.size_hw
    )
    u, v = uv[inside].long().unbind(-1)
    seen = inside.clone()
    picture = scene(graph, view)
    stopped_m = torch.where(picture.alpha > 0.5, picture.range_m, torch.inf)[v, u]
    seen[inside] = depth_m[inside] < (1 + _BEHIND) * stopped_m + _BEHIND_M
    return seen


def _ground(standing: Gaussians, T_scene_ego: Float[Tensor, "K 4 4"]) -> Gaussians:
    """The Gaussians that show the ground near the way: about as high as the wheels stand."""
    mean_m = standing.mean_m
    way = cKDTree(T_scene_ego[:, :2, 3].double().cpu().numpy())
    apart_m, pose = way.query(mean_m[:, :2].double().cpu().numpy())
    T_ego_scene = inverse_se3(T_scene_ego)[torch.from_numpy(pose)].to(mean_m)
    height_m = (T_ego_scene[:, 2, :3] * mean_m).sum(-1) + T_ego_scene[:, 2, 3]
    aside_m = torch.from_numpy(apart_m).to(mean_m)
    shown = (standing.opacity_logit.sigmoid() > _OPAQUE) & (standing.log_scale.exp().amax(-1) < _MOST_M)
    return standing[shown & (aside_m <= WITHIN_M) & (height_m.abs() <= _HEIGHT_M + _SLOPE * aside_m)]


def _levels(xyz_m: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "C 3"]:
    """Middles of the cells in which ground is known, with its median height."""
    cells, member, count = np.unique(
        np.floor(xyz_m[:, :2] / _CELL_M), axis=0, return_inverse=True, return_counts=True
    )
    order = np.lexsort((xyz_m[:, 2], member.reshape(-1)))
    first = np.cumsum(count) - count
    median = xyz_m[order[first + count // 2], 2] if len(cells) else np.zeros(0)
    known = count >= _FEWEST
    return np.column_stack([(cells[known] + 0.5) * _CELL_M, median[known]])


def _grid(way_xy: Float[np.ndarray, "K 2"], step_m: float) -> Float[np.ndarray, "P 2"]:
    low, high = way_xy.min(0) - WITHIN_M, way_xy.max(0) + WITHIN_M
    x, y = (np.arange(a, b, step_m) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
