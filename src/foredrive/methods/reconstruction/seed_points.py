"""Coloured seed points for Gaussians: lidar points and points along pixels."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from torch import Tensor

from foredrive.geometry.projection import pixels_to_rays, project
from foredrive.geometry.se3 import inverse_se3, rotate_vectors, transform_points
from foredrive.methods.reconstruction.scene_graph import STATIC
from foredrive.methods.reconstruction.tracks import ActorStates, ActorTracks, states_at
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.scene.record import Record

GREY = 0.5
"""Grey value of points that no camera saw, if no other point has a colour."""
SEEN_SHARE = 0.75
"""Share of an actor's chosen points that a camera saw."""
UNSEEN_RAD, UNSEEN_M = 0.03, (0.125, 1.0)
"""Spacing of points that no camera saw: a share of the range, within bounds."""
BEAM_WIDTH_RAD = 0.01
"""Maximum standard deviation of a Gaussian at a lidar point, as a share of its range."""
NEAR_IN_IMAGE = 0.06
"""Maximum distance from a pixel to a beam that sets its range, in image heights."""
_BOX_MARGIN_M = 0.1
_NEIGHBOURS = 3
_ALIKE = 5
"""Number of neighbours that set the colour of a point that no camera saw."""


@dataclass(frozen=True)
class SeedPoints(Record):
    """N points."""

    xyz_m: Float[Tensor, "N 3"]
    rgb: Float[Tensor, "N 3"]
    seen: Bool[Tensor, "N"]
    """True if a camera saw the point."""
    scale_m: Float[Tensor, "N"]
    """Maximum standard deviation, m."""


def lidar_points(
    cameras: list[CameraView], sweeps: list[SweepView], tracks: ActorTracks
) -> tuple[SeedPoints, list[SeedPoints]]:
    """Return the lidar points of the static part (scene's frame) and of each actor (its own frame)."""
    exposed_s = torch.tensor([view.t_s for view in cameras])
    standing: list[SeedPoints] = []
    parts: list[list[SeedPoints]] = [[empty_points()] for _ in range(len(tracks))]
    for sweep in sweeps:
        returned = sweep.beams[sweep.beams.returned]
        xyz = transform_points(sweep.T_scene_ego, returned.points_ego)
        states = states_at(tracks, sweep.t_s)
        # Actor of each point at the time of its beam; STATIC (-1) selects the appended velocity of zero
        owner = actor_rows(xyz, returned.dt_s, states, tracks)
        velocity = torch.cat([states.velocity_mps, torch.zeros(1, 3)])[owner]
        points = SeedPoints(
            xyz,
            torch.full_like(xyz, GREY),
            torch.zeros(len(xyz), dtype=torch.bool),
            # The beam's width grows with range and bounds the size of its Gaussian
            BEAM_WIDTH_RAD * returned.range_m,
        )
        for view in _nearest_views(cameras, exposed_s, sweep.t_s):
            # Move points of actors from the time of their beam to the time of the image
            at_exposure = xyz + velocity * (view.t_s - sweep.t_s - returned.dt_s)[:, None]
            inside, colour = _colours(at_exposure, view)
            # Where several images show a point, the one farthest in time sets its colour
            points.rgb[inside], points.seen[inside] = colour, True
        standing.append(points[owner == STATIC])
        # Points of actors at the time of the sweep, to express them in the box at that time
        at_sweep = xyz - velocity * returned.dt_s[:, None]
        for row in owner[owner != STATIC].unique().tolist():
            T_actor_scene, mine = inverse_se3(states.T_scene_actor[row]), owner == row
            own_xyz = transform_points(T_actor_scene, at_sweep[mine])
            parts[row].append(dataclasses.replace(points[mine], xyz_m=own_xyz))
    return all_points([empty_points(), *standing]), [all_points(points) for points in parts]


