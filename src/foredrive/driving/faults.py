"""Faults of an agent's inputs: cameras that fail, and noise on what it is told about itself."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from foredrive.errors import InputError

FaultKind = Literal["lost", "black", "frozen", "halved"]
KINDS: tuple[FaultKind, ...] = ("lost", "black", "frozen", "halved")


@dataclass(frozen=True)
class CameraFault:
    """A camera that fails during a drive."""

    kind: FaultKind
    """lost: no image, and the agent knows it (`Clip.image_valid`). black: a black image that counts as one.
    frozen: the last image before the fault is repeated. halved: every second key frame repeats the image
    before it."""
    camera: str
    """123D's name, such as PCAM_F0."""
    from_s: float = 0.0
    """Time of the drive at which it fails."""


@dataclass(frozen=True)
class Faults:
    """All faults of a drive. By default none."""

    cameras: tuple[CameraFault, ...] = ()
    speed_noise_mps: float = 0.0
    """Standard deviation of the measured speed, independent for each key frame."""
    position_noise_m: float = 0.0
    """Standard deviation of the position that the target point of the route is computed from, along either
    axis, independent for each plan."""

    def __post_init__(self) -> None:
        for name in ("speed_noise_mps", "position_noise_m"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name} must be at least 0, got {getattr(self, name)}")

    def check_cameras(self, names: Sequence[str]) -> None:
        """Check that a vehicle has the cameras that fail.

        Raises:
            InputError: it has no such camera.
        """
        lower_names = {name.lower() for name in names}
        for fault in self.cameras:
            if fault.camera.lower() not in lower_names:
                raise InputError(f"--camera-fault: no camera {fault.camera}; there are {', '.join(names)}")


NO_FAULTS = Faults()


def read_camera_fault(text: str) -> CameraFault:
    """Read a fault from KIND:CAMERA or KIND:CAMERA@S.

    Raises:
        InputError: the text has another form.
    """
    kind, _, rest = text.partition(":")
    camera, _, time = rest.partition("@")
    if kind not in KINDS or not camera:
        raise InputError(
            f"--camera-fault {text}: write KIND:CAMERA or KIND:CAMERA@SECONDS, such as black:PCAM_F0@10; "
            f"kinds are {', '.join(KINDS)}"
        )
    try:
        from_s = float(time) if time else 0.0
    except ValueError:
        from_s = -1.0
    if not 0 <= from_s < math.inf:
        raise InputError(f"--camera-fault {text}: {time!r} is no time of a drive, s")
    return CameraFault(kind, camera, from_s)
