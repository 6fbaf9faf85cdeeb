"""What a field knows of a scene graph's actors: the field of each one, and its place in that field's grid."""

import copy
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.methods.neurad.decoders import BeamDecoder, PatchDecoder
from foredrive.methods.neurad.render import NeuralField
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.reconstruction.scene_graph import Content, SceneGraph
from foredrive.methods.splatad.content import GaussianContent
from foredrive.scene.record import Record


class FieldParts(NamedTuple):
    """A field and the decoders that alone can read its features."""

    network: NeuralField
    camera: PatchDecoder
    lidar: BeamDecoder

    def same_as(self, other: "FieldParts") -> bool:
        """Return whether both have the same actors: one field, or one that was opened twice."""
        # Fields that are opened twice from one file have equal tables, which identify them
        own, others = (parts.network.grids.actors.table for parts in (self, other))
        return own is others or (own.shape == others.shape and torch.equal(own, others.to(own)))


@dataclass(frozen=True)
class FieldContent(Record):
    """The static part and A actors of a field: a `Content`. Edits change places in grids alone."""

    slot: Int[Tensor, "A"]
    """Place of each actor in the grid of actors of its field. A copy has the place of its original."""
    owner: Int[Tensor, "A"]
    """Index in `fields` of the field that each actor is a part of."""
    shown: GaussianContent
    """Coloured lidar points of the static part and of the actors, for viewers."""
    fields: tuple[FieldParts, ...]
    """The scene's own field, and those of other runs whose actors are inserted."""

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
        return FieldContent(self.slot[others], self.owner[others], self.shown.without(row), self.fields)

    def with_copy(self, source: Content, source_row: int, row: int) -> "FieldContent":
        """Return the content with one more actor in `row`, which looks like one of `source`.

        An actor of another field stays a part of it: both fields are then rendered, each with its decoders.

        Raises:
            InputError: `source` is no field.
        """
        if not isinstance(source, FieldContent):
            raise InputError("an actor that is not part of a field does not fit into a field")
        lender, fields = source.fields[int(source.owner[source_row])], self.fields
        places = [place for place, parts in enumerate(fields) if parts.same_as(lender)]
        # A field that is in use already is not added a second time
        if not places:
            fields, places = (*fields, _on(lender, self.device)), [len(fields)]
        return FieldContent(
            slot=torch.cat([self.slot, source.slot[source_row : source_row + 1].to(self.slot)]),
            owner=torch.cat([self.owner, self.owner.new_tensor(places[:1])]),
            shown=self.shown.with_copy(source.shown, source_row, row),
            fields=fields,
        )


def _on(parts: FieldParts, device: torch.device) -> FieldParts:
    """Return a field on a device; one that is elsewhere is copied, because modules move in place."""
    if parts.network.middle_m.device == device:
        return parts
    network, camera, lidar = (copy.deepcopy(module) for module in parts)
    return FieldParts(network.to(device), camera.to(device), lidar.to(device))  # type: ignore[arg-type]


def field_of(graph: SceneGraph) -> FieldContent:
    """Return the content of a scene that is a field.

    Raises:
        InputError: the scene is of another representation.
    """
    if not isinstance(graph.content, FieldContent):
        raise InputError("this scene is not a neural field")
    return graph.content
