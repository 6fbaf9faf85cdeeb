"""The exported graph: an agent from images to plan and occupancy, with plain tensors at both ends."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, UInt8
from torch import Tensor, nn

from foredrive.methods.planner.agent import AgentOutput, PlanningAgent
from foredrive.methods.planner.ego_mlp import ego_motion, route_target
from foredrive.scene import CameraRig, Clip, Frames, last_frames


class GraphInputs(NamedTuple):
    """The inputs of the graph: T key frames (now is last) of C cameras, in a batch of one."""

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
    frame_t_s: Float[Tensor, "1 T"]
    T_now_frame: Float64[Tensor, "1 T 4 4"]
    frame_speed_mps: Float[Tensor, "1 T"]
    frame_speed_valid: Bool[Tensor, "1 T"]

    @classmethod
    def from_clip(cls, observed: Clip, agent: PlanningAgent[Any]) -> "GraphInputs":
        """Return the inputs of `agent` from an observed clip with a batch of one."""
        frames = last_frames(observed, agent.world_model.past_frames)
        poses, speeds = ego_motion(observed, agent.planner.history)
        return cls(
            images=frames.images.contiguous(),
            image_valid=frames.image_valid.contiguous(),
            K=frames.rig.K.contiguous(),
            T_ego_cam=frames.rig.T_ego_cam.contiguous(),
            dist=frames.rig.dist.contiguous(),
            speed_mps=speeds[:, -1],
            speed_valid=observed.ego_speed_valid[:, -1],
            command=observed.command.long(),
            command_valid=observed.command_valid,
            past_motion=torch.cat([poses, speeds[:, :-1, None]], dim=-1),
            route_lead=route_target(observed),
            frame_t_s=frames.t_s.contiguous(),
            T_now_frame=frames.T_now_ego.contiguous(),
            frame_speed_mps=frames.speed_mps.contiguous(),
            frame_speed_valid=frames.speed_valid.contiguous(),
        )


class GraphOutputs(NamedTuple):
    """The outputs of the graph. F counts now and the imagined key frames."""

    waypoints_xy: Float[Tensor, "1 S 2"]
    waypoints_yaw: Float[Tensor, "1 S"]
    occupancy_logit: Float[Tensor, "1 F Z Y X"]
    T_now_ego: Float[Tensor, "1 F 4 4"]

    @classmethod
    def from_agent(cls, output: AgentOutput) -> "GraphOutputs":
        """Return the outputs of the graph from those of the agent."""
        now = torch.eye(4)[None]
        poses = [now if belief.T_now_ego is None else belief.T_now_ego for belief in output.beliefs]
        return cls(
            waypoints_xy=output.plan.xy[:, 0],
            waypoints_yaw=output.plan.yaw[:, 0],
            occupancy_logit=torch.stack([decoded.occupancy_logit for decoded in output.decoded], dim=1),
            T_now_ego=torch.stack(poses, dim=1),
        )


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
    "frame_t_s": "time of each key frame, s; 0 at now",
    "T_now_frame": "ego frame of each key frame -> ego frame now, m",
    "frame_speed_mps": "of the ego vehicle at each key frame, m/s",
    "frame_speed_valid": "whether that speed is known",
    "waypoints_xy": "rear axle in the ego frame now, m; the first one step ahead",
    "waypoints_yaw": "heading relative to now's, rad",
    "occupancy_logit": "before the sigmoid; now first, then the imagined key frames, each in its own ego "
    "frame; voxels in the order Z Y X",
    "T_now_ego": "predicted ego frame of each of these -> ego frame now, m",
}
"""Units and frames of every input and output."""


class AgentGraph(nn.Module):
    """An agent with plain tensors as inputs and outputs.

    No operation depends on the values of the data, so that it can be traced.

    Args:
        agent: in evaluation mode.
        camera_names, image_hw: names and size of the images.
        steps: number of imagined key frames.
    """

    def __init__(
        self, agent: PlanningAgent[Any], camera_names: tuple[str, ...], image_hw: tuple[int, int], steps: int
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
        frame_t_s: Float[Tensor, "1 T"],
        T_now_frame: Float64[Tensor, "1 T 4 4"],
        frame_speed_mps: Float[Tensor, "1 T"],
        frame_speed_valid: Bool[Tensor, "1 T"],
    ) -> dict[str, Tensor]:
        """Run the agent as `PlanningAgent.forward` does. `MEANING` describes all inputs and outputs."""
        model, planner = self.agent.world_model, self.agent.planner
        rig = CameraRig(
            K=K,
            T_ego_cam=T_ego_cam,
            dist=dist,
            # The graph has no input for the readout time: a global shutter
            readout_s=torch.zeros_like(dist[..., 0]),
            names=self.camera_names,
            size_hw=self.image_hw,
        )
        frames = Frames(
            t_s=frame_t_s,
            T_now_ego=T_now_frame,
            images=images,
            image_valid=image_valid,
            rig=rig,
            speed_mps=frame_speed_mps,
            speed_valid=frame_speed_valid,
        )
        now = model.encode(frames)
        # The planner may need more imagined frames than the graph returns; these are dropped below
        beliefs = [now, *model.imagine(now, max(self.steps, planner.imagined_frames))]
        volume = self.agent.planner_volume
        future = volume(beliefs[1]) if planner.imagined_frames else None
        # The same arguments as in `PlanningAgent.forward`, from plain tensors in place of a clip
        plan = planner(
            volume(now),
            future,
            command,
            command_valid,
            speed_mps,
            speed_valid,
            past_motion,
            route_lead,
            self.agent.tokens(now),
        )
        beliefs = beliefs[: self.steps + 1]
        decoded = [model.decode(belief) for belief in beliefs]
        return GraphOutputs.from_agent(AgentOutput(beliefs, decoded, plan))._asdict()
