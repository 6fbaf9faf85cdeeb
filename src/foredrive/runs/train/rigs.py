"""The camera rigs that a run was trained with, and the check of another rig against them."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import yaml
from pydantic import TypeAdapter, ValidationError

from foredrive.data.cameras import find_camera, pinhole_cameras, rig_of_log
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.plain_yaml import read_yaml
from foredrive.sensors.rigs import Mount, RigPlan

RIGS = "rigs.yaml"
"""File of a run folder. Runs of earlier versions have none, and their rig is not checked."""
PLACE_M, ANGLE_DEG = 0.1, 2.0
"""How far a rig may lie outside of those of the training logs."""


@dataclass(frozen=True)
class TrainedRigs:
    """The rigs of the training logs."""

    usual: RigPlan
    """The rig of the most logs."""
    lowest: RigPlan
    """Each number of each camera at its minimum over the logs."""
    highest: RigPlan


def trained_rigs(logs: Sequence[LogPath], names: tuple[str, ...]) -> TrainedRigs | None:
    """Read the rigs of logs; return None if no camera is in all of them.

    Args:
        names: cameras that the run reads. Those that a log lacks are left out.

    Raises:
        InputError: a log cannot be read.
    """
    read = [_read(Log(log), names) for log in logs]
    shared = [name for name in read[0] if all(name in mounts for mounts in read)]
    if not shared:
        return None
    image_hw = rig_of_log(Log(logs[0])).image_hw
    rigs = [RigPlan(image_hw, {name: mounts[name] for name in shared}) for mounts in read]
    counts = Counter(_rounded(rig) for rig in rigs)
    usual = next(rig for rig in rigs if _rounded(rig) == counts.most_common(1)[0][0])
    return TrainedRigs(usual, _extreme(rigs, min), _extreme(rigs, max))


def write_rigs(rigs: TrainedRigs, folder: Path) -> None:
    """Write the rigs to a run folder."""
    text = yaml.safe_dump(TypeAdapter(TrainedRigs).dump_python(rigs, mode="json"), sort_keys=False)
    with atomic_path(folder / RIGS) as temporary:
        temporary.write_text(text)


def read_rigs(folder: Path) -> TrainedRigs | None:
    """Return the rigs that a run was trained with; None if the run does not tell.

    Raises:
        InputError: the file is damaged.
    """
    path = folder / RIGS
    if not path.is_file():
        return None
    try:
        return TypeAdapter(TrainedRigs).validate_python(read_yaml(path, "camera rigs"), extra="forbid")
    except ValidationError as error:
        raise InputError(f"{path}: not camera rigs: {' '.join(str(error).split())}") from error


def check_rig(rigs: TrainedRigs, rig: RigPlan, run: str) -> None:
    """Check that a run knows a rig: the same cameras, no farther than 0.1 m and 2° outside of its logs' rigs.

    The size of the images is not checked: they are resized.

    Args:
        run: name of the run for the message.

    Raises:
        InputError: the run was not trained with such a rig.
    """
    if set(rig.cameras) != set(rigs.usual.cameras):
        there_are = f"{', '.join(rigs.usual.cameras)}, not {', '.join(rig.cameras)}"
        raise InputError(f"{run}: was trained with the cameras {there_are}; --other-rig drives all the same")
    for name, mount in rig.cameras.items():
        for what, excess, allowed in _excesses(rigs.lowest.cameras[name], mount, rigs.highest.cameras[name]):
            if excess > allowed:
                raise InputError(
                    f"{run}: camera {name}: {what} is {excess:.3g} outside of what it was trained with; "
                    "--other-rig drives all the same"
                )


def _excesses(low: Mount, mount: Mount, high: Mount) -> Iterable[tuple[str, float, float]]:
    """Yield the name of each number of a camera, how far it lies outside of a range, and the tolerance."""
    for axis, least, value, most in zip("xyz", low.xyz_m, mount.xyz_m, high.xyz_m, strict=True):
        yield f"{axis} (m)", max(least - value, value - most, 0.0), PLACE_M
    for what in ("yaw_deg", "pitch_deg", "roll_deg", "fov_deg"):
        least, value, most = (getattr(one, what) for one in (low, mount, high))
        middle = 0.5 * (least + most)
        away = abs(math.remainder(value - middle, 360.0)) - 0.5 * (most - least)
        yield what.replace("_deg", " (degrees)"), max(away, 0.0), ANGLE_DEG


def _read(log: Log, names: tuple[str, ...]) -> dict[str, Mount]:
    """Return the cameras of a log that a run reads, by 123D's names, in the order of the run."""
    cameras = pinhole_cameras(log)
    if not cameras:
        return {}
    mounts = rig_of_log(log).cameras
    names_123d = [
        camera.camera_id.name for name in names if (camera := find_camera(cameras, name)) is not None
    ]
    return {name: mounts[name] for name in names_123d}


def _rounded(rig: RigPlan) -> tuple[tuple[float, ...], ...]:
    """Return the numbers of a rig in cm and hundredths of a degree."""
    mounts = [astuple(mount) for mount in rig.cameras.values()]
    return tuple(tuple(round(number, 2) for number in (*place, *angles)) for place, *angles in mounts)


def _extreme(rigs: Sequence[RigPlan], choose: Callable[[Iterable[float]], float]) -> RigPlan:
    """Return the rig of the extreme numbers. Yaws are unwrapped about those of the first rig."""
    cameras = {}
    for name, first in rigs[0].cameras.items():
        mounts = [rig.cameras[name] for rig in rigs]
        yaws_deg = [first.yaw_deg + math.remainder(one.yaw_deg - first.yaw_deg, 360.0) for one in mounts]
        x, y, z = (choose(one.xyz_m[axis] for one in mounts) for axis in range(3))
        cameras[name] = Mount(
            (x, y, z),
            choose(yaws_deg),
            choose(one.fov_deg for one in mounts),
            choose(one.pitch_deg for one in mounts),
            choose(one.roll_deg for one in mounts),
        )
    return RigPlan(rigs[0].image_hw, cameras)
