"""The Gaussians of a scene graph: which belong to the static part, and which to an actor."""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.methods.reconstruction.gaussians import Gaussians, joined
from foredrive.methods.reconstruction.scene_graph import Content, SceneGraph
from foredrive.scene.record import Record


@dataclass(frozen=True)
class GaussianContent(Record):
    """N Gaussians of a static part and of A actors: a `Content`."""

    gaussians: Gaussians
    """Static Gaussians are in the scene's frame, those of actors in the frame of their boxes."""
    actor: Int[Tensor, "N"]
    """Row in the tracks, or `STATIC`."""

    @property
    def device(self) -> torch.device:
        """The device of the Gaussians."""
        return self.actor.device

    def preview(self, row: int) -> Gaussians:
        """Return the Gaussians of an actor in its frame, or the static ones for `STATIC`."""
        return self.gaussians[self.actor == row]

    def evidence(self, row: int) -> int:
        """Return the number of an actor's Gaussians, which begin at its lidar points."""
        return int((self.actor == row).sum())

    def without(self, row: int) -> "GaussianContent":
        """Return the content without the Gaussians of an actor."""
        kept = self.actor != row
        actor = self.actor[kept]
        # Rows behind the removed actor move up by one
        return GaussianContent(self.gaussians[kept], actor - (actor > row).to(actor))

    def with_copy(self, source: Content, source_row: int, row: int) -> "GaussianContent":
        """Return the content with the Gaussians of an actor of `source` as one more actor in `row`.

        Raises:
            InputError: `source` has no Gaussians, or Gaussians of another number of features.
        """
        if not isinstance(source, GaussianContent):
            raise InputError("an actor that is not made of Gaussians does not fit into a scene of Gaussians")
        # Actors have frames of their own, so their Gaussians can be copied as they are
        own = source.preview(source_row).to(self.device)
        features, others = own.feature.shape[1], self.gaussians.feature.shape[1]
        if features != others:
            raise InputError(f"Gaussians of {features} features do not fit into a scene of {others} features")
        added = torch.full((len(own.opacity_logit),), row).to(self.actor)
        return GaussianContent(joined([self.gaussians, own]), torch.cat([self.actor, added]))


def gaussians_of(graph: SceneGraph) -> GaussianContent:
    """Return the content of a scene of Gaussians.

    Raises:
        InputError: the scene is of another representation.
    """
    if not isinstance(graph.content, GaussianContent):
        raise InputError("this scene is not made of Gaussians")
    return graph.content
