"""Gaussians before anything is learned: lidar points in their colours, the far field, random points."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from foredrive.geometry.projection import pixels_to_rays, project
from foredrive.geometry.se3 import inverse_se3, rotate_vectors, transform_points
from foredrive.rendering.gaussians import Gaussians
from foredrive.rendering.scene_graph import STATIC, SceneGraph, joined, mirrored
from foredrive.rendering.tracks import ActorStates, Tracks, states_at
from foredrive.rendering.views import CameraView, SweepView

GREY = 0.5
"""Of what no camera saw."""
_NEIGHBOURS = 3
_LEAST_SCALE_M, _GREATEST_SCALE_M = 0.01, 2.0
_BOX_MARGIN_M = 0.1


@dataclass(frozen=True)
class InitialSize:
    """How many Gaussians a scene begins with, and how they look."""

    lidar_points: int
    """At most, over the static part."""
    far_points: int
    near_points: int
    actor_points: int = 500
    """At least, of each actor; where lidar saw fewer, random points in its box make up for it."""
    actor_points_most: int = 5000
    features: int = 8
    """Beside albedo."""
    opacity: float = 0.5
    near_opacity: float = 0.1
    scale: float = 0.5
    """Standard deviation in units of the mean distance to the nearest neighbours."""
    near_m: float = 2.0
    far_from_m: float = 60.0
    far_m: float = 2000.0


@dataclass(frozen=True)
class _Points:
    xyz_m: Float[Tensor, "N 3"]
    rgb: Float[Tensor, "N 3"]


def initial_scene(
    cameras: list[CameraView],
    sweeps: list[SweepView],
    tracks: Tracks,
    size: InitialSize,
    generator: torch.Generator,
) -> SceneGraph:
    """Gaussians at lidar points, coloured by the image nearest in time, and where lidar cannot reach.

    Far points lie along pixels that look upwards, near ones along any, at distances even in 1/m. Points of
    mirrored actors (`Tracks.mirrored`) are taken from both sides. Without sweeps near points stand for all.

    Args:
        cameras: that may be learned from, with images.
        sweeps: that may be learned from.
        tracks: actors, whose points go into their own frames.
        size: how many of each.
        generator: of which points are taken.
    """
    standing, of_actors = _lidar_points(cameras, sweeps, tracks)
    parts = [_gaussians(_some(standing, size.lidar_points, generator), size, size.opacity)]
    near = size.near_points if sweeps else size.near_points + size.lidar_points
    for count, nearest_m, farthest_m, opacity, up in (
        (near, size.near_m, size.far_from_m, size.near_opacity if sweeps else size.opacity, False),
        (size.far_points, size.far_from_m, size.far_m, size.opacity, True),
    ):
        points, scale_m = _along_pixels(cameras, count, (nearest_m, farthest_m), up, generator)
        parts.append(_gaussians(points, size, opacity, scale_m))
    actor = [torch.full((len(part.opacity_logit),), STATIC) for part in parts]
    for row, points in enumerate(of_actors):
        part = _actor(points, tracks.size_lwh[row], bool(tracks.mirrored[row]), size, generator)
        parts.append(part)
        actor.append(torch.full((len(part.opacity_logit),), row))
    return SceneGraph(joined(parts), torch.cat(actor), tracks)


def _lidar_points(
    cameras: list[CameraView], sweeps: list[SweepView], tracks: Tracks
) -> tuple[_Points, list[_Points]]:
    """Of the static part, in the scene's frame, and of each actor, in its own."""
    exposed_s = torch.tensor([view.t_s for view in cameras])
    standing: list[_Points] = []
    found: list[list[_Points]] = [[_nothing()] for _ in range(len(tracks))]
    for sweep in sweeps:
        returned = sweep.beams[sweep.beams.returned]
        xyz = transform_points(sweep.T_scene_ego, returned.points_ego)
        states = states_at(tracks, sweep.t_s)
        owner = _owners(xyz, returned.dt_s, states, tracks)
        velocity = torch.cat([states.velocity_mps, torch.zeros(1, 3)])[owner]
        rgb = torch.full_like(xyz, GREY)
        for view in _nearest_views(cameras, exposed_s, sweep.t_s):
            at_exposure = xyz + velocity * (view.t_s - sweep.t_s - returned.dt_s)[:, None]
            seen, colour = _colours(at_exposure, view)
            rgb[seen] = colour
        standing.append(_Points(xyz[owner == STATIC], rgb[owner == STATIC]))
        at_sweep = xyz - velocity * returned.dt_s[:, None]
        for row in owner[owner != STATIC].unique().tolist():
            T_actor_scene = inverse_se3(states.T_scene_actor[row])
            found[row].append(
                _Points(transform_points(T_actor_scene, at_sweep[owner == row]), rgb[owner == row])
            )
    return _all([_nothing(), *standing]), [_all(points) for points in found]


def _owners(
    xyz: Float[Tensor, "N 3"], dt_s: Float[Tensor, "N"], states: ActorStates, tracks: Tracks
) -> Int[Tensor, "N"]:
    """In whose box each point lies at the time of its beam."""
    owner = torch.full((len(xyz),), STATIC)
    for row in states.present.nonzero()[:, 0].tolist():
        T, half_m = states.T_scene_actor[row], 0.5 * tracks.size_lwh[row] + _BOX_MARGIN_M
        reach_m = half_m.norm() + states.velocity_mps[row].norm() * 0.1
        near = ((xyz - T[:3, 3]).abs() < reach_m).all(-1).nonzero()[:, 0]
        at_sweep = xyz[near] - states.velocity_mps[row] * dt_s[near, None]
        inside = (transform_points(inverse_se3(T), at_sweep).abs() <= half_m).all(-1)
        owner[near[inside]] = row
    return owner


