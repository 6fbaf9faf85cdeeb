"""What a field knows of a scene graph's actors: where each one is found in the grid of actors."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.rendering.gaussians.content import GaussianContent
from foredrive.rendering.gaussians.gaussians import Gaussians
from foredrive.rendering.scene_graph import Content, SceneGraph
from foredrive.scene.record import Record


@dataclass(frozen=True)
class FieldContent(Record):
    """The static part and A actors of a field: a `Content`. Edits change places in the grid alone."""

    slot: Int[Tensor, "A"]
    """Place of each actor in the grid of actors. A copy has the place of its original."""
    shown: GaussianContent
    """Coloured lidar points of the static part and of the actors, for viewers."""
    table: Float[Tensor, "R F"]
    """Table of the grid of actors. Actors of another table cannot be read."""

    @property
    def device(self) -> torch.device:
        """The device of the field."""
        return self.slot.device

    def preview(self, row: int) -> Gaussians:
        """Return the lidar points of an actor in its frame, or of the static part for `STATIC`."""
        return self.shown.preview(row)

    def evidence(self, row: int) -> int:
        """Return the number of lidar points that are kept of an actor."""
        return self.shown.evidence(row)

    def without(self, row: int) -> "FieldContent":
        """Return the content without an actor."""
        others = torch.arange(len(self.slot), device=self.device) != row
        return FieldContent(self.slot[others], self.shown.without(row), self.table)

    def with_copy(self, source: Content, source_row: int, row: int) -> "FieldContent":
        """Return the content with one more actor in `row`, which looks like one of `source`.

        Raises:
            InputError: `source` is no field, or another field: its features have another meaning.
        """
        if not isinstance(source, FieldContent):
            raise InputError("an actor that is not part of a field does not fit into a field")
        if source.table.shape != self.table.shape or not torch.equal(source.table.to(self.table), self.table):
            raise InputError("an actor of another field does not fit: only this field's decoder can read it")
        slot = torch.cat([self.slot, source.slot[source_row : source_row + 1].to(self.slot)])
        return FieldContent(slot, self.shown.with_copy(source.shown, source_row, row), self.table)


def field_of(graph: SceneGraph) -> FieldContent:
    """Return the content of a scene that is a field.

    Raises:
        InputError: the scene is of another representation.
    """
    if not isinstance(graph.content, FieldContent):
        raise InputError("this scene is not a neural field")
    return graph.content
