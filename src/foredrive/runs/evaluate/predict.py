"""A trained agent in the form that an evaluation asks for."""

import dataclasses
import functools
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from foredrive.heads.agents_head import CarriedConfig
from foredrive.heads.carried import interleaved
from foredrive.heads.following import AgentFollower, Perceive
from foredrive.heads.heads import HeadOutput, TaskHeads, TaskVolume, volumes_of
from foredrive.heads.instances_head import instance_raster
from foredrive.methods.blocks.training_rays import thinned_rays
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.scene import Belief, Clip, Decoded, RayRenderer, Task, WorldModel
from foredrive.tasks.files.frame_keys import continues, time_of
from foredrive.tasks.predictor import Part, Prediction


class DriveFollower:
    """The state between the frames of drives. It begins anew with each log, and where frames are missing.

    Args:
        config: of the carried agents.
    """

    def __init__(self, config: CarriedConfig) -> None:
        self._follower, self._before = AgentFollower(config), ""

    def step(
        self, perceive: Perceive, key: str, T_world_ego: Float64[Tensor, "4 4"]
    ) -> tuple[HeadOutput, Int[Tensor, "1 Q"]]:
        """Return the output of heads for the next frame, and the identity of each agent; -1: none, or hidden.

        Args:
            perceive: the heads.
            key: name of the frame, LOG@T_US.
            T_world_ego: pose at now.
        """
        follows = continues(self._before, key)
        dt_s = 1e-6 * (time_of(key) - time_of(self._before)) if follows else None
        self._before = key
        return self._follower.step(perceive, T_world_ego, dt_s)


def together(outputs: Sequence[HeadOutput]) -> HeadOutput:
    """Return outputs for one clip each as that of a batch."""
    joined: dict[str, Any] = {}
    for field in dataclasses.fields(HeadOutput):
        parts = [getattr(output, field.name) for output in outputs]
        if isinstance(parts[0], list):
            joined[field.name] = [interleaved([part[n] for part in parts]) for n in range(len(parts[0]))]
        elif isinstance(parts[0], Tensor):
            joined[field.name] = torch.cat(parts)
        else:
            joined[field.name] = None if parts[0] is None else interleaved(parts)
    return HeadOutput(**joined)


