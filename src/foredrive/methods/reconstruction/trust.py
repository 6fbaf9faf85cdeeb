"""Predict how far rendered images may be trusted, from what the cameras of the log have seen.

A reconstruction shows surfaces well that its training views saw from about the same direction and no farther
away, and guesses the others. Each block of a rendered image is looked up in the training views: was its
surface seen, by how many of them, from which angle and distance? A gamma regression with logarithmic link
turns this into an expected squared error. Its weights were fitted to reconstructed towns, where the true
image is known for every pose (`benchmarks/trust.py`). Sweeps are not predicted.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.geometry.projection import pixel_centres, pixels_to_rays, project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.methods.reconstruction.novel_views import novel_camera_view
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.rendered import RenderedImage
from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.seed_points import actor_rows
from foredrive.methods.reconstruction.tracks import ActorTracks, states_at
from foredrive.methods.reconstruction.vehicle import LoggedVehicle
from foredrive.methods.reconstruction.views import CameraView
from foredrive.scene.record import Record

BLOCKS, OBSERVED_BLOCKS = 32, 128
"""Blocks from left to right in an image, and in those of the training views, which are compared with it."""
SKY_M = 1000.0
"""Distance at which directions without a surface are compared."""
SAME_M, SAME_SHARE = 0.3, 0.1
"""A view saw a surface if its depth there differs by at most this distance plus this share of the depth."""
NEAR_RAD, TINY_RAD = 0.1, 0.01
"""Angle within which a view looks from about the same direction, and up to which errors grow fast."""
_ANGLE_COST_RAD, _RATIO_COST = 0.1, 0.3
"""Change of angle, and of the logarithm of the distance, by which a view is one unit worse as evidence."""
MOST_VIEWS = 300
"""Maximum number of training views that are kept: of long logs every second or third moment."""
_NEAREST_VIEWS = 48
"""Number of training views of each image that are searched: those whose cameras look most alike."""
_METRES_A_RAD = 15.0
"""Distance between cameras that counts as much as a turn by one radian."""
DARK = 0.75
"""Share of the light that `darkened` takes away."""
MAX_OFFSET = 5.0
"""Bound of `Trust.offset`: a factor of 150, or 22 dB."""
TRUSTED_LOSS_DB = 3.0
"""Largest loss of expected PSNR with which a frame is still trusted."""

IMAGE_WEIGHTS = {
    "one": -5.208,
    "unseen": 0.198,
    "unseen_area": 3.586,
    "unseen_sky": -1.190,
    "unseen_low": 0.413,
    "angle": 0.919,
    "tiny_angle": 91.794,
    "nearer_than_seen": 0.829,
    "farther_than_seen": -0.427,
    "views": -0.289,
    "near_views": 0.053,
    "open": 0.996,
    "sky": 1.380,
    "actor": 0.672,
    "range": -0.003,
    "texture": 0.630,
    "edge": 0.155,
}
"""Weights of `image_features` for the logarithm of the squared error of a block, by `bench trust`."""


@dataclass(frozen=True)
class ObservedViews(Record):
    """The V training images of a log as the reconstruction shows them, in blocks."""

    K: Float[Tensor, "V 3 3"]
    """Intrinsics for images of one pixel a block."""
    dist: Float[Tensor, "V 5"]
    T_scene_cam: Float[Tensor, "V 4 4"]
    depth_m: Float[Tensor, "V h w"]
    alpha: Float[Tensor, "V h w"]
    T_scene_actor: Float[Tensor, "V A 4 4"]
    """Poses of the actors when each image was exposed."""
    present: Bool[Tensor, "V A"]


@torch.no_grad()
def observe_views(scene: ReconstructedScene, vehicle: LoggedVehicle, t_s: Sequence[float]) -> ObservedViews:
    """Render the images of all cameras at the training times, in blocks.

    Raises:
        InputError: the log has no cameras.
    """
    rig, graph = vehicle.rig, scene.graph
    if not rig.names:
        raise InputError("without cameras, nothing is known about images beside the logged way")
    assert rig.exposed_dt_s is not None
    every = -(-len(t_s) * len(rig.names) // MOST_VIEWS)
    views = [
        novel_camera_view(rig, camera, vehicle.at(time_s + float(rig.exposed_dt_s[camera])))
        for time_s in t_s[::every]
        for camera in range(len(rig.names))
    ]
    size_hw = block_hw(rig.size_hw, OBSERVED_BLOCKS)
    depth_m, alpha = zip(
        *(_centres(scene.camera(graph, view.to(scene.device)), size_hw) for view in views), strict=True
    )
    states = [states_at(graph.tracks, view.t_s) for view in views]
    return ObservedViews(
        K=_scaled(torch.stack([view.K for view in views]), rig.size_hw, size_hw),
        dist=torch.stack([view.dist for view in views]),
        T_scene_cam=torch.stack([view.T_scene_cam for view in views]),
        depth_m=torch.stack(depth_m),
        alpha=torch.stack(alpha),
        T_scene_actor=torch.stack([state.T_scene_actor.cpu() for state in states]),
        present=torch.stack([state.present.cpu() for state in states]),
    )


def block_hw(size_hw: tuple[int, int], across: int = BLOCKS) -> tuple[int, int]:
    """Return the numbers of blocks from top to bottom and from left to right in an image of some size."""
    height, width = size_hw
    across = min(across, width)
    return max(1, round(height * across / width)), across


def _scaled(
    K: Float[Tensor, "*b 3 3"], size_hw: tuple[int, int], blocks_hw: tuple[int, int]
) -> Float[Tensor, "*b 3 3"]:
    """Return intrinsics for images of one pixel a block."""
    return K * K.new_tensor([blocks_hw[1] / size_hw[1], blocks_hw[0] / size_hw[0], 1.0])[:, None]


def _centres(
    image: RenderedImage, blocks_hw: tuple[int, int]
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Return depth and alpha in the middle of each block. Means would lie between the surfaces of a block."""
    height, width = image.alpha.shape
    v, u = (
        ((torch.arange(count) + 0.5) * size / count).long()
        for count, size in zip(blocks_hw, (height, width), strict=True)
    )
    return image.range_m[v[:, None], u].cpu(), image.alpha[v[:, None], u].cpu()