def _nearest_views(cameras: list[CameraView], exposed_s: Float[Tensor, "V"], t_s: float) -> list[CameraView]:
    """Of each camera the view that is nearest in time."""
    order = (exposed_s - t_s).abs().argsort(stable=True).tolist()
    nearest: dict[int, CameraView] = {}
    for index in order:
        nearest.setdefault(cameras[index].sensor, cameras[index])
    return list(nearest.values())


def _colours(xyz: Float[Tensor, "N 3"], view: CameraView) -> tuple[Bool[Tensor, "N"], Float[Tensor, "S 3"]]:
    """Which points an image shows, and their colours in it."""
    assert view.image is not None
    uv, _, inside = project(
        transform_points(inverse_se3(view.T_scene_cam), xyz), view.K, view.dist, view.size_hw
    )
    u, v = uv[inside].long().unbind(-1)
    return inside, view.image[:, v, u].T.float() / 255


def _along_pixels(
    cameras: list[CameraView],
    count: int,
    range_m: tuple[float, float],
    up: bool,
    generator: torch.Generator,
) -> tuple[_Points, Float[Tensor, "N"]]:
    """Points along random pixels, and a size that lets neighbours touch, m."""
    if not cameras or count == 0:
        return _nothing(), torch.zeros(0)
    share = -(-4 * count // len(cameras)) if up else -(-count // len(cameras))
    found, distance, apart = [], [], []
    for view in cameras:
        assert view.image is not None
        height, width = view.size_hw
        uv = torch.rand(share, 2, generator=generator) * torch.tensor([width, height])
        direction = rotate_vectors(view.T_scene_cam, pixels_to_rays(uv, view.K, view.dist))
        chosen = direction[:, 2] > 0 if up else direction[:, 2] > -1
        inverse = torch.rand(share, generator=generator) * (1 / range_m[0] - 1 / range_m[1]) + 1 / range_m[1]
        u, v = uv.long().unbind(-1)
        points = _Points(view.T_scene_cam[:3, 3] + direction / inverse[:, None], view.image[:, v, u].T / 255)
        found.append(_Points(points.xyz_m[chosen], points.rgb[chosen]))
        distance.append(1 / inverse[chosen])
        apart.append(
            torch.full((share,), float((height * width / (view.K[0, 0] * view.K[1, 1])).sqrt()))[chosen]
        )
    points, spread_m = _all(found), torch.cat(distance) * torch.cat(apart)
    pick = torch.randperm(len(spread_m), generator=generator)[:count]
    per_view = max(len(pick) / len({view.sensor for view in cameras}), 1)
    return _Points(points.xyz_m[pick], points.rgb[pick]), 0.5 * spread_m[pick] / per_view**0.5


def _actor(
    points: _Points,
    size_lwh: Float[Tensor, "3"],
    both_sides: bool,
    size: InitialSize,
    generator: torch.Generator,
) -> Gaussians:
    """What lidar saw of an actor, from both sides if it is mirrored, and random points in its box."""
    points = _some(points, size.actor_points_most, generator)
    part = _gaussians(points, size, size.opacity)
    if both_sides:
        part = joined([part, mirrored(part)])
    missing = max(size.actor_points - len(part.opacity_logit), 0)
    if missing == 0:
        return part
    rgb = points.rgb.mean(0) if len(points.rgb) else torch.full((3,), GREY)
    inside = _Points((torch.rand(missing, 3, generator=generator) - 0.5) * size_lwh, rgb.expand(missing, 3))
    apart_m = float(size_lwh.prod() / size.actor_points) ** (1 / 3)
    return joined([part, _gaussians(inside, size, size.near_opacity, torch.full((missing,), 0.5 * apart_m))])


def _gaussians(
    points: _Points, size: InitialSize, opacity: float, scale_m: Float[Tensor, "N"] | None = None
) -> Gaussians:
    count = len(points.xyz_m)
    if scale_m is None:
        scale_m = size.scale * _neighbour_distance_m(points.xyz_m)
    quaternion = torch.zeros(count, 4)
    quaternion[:, 0] = 1
    return Gaussians(
        mean_m=points.xyz_m.float(),
        quaternion=quaternion,
        log_scale=scale_m.log()[:, None].repeat(1, 3),
        opacity_logit=torch.full((count,), opacity).logit(),
        feature=F.pad(points.rgb.float(), (0, size.features)),
    )


def _neighbour_distance_m(xyz_m: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
    """Mean distance to the nearest neighbours, within bounds."""
    if len(xyz_m) <= _NEIGHBOURS:
        return torch.full((len(xyz_m),), 0.1)
    points = xyz_m.numpy()
    distance, _ = cKDTree(points).query(points, k=_NEIGHBOURS + 1)
    mean = torch.from_numpy(np.asarray(distance, dtype=np.float32)[:, 1:].mean(-1))
    return mean.clamp(_LEAST_SCALE_M, _GREATEST_SCALE_M)


def _some(points: _Points, most: int, generator: torch.Generator) -> _Points:
    if len(points.xyz_m) <= most:
        return points
    pick = torch.randperm(len(points.xyz_m), generator=generator)[:most]
    return _Points(points.xyz_m[pick], points.rgb[pick])


def _nothing() -> _Points:
    return _Points(torch.zeros(0, 3), torch.zeros(0, 3))


def _all(parts: list[_Points]) -> _Points:
    return _Points(torch.cat([part.xyz_m for part in parts]), torch.cat([part.rgb for part in parts]))
