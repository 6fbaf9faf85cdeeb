"""Camera rigs: known ones by name, and others from YAML files."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import yaml
from jaxtyping import Float
from pydantic import TypeAdapter, ValidationError
from torch import Tensor

from foredrive.errors import InputError
from foredrive.plain_yaml import read_yaml
from foredrive.scene import CameraRig

_EGO_FROM_CAM_AXES = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MIN_FOV_DEG, MAX_FOV_DEG = 1.0, 170.0
"""Range of the horizontal field of view of a pinhole camera."""
ROUNDING = 1e-3
"""Difference of two equal rigs, m and degrees: logs store poses as quaternions."""


@dataclass(frozen=True)
class Mount:
    """A pinhole camera on the vehicle, with square pixels and the principal point in the image's centre."""

    xyz_m: tuple[float, float, float]
    """Position in the ego frame."""
    yaw_deg: float
    """Direction of the optical axis, counterclockwise from straight ahead."""
    fov_deg: float
    """Horizontal field of view."""
    pitch_deg: float = 0.0
    """Angle of the optical axis above the horizon."""
    roll_deg: float = 0.0
    """Turn about the optical axis, clockwise as seen along it."""


@dataclass(frozen=True)
class RigPlan:
    """Size, places and fields of view of the cameras of a vehicle."""

    image_hw: tuple[int, int]
    """Height and width of all images, px."""
    cameras: Mapping[str, Mount]
    """By 123D's camera names, such as PCAM_F0."""

    def __post_init__(self) -> None:
        if not self.cameras:
            raise InputError("a rig needs at least one camera")
        if min(self.image_hw) < 1:
            raise InputError(f"image_hw must be positive, got {self.image_hw[0]} {self.image_hw[1]}")
        for name, mount in self.cameras.items():
            numbers = (*mount.xyz_m, mount.yaw_deg, mount.pitch_deg, mount.roll_deg)
            if not all(map(math.isfinite, numbers)):
                raise InputError(f"camera {name}: its place must be finite, got {mount}")
            if not MIN_FOV_DEG <= mount.fov_deg <= MAX_FOV_DEG:
                allowed = f"{MIN_FOV_DEG:g} to {MAX_FOV_DEG:g} degrees"
                raise InputError(f"camera {name}: fov_deg must be {allowed}, got {mount.fov_deg}")

    def of_size(self, image_hw: tuple[int, int]) -> "RigPlan":
        """Return the same cameras with images of another size."""
        return RigPlan(image_hw, self.cameras)

    def raised(self, height_m: float) -> "RigPlan":
        """Return the same cameras, all of them higher."""
        moved = {
            name: replace(mount, xyz_m=(*mount.xyz_m[:2], mount.xyz_m[2] + height_m))
            for name, mount in self.cameras.items()
        }
        return RigPlan(self.image_hw, moved)

    def turned(self, yaw_deg: float) -> "RigPlan":
        """Return the same cameras in the same places, all of them turned to the left."""
        moved = {
            name: replace(mount, yaw_deg=mount.yaw_deg + yaw_deg) for name, mount in self.cameras.items()
        }
        return RigPlan(self.image_hw, moved)


SURROUND = RigPlan(
    image_hw=(144, 256),
    cameras={
        "PCAM_F0": Mount((1.70, 0.00, 1.60), 0.0, 70.0),
        "PCAM_L0": Mount((1.52, 0.49, 1.60), 55.0, 70.0),
        "PCAM_R0": Mount((1.52, -0.49, 1.60), -55.0, 70.0),
        "PCAM_L1": Mount((1.03, 0.48, 1.60), 110.0, 70.0),
        "PCAM_R1": Mount((1.03, -0.48, 1.60), -110.0, 70.0),
        "PCAM_B0": Mount((0.03, 0.00, 1.60), 180.0, 110.0),
    },
)
"""Six cameras in all directions, similar to those of nuScenes."""
TELE = "FTCAM_TELE_F0"
"""123D's name for a front camera with a long focal length."""
DRIVING = RigPlan(SURROUND.image_hw, {**SURROUND.cameras, TELE: Mount((1.70, 0.00, 1.65), 0.0, 30.0, 6.0)})
"""`SURROUND` with a narrow front camera, tilted up. In it, a lamp of 0.3 m is 3 px at 40 m."""
FRONT_TELE = RigPlan(
    (96, 256),
    {"PCAM_F0": Mount((1.70, 0.00, 1.60), 0.0, 100.0, 2.0), TELE: Mount((1.70, 0.00, 1.65), 0.0, 45.0, 4.0)},
)
"""A wide and a narrow front camera: what a small driver sees. From a stop line, the lamps beyond a junction
are up to 20° aside, where the wide camera shows them in less than a pixel. The narrow one has 2 px at 40 m.
"""
NAVSIM = RigPlan(
    (1080, 1920),
    {
        name: Mount((x_m, y_m, 1.6), yaw_deg, 64.0)
        for name, x_m, y_m, yaw_deg in (
            ("PCAM_F0", 1.70, 0.00, 0.0),
            ("PCAM_L0", 1.52, 0.49, 55.0),
            ("PCAM_R0", 1.52, -0.49, -55.0),
            ("PCAM_L1", 1.03, 0.48, 110.0),
            ("PCAM_R1", 1.03, -0.48, -110.0),
            ("PCAM_L2", 0.30, 0.45, 140.0),
            ("PCAM_R2", 0.30, -0.45, -140.0),
            ("PCAM_B0", 0.03, 0.00, 180.0),
        )
    },
)
"""Eight cameras in all directions with the size and about the field of view of nuPlan's."""
RIGS: Mapping[str, RigPlan] = {
    "surround": SURROUND,
    "driving": DRIVING,
    "front_tele": FRONT_TELE,
    "navsim": NAVSIM,
}