@torch.no_grad()
def image_features(
    observed: ObservedViews,
    track_id: Int[Tensor, "A"],
    graph: SceneGraph,
    view: CameraView,
    image: RenderedImage,
) -> dict[str, Float[Tensor, "N"]]:
    """Return what is known about each block of a rendered image, row by row.

    Args:
        observed: the training views.
        track_id: ids of the actors in `observed`.
        graph: the scene, or an edited version of it, that was rendered. Copies were seen where the actors
            were that they look like; actors of other logs were never seen.
        view: the camera.
        image: the rendered image.
    """
    height, width = size_hw = block_hw(view.size_hw)
    depth_m, alpha_hw = _centres(image, size_hw)
    tracks = graph.tracks.to("cpu")
    surfaces = _surfaces(tracks, view, depth_m, alpha_hw)
    rows = _rows_of(track_id.cpu(), graph.looks_like.cpu(), surfaces.owner)
    alpha, sky, range_m = alpha_hw.flatten(), surfaces.sky, surfaces.range_m
    saw, angle_rad, farther = _sightings(observed, rows, tracks, view, surfaces)
    # Evidence is best from the same direction and from no farther away
    cost = angle_rad / _ANGLE_COST_RAD + farther.clamp_min(0) / _RATIO_COST
    best = torch.where(saw, cost, torch.inf).argmin(0)
    seen, column = saw.any(0), torch.arange(len(alpha))
    best_angle_rad = torch.where(seen, angle_rad[best, column], 0.0)
    best_farther = torch.where(seen, farther[best, column].clamp(-1, 2), 0.0)
    grey = F.interpolate(image.rgb.cpu().mean(0)[None, None], size_hw, mode="area")[0, 0]
    unseen, solid = (~seen).float(), (~sky).float()
    return {
        "one": torch.ones_like(alpha),
        "unseen": unseen,
        "unseen_area": unseen * _around(unseen.view(size_hw)),
        "unseen_sky": unseen * sky,
        "unseen_low": unseen * torch.linspace(0, 1, height).repeat_interleave(width),
        "angle": best_angle_rad,
        "tiny_angle": best_angle_rad.clamp_max(TINY_RAD),
        "nearer_than_seen": best_farther.clamp_min(0),
        "farther_than_seen": best_farther.clamp_max(0),
        "views": saw.float().sum(0).log1p(),
        "near_views": (saw & (angle_rad < NEAR_RAD)).float().sum(0).log1p(),
        "open": (1 - alpha) * solid,
        "sky": sky.float(),
        "actor": (surfaces.owner != STATIC).float(),
        "range": range_m.log1p() * solid,
        "texture": (_steps(grey) + 0.005).log(),
        "edge": _steps(depth_m.clamp_min(0.1).log()).clamp_max(2.0),
    }


