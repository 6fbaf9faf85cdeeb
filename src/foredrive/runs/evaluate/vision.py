"""A trained agent looking at one clip at a time: everything that a person may want to see of it."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import transform_points
from foredrive.models.agent import AgentOutput, PlanningAgent
from foredrive.models.nemo import Nemo
from foredrive.scene import CameraRig, Clip, Trajectory, VoxelSpec
from foredrive.scene.record import Record
from foredrive.sensors import camera_rays

RAYS_AT_ONCE = 8192


@dataclass(frozen=True)
class Vision(Record):
    """What the model holds to be the case: now first, then K imagined key frames, F = K + 1 in all."""

    occupancy_logit: Float[Tensor, "F Z Y X"]
    """Each in its own ego frame."""
    volume: Float[Tensor, "F D Z Y X"]
    T_now_ego: Float[Tensor, "F 4 4"]
    """Predicted ego frame of each -> ego frame now."""
    flow_m: Float[Tensor, "K 3 Z Y X"]
    """f of NeMo's eq. 7: what is at z in frame k + 1 came from z + f, over ground."""
    plan: Trajectory
    """[1 T]."""

    def movement_m(
        self, k: int, spec: VoxelSpec
    ) -> tuple[Float[Tensor, "Z Y X 3"], Float[Tensor, "Z Y X 3"]]:
        """Where the content of every voxel of imagined frame k ≥ 1 came from, and where it is.

        Both over ground, in the ego frame now, m: what stands still came from where it is, however fast the
        vehicle goes.
        """
        centre = spec.centres_m().flatten(0, 2)
        came_from = centre + self.flow_m[k - 1].flatten(1).T
        start, end = (transform_points(self.T_now_ego[k], place) for place in (came_from, centre))
        return start.unflatten(0, spec.shape_zyx), end.unflatten(0, spec.shape_zyx)


class Observer:
    """An agent to whom clips are shown, and who renders what it holds to be the case.

    Args:
        agent: in evaluation mode.
        steps: how many key frames it imagines.
    """

    def __init__(self, agent: PlanningAgent, steps: int) -> None:
        self.agent, self.steps = agent, steps
        self._renderer = agent.world_model.renderer if isinstance(agent.world_model, Nemo) else None

    @property
    def renders(self) -> bool:
        """Whether there is anything to render with."""
        return self._renderer is not None

    @torch.no_grad()
    def look(self, observed: Clip) -> Vision:
        """Everything about an observed clip, a batch of one."""
        output = self.agent(observed, self.steps)
        beliefs = output.beliefs
        eye = torch.eye(4)
        return Vision(
            occupancy_logit=torch.stack([frame.occupancy_logit[0] for frame in output.decoded]),
            volume=torch.stack([belief.volume[0] for belief in beliefs]),
            T_now_ego=torch.stack([eye if b.T_now_ego is None else b.T_now_ego[0] for b in beliefs]),
            flow_m=self._flow_m(output)[0],
            plan=output.plan[0],
        )

    def _flow_m(self, output: AgentOutput) -> Float[Tensor, "1 K 3 Z Y X"]:
        """Where the content of imagined voxels came from; from decoded velocities where there are any."""
        world = self.agent.world_model
        if isinstance(world, Nemo):
            history = output.beliefs[0].history
            assert history is not None
            return world.motion(history).flow[:, : self.steps]
        back = [-world.dt_s * frame.flow for frame in output.decoded if frame.flow is not None]
        return torch.stack(back, dim=1)[:, 1:]

    @torch.no_grad()
    def render(self, vision: Vision, k: int, rig: CameraRig) -> Float[Tensor, "C H W 3"]:
        """What cameras that need not exist would see of frame k: RGB, 0 to 1.

        Args:
            vision: from `look`.
            k: 0 is now.
            rig: C cameras without leading dimensions; `T_ego_cam` leads to the ego frame of frame k.
        """
        renderer = self._renderer
        assert renderer is not None
        volume, logit = vision.volume[k : k + 1], vision.occupancy_logit[k : k + 1]
        rays = camera_rays(rig)
        origin, direction = rays.origin_ego.flatten(0, 1), rays.dir_ego.flatten(0, 1)
        parts = [
            renderer(volume, logit, o[None], d[None]).rgb[0]
            for o, d in zip(origin.split(RAYS_AT_ONCE), direction.split(RAYS_AT_ONCE), strict=True)
        ]
        return torch.cat(parts).view(len(rig.names), *rig.size_hw, 3)
