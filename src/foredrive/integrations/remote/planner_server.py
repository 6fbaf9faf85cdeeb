"""An agent of ours as neuro-ncap's model server: `/alive`, `/reset`, `/infer`."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

from foredrive.data.batches import stack_records
from foredrive.data.boxes import no_boxes
from foredrive.data.commands import RouteAhead
from foredrive.driving.observation import KeyFrame, make_clip, no_images
from foredrive.driving.plans import waypoints_of
from foredrive.driving.simple_agents import StraightAgent
from foredrive.errors import InputError
from foredrive.integrations.remote.planner_messages import COMMANDS, PlannerInput, nuscenes_name
from foredrive.integrations.remote.sent_matrices import read_matrix
from foredrive.integrations.remote.sent_tensors import decode_image
from foredrive.json_http import validated
from foredrive.json_server import Answer
from foredrive.scene import Agent, CameraRig, Clip, Command, Trajectory

COMMAND_OF = {number: command for command, number in COMMANDS.items()}
SPEED = 13
"""Index of the speed forward in the CAN bus signals."""


@dataclass(frozen=True)
class PlannerNeeds:
    """What an agent has to be shown."""

    past_frames: int
    """Number of key frames before now."""
    cameras: tuple[str, ...] | None = None
    """Names of the cameras, in their order, in lower case. None: all that are sent. Empty: no images."""


class PlannerService:
    """Answers to the requests of a simulator that drives with an agent.

    Until the agent has seen enough key frames, the answer is constant velocity. Neuro-ncap does not use plans
    of its priming.

    Args:
        make: returns a new agent for a drive, given a clock, s.
        needs: what the agent has to be shown.
    """

    def __init__(self, make: Callable[[Callable[[], float]], Agent], needs: PlannerNeeds) -> None:
        self._make, self._needs = make, needs
        self._reset()

    def answers(self) -> Mapping[tuple[str, str], Answer]:
        """Return the answers by method and path."""
        return {
            ("GET", "/alive"): lambda _: True,
            ("POST", "/reset"): lambda _: self._reset(),
            ("POST", "/infer"): self._infer,
        }

    def _reset(self) -> bool:
        self._frames: list[KeyFrame] = []
        self._agent = self._make(lambda: self._frames[-1].t_s)
        return True

    def _infer(self, body: object) -> object:
        asked: PlannerInput = validated(PlannerInput, body, "/infer")
        if asked.command not in COMMAND_OF:
            raise InputError(f"command must be one of {sorted(COMMAND_OF)}, got {asked.command}")
        frame, rig = _key_frame(asked, self._needs.cameras)
        if self._frames and frame.t_s <= self._frames[-1].t_s:
            raise InputError(
                f"timestamp {asked.timestamp} is not after the one before; /reset begins a drive"
            )
        self._frames = [*self._frames, frame][-1 - self._needs.past_frames :]
        clip = seen_clip(self._frames, rig, COMMAND_OF[asked.command])
        return {"trajectory": waypoints_of(self._plan(clip, frame.speed_mps)).tolist(), "aux_outputs": {}}

    def _plan(self, clip: Clip, speed_mps: float) -> Trajectory:
        agent = self._agent if len(self._frames) > self._needs.past_frames else StraightAgent(speed_mps)
        return agent.act(stack_records([clip]))


def seen_clip(
    frames: Sequence[KeyFrame],
    rig: CameraRig | None,
    command: Command,
    route: RouteAhead | None = None,
) -> Clip:
    """Return what an agent observes of key frames without ground truth. It is unbatched."""
    clip = make_clip(frames, rig, command, route)
    return dataclasses.replace(clip, boxes_valid=torch.zeros_like(clip.boxes_valid))


def _key_frame(asked: PlannerInput, wanted: tuple[str, ...] | None) -> tuple[KeyFrame, CameraRig | None]:
    """Return the frame and the cameras of its images, in the order of those that are wanted."""
    if len(asked.canbus) <= SPEED:
        raise InputError(f"canbus has {len(asked.canbus)} numbers; 16 are needed")
    if not math.isfinite(asked.canbus[SPEED]):
        raise InputError(f"canbus has the speed {asked.canbus[SPEED]}, which is not finite")
    names = list(asked.images) if wanted is None else list(wanted)
    sent = {
        name: camera for name in names for camera in (name, nuscenes_name(name)) if camera in asked.images
    }
    if missing := [name for name in names if name not in sent]:
        raise InputError(f"cameras not sent: {', '.join(missing)}; sent: {', '.join(asked.images) or 'none'}")
    T_world_ego = read_matrix(asked.ego2world, 4, "ego2world").numpy()
    images, rig = no_images(), None
    if names:
        decoded = [decode_image(asked.images[sent[name]]) for name in names]
        sizes = {tuple(image.shape[:2]) for image in decoded}
        if len(sizes) != 1:
            raise InputError(f"images have to be of one size, got {sorted(sizes)}")
        images = torch.stack(decoded).permute(0, 3, 1, 2)
        rig = _rig([sent[name] for name in names], names, asked, (decoded[0].shape[0], decoded[0].shape[1]))
    speed_mps = max(0.0, asked.canbus[SPEED])
    return KeyFrame(asked.timestamp * 1e-6, T_world_ego, speed_mps, images, None, no_boxes()), rig


def _rig(
    sent: Sequence[str], names: Sequence[str], asked: PlannerInput, size_hw: tuple[int, int]
) -> CameraRig:
    """Return the cameras of a message."""
    matrices = asked.calibration
    for camera in sent:
        if camera not in matrices.camera2image or camera not in matrices.camera2ego:
            raise InputError(f"calibration has no camera {camera}")
    return CameraRig(
        K=torch.stack([read_matrix(matrices.camera2image[name], 3, "camera2image") for name in sent]).float(),
        T_ego_cam=torch.stack(
            [read_matrix(matrices.camera2ego[name], 4, "camera2ego") for name in sent]
        ).float(),
        dist=torch.zeros(len(sent), 5),
        readout_s=torch.zeros(len(sent)),
        names=tuple(names),
        size_hw=size_hw,
    )