def points_along_pixels(
    cameras: list[CameraView],
    sweeps: list[SweepView],
    tracks: ActorTracks,
    count: int,
    scale: float,
    far_m: tuple[float, float],
    generator: torch.Generator,
) -> SeedPoints:
    """Return points along random pixels of all images, at the range of the nearest beam in the image.

    Pixels whose nearest beam hit an actor are skipped, because the actor has its own points.

    Args:
        cameras: views with images.
        sweeps: at least one.
        tracks: the actors.
        count: number of pixels over all images.
        scale: standard deviation in units of the distance between the drawn pixels of a camera.
        far_m: range of points that look upwards with no beam near, uniform in 1/m.
        generator: random choice of pixels.
    """
    from scipy.spatial import cKDTree  # not on every machine with a GPU

    parts = [empty_points()]
    moments_s = torch.tensor([sweep.t_s for sweep in sweeps])
    # Every image gets nearly the same number of pixels; the shares add up to `count`
    for view, share in zip(cameras, _shares(count, len(cameras)), strict=True):
        uv, direction = _random_pixels(view, share, generator)
        sweep = sweeps[int((moments_s - view.t_s).abs().argmin())]
        beams = sweep.beams[sweep.beams.returned]
        xyz = transform_points(sweep.T_scene_ego, beams.points_ego)
        # Only points of the static part give ranges: actors have their own points
        standing = actor_rows(xyz, beams.dt_s, states_at(tracks, sweep.t_s), tracks) == STATIC
        T_cam_scene = inverse_se3(view.T_scene_cam)
        uv_beam, _, inside = project(transform_points(T_cam_scene, xyz), view.K, view.dist, view.size_hw)
        # Ranges for pixels without a beam near: uniform in inverse range, as disparity is
        away_m = even_in_inverse(share, far_m, generator)
        if not bool(inside.any()):
            range_m, kept = away_m, torch.ones(share, dtype=torch.bool)
        else:
            # Nearest projected beam of each pixel in the image
            apart_px, index = cKDTree(uv_beam[inside].numpy()).query(uv.numpy())
            nearest = torch.from_numpy(np.asarray(index))
            beside = torch.from_numpy(np.asarray(apart_px)) < NEAR_IN_IMAGE * view.size_hw[0]
            met = beside | (direction[:, 2] < 0)  # the ground just in front of the vehicle is below all beams
            # Range from the camera, not from the lidar
            beam_m = (xyz[inside] - view.T_scene_cam[:3, 3]).norm(dim=-1)[nearest]
            # Pixels at an actor's beam are dropped; pixels without a near
            # beam are kept at their random range
            range_m, kept = torch.where(met, beam_m, away_m), standing[inside][nearest] | ~met
        # All pixels drawn for this camera over its images: together they cover the scene
        drawn = count * sum(other.sensor == view.sensor for other in cameras) / len(cameras)
        scale_m = scale * range_m * _pixels_apart_rad(view, drawn)
        parts.append(_at(view, uv, direction, range_m, scale_m)[kept])
    return all_points(parts)


def points_at_random_ranges(
    cameras: list[CameraView],
    count: int,
    scale: float,
    range_m: tuple[float, float],
    generator: torch.Generator,
) -> SeedPoints:
    """Return points along random pixels, at ranges uniform in 1/m. See `points_along_pixels`."""
    parts = [empty_points()]
    for view, share in zip(cameras, _shares(count, len(cameras)), strict=True):
        uv, direction = _random_pixels(view, share, generator)
        away_m = even_in_inverse(share, range_m, generator)
        scale_m = scale * away_m * _pixels_apart_rad(view, share)
        parts.append(_at(view, uv, direction, away_m, scale_m))
    return all_points(parts)


def subsample_static(
    points: SeedPoints, most: int, most_unseen: int, generator: torch.Generator
) -> SeedPoints:
    """Choose at most `most` of the points that a camera saw and at most `most_unseen` of the others, evenly.

    Beams hit near surfaces over and over. Where no camera looks, one point is enough per cube. The side of a
    cube is about `UNSEEN_RAD` times the smallest range from which the place was measured.
    """
    # A random order, so that a cut at the end takes points evenly
    order = torch.randperm(len(points.seen), generator=generator)
    seen, unseen = order[points.seen[order]][:most], order[~points.seen[order]]
    return points[torch.cat([seen, unseen[_one_a_cube(points[unseen])][:most_unseen]])]


