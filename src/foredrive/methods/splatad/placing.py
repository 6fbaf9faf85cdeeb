"""Gaussians of a scene graph, placed for one time."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.geometry.quaternions import multiply_quaternions, quaternion_from_matrix
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.tracks import states_at
from foredrive.methods.splatad.content import gaussians_of
from foredrive.ops.splatting import Splats
from foredrive.scene.record import Record

_MIRROR_XYZ = (1.0, -1.0, 1.0)
_MIRROR_WXYZ = (1.0, -1.0, 1.0, -1.0)
"""Mirroring y turns a rotation by θ about the axis a into one by θ about (-aₓ, a_y, -a_z)."""


@dataclass(frozen=True)
class PlacedGaussians(Record):
    """The M Gaussians of a scene's actors, placed for one time."""

    gaussians: Gaussians
    """Gaussians in the scene's frame."""
    velocity_mps: Float[Tensor, "M 3"]
    """Velocities of the centres, in the scene's axes."""
    source: Int[Tensor, "M"]
    """Index of each one in the scene's Gaussians."""


def project_scene(
    graph: SceneGraph,
    t_s: float | Tensor,
    mirror: Bool[Tensor, "A"] | None,
    project: Callable[[Gaussians, Float[Tensor, "N 3"] | None, Bool[Tensor, "N"] | None], Splats],
) -> Splats:
    """Return the splats of a scene at a time: those of the static part, then those of the actors.

    Args:
        graph, t_s, mirror: see `place_actors`.
        project: returns the splats of Gaussians in the scene's frame, by their velocities (None: all stand)
            and those that count (None: all). The static part is not copied: it counts among all Gaussians.
    """
    content = gaussians_of(graph)
    splats = project(content.gaussians, None, content.actor < 0)
    placed = place_actors(graph, t_s, mirror)
    if len(placed.source) == 0:
        return splats
    moving = project(placed.gaussians, placed.velocity_mps, None)
    return Splats(*(torch.cat(fields) for fields in zip(splats, moving, strict=True)))


def place_actors(
    graph: SceneGraph, t_s: float | Tensor, mirror: Bool[Tensor, "A"] | None = None
) -> PlacedGaussians:
    """Place every present actor at a time, with poses and velocities.

    Args:
        graph: a scene of Gaussians.
        t_s: seconds since the start of the drive.
        mirror: actors whose left and right sides are swapped; None: none.
    """
    content, states = gaussians_of(graph), states_at(graph.tracks, t_s)
    shown = torch.cat([states.present, states.present.new_zeros(1)])[content.actor]  # STATIC, -1: last entry
    moving = shown.nonzero()[:, 0]
    owner = content.actor[moving]
    own = content.shaped(content.gaussians[moving], owner, t_s)
    if mirror is not None:
        own = _mirrored(own, mirror[owner])

    def of_owner(values: Float[Tensor, "A *n"]) -> Float[Tensor, "M *n"]:
        return values.index_select(0, owner)  # indexing would add up gradients in the order of threads

    R = states.T_scene_actor[:, :3, :3]
    # Offset of the Gaussian from the actor's origin, in the scene's axes
    arm = (of_owner(R) @ own.mean_m[..., None])[..., 0]
    moved = dataclasses.replace(
        own,
        mean_m=of_owner(states.T_scene_actor[:, :3, 3]) + arm,
        quaternion=multiply_quaternions(of_owner(quaternion_from_matrix(R)), own.quaternion),
    )
    # Velocity of a point of a rigid body: v + ω × r
    velocity = of_owner(states.velocity_mps) + torch.linalg.cross(of_owner(states.turn_radps), arm)
    return PlacedGaussians(moved, velocity, moving)


def mirrored(gaussians: Gaussians) -> Gaussians:
    """Swap left and right: y to -y, in the frame of the box."""
    return _mirrored(gaussians, torch.ones_like(gaussians.opacity_logit, dtype=torch.bool))


def _mirrored(gaussians: Gaussians, which: Bool[Tensor, "M"]) -> Gaussians:
    # Signs of the components are flipped only for mirrored actors
    xyz = torch.where(which[:, None], gaussians.mean_m.new_tensor(_MIRROR_XYZ), 1.0)
    wxyz = torch.where(which[:, None], gaussians.mean_m.new_tensor(_MIRROR_WXYZ), 1.0)
    return dataclasses.replace(
        gaussians, mean_m=gaussians.mean_m * xyz, quaternion=gaussians.quaternion * wxyz
    )
