"""The Gaussians of a scene graph: which belong to the static part, and which to an actor."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.methods.reconstruction.gaussians import Gaussians, joined
from foredrive.methods.reconstruction.scene_graph import Content, SceneGraph
from foredrive.methods.splatad.deformation import Deformation
from foredrive.scene.record import Record

RIGID = -1
"""In place of the row of an actor's code."""


@dataclass(frozen=True)
class GaussianContent(Record):
    """N Gaussians of a static part and of A actors: a `Content`."""

    gaussians: Gaussians
    """Static Gaussians are in the scene's frame, those of actors in the frame of their boxes."""
    actor: Int[Tensor, "N"]
    """Row in the tracks, or `STATIC`."""
    deformation: Deformation | None = None
    """Moves the Gaussians of some actors in their boxes; None: all actors are rigid."""
    code: Int[Tensor, "A"] | None = None
    """Row of each actor in the codes of the deformation, or `RIGID`; None: as `deformation`."""

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
        code = None if self.code is None else torch.cat([self.code[:row], self.code[row + 1 :]])
        # Rows behind the removed actor move up by one
        return dataclasses.replace(
            self, gaussians=self.gaussians[kept], actor=actor - (actor > row).to(actor), code=code
        )

    def with_copy(self, source: Content, source_row: int, row: int) -> "GaussianContent":
        """Return the content with the Gaussians of an actor of `source` as one more actor in `row`.

        Actors of other scenes are rigid here.

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
        code = self.code
        if code is not None:
            source_code = source.code if source.deformation is self.deformation else None
            rigid = code.new_full((1,), RIGID)
            copied = rigid if source_code is None else source_code[source_row : source_row + 1]
            code = torch.cat([code, copied])
        return dataclasses.replace(
            self,
            gaussians=joined([self.gaussians, own]),
            actor=torch.cat([self.actor, added]),
            code=code,
        )

    def shaped(self, own: Gaussians, owner: Int[Tensor, "M"], t_s: float | Tensor) -> Gaussians:
        """Return Gaussians of actors, in the frames of their boxes, as they are at a time.

        Args:
            own: M Gaussians.
            owner: row of the actor of each one.
            t_s: seconds since the start of the drive.
        """
        if self.deformation is None or self.code is None:
            return own
        code = self.code[owner]
        changing = (code != RIGID).nonzero()[:, 0]
        then = self.deformation(own[changing], code[changing], t_s)
        return dataclasses.replace(
            own,
            mean_m=own.mean_m.index_copy(0, changing, then.mean_m),
            quaternion=own.quaternion.index_copy(0, changing, then.quaternion),
        )


def gaussians_of(graph: SceneGraph) -> GaussianContent:
    """Return the content of a scene of Gaussians.

    Raises:
        InputError: the scene is of another representation.
    """
    if not isinstance(graph.content, GaussianContent):
        raise InputError("this scene is not made of Gaussians")
    return graph.content
