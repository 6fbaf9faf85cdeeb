"""NeMo's world model: images to volume, occupancy, motion, imagined futures."""

import math

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.models.averaging import AveragingEncoder
from foredrive.models.backbone import ImageBackbone
from foredrive.models.bev import BevEncoder
from foredrive.models.lifting import LiftingEncoder
from foredrive.models.nemo.motion import MotionFlow
from foredrive.models.nemo.rendering import VolumeRenderer
from foredrive.ops.volume import warp_volume
from foredrive.scene import Belief, CameraRig, Clip, Decoded, Task, VoxelSpec

OCCUPIED_PRIOR = 0.02
"""Where f_occ starts: most of space is free, and a volume that starts opaque hides what lies behind."""


class Nemo(nn.Module):
    """A `WorldModel` (NeMo §3.2): ResNet features → deformable lifting → volume → occupancy, motion, colour.

    Args:
        backbone, encoder, motion, renderer: the parts.
        past_frames: T_p, how many key frames before now are seen.
        channels: D.
        hidden: width of the occupancy MLP f_occ.
    """

    def __init__(
        self,
        *,
        backbone: ImageBackbone,
        encoder: LiftingEncoder | BevEncoder | AveragingEncoder,
        motion: MotionFlow,
        renderer: VolumeRenderer,
        past_frames: int,
        channels: int,
        hidden: int,
    ) -> None:
        super().__init__()
        self.backbone, self.encoder, self.motion, self.renderer = backbone, encoder, motion, renderer
        self.past_frames = past_frames
        to_logit = nn.Linear(hidden, 1)
        nn.init.constant_(to_logit.bias, math.log(OCCUPIED_PRIOR / (1 - OCCUPIED_PRIOR)))
        self.occupancy = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), to_logit)

    @property
    def spec(self) -> VoxelSpec:
        """The volume's grid."""
        return self.encoder.spec

    def observe(self, clip: Clip) -> Belief:
        """Encode the last T_p + 1 frames, each in its own ego frame (V_t of eq. 1).

        Raises:
            InputError: if the clip shows the future or has too few frames.
        """
        frames = clip.t_s.shape[-1]
        if clip.now != frames - 1:
            raise InputError("a world model observes frames up to now only: pass clip.observed()")
        if frames < self.past_frames + 1:
            raise InputError(f"NeMo needs {self.past_frames} frames before now, the clip has {frames - 1}")
        seen = clip.frames(slice(frames - self.past_frames - 1, frames))
        return self.encode(seen.images, seen.image_valid, seen.rig)

    def encode(
        self, images: UInt8[Tensor, "b T C 3 H W"], image_valid: Bool[Tensor, "b T C"], rig: CameraRig
    ) -> Belief:
        """The frames of `observe`, now last, as a belief; nothing here depends on what the data say."""
        b, t, c = image_valid.shape
        levels = self.backbone(images.flatten(0, 2))
        features = [level.unflatten(0, (b * t, c)) for level in levels]
        per_image = rig.map_tensors(lambda tensor: tensor.flatten(0, 1))
        volumes = self.encoder(features, per_image, image_valid.flatten(0, 1)).unflatten(0, (b, t))
        return Belief(volume=volumes[:, -1], history=volumes)

    def imagine(
        self, belief: Belief, steps: int, actions: Float[Tensor, "b K A"] | None = None
    ) -> list[Belief]:
        """Warp the volume into the next key frames by predicted flow and ego motion (eq. 7–8).

        NeMo predicts its own ego motion; it takes no actions.
        """
        if belief.history is None:
            raise InputError("NeMo imagines from what `observe` returned, not from an imagined belief")
        if actions is not None:
            raise InputError("NeMo predicts the ego motion by itself and takes no actions")
        if not 0 < steps <= self.motion.steps:
            raise InputError(f"this NeMo imagines 1 to {self.motion.steps} steps, not {steps}")
        motion = self.motion(belief.history)
        volume = belief.volume
        T_now_ego = torch.eye(4, device=volume.device).expand(len(volume), 4, 4)
        futures = []
        for k in range(steps):
            T_prev_next = motion.T_prev_next[:, k]
            volume = warp_volume(volume, motion.flow[:, k], T_prev_next, self.spec.lower_m, self.spec.voxel_m)
            T_now_ego = T_now_ego @ T_prev_next
            futures.append(Belief(volume=volume, T_now_ego=T_now_ego))
        return futures

    def decode(self, belief: Belief) -> Decoded:
        """Occupancy of every voxel (eq. 4); the volume itself is what is rendered."""
        logit = self.occupancy(belief.volume.permute(0, 2, 3, 4, 1))[..., 0].float()
        return Decoded(occupancy_logit=logit, feature=belief.volume)

    def volume_for(self, belief: Belief, task: Task) -> Float[Tensor, "b D Z Y X"]:
        """The belief's own volume: NeMo's features are the same for all tasks."""
        return belief.volume
