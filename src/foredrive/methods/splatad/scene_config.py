"""Settings of a reconstructed scene of Gaussians."""

from dataclasses import dataclass, field
from typing import Literal

from foredrive.methods.reconstruction.decoders import CameraDecoderConfig
from foredrive.methods.splatad.camera import NEAR_M


@dataclass(frozen=True)
class GaussianSceneConfig:
    """Parts of a `GaussianScene`."""

    decoder: CameraDecoderConfig = field(default_factory=CameraDecoderConfig)
    rolling: bool = True
    """Rows of an image and beams of a sweep have their own times. If False, all are simultaneous."""
    background: Literal["albedo", "after_decoder"] = "albedo"
    """Colour where no Gaussian covers a pixel: a grey albedo, which is decoded, or a colour that is added to
    the decoded image. The latter is random in every step of training."""
    drop_from_alpha: bool = True
    """Multiply the decoder's probability of a return by alpha, see `LidarDecoder`. If False, the decoder
    alone decides."""
    camera_near_m: float = NEAR_M
    """Minimum depth of the Gaussians that a camera sees, m."""
    lidar_reach_m: float | None = None
    """Range beyond which nothing stops a beam, m; None: the reach of the log's lidar."""
    deformed_people: bool = False
    """Pedestrians and animals change their shape in their boxes (`Deformation`). If False, they are rigid."""
    frame_velocities: bool = False
    """Learn corrections of the velocity and turn rate of each training image and sweep. They are not used for
    other views."""
