"""What is exported: an agent's way from images to plan and occupancy, with plain tensors at both ends."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from foredrive.models.agent import PlanningAgent
from foredrive.models.ego_mlp import ego_motion, route_lead
from foredrive.models.nemo import Nemo
from foredrive.scene import CameraRig, Clip


class GraphInputs(NamedTuple):
    """What a vehicle feeds in: T key frames, now last, of C cameras; a batch of one."""

    images: UInt8[Tensor, "1 T C 3 H W"]
    image_valid: Bool[Tensor, "1 T C"]
    K: Float[Tensor, "1 T C 3 3"]
    T_ego_cam: Float[Tensor, "1 T C 4 4"]
    dist: Float[Tensor, "1 T C 5"]
    speed_mps: Float[Tensor, "1"]
    speed_valid: Bool[Tensor, "1"]
    command: Int[Tensor, "1"]
    command_valid: Bool[Tensor, "1"]
    past_motion: Float[Tensor, "1 P 4"]
    route_lead: Float[Tensor, "1 3"]

    @classmethod
    def of(cls, observed: Clip, agent: PlanningAgent) -> "GraphInputs":
        """What `agent` looks at of an observed clip with a batch of one."""
        rig, frames = observed.rig, agent.world_model.past_frames + 1
        poses, speeds = ego_motion(observed, agent.planner.history)
        return cls(
            images=observed.images[:, -frames:].contiguous(),
            image_valid=observed.image_valid[:, -frames:].contiguous(),
            K=rig.K[:, -frames:].contiguous(),
            T_ego_cam=rig.T_ego_cam[:, -frames:].contiguous(),
            dist=rig.dist[:, -frames:].contiguous(),
            speed_mps=observed.ego_speed_mps[:, -1],
            speed_valid=observed.ego_speed_valid[:, -1],
            command=observed.command.long(),
            command_valid=observed.command_valid,
            past_motion=torch.cat([poses, speeds[:, :-1, None]], dim=-1),
            route_lead=route_lead(observed),
        )


class GraphOutputs(NamedTuple):
    """What comes out; F counts now and the imagined key frames."""

    waypoints_xy: Float[Tensor, "1 S 2"]
    waypoints_yaw: Float[Tensor, "1 S"]
    occupancy_logit: Float[Tensor, "1 F Z Y X"]
    T_now_ego: Float[Tensor, "1 F 4 4"]


MEANING = {
    "images": "RGB, 0 to 255; T key frames in the order of time, now last",
    "image_valid": "whether the image exists; one that does not is not looked at",
    "K": "intrinsics of images of this size, px, pixel centres at +0.5",
    "T_ego_cam": "camera (x right, y down, z forward) at its exposure -> ego (x forward, y left, z up, rear "
    "axle on the ground) at the frame's time, m",
    "dist": "OpenCV k1 k2 p1 p2 k3; zeros for an ideal pinhole",
    "speed_mps": "of the ego vehicle now, m/s",
    "speed_valid": "whether the speed is known",
    "command": "0 left, 1 right, 2 straight",
    "command_valid": "whether the command is known",
    "past_motion": "x, y (m), yaw (rad) in the ego frame at now and speed (m/s) of the P key "
    "frames before now; P is 0 where the planner does not look at them",
    "route_lead": "x, y of where the route is 20 m on, in the ego frame at now, m, and 1; zeros where that "
    "is not known; planners that go by the command alone do not look at it",
    "waypoints_xy": "rear axle in the ego frame now, m; the first one step ahead",
    "waypoints_yaw": "heading relative to now's, rad",
    "occupancy_logit": "before the sigmoid; now first, then the imagined key frames, each in its own ego "
    "frame; voxels in the order Z Y X",
    "T_now_ego": "predicted ego frame of each of these -> ego frame now, m",
}
"""Units and frames of every input and output."""


class AgentGraph(nn.Module):
    """An agent on a NeMo between plain tensors: nothing in it depends on what data say, so it can be traced.

    Args:
        agent: in evaluation mode.
        camera_names, image_hw: of the images that will come.
        steps: how many key frames are imagined.
    """

    def __init__(
        self, agent: PlanningAgent, camera_names: tuple[str, ...], image_hw: tuple[int, int], steps: int
    ) -> None:
        super().__init__()
        self.agent, self.camera_names, self.image_hw, self.steps = agent, camera_names, image_hw, steps

    def forward(
        self,
        images: UInt8[Tensor, "1 T C 3 H W"],
        image_valid: Bool[Tensor, "1 T C"],
        K: Float[Tensor, "1 T C 3 3"],
        T_ego_cam: Float[Tensor, "1 T C 4 4"],
        dist: Float[Tensor, "1 T C 5"],
        speed_mps: Float[Tensor, "1"],
        speed_valid: Bool[Tensor, "1"],
        command: Int[Tensor, "1"],
        command_valid: Bool[Tensor, "1"],
        past_motion: Float[Tensor, "1 P 4"],
        route_lead: Float[Tensor, "1 3"],
    ) -> dict[str, Tensor]:
        """As `PlanningAgent.forward`: the fields of `GraphOutputs`; `MEANING` says what all of them are."""
        model, planner = self.agent.world_model, self.agent.planner
        assert isinstance(model, Nemo)
        rig = CameraRig(
            K=K,
            T_ego_cam=T_ego_cam,
            dist=dist,
            readout_s=torch.zeros_like(dist[..., 0]),
            names=self.camera_names,
            size_hw=self.image_hw,
        )
        now = model.encode(images, image_valid, rig)
        beliefs = [now, *model.imagine(now, max(self.steps, planner.looks_ahead))]
        ahead = beliefs[1].volume if planner.looks_ahead else None
        plan = planner(
            now.volume, ahead, command, command_valid, speed_mps, speed_valid, past_motion, route_lead
        )
        shown = beliefs[: self.steps + 1]
        poses = [torch.eye(4)[None] if belief.T_now_ego is None else belief.T_now_ego for belief in shown]
        outputs = GraphOutputs(
            waypoints_xy=plan.xy[:, 0],
            waypoints_yaw=plan.yaw[:, 0],
            occupancy_logit=torch.stack([model.decode(belief).occupancy_logit for belief in shown], dim=1),
            T_now_ego=torch.stack(poses, dim=1),
        )
        return outputs._asdict()
