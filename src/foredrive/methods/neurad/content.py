"""What a field knows of a scene graph's actors: the place of each one in the field's grid."""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.reconstruction.scene_graph import Content, SceneGraph
from foredrive.methods.splatad.content import GaussianContent
from foredrive.scene.record import Record


@dataclass(frozen=True)
class FieldContent(Record):
    """The static part and A actors of a field: a `Content`. Edits change places in grids alone."""

    slot: Int[Tensor, "A"]
    """Place of each actor in the grid of actors. A copy has the place of its original."""
    shown: GaussianContent
    """Coloured lidar points of the static part and of the actors, for viewers."""
    table: Tensor
    """Table of the grid of actors, which identifies the field."""

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
            InputError: `source` is no field, or another one: features mean something to their own decoder
                alone.
        """
        if not isinstance(source, FieldContent):
            raise InputError("an actor that is not part of a field does not fit into a field")
        # A field that is opened twice from one file has equal tables
        if source.table.shape != self.table.shape or not torch.equal(source.table.to(self.table), self.table):
            raise InputError(
                "an actor of another neural field does not fit into this one, whose decoders cannot read its "
                "features; actors of Gaussian scenes can be inserted into each other"
            )
        return FieldContent(
            slot=torch.cat([self.slot, source.slot[source_row : source_row + 1].to(self.slot)]),
            shown=self.shown.with_copy(source.shown, source_row, row),
            table=self.table,
        )


def field_of(graph: SceneGraph) -> FieldContent:
    """Return the content of a scene that is a field.

    Raises:
        InputError: the scene is of another representation.
    """
    if not isinstance(graph.content, FieldContent):
        raise InputError("this scene is not a neural field")
    return graph.content
