"""Initial Gaussians before training: coloured lidar points, the far field, random points."""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.quaternions import quaternion_from_matrix
from foredrive.geometry.se3 import transform_points
from foredrive.methods.reconstruction.gaussians import Gaussians, joined
from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.seed_points import (
    GREY,
    SeedPoints,
    colour_from_neighbours,
    empty_points,
    even_in_inverse,
    lidar_points,
    neighbour_distance_m,
    points_along_pixels,
    points_at_random_ranges,
    subsample,
    subsample_static,
)
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.methods.splatad.content import GaussianContent
from foredrive.methods.splatad.placing import mirrored

AHEAD_M, ASIDE_M, HEIGHT_M = 80.0, 60.0, 50.0
"""Padding of the drive's bounds ahead and behind, and to both sides; height of the bounds, m."""
FAR_M = 1e4
"""Distance of the farthest points, m."""


class DriveBounds(NamedTuple):
    """An upright box around the poses of a drive, in the scene's axes."""

    centre_m: Float[Tensor, "3"]
    size_m: Float[Tensor, "3"]


def drive_bounds(T_scene_sensor: Float[Tensor, "V 4 4"]) -> DriveBounds:
    """Return the box around the mean position that holds every pose with its padding.

    Args:
        T_scene_sensor: poses with x ahead and y to the left.
    """
    padding = [(0.0, 0.0, 0.0), *((x, y, 0.0) for x in (-AHEAD_M, AHEAD_M) for y in (-ASIDE_M, ASIDE_M))]
    # The padded corners of every pose, in the scene's axes
    corners = torch.stack([transform_points(T, T.new_tensor(padding)) for T in T_scene_sensor])
    centre_m = T_scene_sensor[:, :3, 3].mean(0)
    # Twice the largest distance from the centre, so that the box is symmetric about it
    size_m = 2 * (corners - centre_m).abs().amax((0, 1))
    size_m[2] = HEIGHT_M
    return DriveBounds(centre_m, size_m)


def random_points(
    bounds: DriveBounds, far: int, near: int, scale: float, generator: torch.Generator
) -> SeedPoints:
    """Return points of random colours: `far` above and around the bounds, `near` in them.

    Far points lie in random directions of the upper half, at distances uniform in 1/m from the bounds to
    `FAR_M`. Near points are uniform in the bounds.

    Args:
        scale: standard deviation in units of the mean distance to the nearest of these points.
    """
    direction = torch.rand(far, 3, generator=generator) - 0.5
    # Directions of the upper half
    direction[:, 2].abs_()
    # Far points begin at half the shorter side of the bounds
    range_m = even_in_inverse(far, (0.5 * float(bounds.size_m[:2].min()), FAR_M), generator)
    away_m = torch.nn.functional.normalize(direction, dim=-1) * range_m[:, None]
    beside_m = (torch.rand(near, 3, generator=generator) - 0.5) * bounds.size_m
    xyz_m = bounds.centre_m + torch.cat([away_m, beside_m])
    return SeedPoints(
        xyz_m,
        torch.rand(far + near, 3, generator=generator),
        torch.zeros(far + near, dtype=torch.bool),
        scale * neighbour_distance_m(xyz_m),
    )