def _one_a_cube(points: SeedPoints) -> Int[Tensor, "K"]:
    """Return the index of the first point of each cube, in order."""
    # `scale_m` is the beam's width, proportional to range: it gives the range back
    xyz_m, range_m = points.xyz_m.double().numpy(), points.scale_m.double().numpy() / BEAM_WIDTH_RAD
    _, block = np.unique(_keys(np.floor(xyz_m / UNSEEN_M[1])), return_inverse=True)
    # Smallest range from which each block of 1 m was measured
    closest_m = np.full(block.max(initial=-1) + 1, np.inf)
    np.minimum.at(closest_m, block, range_m)
    # Halve the block until its side is at most UNSEEN_RAD times that range, within the bounds
    halvings = np.ceil(np.log2(UNSEEN_M[1] / (UNSEEN_RAD * closest_m).clip(*UNSEEN_M)))
    halvings = halvings[block]
    # Side and index together name a cube, so cubes of different blocks do not mix
    cubes = np.column_stack([np.floor(xyz_m / (UNSEEN_M[1] / 2**halvings)[:, None]), halvings])
    # The index of the first point of each cube; sorting keeps the random order of the caller
    return torch.from_numpy(np.sort(np.unique(_keys(cubes), return_index=True)[1]))


def _keys(rows: Float64[np.ndarray, "N K"]) -> Int64[np.ndarray, "N"]:
    """Return a number for each row of whole numbers, the same for equal rows. Numbers sort faster."""
    if len(rows) == 0:
        return np.zeros(0, np.int64)
    whole = (rows - rows.min(0)).astype(np.int64)
    return np.ravel_multi_index(tuple(whole.T), tuple(whole.max(0) + 1))


def subsample(points: SeedPoints, most: int, generator: torch.Generator) -> SeedPoints:
    """Choose at most `most` points, `SEEN_SHARE` of them seen by a camera if there are enough."""
    order = torch.randperm(len(points.seen), generator=generator)
    seen, unseen = order[points.seen[order]], order[~points.seen[order]]
    # If unseen points are too few for their share, seen ones fill it
    seen_count = max(round(SEEN_SHARE * most), most - len(unseen))
    picked = torch.cat([seen[:seen_count], unseen[: most - min(seen_count, len(seen))]])
    return points[picked]


def colour_from_neighbours(points: SeedPoints) -> SeedPoints:
    """Give unseen points the median colour of their nearest seen neighbours, if there are any."""
    from scipy.spatial import cKDTree  # not on every machine with a GPU

    if bool(points.seen.all()) or not bool(points.seen.any()):
        return points
    near = cKDTree(points.xyz_m[points.seen].numpy()).query(
        points.xyz_m[~points.seen].numpy(), k=min(_ALIKE, int(points.seen.sum()))
    )[1]
    rgb = points.rgb.clone()
    index = torch.from_numpy(np.asarray(near)).view(int((~points.seen).sum()), -1)
    rgb[~points.seen] = points.rgb[points.seen][index].median(1).values
    return dataclasses.replace(points, rgb=rgb)


def neighbour_distance_m(xyz_m: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
    """Return the mean distance of each point to its nearest neighbours; 0.1 m for a few points."""
    from scipy.spatial import cKDTree  # not on every machine with a GPU

    if len(xyz_m) <= _NEIGHBOURS:
        return torch.full((len(xyz_m),), 0.1)
    points = xyz_m.numpy()
    # The nearest neighbour of each point is the point itself, hence one more and column 0 left out
    distance, _ = cKDTree(points).query(points, k=_NEIGHBOURS + 1)
    return torch.from_numpy(np.asarray(distance, dtype=np.float32)[:, 1:].mean(-1))


def empty_points() -> SeedPoints:
    """Return an empty set."""
    return SeedPoints(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool), torch.zeros(0))


