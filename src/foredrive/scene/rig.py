"""The cameras of a vehicle."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class CameraRig(Record):
    """C cameras with one image size. In a `Clip` the leading dimensions are [b T].

    Extrinsics are kept per frame because each camera is exposed at its own time. `T_ego_cam` maps points from
    the camera frame at exposure to the ego frame at the time of the clip's frame. It includes the ego motion
    between the two times.
    """

    K: Float[Tensor, "*b C 3 3"]
    """Pinhole intrinsics for images of `size_hw`, px. Pixel centres are at +0.5."""
    T_ego_cam: Float[Tensor, "*b C 4 4"]
    """camera (x right, y down, z forward) -> ego."""
    dist: Float[Tensor, "*b C 5"]
    """OpenCV radial-tangential distortion k1 k2 p1 p2 k3. Zeros for an ideal pinhole."""
    readout_s: Float[Tensor, "*b C"]
    """Time from the first to the last image row, s. 0 is a global shutter."""
    names: tuple[str, ...]
    """C camera names in the order of the C dimension, equal for the whole batch."""
    size_hw: tuple[int, int]
    """Height and width of the images, px."""
    exposed_dt_s: Float[Tensor, "*b C"] | None = None
    """Exposure time of the middle row, relative to the time of the frame, s. None means 0."""
