"""Edits of a reconstructed scene: a short list that can be saved to a file and applied again."""

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Discriminator, FiniteFloat, TypeAdapter, ValidationError
from torch import Tensor

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw
from foredrive.methods.reconstruction.scene_graph import ANOTHER, SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks

Offset = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
"""Forward, left, up, m."""
MAX_EDITS = 1000
"""Largest number of edits in a file. Each may copy all tracks."""


@dataclass(frozen=True)
class Move:
    """An edit that moves an actor at all times by an offset and a rotation in its own frame."""

    actor: int
    offset_m: Offset = (0.0, 0.0, 0.0)
    yaw_rad: FiniteFloat = 0.0
    kind: Literal["move"] = "move"


@dataclass(frozen=True)
class Remove:
    """An edit that removes an actor."""

    actor: int
    kind: Literal["remove"] = "remove"


@dataclass(frozen=True)
class Duplicate:
    """An edit that adds a copy of an actor at another place."""

    actor: int
    copy: int
    """Id of the copy; must be free."""
    offset_m: Offset = (0.0, 0.0, 0.0)
    yaw_rad: FiniteFloat = 0.0
    kind: Literal["duplicate"] = "duplicate"


@dataclass(frozen=True)
class Insert:
    """An edit that adds an actor of another run, on the path of an actor of this scene, with an offset."""

    run: str
    """Folder of the other run."""
    actor: int
    """Id in the other run."""
    copy: int
    """Id in this scene."""
    follows: int
    """Id of the actor whose path it follows."""
    offset_m: Offset = (0.0, 0.0, 0.0)
    yaw_rad: FiniteFloat = 0.0
    kind: Literal["insert"] = "insert"


@dataclass(frozen=True)
class DriveStraight:
    """An edit that adds a copy of an actor, which drives straight at constant velocity at all times."""

    actor: int
    copy: int
    """Id of the copy; must be free."""
    at_m: Offset
    """Position of its centre at `at_s`, in the scene's frame, m."""
    at_s: FiniteFloat
    velocity_mps: Offset = (0.0, 0.0, 0.0)
    """Velocity in the scene's axes."""
    yaw_rad: FiniteFloat = 0.0
    """Heading about the z axis of the scene."""
    kind: Literal["send"] = "send"


@dataclass(frozen=True)
class ShiftEgo:
    """An edit that moves the ego vehicle and its sensors at all times, by an offset in its own frame."""

    offset_m: Offset
    yaw_rad: FiniteFloat = 0.0
    kind: Literal["shift_ego"] = "shift_ego"


Edit = Annotated[Move | Remove | Duplicate | Insert | DriveStraight | ShiftEgo, Discriminator("kind")]


@dataclass(frozen=True)
class EditedScene:
    """A scene after edits."""

    graph: SceneGraph
    T_ego_shifted: Float[Tensor, "4 4"]
    """Pose of the ego vehicle in the frame in which it was driven. It multiplies every T_scene_ego from the
    right."""


def apply_edits(
    graph: SceneGraph, edits: Sequence[Edit], open_run: Callable[[str], SceneGraph] | None = None
) -> EditedScene:
    """Apply edits in order.

    Args:
        graph: the scene; it is not changed.
        edits: edits in order.
        open_run: opens the scene of another run's folder, for `Insert`.

    Raises:
        InputError: an actor does not exist (the message names those that do) or belongs to the static part,
            or the id of a copy is taken.
    """
    T_ego_shifted = torch.eye(4).to(graph.tracks.T_scene_actor)
    for edit in edits:
        if isinstance(edit, ShiftEgo):
            # Offsets accumulate from the left: each is in the frame that the earlier ones give
            T_ego_shifted = T_ego_shifted @ _offset(edit.offset_m, edit.yaw_rad).to(T_ego_shifted)
        elif isinstance(edit, Remove):
            graph = _without(graph, graph.actor_row(edit.actor))
        elif isinstance(edit, Move):
            row = graph.actor_row(edit.actor)
            graph = dataclasses.replace(graph, tracks=_moved(graph.tracks, row, edit.offset_m, edit.yaw_rad))
        elif isinstance(edit, Duplicate):
            graph = _with_copy(graph, graph, edit.actor, edit.actor, edit.copy, edit.offset_m, edit.yaw_rad)
        elif isinstance(edit, DriveStraight):
            graph = _with_sent(graph, edit)
        else:
            if open_run is None:
                raise InputError(
                    f"actor {edit.actor} is to come from {edit.run}, but no run can be opened here"
                )
            source = open_run(edit.run)
            graph = _with_copy(
                graph, source, edit.actor, edit.follows, edit.copy, edit.offset_m, edit.yaw_rad
            )
    return EditedScene(graph, T_ego_shifted)


def move_between(
    actor: int, T_scene_before: Float[Tensor, "4 4"], T_scene_after: Float[Tensor, "4 4"]
) -> Move:
    """Return the edit that moves an actor between two poses of the same time. Only its yaw turns."""
    # The change in the actor's frame before the move
    change = (inverse_se3(T_scene_before) @ T_scene_after).tolist()
    forward_m, left_m, up_m = (row[3] for row in change[:3])
    return Move(actor, (forward_m, left_m, up_m), math.atan2(change[1][0], change[0][0]))