class _Surfaces(NamedTuple):
    """The surfaces that the N blocks of an image show."""

    points: Float[Tensor, "N 3"]
    """Places in the scene; sky is far away."""
    range_m: Float[Tensor, "N"]
    sky: Bool[Tensor, "N"]
    owner: Int[Tensor, "N"]
    """Row of the actor that a point lies on, or `STATIC`."""


def _surfaces(
    tracks: ActorTracks, view: CameraView, depth_m: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]
) -> _Surfaces:
    """Return what each block of an image shows, by its rendered depth."""
    size_hw = (depth_m.shape[0], depth_m.shape[1])
    K = _scaled(view.K, view.size_hw, size_hw)
    rays = pixels_to_rays(pixel_centres(size_hw).view(-1, 2), K, view.dist)
    sky = alpha.flatten() < 0.5
    points_cam = rays / rays[:, 2:] * torch.where(sky, SKY_M, depth_m.flatten())[:, None]
    points = transform_points(view.T_scene_cam, points_cam)
    owner = actor_rows(points, torch.zeros(len(points)), states_at(tracks, view.t_s), tracks)
    owner[sky] = STATIC
    return _Surfaces(points, points_cam.norm(dim=-1), sky, owner)


class _Sightings(NamedTuple):
    """Sightings of N surfaces by V training views."""

    saw: Bool[Tensor, "V N"]
    """True where the surface was in the image and not hidden."""
    angle_rad: Float[Tensor, "V N"]
    """Angle between the directions from which the view and the new camera see the surface."""
    farther: Float[Tensor, "V N"]
    """Logarithm of the view's distance in distances of the new camera; 0 for sky."""


def _sightings(
    observed: ObservedViews,
    rows: Int[Tensor, "N"],
    tracks: ActorTracks,
    view: CameraView,
    surfaces: _Surfaces,
) -> _Sightings:
    """Look surfaces up in the training views whose cameras are most alike.

    Args:
        observed: the training views.
        rows: of `_rows_of`.
        tracks: the actors of the rendered scene.
        view: the camera.
        surfaces: what the blocks show.
    """
    observed = observed[_most_alike(observed, view)]
    views, points, sky = len(observed.T_scene_cam), surfaces.points, surfaces.sky
    # Surfaces of actors, and the camera beside them, to where the actor was when each view was exposed
    T_scene_actor = states_at(tracks, view.t_s).T_scene_actor
    T_then_now, present = _moved_along(observed, T_scene_actor, surfaces.owner, rows)
    points_then = _transformed(T_then_now, points.expand(views, -1, -1))
    eye_then = _transformed(T_then_now, view.T_scene_cam[:3, 3].expand(views, len(points), 3))
    # The depth that each view has where the surface would be in its image
    height, width = observed.depth_m.shape[1:]
    points_cam = transform_points(inverse_se3(observed.T_scene_cam), points_then)
    uv, depth_then_m, inside = project(points_cam, observed.K, observed.dist, (height, width))
    u, v = uv[..., 0].long().clamp(0, width - 1), uv[..., 1].long().clamp(0, height - 1)
    every = torch.arange(views)[:, None]
    shown_m, shown_alpha = observed.depth_m[every, v, u], observed.alpha[every, v, u]
    # Another depth means that something else was in front, or that this surface is not where it seems
    same_surface = (shown_alpha >= 0.5) & ((depth_then_m - shown_m).abs() < SAME_SHARE * shown_m + SAME_M)
    saw = inside & present & torch.where(sky, shown_alpha < 0.5, same_surface)
    before = points_then - observed.T_scene_cam[:, None, :3, 3]
    angle_rad = torch.acos(F.cosine_similarity(before, points_then - eye_then, dim=-1).clamp(-1, 1))
    farther = torch.where(sky, 0.0, (before.norm(dim=-1) / surfaces.range_m).log())
    return _Sightings(saw, angle_rad, farther)


