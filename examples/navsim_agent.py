"""A NAVSIM agent that plans with a Foredrive run, for NAVSIM's own evaluation of its own data.

Copy foredrive_agent.yaml beside it to navsim/planning/script/config/common/agent, put this folder on
PYTHONPATH, and give `agent=foredrive_agent agent.run=RUN` to NAVSIM's scripts.
"""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from navsim.agents.abstract_agent import AbstractAgent
from navsim.common.dataclasses import AgentInput, SensorConfig, Trajectory
from nuplan.planning.simulation.trajectory.trajectory_sampling import TrajectorySampling

from foredrive.data.batches import stack_records
from foredrive.data.resizing import shrink_images
from foredrive.driving.observation import FRAME_DT_S, KeyFrame, make_clip
from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.runs import load_agent, open_run
from foredrive.runs.shipped import run_folder
from foredrive.scene import CameraRig, Clip, Command
from foredrive.scene import Trajectory as Plan
from foredrive.scene.actors import boxes_in_ego_frame

CAMERAS = ("cam_f0", "cam_l0", "cam_r0", "cam_l1", "cam_r1", "cam_b0")
"""The six of NAVSIM's eight cameras that look as those of the rig `surround` do."""
HISTORY = 4
"""Number of key frames that NAVSIM gives, the last of them now."""
COMMANDS = (Command.LEFT, Command.STRAIGHT, Command.RIGHT)
"""NAVSIM's driving command is one of four; the fourth is "unknown"."""


class ForedriveAgent(AbstractAgent):
    """Plans with a run, from the cameras, the speed and the command.

    Args:
        run: a run folder, or embedded:nemo_town.
        trajectory_sampling: times of the poses; steps of 0.5 s.
    """

    def __init__(self, run: str, trajectory_sampling: TrajectorySampling) -> None:
        super().__init__(trajectory_sampling)
        self._run = open_run(run_folder(Path(run)))
        self._past_frames = self._run.recipe.clips.past_frames

    def name(self) -> str:
        """Return the name of the file of results."""
        return f"foredrive_{self._run.folder.name}"

    def get_sensor_config(self) -> SensorConfig:
        """Ask for the cameras at the key frames that the run observes."""
        config = SensorConfig.build_no_sensors()
        for camera in CAMERAS:
            setattr(config, camera, list(range(HISTORY - 1 - self._past_frames, HISTORY)))
        return config

    def initialize(self) -> None:
        """Load the weights; each worker calls this once."""
        self._agent = load_agent(self._run)

    @torch.no_grad()
    def compute_trajectory(self, agent_input: AgentInput) -> Trajectory:
        """Return the plan as poses (x, y, heading) in the frame of the rear axle at now."""
        clip = shrink_images(
            stack_records([clip_of(agent_input, self._past_frames)]), self._run.recipe.clips.image_hw
        )
        count = self._trajectory_sampling.num_poses
        return Trajectory(poses_of(self._agent.act(clip), count), self._trajectory_sampling)


def clip_of(given: AgentInput, past_frames: int) -> Clip:
    """Return NAVSIM's input as a clip. Lidar, boxes and the target point are not given."""
    frames = []
    for status, cameras in list(zip(given.ego_statuses, given.cameras, strict=True))[-1 - past_frames :]:
        x, y, yaw = (float(value) for value in status.ego_pose)
        T_now_ego = matrix_from_yaw(torch.tensor(yaw).double(), torch.tensor([x, y, 0.0]).double()).numpy()
        images = np.stack([getattr(cameras, name).image for name in CAMERAS])
        frames.append(
            KeyFrame(
                t_s=FRAME_DT_S * len(frames),
                T_world_ego=T_now_ego,  # the world is the frame of now
                speed_mps=float(np.hypot(*status.ego_velocity[:2])),
                images=torch.from_numpy(images).permute(0, 3, 1, 2),
                sweep=None,
                boxes=boxes_in_ego_frame([], T_now_ego),
            )
        )
    told = int(np.argmax(given.ego_statuses[-1].driving_command))
    known = told < len(COMMANDS)
    clip = make_clip(frames, rig_of(given), COMMANDS[told] if known else Command.STRAIGHT)
    no_boxes = torch.zeros_like(clip.boxes_valid)
    return dataclasses.replace(clip, boxes_valid=no_boxes, command_valid=torch.tensor(known))


def rig_of(given: AgentInput) -> CameraRig:
    """Return the cameras at now. nuPlan's merged lidar is in the ego frame, so sensor2lidar is T_ego_cam."""
    cameras = [getattr(given.cameras[-1], name) for name in CAMERAS]
    T_ego_cam = torch.eye(4).repeat(len(cameras), 1, 1)
    T_ego_cam[:, :3, :3] = torch.tensor(np.stack([camera.sensor2lidar_rotation for camera in cameras]))
    T_ego_cam[:, :3, 3] = torch.tensor(np.stack([camera.sensor2lidar_translation for camera in cameras]))
    return CameraRig(
        K=torch.tensor(np.stack([camera.intrinsics for camera in cameras])).float(),
        T_ego_cam=T_ego_cam,
        dist=torch.tensor(np.stack([camera.distortion for camera in cameras])).float(),
        readout_s=torch.zeros(len(cameras)),
        names=CAMERAS,
        size_hw=tuple(cameras[0].image.shape[:2]),
    )


def poses_of(plan: Plan, count: int) -> np.ndarray:
    """Return the likeliest alternative of a batch of one as poses [count 3].

    Our models plan 3 s. Poses after that repeat the last step, straight on.
    """
    best = int(plan.log_prob[0].argmax())
    poses = torch.cat([plan.xy[0, best], plan.yaw[0, best, :, None]], dim=-1).numpy()
    step = poses[-1] - poses[-2]
    step[2] = 0.0
    more = poses[-1] + step * np.arange(1, max(0, count - len(poses)) + 1)[:, None]
    return np.concatenate([poses, more])[:count].astype(np.float32)
