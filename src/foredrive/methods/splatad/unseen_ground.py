"""Guessed ground where no sensor could look, such as under parked vehicles and behind them.

The learned scene ends where sensors could not look. Holes would show there after an actor is removed or when
the ego vehicle drives elsewhere. These Gaussians are extrapolated from the ground nearby, not reconstructed,
and are added last.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.views import CameraView
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.scene import GaussianScene

WITHIN_M = 25.0
"""Maximum distance from the driven path, m."""
STEP_M = 0.4
"""Spacing of the added Gaussians, m."""
_HEIGHT_M, _SLOPE = 0.15, 0.04
"""Height tolerance of ground: this many metres from the level of the wheels, plus this much per metre of
lateral distance."""
_CELL_M, _FEWEST = 1.0, 4
"""Side of a ground cell, m, and the minimum number of Gaussians in a known cell."""
_FROM_KNOWN_M = 5.0
"""Maximum distance from known ground to a guess, m."""
_LEVELS, _ALIKE = 8, 64
"""Number of nearest cells that set the height of the ground, and of nearest Gaussians that set its features.
The median of the features is used because some of these Gaussians are hidden and have arbitrary colours."""
_VIEWS = 10
"""Maximum number of views per camera that are checked."""
_BEHIND, _BEHIND_M = 0.02, 0.2
"""A point is hidden if it is farther than the rendered depth by this share of it plus this many metres."""
_OPAQUE, _MOST_M = 0.3, 0.5
"""Minimum opacity and maximum standard deviation (m) of a Gaussian that shows the ground."""


@torch.no_grad()
def add_unseen_ground(
    scene: GaussianScene, T_scene_ego: Float[Tensor, "K 4 4"], views: Sequence[CameraView]
) -> None:
    """Add the Gaussians of `extrapolated_ground` to a scene, except those that a camera would have seen.

    Args:
        scene: a learned scene.
        T_scene_ego: poses of the ego vehicle, whose frame is on the ground.
        views: training views; some of each camera are checked.
    """
    graph = scene.graph
    ground = extrapolated_ground(scene.content.preview(STATIC), T_scene_ego)
    seen = torch.zeros_like(ground.opacity_logit, dtype=torch.bool)
    # Ground that a camera would have seen would hide what it saw, so it is left out
    for view in _some_views(views):
        seen |= _seen(scene, graph, view.to(seen.device), ground.mean_m)
    scene.add_static(ground[~seen])


def extrapolated_ground(
    standing: Gaussians, T_scene_ego: Float[Tensor, "K 4 4"], step_m: float = STEP_M
) -> Gaussians:
    """Return flat Gaussians where ground is missing near the driven path; none if no ground is known.

    Args:
        standing: the learned static part.
        T_scene_ego: poses of the ego vehicle, whose frame is on the ground.
        step_m: spacing of the added Gaussians.
    """
    from scipy.spatial import cKDTree  # not on every machine with a GPU

    ground = _ground(standing, T_scene_ego)
    xyz = ground.mean_m.double().cpu().numpy()
    level = _levels(xyz)
    if not len(level):
        return ground[:0]
    way = cKDTree(T_scene_ego[:, :2, 3].double().cpu().numpy())
    places = _grid(T_scene_ego[:, :2, 3].double().cpu().numpy(), step_m)
    # Places near the path, near known ground, and with no Gaussian of the ground close by
    near = way.query(places)[0] <= WITHIN_M
    near &= cKDTree(level[:, :2]).query(places)[0] <= _FROM_KNOWN_M
    near &= cKDTree(xyz[:, :2]).query(places)[0] > step_m
    places = places[near]
    if not len(places):
        return ground[:0]
    # Height by inverse-square weights of the nearest known cells
    apart, beside = cKDTree(level[:, :2]).query(places, k=range(1, min(_LEVELS, len(level)) + 1))
    share = 1 / (np.asarray(apart) + _CELL_M) ** 2
    z = (share * level[beside, 2]).sum(1) / share.sum(1)
    # Features by the median of the nearest ground Gaussians
    alike = cKDTree(xyz[:, :2]).query(places, k=range(1, min(_ALIKE, len(xyz)) + 1))[1]
    feature = ground.feature[torch.from_numpy(np.asarray(alike)).to(ground.feature.device)].median(1).values
    # Discs that overlap their neighbours at the spacing of the grid
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
    """Choose at most `_VIEWS` views of each camera, spread over the drive."""
    chosen: list[CameraView] = []
    for sensor in sorted({view.sensor for view in views}):
        own = [view for view in views if view.sensor == sensor]
        # Every n-th view, rounded up, so that there are at most `_VIEWS`
        chosen += own[:: -(-len(own) // _VIEWS)]
    return chosen


def _seen(
    scene: GaussianScene, graph: SceneGraph, view: CameraView, xyz_m: Float[Tensor, "N 3"]
) -> Bool[Tensor, "N"]:
    """Return which points a view shows: inside the image and not hidden."""
    uv, depth_m, inside = project(
        transform_points(inverse_se3(view.T_scene_cam), xyz_m), view.K, view.dist, view.size_hw
    )
    u, v = uv[inside].long().unbind(-1)
    seen = inside.clone()
    picture = scene.camera(graph, view)
    # Depth at which the rendered view is stopped; see-through pixels hide nothing
    stopped_m = torch.where(picture.alpha > 0.5, picture.range_m, torch.inf)[v, u]
    seen[inside] = depth_m[inside] < (1 + _BEHIND) * stopped_m + _BEHIND_M
    return seen


def _ground(standing: Gaussians, T_scene_ego: Float[Tensor, "K 4 4"]) -> Gaussians:
    """Return the Gaussians that show the ground near the path, at about the height of the wheels."""
    from scipy.spatial import cKDTree  # not on every machine with a GPU

    mean_m = standing.mean_m
    way = cKDTree(T_scene_ego[:, :2, 3].double().cpu().numpy())
    # Nearest pose of the path to each Gaussian, over the ground
    apart_m, pose = way.query(mean_m[:, :2].double().cpu().numpy())
    T_ego_scene = inverse_se3(T_scene_ego)[torch.from_numpy(pose)].to(mean_m)
    # Height above the wheels of that pose: the z row of the transform
    height_m = (T_ego_scene[:, 2, :3] * mean_m).sum(-1) + T_ego_scene[:, 2, 3]
    aside_m = torch.from_numpy(apart_m).to(mean_m)
    shown = (standing.opacity_logit.sigmoid() > _OPAQUE) & (standing.log_scale.exp().amax(-1) < _MOST_M)
    # The tolerance grows aside of the path, as roads are cambered
    return standing[shown & (aside_m <= WITHIN_M) & (height_m.abs() <= _HEIGHT_M + _SLOPE * aside_m)]


def _levels(xyz_m: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "C 3"]:
    """Return the centres of the cells with known ground, with its median height."""
    cells, member, count = np.unique(
        np.floor(xyz_m[:, :2] / _CELL_M), axis=0, return_inverse=True, return_counts=True
    )
    # Sort by cell, then by height: the median is in the middle of each cell's block
    order = np.lexsort((xyz_m[:, 2], member.reshape(-1)))
    first = np.cumsum(count) - count
    median = xyz_m[order[first + count // 2], 2] if len(cells) else np.zeros(0)
    reliable = count >= _FEWEST
    return np.column_stack([(cells[reliable] + 0.5) * _CELL_M, median[reliable]])


def _grid(way_xy: Float[np.ndarray, "K 2"], step_m: float) -> Float[np.ndarray, "P 2"]:
    low, high = way_xy.min(0) - WITHIN_M, way_xy.max(0) + WITHIN_M
    x, y = (np.arange(a, b, step_m) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
