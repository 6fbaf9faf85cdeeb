"""A scene graph: the tracks of actors, what the static part and each actor look like, and obstacles.

A representation stores what they look like: `rendering.gaussians` keeps Gaussians. Everything else (edits,
threats, films, drives, evaluation) uses only `Content`.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.reconstruction.tracks import ActorTracks, joined_tracks
from foredrive.scene.record import Record

STATIC = -1
"""Row number of the static part, which belongs to no actor."""
ANOTHER = -1
"""In place of an id: the actor is of another log."""


@runtime_checkable
class Content(Protocol):
    """The static part and A actors in the frames of their boxes, in the order of the rows of the tracks.

    An implementation is a `Record`. No method changes it, or learned weights.
    """

    @property
    def device(self) -> torch.device:
        """Return the device of its tensors."""
        ...

    def without(self, row: int) -> "Content":
        """Return the content without an actor. The rows behind it move up."""
        ...

    def with_copy(self, source: "Content", source_row: int, row: int) -> "Content":
        """Return the content with one more actor in `row`, the next, which looks like one of `source`.

        Raises:
            InputError: `source` is of another representation, or of other sizes.
        """
        ...

    def evidence(self, row: int) -> int:
        """Return how much an actor was observed, to compare the actors of one scene."""
        ...

    def preview(self, row: int) -> Gaussians:
        """Return an actor, or the static part for `STATIC`, as Gaussians for viewers, in its albedo."""
        ...


@dataclass(frozen=True)
class SceneGraph(Record):
    """A static part and A actors."""

    tracks: ActorTracks
    content: Content
    obstacles: ActorTracks | None = None
    """Tracks whose looks belong to the static part, such as those of parked vehicles. They are in the way all
    the same. Key times are those of `tracks`."""
    looks: Int[Tensor, "A"] | None = None
    """Ids of the log's actors that the actors look like, `ANOTHER` for one of another log. None: without
    edits, each looks like itself."""

    @property
    def looks_like(self) -> Int[Tensor, "A"]:
        """Return the id of the log's actor that each actor looks like; `ANOTHER` for one of another log."""
        return self.tracks.track_id if self.looks is None else self.looks

    @property
    def all_tracks(self) -> ActorTracks:
        """Return the tracks of all road users: those of the actors, then those of the obstacles."""
        return self.tracks if self.obstacles is None else joined_tracks(self.tracks, self.obstacles)

    def actor_row(self, track_id: int) -> int:
        """Return the row of an actor.

        Raises:
            InputError: there is no actor with this id, or its looks belong to the static part.
        """
        if self.obstacles is not None and track_id in self.obstacles.track_id.tolist():
            raise InputError(
                f"{track_id} is no actor of its own: it stands in the log, or is not rigid, and so belongs "
                "to the static part, which edits do not change; "
                "reconstruct with --set actors=true moves_m=0 nonrigid=true"
            )
        return self.tracks.index_of(track_id)