@torch.no_grad()
def darkened(
    observed: ObservedViews,
    scene: ReconstructedScene,
    graph: SceneGraph,
    view: CameraView,
    image: RenderedImage,
) -> RenderedImage:
    """Return an image in which what no training view saw is dark.

    Args:
        observed: the training views.
        scene: the scene.
        graph: the scene, or an edited version of it, that was rendered.
        view: the camera.
        image: the rendered image.
    """
    # Single blocks at the edges of objects stay bright, since their neighbours were seen
    unseen = image_features(observed, scene.track_id, graph, view, image)["unseen_area"]
    light = 1 - DARK * unseen.view(block_hw(view.size_hw)).to(image.rgb)
    light = F.interpolate(light[None, None], view.size_hw, mode="bilinear", align_corners=False)[0]
    return dataclasses.replace(image, rgb=image.rgb * light)


def _around(values: Float[Tensor, "h w"]) -> Float[Tensor, "N"]:
    """Return the mean over each block and its neighbours."""
    return F.avg_pool2d(values[None, None], 3, stride=1, padding=1, count_include_pad=False).flatten()


def _steps(values: Float[Tensor, "h w"]) -> Float[Tensor, "N"]:
    """Return the change of each block to the next block to the right and below."""
    right = F.pad((values[:, 1:] - values[:, :-1]).abs(), (0, 1))
    below = F.pad((values[1:] - values[:-1]).abs(), (0, 0, 0, 1))
    return (right + below).flatten()


def _most_alike(observed: ObservedViews, view: CameraView) -> Int[Tensor, "n"]:
    """Return the training views whose place and axis are nearest to those of a view."""
    away_m = (observed.T_scene_cam[:, :3, 3] - view.T_scene_cam[:3, 3]).norm(dim=-1)
    turned = 1 - observed.T_scene_cam[:, :3, 2] @ view.T_scene_cam[:3, 2]
    return (away_m / _METRES_A_RAD + turned).argsort(stable=True)[:_NEAREST_VIEWS]


def _rows_of(
    track_id: Int[Tensor, "A"], looks: Int[Tensor, "B"], owner: Int[Tensor, "N"]
) -> Int[Tensor, "N"]:
    """Return the row in `track_id` of the actor that the owner of each point looks like.

    A stands for the static part, A + 1 for actors of other logs.
    """
    count = len(track_id)
    same = looks[:, None] == track_id
    row = torch.where(same.any(-1), same.float().argmax(-1) if count else 0, count + 1)
    # The row behind the last actor is the static part's, which STATIC = -1 indexes
    return torch.cat([row, torch.tensor([count])])[owner]


