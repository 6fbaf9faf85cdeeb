"""Gaussians before anything is learned: lidar points in their colours, the far field, random points."""

import dataclasses
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
from foredrive.scene.record import Record

GREY = 0.5
"""Of what no camera saw."""
SEEN_SHARE = 0.75
"""Of the lidar points that are taken, how many a camera saw."""
BEAM_WIDTH_RAD = 0.01
"""Of its range the most that a Gaussian at a lidar's point may measure (standard deviation)."""
NEAR_IN_IMAGE = 0.06
"""How far from a pixel, in heights of the image, a beam says how far that pixel looks."""
_NEIGHBOURS = 3
_LEAST_SCALE_M, _GREATEST_SCALE_M = 0.01, 2.0
_BOX_MARGIN_M = 0.1


@dataclass(frozen=True)
class InitialSize:
    """How many Gaussians a scene begins with, and how they look."""

    lidar_points: int
    """At most, over the static part."""
    pixel_points: int
    """Along random pixels, at the range of the beam nearest in the image, or far away where none is near."""
    near_points: int
    """Along random pixels, anywhere."""
    actor_points: int = 500
    """At least, of each actor; where lidar saw fewer, random points in its box make up for it."""
    actor_points_most: int = 5000
    features: int = 8
    """Beside albedo."""
    opacity: float = 0.5
    near_opacity: float = 0.1
    scale: float = 0.5
    """Standard deviation in units of the mean distance to the nearest neighbours."""
    pixel_scale: float = 0.6
    """The same of points along pixels, in units of the distance between pixels drawn of a camera."""
    near_m: float = 2.0
    far_from_m: float = 60.0
    far_m: float = 2000.0


@dataclass(frozen=True)
class _Points(Record):
    xyz_m: Float[Tensor, "N 3"]
    rgb: Float[Tensor, "N 3"]
    seen: Bool[Tensor, "N"]
    """By a camera."""
    scale_m: Float[Tensor, "N"]
    """Standard deviation at most."""


def initial_scene(
    cameras: list[CameraView],
    sweeps: list[SweepView],
    tracks: Tracks,
    size: InitialSize,
    generator: torch.Generator,
) -> SceneGraph:
    """Gaussians at lidar points, coloured by the image nearest in time, and along pixels.

    Of the lidar's points most are taken from those that a camera saw. Points of mirrored actors
    (`Tracks.mirrored`) are taken from both sides. Without sweeps points anywhere along pixels stand for all.

    Args:
        cameras: that may be learned from, with images.
        sweeps: that may be learned from.
        tracks: actors, whose points go into their own frames.
        size: how many of each.
        generator: of which points are taken.
    """
    standing, of_actors = _lidar_points(cameras, sweeps, tracks)
    standing = _some(standing, size.lidar_points, generator)
    along = _along_pixels(cameras, sweeps, tracks, size, generator) if sweeps else _nothing()
    anywhere = size.near_points + (0 if sweeps else size.lidar_points + size.pixel_points)
    near = _anywhere_along_pixels(cameras, anywhere, size, generator)
    parts = [
        _gaussians(standing, size, size.opacity, by_neighbours=True),
        _gaussians(along, size, size.opacity),
        _gaussians(near, size, size.near_opacity if sweeps else size.opacity),
    ]
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
        points = _Points(
            xyz,
            torch.full_like(xyz, GREY),
            torch.zeros(len(xyz), dtype=torch.bool),
            BEAM_WIDTH_RAD * returned.range_m,
        )
        for view in _nearest_views(cameras, exposed_s, sweep.t_s):
            at_exposure = xyz + velocity * (view.t_s - sweep.t_s - returned.dt_s)[:, None]
            inside, colour = _colours(at_exposure, view)
            points.rgb[inside], points.seen[inside] = colour, True
        standing.append(points[owner == STATIC])
        at_sweep = xyz - velocity * returned.dt_s[:, None]
        for row in owner[owner != STATIC].unique().tolist():
            T_actor_scene, mine = inverse_se3(states.T_scene_actor[row]), owner == row
            own_xyz = transform_points(T_actor_scene, at_sweep[mine])
            found[row].append(dataclasses.replace(points[mine], xyz_m=own_xyz))
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
    sweeps: list[SweepView],
    tracks: Tracks,
    size: InitialSize,
    generator: torch.Generator,
) -> _Points:
    """Points along random pixels of all images, as far as the beam that is nearest in the image.

    Where none is near they lie far away. Pixels beside beams that met an actor are left to it.
    """
    found = [_nothing()]
    moments_s = torch.tensor([sweep.t_s for sweep in sweeps])
    for view, count in zip(cameras, _shares(size.pixel_points, len(cameras)), strict=True):
        uv, direction = _random_pixels(view, count, generator)
        sweep = sweeps[int((moments_s - view.t_s).abs().argmin())]
        beams = sweep.beams[sweep.beams.returned]
        xyz = transform_points(sweep.T_scene_ego, beams.points_ego)
        standing = _owners(xyz, beams.dt_s, states_at(tracks, sweep.t_s), tracks) == STATIC
        T_cam_scene = inverse_se3(view.T_scene_cam)
        uv_beam, _, inside = project(transform_points(T_cam_scene, xyz), view.K, view.dist, view.size_hw)
        far_m = _even_in_inverse(count, (size.far_from_m, size.far_m), generator)
        if not bool(inside.any()):
            range_m, kept = far_m, torch.ones(count, dtype=torch.bool)
        else:
            apart_px, index = cKDTree(uv_beam[inside].numpy()).query(uv.numpy())
            nearest = torch.from_numpy(np.asarray(index))
            met = torch.from_numpy(np.asarray(apart_px)) < NEAR_IN_IMAGE * view.size_hw[0]
            beam_m = (xyz[inside] - view.T_scene_cam[:3, 3]).norm(dim=-1)[nearest]
            range_m, kept = torch.where(met, beam_m, far_m), standing[inside][nearest] | ~met
        drawn = size.pixel_points * sum(other.sensor == view.sensor for other in cameras) / len(cameras)
        scale_m = size.pixel_scale * range_m * _pixels_apart_rad(view, drawn)
        found.append(_at(view, uv, direction, range_m, scale_m)[kept])
    return _all(found)


