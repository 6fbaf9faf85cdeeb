"""A scene graph: the tracks of actors, and what the static part and each actor look like.

What they look like is the matter of a representation: `rendering.gaussians` keeps Gaussians. Everything else
(edits, threats, films, drives, evaluation) knows `Content` alone.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch

from foredrive.rendering.gaussians.gaussians import Gaussians
from foredrive.rendering.tracks import ActorTracks
from foredrive.scene.record import Record

STATIC = -1
"""Row number of the static part, which belongs to no actor."""


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