class AgentPredictor:
    """A trained agent as a `Predictor`.

    Args:
        agent: in evaluation mode.
        steps: number of future key frames to predict.
        ray_stride: one pixel in `ray_stride` along rows and columns is rendered, at the present frame, by a
            world model that renders; 0 renders nothing.
        futures: number of futures to draw from a stochastic world model. Their random states depend on the
            first clip of a batch alone, if `follow` names it.
        heads: trained task heads in evaluation mode; None predicts no further tasks.
    """

    def __init__(
        self,
        agent: PlanningAgent[Any],
        steps: int,
        ray_stride: int,
        futures: int = 0,
        heads: TaskHeads | None = None,
    ) -> None:
        self.agent, self.steps, self.ray_stride, self.futures = agent, steps, ray_stride, futures
        self.heads = heads
        self._generator = torch.Generator().manual_seed(0)
        agents = None if heads is None else heads.config.agents
        carried = None if agents is None else agents.carried
        self._follower = None if carried is None else DriveFollower(carried)
        self._keys: Sequence[str] = ()

    @property
    def carries(self) -> bool:
        """Return whether it carries agents from frame to frame, so that a drive must stay whole."""
        return self._follower is not None

    def follow(self, keys: Sequence[str]) -> None:
        """Receive the names of the clips of the next call of `predict`; without, no agents are carried on."""
        self._keys = keys
        self._generator.manual_seed(zlib.crc32(keys[0].encode()))

    @torch.no_grad()
    def predict(self, observed: Clip, asked: frozenset[Part]) -> Prediction:
        """Predict plan, occupancy and flow for now and the next key frames; views and futures if asked."""
        agent, world = self.agent, self.agent.world_model
        beliefs = agent.rollout(observed, max(self.steps, agent.planner.imagined_frames))
        output, track_id = self._perceive(beliefs[0], observed)
        decoded = [world.decode(belief) for belief in beliefs[: self.steps + 1]]
        flow = [frame.flow for frame in decoded if frame.flow is not None]
        views = None
        if "images" in asked and self.ray_stride and world.renderer is not None:
            views = self._views(world.renderer, observed, decoded[0])[:, None]
        futures = None
        if "futures" in asked and self.futures and self.steps and world.samples_futures:
            drawn = [
                world.imagine(beliefs[0], self.steps, generator=self._generator) for _ in range(self.futures)
            ]
            futures = torch.stack([_occupied(world, beliefs) for beliefs in drawn], dim=1)
        tasks = Prediction()
        if self.heads is not None and output is not None:
            tasks = _tasks(self.heads, output, track_id)
        own = output if self.heads is agent.heads else None
        return dataclasses.replace(
            tasks,
            occupancy_logit=torch.stack([frame.occupancy_logit for frame in decoded], dim=1),
            plan=agent.plan(observed, beliefs, own),
            flow_mps=torch.stack(flow, dim=1) if len(flow) == len(decoded) else None,
            futures=futures,
            images=views,
            image_stride=max(self.ray_stride, 1),
        )

    def _perceive(self, now: Belief, observed: Clip) -> tuple[HeadOutput | None, Int[Tensor, "b _Q"] | None]:
        """Return the output of the heads, and the identities of the agents if they have any."""
        heads, follower = self.heads, self._follower
        if heads is None:
            return None, None
        volumes = volumes_of(self.agent.world_model, now, heads.config.volumes, heads.config.later)
        if follower is None:
            return heads(volumes), None
        outputs = []
        for item, key in enumerate(self._keys or [""] * len(now.volume)):
            of_item = functools.partial(heads, _of_item(volumes, item), None)
            outputs.append(follower.step(of_item, key, observed.T_world_ego[item, observed.now]))
        self._keys = ()
        return together([output for output, _ in outputs]), torch.cat([track_id for _, track_id in outputs])

    def _views(self, renderer: RayRenderer, observed: Clip, now: Decoded) -> Float[Tensor, "b C 3 h w"]:
        rays = thinned_rays(observed, observed.now, self.ray_stride)
        rendered = renderer(now.feature, now.occupancy_logit, rays.origin, rays.direction)
        b, c, _, h, w = rays.rgb.shape
        return rendered.rgb.view(b, c, h, w, 3).permute(0, 1, 4, 2, 3)


def _of_item(volumes: Mapping[Task, TaskVolume], item: int) -> dict[Task, TaskVolume]:
    """Return the volumes of one item, as a batch of one. Tasks that share a volume still do."""
    distinct = {id(volume): volume[item : item + 1] for volume in volumes.values()}
    return {task: distinct[id(volume)] for task, volume in volumes.items()}


def _tasks(heads: TaskHeads, output: HeadOutput, track_id: Int[Tensor, "b Q"] | None) -> Prediction:
    """Return the parts of a prediction that heads give; those without a head are None."""
    motion = None if heads.agents is None else heads.agents.motion
    agents = None
    if output.agents is not None:
        agents = output.agents[-1].agents(0.5 if motion is None else motion.config.dt_s)
        agents = agents if track_id is None else dataclasses.replace(agents, track_id=track_id)
    instances = None
    if output.instances is not None and output.agents is not None and heads.instance_grid is not None:
        instances = instance_raster(output.instances, output.agents[-1], heads.instance_grid)
    return Prediction(
        instances=instances,
        agents=agents,
        map_lines=None if output.elements is None else output.elements[-1].lines(),
        map_layers=None if output.raster is None else output.raster.sigmoid(),
        semantics=None if output.voxels is None else output.voxels.argmax(dim=1).to(torch.uint8),
    )


def _occupied(world: WorldModel, beliefs: Sequence[Belief]) -> Bool[Tensor, "b F Z Y X"]:
    return torch.stack([world.decode(belief).occupancy_logit > 0 for belief in beliefs], dim=1)
