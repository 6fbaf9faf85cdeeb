"""Gaussians of a scene graph, placed for one time."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.geometry.quaternions import multiply_quaternions, quaternion_from_matrix
from foredrive.methods.reconstruction.gaussians import Gaussians, joined
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
    """M of a scene's Gaussians, placed for one time."""

    gaussians: Gaussians
    """Gaussians in the scene's frame."""
    velocity_mps: Float[Tensor, "M 3"] | None
    """Velocities of the centres, in the scene's axes. None: all stand."""
    source: Int[Tensor, "M"]
    """Index of each one in the scene's Gaussians."""


def place_gaussians(
    graph: SceneGraph, t_s: float | Tensor, mirror: Bool[Tensor, "A"] | None = None
) -> PlacedGaussians:
    """Place the static part and every present actor at a time. The arguments are those of `placed_parts`."""
    parts = placed_parts(graph, t_s, mirror)
    if len(parts) == 1:
        return parts[0]
    standing, moved = parts
    assert moved.velocity_mps is not None
    return PlacedGaussians(
        gaussians=joined([standing.gaussians, moved.gaussians]),
        velocity_mps=torch.cat([torch.zeros_like(standing.gaussians.mean_m), moved.velocity_mps]),
        source=torch.cat([standing.source, moved.source]),
    )


def projected_parts(
    graph: SceneGraph,
    t_s: float | Tensor,
    mirror: Bool[Tensor, "A"] | None,
    project: Callable[[Gaussians, Float[Tensor, "M 3"] | None], Splats],
) -> Splats:
    """Return the splats of the placed Gaussians, by a projection of Gaussians and their velocities.

    Without gradients, the static part is projected where it is: joined with the actors it would be copied.
    """
    if torch.is_grad_enabled():
        placed = place_gaussians(graph, t_s, mirror)
        return project(placed.gaussians, placed.velocity_mps)
    parts = [project(part.gaussians, part.velocity_mps) for part in placed_parts(graph, t_s, mirror)]
    return Splats(*(torch.cat(field) for field in zip(*parts, strict=True)))


def placed_parts(
    graph: SceneGraph, t_s: float | Tensor, mirror: Bool[Tensor, "A"] | None = None
) -> list[PlacedGaussians]:
    """Return the static part, then the Gaussians of all present actors if there are any, at a time.

    Args:
        graph: a scene of Gaussians.
        t_s: seconds since the start of the drive.
        mirror: actors whose left and right sides are swapped; None: none.
    """
    content, states = gaussians_of(graph), states_at(graph.tracks, t_s)
    shown = torch.cat([states.present, states.present.new_ones(1)])[content.actor]  # STATIC, -1: last entry
    # Gaussians of present actors; the static ones always count
    moving = (shown & (content.actor >= 0)).nonzero()[:, 0]
    if torch.is_grad_enabled():
        still = (content.actor < 0).nonzero()[:, 0]
        standing = content.gaussians[still]
    else:
        still, standing = content.static_part
    parts = [PlacedGaussians(standing, None, still)]
    if len(moving) == 0:
        return parts
    owner = content.actor[moving]
    own = content.gaussians[moving]
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
    return [*parts, PlacedGaussians(moved, velocity, moving)]


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