def _moved_along(
    observed: ObservedViews,
    T_scene_actor: Float[Tensor, "B 4 4"],
    owner: Int[Tensor, "N"],
    rows: Int[Tensor, "N"],
) -> tuple[Float[Tensor, "V N 4 4"], Bool[Tensor, "V N"]]:
    """Return the motion of each point's actor from now to each view's time, and whether it was present."""
    views = len(observed.T_scene_cam)
    T_then_now = torch.eye(4).repeat(views, len(rows), 1, 1)
    for actor in owner[rows < observed.present.shape[1]].unique().tolist():
        mine = owner == actor
        row, now = rows[mine][0], inverse_se3(T_scene_actor[actor])
        T_then_now[:, mine] = (observed.T_scene_actor[:, row] @ now)[:, None]
    # The static part is always present; an actor that was never seen is not, and its points stay in place
    present = torch.cat([observed.present, torch.tensor([[True, False]]).expand(views, 2)], 1)
    return T_then_now, present[:, rows]


def _transformed(T: Float[Tensor, "V N 4 4"], points: Float[Tensor, "V N 3"]) -> Float[Tensor, "V N 3"]:
    """Transform each point by its own pose."""
    return (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]


@dataclass(frozen=True, eq=False)
class Trust:
    """A reconstruction's expectations of its own images."""

    scene: ReconstructedScene
    views: ObservedViews
    offset: float
    """Offset of `expected_errors`: this log differs from those of the fit."""
    reference_db: float
    """Expected PSNR along the logged way."""
    weights: Mapping[str, float] = field(default_factory=lambda: IMAGE_WEIGHTS)

    @torch.no_grad()
    def block_errors(self, graph: SceneGraph, view: CameraView, image: RenderedImage) -> Float[Tensor, "h w"]:
        """Return the expected squared error of each block of a rendered image, with colours from 0 to 1.

        Args:
            graph: the scene, or an edited version of it, that was rendered.
            view: the camera.
            image: the rendered image.
        """
        features = image_features(self.views, self.scene.track_id, graph, view, image)
        return expected_errors(features, self.offset, self.weights).view(block_hw(view.size_hw))

    def psnr_db(self, graph: SceneGraph, images: Sequence[tuple[CameraView, RenderedImage]]) -> float:
        """Return the expected PSNR of the images of all cameras at one time together, dB."""
        return psnr_of(torch.cat([self.block_errors(graph, view, image).flatten() for view, image in images]))

    def trusts(self, psnr_db: float) -> bool:
        """Return whether images are expected to be almost as good as those along the logged way."""
        return psnr_db >= self.reference_db - TRUSTED_LOSS_DB


def expected_errors(
    features: Mapping[str, Float[Tensor, "*b N"]],
    offset: float,
    weights: Mapping[str, float] = IMAGE_WEIGHTS,
) -> Float[Tensor, "*b N"]:
    """Return the expected squared errors of blocks, with colours from 0 to 1.

    Args:
        features: of `image_features`.
        offset: logarithm of the factor by which errors of this log differ from those of the fit. It counts in
            full for what was seen from the same direction, by half from other directions, and not for what
            was never seen: a guess is no better in a log whose seen surfaces are good.
        weights: of the features.
    """
    log_error = torch.stack([weight * features[name] for name, weight in weights.items()]).sum(0)
    own = (1 - features["unseen"]) * (1 - 0.5 * features["tiny_angle"] / TINY_RAD)
    return (log_error + offset * own).clamp_max(0.0).exp()


def fitted_offset(
    frames: Sequence[Mapping[str, Float[Tensor, "N"]]],
    psnr_db: float,
    weights: Mapping[str, float] = IMAGE_WEIGHTS,
) -> float:
    """Return the offset with which the mean of the expected PSNRs of some frames is the real one."""
    low, high = -MAX_OFFSET, MAX_OFFSET
    # The expected PSNR falls with the offset: halve the interval
    for _ in range(30):
        middle = 0.5 * (low + high)
        expected_db = fmean(psnr_of(expected_errors(frame, middle, weights)) for frame in frames)
        low, high = (middle, high) if expected_db > psnr_db else (low, middle)
    return 0.5 * (low + high)


def psnr_of(squared_error: Float[Tensor, "*shape"]) -> float:
    """Return the PSNR of an image, dB, from the squared errors of its blocks."""
    return float(-10 * squared_error.mean().clamp_min(1e-9).log10())