def all_points(parts: list[SeedPoints]) -> SeedPoints:
    """Concatenate sets of points."""
    names = [field.name for field in dataclasses.fields(SeedPoints)]
    return SeedPoints(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def actor_rows(
    xyz: Float[Tensor, "N 3"], dt_s: Float[Tensor, "N"], states: ActorStates, tracks: ActorTracks
) -> Int[Tensor, "N"]:
    """Return the actor whose box holds each point at the time of its beam, or `STATIC`."""
    owner = torch.full((len(xyz),), STATIC)
    for row in states.present.nonzero()[:, 0].tolist():
        T, half_m = states.T_scene_actor[row], 0.5 * tracks.size_lwh[row] + _BOX_MARGIN_M
        # Half diagonal of the box, plus its motion over a tenth of a second, the time of a revolution
        reach_m = half_m.norm() + states.velocity_mps[row].norm() * 0.1
        # A cheap test first: the box test below runs on few points only
        near = ((xyz - T[:3, 3]).abs() < reach_m).all(-1).nonzero()[:, 0]
        # Move the points to the time of the sweep, at which the box is posed
        at_sweep = xyz[near] - states.velocity_mps[row] * dt_s[near, None]
        inside = (transform_points(inverse_se3(T), at_sweep).abs() <= half_m).all(-1)
        owner[near[inside]] = row
    return owner


def _nearest_views(cameras: list[CameraView], exposed_s: Float[Tensor, "V"], t_s: float) -> list[CameraView]:
    """Return the view of each camera that is nearest in time."""
    # Views in order of time distance: the first of each sensor is its nearest
    order = (exposed_s - t_s).abs().argsort(stable=True).tolist()
    nearest: dict[int, CameraView] = {}
    for index in order:
        nearest.setdefault(cameras[index].sensor, cameras[index])
    return list(nearest.values())


def _colours(xyz: Float[Tensor, "N 3"], view: CameraView) -> tuple[Bool[Tensor, "N"], Float[Tensor, "S 3"]]:
    """Return which points an image shows, and their colours."""
    assert view.image is not None
    uv, _, inside = project(
        transform_points(inverse_se3(view.T_scene_cam), xyz), view.K, view.dist, view.size_hw
    )
    u, v = uv[inside].long().unbind(-1)
    return inside, view.image[:, v, u].T.float() / 255


def _pixels_apart_rad(view: CameraView, drawn: int | float) -> float:
    """Return the mean angular spacing (rad) of `drawn` random pixels of an image."""
    height, width = view.size_hw
    # Square root of the image area per drawn pixel, divided by the focal length
    return (height * width / max(drawn, 1.0)) ** 0.5 / float(view.K[0, 0])


def _shares(count: int, parts: int) -> list[int]:
    return [count * (k + 1) // parts - count * k // parts for k in range(parts)]


def _random_pixels(
    view: CameraView, count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N 3"]]:
    """Return random positions in an image (px) and their unit directions in the scene's frame."""
    height, width = view.size_hw
    uv = torch.rand(count, 2, generator=generator) * torch.tensor([width, height])
    return uv, rotate_vectors(view.T_scene_cam, pixels_to_rays(uv, view.K, view.dist))


def even_in_inverse(
    count: int, range_m: tuple[float, float], generator: torch.Generator
) -> Float[Tensor, "N"]:
    """Return random ranges between two bounds, uniform in 1/m."""
    # 1/range is drawn uniformly between the inverse bounds
    near, far = 1 / range_m[0], 1 / range_m[1]
    return 1 / (torch.rand(count, generator=generator) * (near - far) + far)


def _at(
    view: CameraView,
    uv: Float[Tensor, "N 2"],
    direction: Float[Tensor, "N 3"],
    range_m: Float[Tensor, "N"],
    scale_m: Float[Tensor, "N"],
) -> SeedPoints:
    assert view.image is not None
    u, v = uv.long().unbind(-1)
    return SeedPoints(
        view.T_scene_cam[:3, 3] + direction * range_m[:, None],
        view.image[:, v, u].T / 255,
        torch.ones(len(uv), dtype=torch.bool),
        scale_m,
    )