def unused_id(graph: SceneGraph) -> int:
    """Return an id that no actor and no obstacle has, for a copy."""
    return max(graph.all_tracks.track_id.tolist(), default=0) + 1


def save_edits(edits: Sequence[Edit], path: Path) -> None:
    """Write edits as JSON.

    Raises:
        InputError: the file exists and is not a list of edits; it is not overwritten.
    """
    if path.exists():
        # Reading the file first refuses to overwrite something that is not a list of edits
        load_edits(path)
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps([dataclasses.asdict(edit) for edit in edits], indent=1) + "\n")


def load_edits(path: Path) -> list[Edit]:
    """Read a file written by `save_edits`.

    Raises:
        InputError: the file cannot be read, or an entry is wrong. The message names both.
    """
    try:
        edits: list[Edit] = TypeAdapter(list[Edit]).validate_json(path.read_bytes(), extra="forbid")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(
            f"{path}: not a list of edits: {f'{where}: ' if where else ''}{first['msg']}"
        ) from error
    if len(edits) > MAX_EDITS:
        raise InputError(f"{path}: {len(edits):,} edits; there may be {MAX_EDITS:,}")
    return edits


def _offset(offset_m: Offset, yaw_rad: float) -> Float[Tensor, "4 4"]:
    return matrix_from_yaw(torch.tensor(yaw_rad), torch.tensor(offset_m))


def _moved(tracks: ActorTracks, row: int, offset_m: Offset, yaw_rad: float) -> ActorTracks:
    poses = tracks.T_scene_actor.clone()
    # Multiplied from the right: the offset is in the actor's own axes
    poses[row] = poses[row] @ _offset(offset_m, yaw_rad).to(poses)
    return dataclasses.replace(tracks, T_scene_actor=poses)


def _without(graph: SceneGraph, row: int) -> SceneGraph:
    others = torch.arange(len(graph.tracks)) != row
    return dataclasses.replace(
        graph,
        tracks=graph.tracks.only(others),
        content=graph.content.without(row),
        looks=graph.looks_like[others],
    )


def _with_copy(
    graph: SceneGraph,
    source: SceneGraph,
    actor: int,
    follows: int,
    copy: int,
    offset_m: Offset,
    yaw_rad: float,
) -> SceneGraph:
    """Add an actor of `source` as `copy`, on the path of an actor of this scene and at its ground height."""
    row, way = source.actor_row(actor), graph.actor_row(follows)
    if copy in graph.all_tracks.track_id.tolist():
        raise InputError(f"there is an actor {copy} already: a copy needs an id of its own")
    tracks = graph.tracks
    try:
        content = graph.content.with_copy(source.content, row, len(tracks))
    except InputError as error:
        raise InputError(f"actor {actor} cannot be copied here: {error}") from error
    # Boxes are posed by their centre: half the difference of the heights keeps the copy on the ground
    lift_m = 0.5 * float(source.tracks.size_lwh[row, 2] - tracks.size_lwh[way, 2])
    looks = graph.looks_like[row : row + 1]
    if source is not graph:
        looks = tracks.track_id.new_tensor([ANOTHER])
    forward_m, left_m, up_m = offset_m
    pose = tracks.T_scene_actor[way] @ _offset((forward_m, left_m, up_m + lift_m), yaw_rad).to(
        tracks.size_lwh
    )
    return dataclasses.replace(
        graph,
        tracks=ActorTracks(
            track_id=torch.cat([tracks.track_id, tracks.track_id.new_tensor([copy])]),
            category=torch.cat([tracks.category, source.tracks.category[row : row + 1]]),
            size_lwh=torch.cat([tracks.size_lwh, source.tracks.size_lwh[row : row + 1]]),
            t_s=tracks.t_s,
            # The copy follows the path at the times when the followed actor is present
            T_scene_actor=torch.cat([tracks.T_scene_actor, pose[None]]),
            present=torch.cat([tracks.present, tracks.present[way : way + 1]]),
        ),
        content=content,
        looks=torch.cat([graph.looks_like, looks]),
    )


def _with_sent(graph: SceneGraph, edit: DriveStraight) -> SceneGraph:
    """Add a copy of an actor on a straight path."""
    graph = _with_copy(graph, graph, edit.actor, edit.actor, edit.copy, (0.0, 0.0, 0.0), 0.0)
    tracks, row = graph.tracks, len(graph.tracks) - 1
    # The straight path passes `at_m` at `at_s` and holds at all times of the scene
    since_s = (tracks.t_s - edit.at_s)[:, None]
    way = tracks.t_s.new_tensor(edit.at_m) + since_s * tracks.t_s.new_tensor(edit.velocity_mps)
    poses, present = tracks.T_scene_actor.clone(), tracks.present.clone()
    poses[row] = matrix_from_yaw(torch.full_like(tracks.t_s, edit.yaw_rad), way)
    present[row] = True
    return dataclasses.replace(
        graph, tracks=dataclasses.replace(tracks, T_scene_actor=poses, present=present)
    )
