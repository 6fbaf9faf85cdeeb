"""Run a trained agent on one clip at a time, for display."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from foredrive.geometry.se3 import transform_points
from foredrive.heads.heads import TaskHeads
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.scene import CameraRig, Clip, Decoded, RayRenderer, Trajectory, VoxelSpec
from foredrive.scene.agents import Agents, MapLines
from foredrive.scene.record import Record
from foredrive.scene.semantics import Taxonomy
from foredrive.sensors import camera_rays
from foredrive.tasks.predictor import Prediction

RAYS_AT_ONCE = 8192


@dataclass(frozen=True)
class DisplayPrediction(Record):
    """The predictions of a model: now first, then K imagined key frames, F = K + 1 in all."""

    occupancy_logit: Float[Tensor, "F Z Y X"]
    """Occupancy logits, each frame in its own ego frame."""
    volume: Float[Tensor, "F D Z Y X"]
    T_now_ego: Float[Tensor, "F 4 4"]
    """Transform from the predicted ego frame of each frame to the ego frame now."""
    flow_m: Float[Tensor, "K 3 Z Y X"] | None
    """Backward flow of the imagined frames over ground, m: the content at z came from z + flow in the frame
    before. None from a model without flow.
    """
    plan: Trajectory
    """The plan; batch shape [1 T]."""
    agents: Agents | None = None
    """Road users at now; None without a head."""
    lines: MapLines | None = None
    classes: UInt8[Tensor, "Z Y X"] | None = None
    """Class of each voxel at now, in `taxonomy`."""
    taxonomy: Taxonomy = "occ3d"

    def movement_m(
        self, k: int, spec: VoxelSpec
    ) -> tuple[Float[Tensor, "Z Y X 3"], Float[Tensor, "Z Y X 3"]] | None:
        """Return start and end of the movement of each voxel's content up to imagined frame k ≥ 1.

        Both over ground, in the ego frame now, m: static content has start = end, however fast the vehicle
        drives. None if the model predicts no flow.
        """
        if self.flow_m is None:
            return None
        centre = spec.centres_m().flatten(0, 2)
        came_from = centre + self.flow_m[k - 1].flatten(1).T
        start, end = (transform_points(self.T_now_ego[k], place) for place in (came_from, centre))
        return start.unflatten(0, spec.shape_zyx), end.unflatten(0, spec.shape_zyx)


class DisplayPredictor:
    """Runs an agent on clips and renders its predictions.

    Args:
        agent: in evaluation mode.
        steps: number of key frames to imagine.
        heads: trained task heads in evaluation mode; None shows no further tasks.
    """

    def __init__(self, agent: PlanningAgent[Any], steps: int, heads: TaskHeads | None = None) -> None:
        self.agent, self.steps, self.heads = agent, steps, heads
        self._renderer: RayRenderer | None = agent.world_model.renderer

    @property
    def renders(self) -> bool:
        """Return whether the world model renders images."""
        return self._renderer is not None

    @torch.no_grad()
    def predict(self, observed: Clip) -> DisplayPrediction:
        """Return all predictions for an observed clip, a batch of one."""
        output = self.agent(observed, self.steps)
        beliefs = output.beliefs
        eye = torch.eye(4)
        tasks = Prediction()
        if self.heads is not None:
            predictor = AgentPredictor(self.agent, self.steps, 0, heads=self.heads)
            tasks = predictor.predict(observed, frozenset())
        voxels = None if self.heads is None else self.heads.voxels
        return DisplayPrediction(
            agents=None if tasks.agents is None else tasks.agents[0],
            lines=None if tasks.map_lines is None else tasks.map_lines[0],
            classes=None if tasks.semantics is None else tasks.semantics[0],
            taxonomy="occ3d" if voxels is None else voxels.taxonomy,
            occupancy_logit=torch.stack([frame.occupancy_logit[0] for frame in output.decoded]),
            volume=torch.stack([belief.volume[0] for belief in beliefs]),
            T_now_ego=torch.stack([eye if b.T_now_ego is None else b.T_now_ego[0] for b in beliefs]),
            flow_m=self._flow_m(output.decoded[1:]),
            plan=output.plan[0],
        )

    def _flow_m(self, imagined: Sequence[Decoded]) -> Float[Tensor, "K 3 Z Y X"] | None:
        flow = [frame.flow[0] for frame in imagined if frame.flow is not None]
        return -self.agent.world_model.dt_s * torch.stack(flow) if flow else None

    @torch.no_grad()
    def render(self, prediction: DisplayPrediction, k: int, rig: CameraRig) -> Float[Tensor, "C H W 3"]:
        """Render frame k for any cameras, real or virtual: RGB, 0 to 1.

        Args:
            prediction: from `predict`.
            k: index of the frame; 0 is now.
            rig: C cameras without leading dimensions; `T_ego_cam` leads to the ego frame of frame k.
        """
        renderer = self._renderer
        assert renderer is not None
        volume, logit = prediction.volume[k : k + 1], prediction.occupancy_logit[k : k + 1]
        rays = camera_rays(rig)
        origin, direction = rays.origin_ego.flatten(0, 1), rays.dir_ego.flatten(0, 1)
        parts = [
            renderer(volume, logit, o[None], d[None]).rgb[0]
            for o, d in zip(origin.split(RAYS_AT_ONCE), direction.split(RAYS_AT_ONCE), strict=True)
        ]
        return torch.cat(parts).view(len(rig.names), *rig.size_hw, 3)