def find_rig(name: str) -> RigPlan:
    """Return a rig by its name, or read it from a YAML file.

    Raises:
        InputError: there is no such rig or file, or the file does not describe a rig.
    """
    if name in RIGS:
        return RIGS[name]
    path = Path(name)
    if not os.path.exists(path):
        raise InputError(f"no rig {name[:200]!r}: {', '.join(RIGS)}, or a YAML file")
    written = read_yaml(path)
    try:
        return TypeAdapter(RigPlan).validate_python(written, extra="forbid")
    except ValidationError as error:
        # The right name of a mistyped entry is missing. The mistyped one tells more.
        first = min(error.errors(), key=lambda error_entry: error_entry["type"] == "missing")
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        why = first["msg"].removeprefix("Value error, ").removesuffix(" or an instance of RigPlan")
        raise InputError(f"{path}: {where}: {why}") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def same_rig(one: RigPlan, other: RigPlan) -> bool:
    """Return whether two rigs are the same but for rounding and the order of the cameras."""
    if one.image_hw != other.image_hw or set(one.cameras) != set(other.cameras):
        return False
    here, beyond = _numbers(one), _numbers(other)
    return all(math.dist(here[name], beyond[name]) < ROUNDING for name in here)


def _numbers(plan: RigPlan) -> dict[str, tuple[float, ...]]:
    """Return the numbers of each camera: place in m, yaw as a direction, the other angles in degrees."""
    return {
        name: (
            *mount.xyz_m,
            math.cos(math.radians(mount.yaw_deg)),
            math.sin(math.radians(mount.yaw_deg)),
            mount.fov_deg,
            mount.pitch_deg,
            mount.roll_deg,
        )
        for name, mount in plan.cameras.items()
    }


def rig_yaml(plan: RigPlan) -> str:
    """Return a rig as the YAML that `find_rig` reads."""
    text: str = yaml.safe_dump(TypeAdapter(RigPlan).dump_python(plan, mode="json"), sort_keys=False)
    return text


def rig_of_cameras(rig: CameraRig) -> RigPlan:
    """Return the plan of a rig without leading dimensions. Distortion and principal points are left out."""
    mounts = {}
    for i, name in enumerate(rig.names):
        T = rig.T_ego_cam[i].double()
        x, y, z = T[:3, 3].tolist()
        # Columns of the rotation: image right, down, and the optical axis
        right, _, ahead = T[:3, :3].unbind(dim=1)
        yaw = math.atan2(ahead[1], ahead[0])
        # Roll: angle of the image's right from the level direction to the right of the axis
        level = torch.tensor([math.sin(yaw), -math.cos(yaw), 0.0], dtype=T.dtype)
        roll = math.atan2(-right[2], math.hypot(ahead[0], ahead[1]) * (right @ level))
        mounts[name] = Mount(
            (x, y, z),
            math.degrees(yaw),
            math.degrees(2 * math.atan(0.5 * rig.size_hw[1] / float(rig.K[i, 0, 0]))),
            math.degrees(math.asin(max(-1.0, min(1.0, float(ahead[2]))))),
            math.degrees(roll),
        )
    return RigPlan(rig.size_hw, mounts)


def camera_rig(
    size_hw: tuple[int, int] | None = None, readout_s: float = 0.0, plan: RigPlan = SURROUND
) -> CameraRig:
    """Return the cameras of a plan, without leading dimensions.

    Rows are read from the top within `readout_s`, the middle row at the frame's time. 0: a global shutter.

    Args:
        size_hw: height and width of the images, px; None: those of the plan.
    """
    height, width = size_hw or plan.image_hw
    K, T_ego_cam = [], []
    for mount in plan.cameras.values():
        # Focal length from the horizontal field of view
        focal_px = 0.5 * width / math.tan(math.radians(0.5 * mount.fov_deg))
        K.append(torch.tensor([[focal_px, 0.0, 0.5 * width], [0.0, focal_px, 0.5 * height], [0.0, 0.0, 1.0]]))
        T_ego_cam.append(_pose(mount))
    count = len(plan.cameras)
    return CameraRig(
        K=torch.stack(K),
        T_ego_cam=torch.stack(T_ego_cam),
        dist=torch.zeros(count, 5),
        readout_s=torch.full((count,), readout_s),
        names=tuple(plan.cameras),
        size_hw=(height, width),
    )


def _pose(mount: Mount) -> Float[Tensor, "4 4"]:
    """Return T_ego_cam: yaw about z, pitch about the axis to the left, roll about the optical axis."""
    yaw, pitch, roll = (math.radians(angle) for angle in (mount.yaw_deg, mount.pitch_deg, mount.roll_deg))
    cos, sin = math.cos(yaw), math.sin(yaw)
    yawed = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    cos, sin = math.cos(pitch), math.sin(pitch)
    pitched = torch.tensor([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
    cos, sin = math.cos(roll), math.sin(roll)
    rolled = torch.tensor([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    T = torch.eye(4)
    # Camera axes into ego axes first, then roll, pitch and yaw
    T[:3, :3] = yawed @ pitched @ rolled @ _EGO_FROM_CAM_AXES
    T[:3, 3] = torch.tensor(mount.xyz_m)
    return T
