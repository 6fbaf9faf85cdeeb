"""An agent whose observations have faults."""

import dataclasses
import zlib

import numpy as np
import torch
from torch import Tensor

from foredrive.driving.faults import CameraFault, Faults
from foredrive.scene import Agent, Clip, Trajectory
from foredrive.scene.affordances import PathEstimate
from foredrive.scene.protocols import SeesPath

TOLERANCE_S = 1e-6


class FaultyAgent:
    """An `Agent` whose observations have faults. It counts the time of the drive by its own plans.

    Args:
        agent: gets the observations.
        faults: the faults.
        period_s: time between two plans.
        name: name of the drive; seeds the noise.
    """

    def __init__(self, agent: Agent, faults: Faults, period_s: float, name: str) -> None:
        self._agent, self._faults, self._period_s = agent, faults, period_s
        self._rng = np.random.default_rng(zlib.crc32(name.encode()))
        self._plans = 0
        self._speeds: dict[float, float] = {}
        self._kept: dict[str, Tensor] = {}
        self._shown: dict[tuple[str, int], Tensor] = {}
        """Images by camera and key frame of the drive, of the clip before, as they were shown."""

    @property
    def sight(self) -> PathEstimate | None:
        """Return what the agent saw of its path, if it says so."""
        return self._agent.sight if isinstance(self._agent, SeesPath) else None

    def act(self, observation: Clip) -> Trajectory:
        """Return the agent's plan for the observation with its faults."""
        now_s = self._plans * self._period_s
        self._plans += 1
        for fault in self._faults.cameras:
            observation = self._failed(observation, fault, now_s)
        return self._agent.act(self._noisy(observation, now_s))

    def _failed(self, clip: Clip, fault: CameraFault, now_s: float) -> Clip:
        """Return a clip in which a camera has failed in the key frames from the fault on."""
        wanted = fault.camera.lower()
        cameras = [k for k, name in enumerate(clip.rig.names) if name.lower() == wanted]
        if not cameras:  # the agent does not read it
            return clip
        camera = cameras[0]
        failed = clip.t_s[0] + now_s >= fault.from_s - TOLERANCE_S
        frames = failed.nonzero()[:, 0]
        images, valid = clip.images.clone(), clip.image_valid.clone()
        if fault.kind == "frozen":
            before = (~failed).nonzero()[:, 0]
            if len(before):
                self._kept[fault.camera] = images[:, before[-1], camera].clone()
            kept = self._kept.setdefault(fault.camera, images[:, 0, camera].clone())
            images[:, frames, camera] = kept[:, None]
        elif fault.kind == "halved":
            numbers = ((clip.t_s[0] + now_s) / self._period_s).round().int().tolist()
            for frame in frames.tolist():
                # The image before a key frame with an odd number was shown in this clip or in the one before
                before_it = self._shown.get((fault.camera, numbers[frame] - 1))
                if numbers[frame] % 2 and before_it is not None:
                    images[:, frame, camera] = before_it
                self._shown[fault.camera, numbers[frame]] = images[:, frame, camera].clone()
            for camera_and_number in [key for key in self._shown if key[1] < numbers[0] - 1]:
                del self._shown[camera_and_number]
        else:
            images[:, frames, camera] = 0
            if fault.kind == "lost":
                valid[:, frames, camera] = False
        return dataclasses.replace(clip, images=images, image_valid=valid)

    def _noisy(self, clip: Clip, now_s: float) -> Clip:
        """Return a clip with noise on speed and position on the route. A key frame keeps its noise."""
        faults = self._faults
        if faults.speed_noise_mps > 0:
            error = [self._speed_error(round(float(t_s) + now_s, 3)) for t_s in clip.t_s[0]]
            speed = (clip.ego_speed_mps + torch.tensor(error)).clamp_min(0.0)
            clip = dataclasses.replace(clip, ego_speed_mps=speed)
        if faults.position_noise_m > 0:
            moved = torch.from_numpy(self._rng.normal(0, faults.position_noise_m, 2)).float()
            clip = dataclasses.replace(clip, route_xy=clip.route_xy + moved)
        return clip

    def _speed_error(self, t_s: float) -> float:
        if t_s not in self._speeds:
            self._speeds[t_s] = float(self._rng.normal(0, self._faults.speed_noise_mps))
        return self._speeds[t_s]