_LEAST_SCALE_M, _GREATEST_SCALE_M = 0.01, 2.0
AHEAD_LEFT_UP = torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Transform from axes ahead, left, up to those of a camera."""
_PATCH = 8
"""Number of neighbours that set the shape of a Gaussian where no camera looks."""
_FLATTEST_M = 0.03


@dataclass(frozen=True)
class InitialGaussians:
    """Numbers and appearance of the initial Gaussians of a scene."""

    lidar_points: int
    """Maximum number of static lidar points that a camera saw."""
    unseen_points: int
    """Maximum number of static lidar points that no camera saw."""
    pixel_points: int
    """Points along random pixels, at the range of the nearest beam in the image, or far away where none is
    near."""
    near_points: int
    """Points along random pixels at any range."""
    actor_points: int = 500
    """Minimum number of points per actor. Where lidar saw fewer, random points in its box are added."""
    max_actor_points: int = 5000
    """Maximum number of lidar points per actor."""
    features: int = 8
    """Number of features besides albedo."""
    opacity: float = 0.5
    """Opacity of all points except those that `near_opacity` is for."""
    near_opacity: float = 0.1
    """Opacity of random points in the boxes of actors and, if there is lidar, of points along pixels at any
    range."""
    scale: float = 0.5
    """Standard deviation in units of the mean distance to the nearest neighbours."""
    pixel_scale: float = 0.6
    """Standard deviation of points along pixels, in units of the distance between the drawn pixels of a
    camera."""
    near_m: float = 2.0
    """Minimum range of `near_points`, m."""
    far_from_m: float = 500.0
    """Far points lie in a thin shell from here to `far_m`, m. It then stays closed for a vehicle on another
    path."""
    far_m: float = 2000.0
    """Maximum range of points along pixels, m."""
    random_far_points: int = 0
    """Points of random colours above and around the drive, see `random_points`."""
    random_near_points: int = 0
    """Points of random colours within the bounds of the drive, see `random_points`."""
    random_features: bool = False
    """Draw features from a normal distribution. If False, they are 0."""
    random_rotations: bool = False
    """Draw rotations uniformly. If False, Gaussians begin without rotation, and flat on their surface where
    no camera saw it."""


def initial_scene(
    cameras: list[CameraView],
    sweeps: list[SweepView],
    tracks: ActorTracks,
    size: InitialGaussians,
    generator: torch.Generator,
) -> SceneGraph:
    """Build Gaussians at lidar points, coloured by the image nearest in time, and along pixels.

    Lidar points that no camera saw are coloured like points near them and lie flat on their surface, because
    only a few beams would constrain their size in training. Points of symmetric actors
    (`ActorTracks.mirrored`) are used on both sides. Without sweeps, points at any range along pixels replace
    all others.

    Args:
        cameras: training views, with images.
        sweeps: training sweeps.
        tracks: actors, whose points go into their own frames.
        size: how many of each.
        generator: random choice of points.
    """
    standing, of_actors = lidar_points(cameras, sweeps, tracks)
    standing = colour_from_neighbours(
        subsample_static(standing, size.lidar_points, size.unseen_points, generator)
    )
    # Inverse ranges are uniform, so far points fill a thin shell as seen from the vehicle
    near, far = (size.near_m, size.far_m), (size.far_from_m, size.far_m)
    along, anywhere = empty_points(), size.near_points
    if sweeps:
        count, scale = size.pixel_points, size.pixel_scale
        along = points_along_pixels(cameras, sweeps, tracks, count, scale, far, generator)
    else:
        # Without lidar, the same number of points goes to random ranges along pixels
        anywhere += size.lidar_points + size.unseen_points + size.pixel_points
    beside = points_at_random_ranges(cameras, anywhere, size.scale, near, generator)
    parts = [
        _gaussians(standing[standing.seen], size, size.opacity, generator, by_neighbours=True),
        _patches(standing[~standing.seen], size, generator),
        _gaussians(along, size, size.opacity, generator),
        _gaussians(beside, size, size.near_opacity if sweeps else size.opacity, generator),
    ]
    if size.random_far_points or size.random_near_points:
        # Poses with x ahead and y left: those of the vehicle, or cameras turned to these axes
        poses = [view.T_scene_ego for view in sweeps] or [
            view.T_scene_cam @ AHEAD_LEFT_UP for view in cameras
        ]
        bounds, counts = drive_bounds(torch.stack(poses)), (size.random_far_points, size.random_near_points)
        around = random_points(bounds, *counts, size.scale, generator)
        parts.append(_gaussians(around, size, size.opacity, generator))
    actor = [torch.full((len(part.opacity_logit),), STATIC) for part in parts]
    # Points of an actor are in the frame of its box
    for row, points in enumerate(of_actors):
        part = _actor(points, tracks.size_lwh[row], bool(tracks.mirrored[row]), size, generator)
        parts.append(part)
        actor.append(torch.full((len(part.opacity_logit),), row))
    return SceneGraph(tracks, GaussianContent(joined(parts), torch.cat(actor)))


def _actor(
    points: SeedPoints,
    size_lwh: Float[Tensor, "3"],
    both_sides: bool,
    size: InitialGaussians,
    generator: torch.Generator,
) -> Gaussians:
    """Build an actor from its lidar points (on both sides if symmetric) and random points in its box."""
    points = colour_from_neighbours(subsample(points, size.max_actor_points, generator))
    part = _gaussians(points, size, size.opacity, generator, by_neighbours=True)
    # Both sides of a symmetric actor share what lidar saw of either
    if both_sides:
        part = joined([part, mirrored(part)])
    missing = max(size.actor_points - len(part.opacity_logit), 0)
    if missing == 0:
        return part
    rgb = points.rgb.mean(0) if len(points.rgb) else torch.full((3,), GREY)
    # Mean spacing of actor_points random points in the box
    apart_m = float(size_lwh.prod() / size.actor_points) ** (1 / 3)
    inside = SeedPoints(
        (torch.rand(missing, 3, generator=generator) - 0.5) * size_lwh,
        rgb.expand(missing, 3),
        torch.zeros(missing, dtype=torch.bool),
        torch.full((missing,), size.scale * apart_m),
    )
    return joined([part, _gaussians(inside, size, size.near_opacity, generator)])


def _gaussians(
    points: SeedPoints,
    size: InitialGaussians,
    opacity: float,
    generator: torch.Generator,
    *,
    by_neighbours: bool = False,
) -> Gaussians:
    count = len(points.xyz_m)
    quaternion, feature = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), torch.zeros(count, size.features)
    if size.random_rotations:
        quaternion = F.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    if size.random_features:
        feature = torch.randn(count, size.features, generator=generator)
    scale_m = points.scale_m
    if by_neighbours:
        apart_m = neighbour_distance_m(points.xyz_m).clamp(_LEAST_SCALE_M, _GREATEST_SCALE_M)
        # No wider than the beam's bound, nor than half the distance to the neighbours
        scale_m = scale_m.minimum(size.scale * apart_m)
    return Gaussians(
        mean_m=points.xyz_m.float(),
        quaternion=quaternion,
        log_scale=scale_m.log()[:, None].repeat(1, 3),
        opacity_logit=torch.full((count,), opacity).logit(),
        feature=torch.cat([points.rgb.float(), feature], dim=-1),
    )


def _patches(points: SeedPoints, size: InitialGaussians, generator: torch.Generator) -> Gaussians:
    """Build Gaussians with the covariance axes of their neighbours: flat where the neighbours are flat."""
    from scipy.spatial import cKDTree  # not on every machine with a GPU

    gaussians = _gaussians(points, size, size.opacity, generator, by_neighbours=size.random_rotations)
    if len(points.xyz_m) <= _PATCH or size.random_rotations:
        return gaussians
    xyz = points.xyz_m.numpy().astype(np.float64)
    _, near = cKDTree(xyz).query(xyz, k=_PATCH + 1)
    # Covariance of the nearest points; the first neighbour is the point itself
    spread = xyz[near] - xyz[near].mean(1, keepdims=True)
    variance, axes = np.linalg.eigh(spread.transpose(0, 2, 1) @ spread / (_PATCH + 1))
    axes *= np.sign(np.linalg.det(axes))[:, None, None]  # make it a rotation
    # The smallest axis keeps a thickness, so that the Gaussian stays visible edge-on
    scale_m = np.sqrt(variance.clip(0)).clip(_FLATTEST_M, 0.5 * _GREATEST_SCALE_M)
    quaternion, log_scale = quaternion_from_matrix(torch.from_numpy(axes)), torch.from_numpy(scale_m).log()
    return dataclasses.replace(gaussians, quaternion=quaternion.float(), log_scale=log_scale.float())
