"""The input of world models: the part of a clip up to now."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3
from foredrive.scene.clip import Clip
from foredrive.scene.record import Record
from foredrive.scene.rig import CameraRig


@dataclass(frozen=True)
class Frames(Record):
    """The last T key frames of a clip. Now is the last."""

    t_s: Float[Tensor, "b T"]
    """0 at now, negative before it."""
    T_now_ego: Float64[Tensor, "b T 4 4"]
    """Ego frame of each key frame -> ego frame at now."""
    images: UInt8[Tensor, "b T C 3 H W"]
    """RGB."""
    image_valid: Bool[Tensor, "b T C"]
    rig: CameraRig
    """Leading dimensions [b T]."""
    speed_mps: Float[Tensor, "b T"]
    """Speed of the ego vehicle."""
    speed_valid: Bool[Tensor, "b T"]


def last_frames(clip: Clip, past_frames: int) -> Frames:
    """Return now and the `past_frames` key frames before it.

    Raises:
        InputError: the clip contains the future, or it has too few frames.
    """
    frames = clip.t_s.shape[-1]
    if clip.now != frames - 1:
        raise InputError("a world model observes frames up to now only: pass clip.observed()")
    if frames < past_frames + 1:
        raise InputError(f"the world model needs {past_frames} frames before now, the clip has {frames - 1}")
    seen = clip.frames(slice(frames - past_frames - 1, frames))
    return Frames(
        t_s=seen.t_s,
        T_now_ego=inverse_se3(seen.T_world_ego[:, -1:]) @ seen.T_world_ego,
        images=seen.images,
        image_valid=seen.image_valid,
        rig=seen.rig,
        speed_mps=seen.ego_speed_mps,
        speed_valid=seen.ego_speed_valid,
    )
