"""Actors of a run in the scene of a reconstructed log: copies of the log's actors on ways of their own."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float64
from scipy.interpolate import interp1d
from torch import Tensor

from foredrive.driving.ncap.drawing import DrawnActor, DrawnRun
from foredrive.driving.ncap.scenario import Polyline
from foredrive.driving.observation import FRAME_DT_S
from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3
from foredrive.methods.reconstruction.edits import Duplicate, Remove, apply_edits, unused_id
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.tracks import MOVES_M, move_at_least

STANDS_M = 1e-3
"""An actor that moves less than this in `FRAME_DT_S`, m, stands."""


def place_actors(
    graph: SceneGraph,
    run: DrawnRun,
    T_world_scene: Float64[Tensor, "4 4"],
    track_ids: Mapping[str, int],
    *,
    moving_stay: bool,
) -> SceneGraph:
    """Return the scene with the actors of a run.

    Args:
        track_ids: id of each of the log's tracks by its token.
        moving_stay: whether the log's own actors that move stay. What stands in the log stays in any case.

    Raises:
        InputError: the log has no track of an actor's name.
    """
    logged = graph.tracks
    # Add the actors one by one; then remove the moving ones of the log unless the rules keep them
    for actor in run.actors:
        graph = _with_actor(graph, actor, T_world_scene, track_ids)
    if moving_stay:
        return graph
    moving = logged.track_id[move_at_least(logged, MOVES_M)]
    return apply_edits(graph, [Remove(track_id) for track_id in moving.tolist()]).graph


def _with_actor(
    graph: SceneGraph, actor: DrawnActor, T_world_scene: Float64[Tensor, "4 4"], track_ids: Mapping[str, int]
) -> SceneGraph:
    if actor.name not in track_ids:
        some_ids = ", ".join(list(track_ids)[:8]) or "none"
        raise InputError(f"the log has no actor {actor.name!r}; some of those that it has: {some_ids}")
    copied = apply_edits(graph, [Duplicate(track_ids[actor.name], unused_id(graph))]).graph
    tracks = copied.tracks
    poses = way_poses(actor.way, actor.yaw_rad, tracks.t_s.double().cpu().numpy())
    # The way gives the foot; the box' centre lies half its height above, along its own z axis
    poses[:, :3, 3] += 0.5 * float(tracks.size_lwh[-1, 2]) * poses[:, :3, 2]
    T_scene_actor = inverse_se3(T_world_scene) @ torch.from_numpy(poses)
    of_all, present = tracks.T_scene_actor.clone(), tracks.present.clone()
    of_all[-1], present[-1] = T_scene_actor.to(of_all), True
    return dataclasses.replace(
        copied, tracks=dataclasses.replace(tracks, T_scene_actor=of_all, present=present)
    )


def way_points(way: Polyline, t_s: Float64[np.ndarray, "K"]) -> Float64[np.ndarray, "K 3"]:
    """Return the positions on a way at some times, m, world frame."""
    # Interpolation, and extrapolation beyond both ends
    line = interp1d(way.t_s, np.array(way.xyz_m, dtype=float), axis=0, fill_value="extrapolate")
    return np.asarray(line(t_s))


def way_velocity(way: Polyline, t_s: float) -> Float64[np.ndarray, "2"]:
    """Return the velocity in the plane from a time to the next key frame, m/s, world frame."""
    before, after = way_points(way, np.array([t_s, t_s + FRAME_DT_S]))
    return np.asarray((after - before)[:2] / FRAME_DT_S)


def way_poses(
    way: Polyline, standing_yaw_rad: float, t_s: Float64[np.ndarray, "K"]
) -> Float64[np.ndarray, "K 4 4"]:
    """Return `T_world_actor` of an actor's foot at some times.

    The actor points to where it is one key frame later, uphill and downhill too. While it stands, it has the
    given heading and is level.
    """
    points = way_points(way, t_s)
    # The actor heads to where it is one key frame later; while it stands, as given
    forward = way_points(way, t_s + FRAME_DT_S) - points
    moved_m = np.linalg.norm(forward, axis=1, keepdims=True)
    level = np.array([np.cos(standing_yaw_rad), np.sin(standing_yaw_rad), 0.0])
    forward = np.where(moved_m > STANDS_M, forward / np.maximum(moved_m, STANDS_M), level)
    # Left is horizontal: the actor does not roll
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    poses[:, :3, :3] = np.stack([forward, left, np.cross(forward, left)], axis=-1)
    poses[:, :3, 3] = points
    return poses
