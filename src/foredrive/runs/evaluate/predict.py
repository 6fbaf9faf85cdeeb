"""A trained agent in the form that an evaluation asks for."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.evaluation.predictor import Part, Prediction
from foredrive.models.agent import AgentOutput, PlanningAgent
from foredrive.models.tasks.heads import TaskHeads
from foredrive.scene import Belief, Clip, Decoded, RayRenderer, WorldModel
from foredrive.training import thinned_rays
from foredrive.training.task_probe import task_volumes


class AgentPredictor:
    """A trained agent as a `Predictor`.

    Args:
        agent: in evaluation mode.
        steps: number of future key frames to predict.
        ray_stride: one pixel in `ray_stride` along rows and columns is rendered, at the present frame, by a
            world model that renders; 0 renders nothing.
        futures: number of futures to draw from a stochastic world model. Their random states depend on the
            order of the clips.
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

    @torch.no_grad()
    def predict(self, observed: Clip, asked: frozenset[Part]) -> Prediction:
        """Predict plan, occupancy and flow for now and the next key frames; views and futures if asked."""
        output = self.agent(observed, self.steps)
        decoded, world = output.decoded, self.agent.world_model
        flow = [frame.flow for frame in decoded if frame.flow is not None]
        views = None
        if "images" in asked and self.ray_stride and world.renderer is not None:
            views = self._views(world.renderer, observed, decoded[0])[:, None]
        futures = None
        if "futures" in asked and self.futures and self.steps and world.samples_futures:
            drawn = [
                world.imagine(output.beliefs[0], self.steps, generator=self._generator)
                for _ in range(self.futures)
            ]
            futures = torch.stack([_occupied(world, beliefs) for beliefs in drawn], dim=1)
        tasks = Prediction() if self.heads is None else self._tasks(self.heads, output)
        return dataclasses.replace(
            tasks,
            occupancy_logit=torch.stack([frame.occupancy_logit for frame in decoded], dim=1),
            plan=output.plan,
            flow_mps=torch.stack(flow, dim=1) if len(flow) == len(decoded) else None,
            futures=futures,
            images=views,
            image_stride=max(self.ray_stride, 1),
        )

    def _tasks(self, heads: TaskHeads, output: AgentOutput) -> Prediction:
        """Return the parts of a prediction that the heads give; those without a head are None."""
        found = output.found
        if heads is not self.agent.heads or found is None:
            now, world = output.beliefs[0], self.agent.world_model
            found = heads(task_volumes(world, now, heads.config.tasks).by_task())
        motion = None if heads.agents is None else heads.agents.motion
        dt_s = 0.5 if motion is None else motion.config.dt_s
        return Prediction(
            agents=None if found.agents is None else found.agents[-1].agents(dt_s),
            map_lines=None if found.elements is None else found.elements[-1].lines(),
            map_layers=None if found.raster is None else found.raster.sigmoid(),
            semantics=None if found.voxels is None else found.voxels.argmax(dim=1).to(torch.uint8),
        )

    def _views(self, renderer: RayRenderer, observed: Clip, now: Decoded) -> Float[Tensor, "b C 3 h w"]:
        rays = thinned_rays(observed, observed.now, self.ray_stride)
        rendered = renderer(now.feature, now.occupancy_logit, rays.origin, rays.direction)
        b, c, _, h, w = rays.rgb.shape
        return rendered.rgb.view(b, c, h, w, 3).permute(0, 1, 4, 2, 3)


def _occupied(world: WorldModel, beliefs: Sequence[Belief]) -> Bool[Tensor, "b F Z Y X"]:
    return torch.stack([world.decode(belief).occupancy_logit > 0 for belief in beliefs], dim=1)