def _anywhere_along_pixels(
    cameras: list[CameraView], count: int, size: InitialSize, generator: torch.Generator
) -> _Points:
    """Points along random pixels of all images, at ranges even in 1/m."""
    found = [_nothing()]
    for view, share in zip(cameras, _shares(count, len(cameras)), strict=True):
        uv, direction = _random_pixels(view, share, generator)
        range_m = _even_in_inverse(share, (size.near_m, size.far_m), generator)
        scale_m = (
            size.scale * (view.size_hw[0] * view.size_hw[1] / max(share, 1)) ** 0.5 / view.K[0, 0] * range_m
        )
        found.append(_at(view, uv, direction, range_m, scale_m))
    return _all(found)


def _pixels_apart_rad(view: CameraView, drawn: float) -> float:
    """How far apart so many places in an image are."""
    height, width = view.size_hw
    return (height * width / max(drawn, 1.0)) ** 0.5 / float(view.K[0, 0])


def _shares(count: int, parts: int) -> list[int]:
    return [count * (k + 1) // parts - count * k // parts for k in range(parts)]


def _random_pixels(
    view: CameraView, count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N 3"]]:
    """Places in an image, px, and unit directions in the scene's frame."""
    height, width = view.size_hw
    uv = torch.rand(count, 2, generator=generator) * torch.tensor([width, height])
    return uv, rotate_vectors(view.T_scene_cam, pixels_to_rays(uv, view.K, view.dist))


def _even_in_inverse(
    count: int, range_m: tuple[float, float], generator: torch.Generator
) -> Float[Tensor, "N"]:
    near, far = 1 / range_m[0], 1 / range_m[1]
    return 1 / (torch.rand(count, generator=generator) * (near - far) + far)


def _at(
    view: CameraView,
    uv: Float[Tensor, "N 2"],
    direction: Float[Tensor, "N 3"],
    range_m: Float[Tensor, "N"],
    scale_m: Float[Tensor, "N"],
) -> _Points:
    assert view.image is not None
    u, v = uv.long().unbind(-1)
    return _Points(
        view.T_scene_cam[:3, 3] + direction * range_m[:, None],
        view.image[:, v, u].T / 255,
        torch.ones(len(uv), dtype=torch.bool),
        scale_m,
    )


def _actor(
    points: _Points,
    size_lwh: Float[Tensor, "3"],
    both_sides: bool,
    size: InitialSize,
    generator: torch.Generator,
) -> Gaussians:
    """What lidar saw of an actor, from both sides if it is mirrored, and random points in its box."""
    points = _some(points, size.actor_points_most, generator)
    part = _gaussians(points, size, size.opacity, by_neighbours=True)
    if both_sides:
        part = joined([part, mirrored(part)])
    missing = max(size.actor_points - len(part.opacity_logit), 0)
    if missing == 0:
        return part
    rgb = points.rgb.mean(0) if len(points.rgb) else torch.full((3,), GREY)
    apart_m = float(size_lwh.prod() / size.actor_points) ** (1 / 3)
    inside = _Points(
        (torch.rand(missing, 3, generator=generator) - 0.5) * size_lwh,
        rgb.expand(missing, 3),
        torch.zeros(missing, dtype=torch.bool),
        torch.full((missing,), size.scale * apart_m),
    )
    return joined([part, _gaussians(inside, size, size.near_opacity)])


def _gaussians(
    points: _Points, size: InitialSize, opacity: float, *, by_neighbours: bool = False
) -> Gaussians:
    count = len(points.xyz_m)
    quaternion = torch.zeros(count, 4)
    quaternion[:, 0] = 1
    scale_m = points.scale_m
    if by_neighbours:
        scale_m = scale_m.minimum(size.scale * _neighbour_distance_m(points.xyz_m))
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
    """At most so many, `SEEN_SHARE` of them among those that a camera saw, where there are so many."""
    order = torch.randperm(len(points.seen), generator=generator)
    seen, unseen = order[points.seen[order]], order[~points.seen[order]]
    of_seen = max(round(SEEN_SHARE * most), most - len(unseen))
    picked = torch.cat([seen[:of_seen], unseen[: most - min(of_seen, len(seen))]])
    return points[picked]


def _nothing() -> _Points:
    return _Points(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool), torch.zeros(0))


def _all(parts: list[_Points]) -> _Points:
    names = [field.name for field in dataclasses.fields(_Points)]
    return _Points(*(torch.cat([getattr(part, name) for part in parts]) for name in names))
