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
from foredrive.geometry.se3 import compose_se3, inverse_se3, rotate_vectors
from foredrive.methods.blocks.averaging import AveragingConfig, AveragingEncoder
from foredrive.methods.blocks.backbone import BackboneConfig, ImageBackbone
from foredrive.methods.blocks.bev import BevConfig, BevEncoder
from foredrive.methods.blocks.lifting import LiftingConfig, LiftingEncoder, lift_frames
from foredrive.methods.nemo.motion import MotionConfig, MotionFlow
from foredrive.methods.nemo.rendering import RendererConfig, VolumeRenderer
from foredrive.ops.volume import compose_flows, warp_volume
from foredrive.scene import Belief, Clip, Decoded, Frames, Task, VoxelSpec, last_frames
from foredrive.scene.ego_motion import continued_motion

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
    step_features: bool = False
    """Add a learned feature to all voxels of an imagined volume, one for each step. Warped features are
    smoother than observed ones, and the feature tells the decoder the step. Not in the paper."""
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
        channels = config.channels
        finest_alone = isinstance(config.encoder, AveragingConfig)
        levels = 1 if finest_alone else config.backbone.levels or len(config.backbone.stages)
        self.spec, self.channels, self.dt_s = spec, channels, dt_s
        self.past_frames, self.max_steps = past_frames, max_steps
        self.starts_from_measured = config.motion.ego == "measured"
        self.backbone = ImageBackbone(config.backbone, channels=channels, levels=levels, fetch=fetch)
        self.encoder = ENCODERS[type(config.encoder)](config.encoder, spec, channels=channels, levels=levels)
        self.motion = MotionFlow(config.motion, channels=channels, frames=past_frames + 1, steps=max_steps)
        self.renderer = VolumeRenderer(config.renderer, spec, channels=channels)
        self.step_features = nn.Parameter(torch.zeros(max_steps, channels)) if config.step_features else None
        to_logit = nn.Linear(config.occupancy_hidden, 1)
        # The bias starts f_occ at the prior: log-odds of occupied_prior
        nn.init.constant_(to_logit.bias, math.log(config.occupied_prior / (1 - config.occupied_prior)))
        self.occupancy = nn.Sequential(nn.Linear(channels, config.occupancy_hidden), nn.ReLU(), to_logit)

    def imagination(self) -> list[nn.Parameter]:
        """Return the parameters that only imagined frames depend on."""
        learned = [] if self.step_features is None else [self.step_features]
        return [*self.motion.parameters(), *learned]

    def observe(self, clip: Clip) -> Belief:
        """Encode the last T_p + 1 frames, each in its own ego frame (V_t of eq. 1).

        Raises:
            InputError: the clip contains future frames or has too few frames.
        """
        return self.encode(last_frames(clip, self.past_frames))

    def encode(self, frames: Frames) -> Belief:
        """Do the work of `observe`. No step depends on the values of the data."""
        return self.believe(frames, lift_frames(frames, self.backbone, self.encoder)[0])

    def believe(self, frames: Frames, volumes: Float[Tensor, "b T D Z Y X"]) -> Belief:
        """Return the belief about now from the volumes of T_p + 1 frames."""
        measured = continued_motion(frames, self.max_steps) if self.starts_from_measured else None
        # Pose of now in the ego frame of the last past frame; clips of one frame have none
        T_past_now = inverse_se3(frames.T_now_ego[:, -2]).float() if volumes.shape[1] > 1 else None
        return Belief(volumes[:, -1], history=volumes, T_past_now=T_past_now, T_prev_next=measured)

    def imagine(
        self,
        belief: Belief,
        steps: int,
        actions: Float[Tensor, "b K A"] | None = None,
        generator: torch.Generator | None = None,
    ) -> list[Belief]:
        """Warp the volume into the next key frames by predicted flow and ego motion (eq. 7–8).

        Every step reads the volume of now once: V̂_{t+k}[z] = V_t[y + F_k(y)] with y = T_now_ego z. F_k is the
        flow of k steps, accumulated on the grid of frame t. NeMo predicts its own ego motion and takes no
        actions. It has only one future, so `generator` is ignored.

        Raises:
            InputError: the belief is an imagined one, actions are given, or `steps` is out of range.
        """
        if belief.history is None:
            raise InputError("NeMo imagines only from an observed belief, not from an imagined one")
        if actions is not None:
            raise InputError("NeMo predicts the ego motion itself and takes no actions")
        if not 0 < steps <= self.max_steps:
            raise InputError(f"this NeMo imagines 1 to {self.max_steps} steps, not {steps}")
        # Flow on the grid of now and ego motion for every step, from one pass over the history
        motion = self.motion(belief.history)
        T_now_ego = torch.eye(4, device=belief.volume.device).expand(len(belief.volume), 4, 4)
        since_now_m = torch.zeros_like(motion.flow[:, 0])
        futures = []
        for k in range(steps):
            # With measured motion, the predicted one corrects it: continued step first, then the correction
            if belief.T_prev_next is not None:
                T_now_ego = compose_se3(T_now_ego, belief.T_prev_next[:, k])
            T_now_ego = compose_se3(T_now_ego, motion.T_prev_next[:, k])
            # Accumulate the flow from now to step k + 1 on the grid of now
            since_now_m = compose_flows(motion.flow[:, k], since_now_m, self.spec.voxel_m)
            # Each step gathers from the volume of now once, so that
            # interpolation does not blur step by step
            volume = self._warped(belief.volume, since_now_m, T_now_ego)
            if self.step_features is not None:
                volume = volume + self.step_features[k].view(-1, 1, 1, 1)
            futures.append(
                Belief(
                    volume=volume,
                    flow_mps=self._velocity(motion.flow[:, k], T_now_ego),
                    T_now_ego=T_now_ego,
                )
            )
        return futures

    def _warped(
        self,
        volume: Float[Tensor, "b D Z Y X"],
        flow_m: Float[Tensor, "b 3 Z Y X"],
        T_now_ego: Float[Tensor, "b 4 4"],
    ) -> Float[Tensor, "b D Z Y X"]:
        return warp_volume(volume, flow_m, T_now_ego, self.spec.lower_m, self.spec.voxel_m)

    def _velocity(
        self, flow_m: Float[Tensor, "b 3 Z Y X"], T_now_ego: Float[Tensor, "b 4 4"]
    ) -> Float[Tensor, "b 3 Z Y X"]:
        """Return the velocity (m/s, axes of the imagined ego frame) of one step's flow on the grid of now."""
        # Bring the flow to the grid of the imagined ego frame, then turn its vectors to that frame's axes
        at_ego = self._warped(flow_m, torch.zeros_like(flow_m), T_now_ego)
        along_ego = rotate_vectors(inverse_se3(T_now_ego), at_ego.flatten(2).transpose(1, 2))
        # The flow points from a place to where its content was before: the velocity is the opposite
        return -along_ego.transpose(1, 2).unflatten(2, self.spec.shape_zyx) / self.dt_s

    def decode(self, belief: Belief) -> Decoded:
        """Return the occupancy of every voxel (eq. 4) and the volume itself as renderable features."""
        logit = self.occupancy(belief.volume.permute(0, 2, 3, 4, 1))[..., 0].float()
        return Decoded(occupancy_logit=logit, feature=belief.volume, flow=belief.flow_mps)

    def volume_for(self, belief: Belief, task: Task) -> Float[Tensor, "b D Z Y X"]:
        """Return the volume of the belief. NeMo's features are the same for all tasks."""
        return belief.volume
