"""Agents that are carried from frame to frame: identities without an association step."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from foredrive.geometry.precision import full_precision
from foredrive.geometry.se3 import compose_se3, inverse_se3, rotate_vectors, transform_points
from foredrive.heads.agents_head import AgentHead, AgentSet, CarriedConfig
from foredrive.heads.plane import Planes
from foredrive.heads.proposals import CentreMap
from foredrive.scene.record import Record

R = TypeVar("R", bound=Record)
NEW = -1
"""Source of a query that continues none."""


@dataclass(frozen=True)
class FrameSteps(Record):
    """The ego motion within B sequences of K key frames. A batch has B · K items, sequence by sequence."""

    T_now_before: Float[Tensor, "B K 4 4"]
    """The ego frame of the frame before -> the ego frame of each; that of the first is the identity."""
    dt_s: float
    """Time between frames."""


@dataclass(frozen=True)
class Lineage(Record):
    """The origin of each query in the frame before, and its rank among those to be carried on."""

    source: Int[Tensor, "*b Q"]
    """Index of the query in the frame before, or `NEW`."""
    rank: Float[Tensor, "*b Q"]


@dataclass(frozen=True)
class CarriedAgents(Record):
    """The C agents of the frame before that go on, moved to the ego frame at now."""

    agents: AgentSet
    """Their queries have the features of the frame before."""
    lineage: Lineage


def frame_steps(T_world_ego: Float64[Tensor, "b 4 4"], frames: int, dt_s: float) -> FrameSteps:
    """Return the ego motion of a batch of sequences.

    Args:
        T_world_ego: pose at the now of each item.
        frames: K, items of a sequence.
        dt_s: time between them.
    """
    poses = T_world_ego.unflatten(0, (-1, frames))
    # The first frame of a sequence is its own predecessor
    before = torch.cat([poses[:, :1], poses[:, :-1]], dim=1)
    return FrameSteps(compose_se3(inverse_se3(poses), before).float(), dt_s)


def lineage_of(predicted: AgentSet, carried: CarriedAgents | None, decay: float) -> Lineage:
    """Return the lineage of queries of which the first are those of `carried`.

    The rank is the score. Carried queries keep at least `decay` times their rank, so that an agent that is
    hidden for a moment is not lost (SparseDrive, Sun et al. 2024: its instance bank).
    """
    score = predicted.best_class()[0].detach()
    source = torch.full_like(score, NEW, dtype=torch.long)
    if carried is None:
        return Lineage(source, score)
    old = carried.lineage.rank.shape[-1]
    # Carried queries come first: their rank decays slowly, new ones have their score
    rank = torch.cat([torch.maximum(score[:, :old], decay * carried.lineage.rank), score[:, old:]], dim=-1)
    return Lineage(torch.cat([carried.lineage.source, source[:, old:]], dim=-1), rank)


def carry(
    predicted: AgentSet, lineage: Lineage, count: int, T_now_before: Float[Tensor, "b 4 4"], dt_s: float
) -> CarriedAgents:
    """Return the agents of the highest ranks, moved by the ego motion and their own velocity.

    Queries keep their gradients. Boxes pass none, as in the layers of the head.

    Args:
        predicted: agents of the frame before, with their queries.
        lineage: of these agents.
        count: number of agents to carry on.
        T_now_before: the ego frame of the frame before -> the ego frame at now.
        dt_s: time between the frames.
    """
    rank, best = lineage.rank.topk(count, dim=-1)
    item = torch.arange(len(best), device=best.device)[:, None]
    # Forecasts are not carried
    bare = dataclasses.replace(predicted, future_xy=None, log_prob=None)
    chosen = bare.map_tensors(lambda tensor: tensor[item, best])
    query = chosen.query
    here = moved(chosen.map_tensors(Tensor.detach), T_now_before, dt_s)
    return CarriedAgents(dataclasses.replace(here, query=query), Lineage(best, rank))


def moved(agents: AgentSet, T_now_before: Float[Tensor, "b 4 4"], dt_s: float) -> AgentSet:
    """Return agents in another ego frame, where they are at constant velocity after `dt_s`."""
    boxes = agents.boxes
    with full_precision(boxes.mean, T_now_before) as (mean, T):
        level = torch.zeros_like(mean[..., :1])
        velocity = torch.cat([agents.velocity.to(mean), level], dim=-1)
        # Position after dt at constant velocity, in the new ego frame
        centre = transform_points(T, mean[..., :3] + dt_s * velocity)
        sin, cos = boxes.heading.to(mean).unbind(-1)
        # The heading is stored as sine and cosine; as a vector it is (cos, sin)
        heading = rotate_vectors(T, torch.stack([cos, sin, level[..., 0]], dim=-1))
        turned = torch.nn.functional.normalize(heading[..., [1, 0]], dim=-1, eps=1e-3)
        moved_boxes = dataclasses.replace(
            boxes, mean=torch.cat([centre, mean[..., 3:]], dim=-1), heading=turned
        )
        return dataclasses.replace(agents, boxes=moved_boxes, velocity=rotate_vectors(T, velocity)[..., :2])


def follow(
    head: AgentHead, config: CarriedConfig, planes: Planes, motion_planes: Planes | None, steps: FrameSteps
) -> tuple[CentreMap, list[AgentSet], Lineage]:
    """Return what a head finds in each frame of sequences, with the agents of the frames before carried on.

    Args:
        head: of agents.
        config: of the carried agents.
        planes, motion_planes: of all B · K items, as for the head.
        steps: ego motion.
    """
    frames = steps.T_now_before.shape[1]
    carried: CarriedAgents | None = None
    every: list[tuple[CentreMap, list[AgentSet], Lineage]] = []
    for k in range(frames):
        # Frame k of all sequences: items are sequence by sequence
        now, motion = (
            None if part is None else part.map_tensors(lambda tensor, k=k: tensor[k::frames])  # type: ignore[misc]
            for part in (planes, motion_planes)
        )
        assert now is not None
        centres, layers = head(now, motion, None if carried is None else carried.agents)
        lineage = lineage_of(layers[-1], carried, config.decay)
        every.append((centres, layers, lineage))
        # The agents of the last frame go nowhere
        if k + 1 < frames:
            carried = carry(layers[-1], lineage, config.agents, steps.T_now_before[:, k + 1], steps.dt_s)
    layers = [interleaved([step[1][n] for step in every]) for n in range(len(every[0][1]))]
    return interleaved([step[0] for step in every]), layers, interleaved([step[2] for step in every])


def interleaved(records: Sequence[R]) -> R:
    """Return the records of K frames, of B sequences each, as one of B · K items."""

    def join(values: list[Any]) -> Any:
        if isinstance(values[0], Tensor):
            # Stack the frames of each sequence beside each other again
            return torch.stack(values, dim=1).flatten(0, 1)
        return interleaved(values) if isinstance(values[0], Record) else values[0]

    names = [field.name for field in dataclasses.fields(records[0])]
    joined = {name: join([getattr(record, name) for record in records]) for name in names}
    return dataclasses.replace(records[0], **joined)
