"""Views beside the path of a real log, where no camera was: the points of the lidar as the truth.

Each held-out image colours the lidar points of its time. Rendered from beside the path, a point should have
the same depth and colour. Points on actors are left out, since they move between sweep and exposure, and so
are those that nearer ones hide from the new place.
"""

import dataclasses
from collections.abc import Sequence
from statistics import fmean

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.scene_graph import STATIC
from foredrive.methods.reconstruction.seed_points import actor_rows
from foredrive.methods.reconstruction.tracks import states_at
from foredrive.methods.reconstruction.training import SensorViews
from foredrive.methods.reconstruction.trust import psnr_of
from foredrive.methods.reconstruction.views import CameraView, SweepView

HIDDEN_PX = 12
"""Side of the squares of an image in which a nearer point hides those behind it."""
HIDDEN_M, HIDDEN_SHARE = 0.5, 0.05
"""A point is hidden if it is farther than the nearest one by more than this distance plus this share."""


@torch.no_grad()
def points_aside(scene: ReconstructedScene, views: SensorViews, left_m: float) -> dict[str, float]:
    """Return `psnr_db` of the points' colours, and `depth_error_m`, the median, means over images.

    Args:
        scene: the scene.
        views: held out, with images.
        left_m: distance of the views from the logged ones to the left.
    """
    squared, errors_m = list[Tensor](), list[float]()
    for view in views.cameras:
        sweep = min(views.sweeps, key=lambda one: abs(one.t_s - view.t_s))
        points = _static_points(scene, sweep)
        u, v, _, seen = _looked_up(view, points)
        assert view.image is not None
        colours = view.image[:, v[seen], u[seen]].float() / 255
        points = points[seen]
        T_shift = torch.eye(4)
        # To the left is -x of a camera
        T_shift[0, 3] = -left_m
        aside = dataclasses.replace(view, T_scene_cam=view.T_scene_cam @ T_shift, image=None)
        u, v, depth_m, seen = _looked_up(aside, points)
        image = scene.camera(scene.graph, aside.to(scene.device))
        shown = image.rgb.clamp(0, 1).cpu()[:, v[seen], u[seen]]
        squared.append((shown - colours[:, seen]).square().flatten())
        errors_m.append(float((image.range_m.cpu()[v[seen], u[seen]] - depth_m[seen]).abs().median()))
    return {"psnr_db": fmean(psnr_of(image) for image in squared), "depth_error_m": fmean(errors_m)}


def _static_points(scene: ReconstructedScene, sweep: SweepView) -> Float[Tensor, "N 3"]:
    """Return the returns of a sweep that are not on actors, in the scene's frame."""
    beams = sweep.beams[sweep.beams.returned]
    points = transform_points(sweep.T_scene_ego, beams.points_ego)
    tracks = scene.tracks.to("cpu")
    rows = actor_rows(points, beams.dt_s, states_at(tracks, sweep.t_s), tracks)
    return points[rows == STATIC]


def _looked_up(
    view: CameraView, points: Float[Tensor, "N 3"]
) -> tuple[Tensor, Tensor, Float[Tensor, "N"], Bool[Tensor, "N"]]:
    """Return column, row and depth of points in an image, and which are in it and not hidden."""
    height, width = view.size_hw
    in_camera = transform_points(inverse_se3(view.T_scene_cam), points)
    uv, depth_m, inside = project(in_camera, view.K, view.dist, view.size_hw)
    u, v = uv[:, 0].long().clamp(0, width - 1), uv[:, 1].long().clamp(0, height - 1)
    # The nearest depth in each square and its neighbours, of all points
    rows, columns = -(-height // HIDDEN_PX), -(-width // HIDDEN_PX)
    square = v // HIDDEN_PX * columns + u // HIDDEN_PX
    nearest_m = torch.full((rows * columns,), torch.inf)
    nearest_m = nearest_m.scatter_reduce(0, square[inside], depth_m[inside], "amin")
    around_m = -F.max_pool2d(-nearest_m.view(1, 1, rows, columns), 3, stride=1, padding=1).flatten()
    return u, v, depth_m, inside & (depth_m < around_m[square] * (1 + HIDDEN_SHARE) + HIDDEN_M)


def aside_figures(
    scene: ReconstructedScene, views: SensorViews, aside_m: Sequence[float]
) -> dict[str, float]:
    """Return the figures of `points_aside` on the path, and beside it the means of both sides."""
    figures = {f"points.{name}": value for name, value in points_aside(scene, views, 0.0).items()}
    for metres in aside_m:
        left, right = (points_aside(scene, views, sign * metres) for sign in (1, -1))
        figures |= {f"points.{metres:g}m_aside.{name}": fmean((left[name], right[name])) for name in left}
    return figures
