"""NeMo's world model: images to volume, occupancy, motion and imagined futures."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Discriminator
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.models.averaging import AveragingConfig, AveragingEncoder
from foredrive.models.backbone import BackboneConfig, ImageBackbone
from foredrive.models.bev import BevConfig, BevEncoder
from foredrive.models.lifting import LiftingConfig, LiftingEncoder, lift_frames
from foredrive.models.nemo.motion import MotionConfig, MotionFlow
from foredrive.models.nemo.rendering import RendererConfig, VolumeRenderer
from foredrive.ops.volume import warp_volume
from foredrive.scene import Belief, Clip, Decoded, Frames, Task, VoxelSpec, last_frames

Encoder = LiftingEncoder | BevEncoder | AveragingEncoder
ENCODERS: Mapping[type, Callable[..., Encoder]] = {
    LiftingConfig: LiftingEncoder,
    BevConfig: BevEncoder,
    AveragingConfig: AveragingEncoder,
}
"""Encoder class per config. Each takes the config, grid, channels and number of image feature levels."""


@dataclass(frozen=True)
class NemoConfig:
    """Sizes of a `Nemo`."""

    backbone: BackboneConfig
    encoder: Annotated[LiftingConfig | BevConfig | AveragingConfig, Discriminator("kind")]
    motion: MotionConfig
    renderer: RendererConfig
    channels: int
    """D, channels of the volume."""
    occupancy_hidden: int
    """Width of the occupancy MLP f_occ."""
    occupied_prior: float = 0.02
    """Initial occupancy probability of f_occ. It is small because most space is free and an opaque volume
    would hide what is behind."""
    kind: Literal["nemo"] = "nemo"


class Nemo(nn.Module):
    """A `WorldModel` (NeMo §3.2): ResNet features → deformable lifting → volume → occupancy, motion, colour.

    Args:
        config: sizes.
        spec: grid of the volume.
        past_frames: T_p, number of key frames read before now.
        max_steps: T_f, maximum number of imagined key frames.
        dt_s: time between key frames, s.
        fetch: load the weights of the backbone. Not needed when trained weights replace them later.
    """

    samples_futures = False

    def __init__(
        self,
        config: NemoConfig,
        spec: VoxelSpec,
        *,
        past_frames: int,
        max_steps: int,
        dt_s: float,
        fetch: bool = True,
    ) -> None:
        super().__init__()
        channels, levels = config.channels, len(config.backbone.stages)
        self.spec, self.channels, self.dt_s = spec, channels, dt_s
        self.past_frames, self.max_steps = past_frames, max_steps
        self.backbone = ImageBackbone(config.backbone, channels=channels, fetch=fetch)
        self.encoder = ENCODERS[type(config.encoder)](config.encoder, spec, channels=channels, levels=levels)
        self.motion = MotionFlow(config.motion, channels=channels, frames=past_frames + 1, steps=max_steps)
        self.renderer = VolumeRenderer(config.renderer, spec, channels=channels)
        to_logit = nn.Linear(config.occupancy_hidden, 1)
        nn.init.constant_(to_logit.bias, math.log(config.occupied_prior / (1 - config.occupied_prior)))
        self.occupancy = nn.Sequential(nn.Linear(channels, config.occupancy_hidden), nn.ReLU(), to_logit)

    def observe(self, clip: Clip) -> Belief:
        """Encode the last T_p + 1 frames, each in its own ego frame (V_t of eq. 1).

        Raises:
            InputError: the clip contains future frames or has too few frames.
        """
        return self.encode(last_frames(clip, self.past_frames))

    def encode(self, frames: Frames) -> Belief:
        """Do the work of `observe`. No step depends on the values of the data."""
        volumes = lift_frames(frames, self.backbone, self.encoder)
        return Belief(volume=volumes[:, -1], history=volumes)

    def imagine(
        self,
        belief: Belief,
        steps: int,
        actions: Float[Tensor, "b K A"] | None = None,
        generator: torch.Generator | None = None,
    ) -> list[Belief]:
        """Warp the volume into the next key frames by predicted flow and ego motion (eq. 7–8).

        NeMo predicts its own ego motion and takes no actions. It has only one future, so `generator` is
        ignored.

        Raises:
            InputError: the belief is an imagined one, actions are given, or `steps` is out of range.
        """
        if belief.history is None:
            raise InputError("NeMo imagines only from an observed belief, not from an imagined one")
        if actions is not None:
            raise InputError("NeMo predicts the ego motion itself and takes no actions")
        if not 0 < steps <= self.max_steps:
            raise InputError(f"this NeMo imagines 1 to {self.max_steps} steps, not {steps}")
        motion = self.motion(belief.history)
        volume = belief.volume
        T_now_ego = torch.eye(4, device=volume.device).expand(len(volume), 4, 4)
        futures = []
        for k in range(steps):
            T_prev_next = motion.T_prev_next[:, k]
            flow_m = motion.flow[:, k]
            volume = warp_volume(volume, flow_m, T_prev_next, self.spec.lower_m, self.spec.voxel_m)
            T_now_ego = T_now_ego @ T_prev_next
            futures.append(Belief(volume=volume, flow_mps=-flow_m / self.dt_s, T_now_ego=T_now_ego))
        return futures

    def decode(self, belief: Belief) -> Decoded:
        """Return the occupancy of every voxel (eq. 4) and the volume itself as renderable features."""
        logit = self.occupancy(belief.volume.permute(0, 2, 3, 4, 1))[..., 0].float()
        return Decoded(occupancy_logit=logit, feature=belief.volume, flow=belief.flow_mps)

    def volume_for(self, belief: Belief, task: Task) -> Float[Tensor, "b D Z Y X"]:
        """Return the volume of the belief. NeMo's features are the same for all tasks."""
        return belief.volume
