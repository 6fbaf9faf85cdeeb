"""Argument types that several verbs share, and checks without expensive imports."""

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from foredrive.errors import InputError
from foredrive.runs.shipped import run_folder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from foredrive.data.log_paths import LogPath
    from foredrive.sensors.rigs import RigPlan

OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH")]
SomePaths = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PATH [PATH ...]")]
Settings = Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE [KEY=VALUE ...]")]
ImageSize = Annotated[tuple[int, int], tyro.conf.arg(metavar="HEIGHT WIDTH")]

Number = float | int

RUN_CONFIG = "config.yaml"
"""A file that folders of runs contain, and folders of logs do not."""
MAX_IMAGE_PX = 16_384


def check_number(
    flag: str,
    value: Number | None,
    *,
    above: Number | None = None,
    low: Number | None = None,
    high: Number = math.inf,
) -> None:
    """Check the number of a flag; None (the flag is not given) is valid.

    Args:
        flag: name of the flag on the command line.
        value: the given number.
        above: the number must be larger than this.
        low: minimum.
        high: maximum.

    Raises:
        InputError: the number is outside the range, infinite or not a number.
    """
    if value is None:
        return
    wanted = "a finite number"
    if above is not None:
        wanted = f"a number above {above:g}"
    elif low is not None and high < math.inf:
        wanted = f"a number from {low:g} to {high:g}"
    elif low is not None:
        wanted = f"a number of {low:g} or more"
    fits = (above is None or value > above) and (low is None or value >= low) and value <= high
    # NaN fails all comparisons, and infinity may pass them
    if not (math.isfinite(value) and fits):
        raise InputError(f"{flag} must be {wanted}, got {value:g}")


def check_image_size(size: tuple[int, int] | None) -> None:
    """Check --image-size. Raise `InputError` if the size is impossible."""
    if size is not None and not all(0 < side <= MAX_IMAGE_PX for side in size):
        raise InputError(f"--image-size must be 1 to {MAX_IMAGE_PX} px, got {size[0]} {size[1]}")


def chosen_rig(rig: str, image_hw: tuple[int, int] | None) -> "RigPlan":
    """Return the rig of --rig, with images of --image-size if that is given.

    Raises:
        InputError: there is no such rig, its images are too large, or 123D has no camera of a name.
    """
    from foredrive.data.camera_streams import CAMERA_NAMES
    from foredrive.sensors.rigs import find_rig

    plan = find_rig(rig)
    if image_hw is not None:
        plan = plan.of_size(image_hw)
    if max(plan.image_hw) > MAX_IMAGE_PX:
        raise InputError(f"{rig}: image_hw must be 1 to {MAX_IMAGE_PX} px, got {list(plan.image_hw)}")
    for name in plan.cameras:
        if name not in CAMERA_NAMES:
            raise InputError(f"{rig}: 123D has no camera {name!r}; it has {', '.join(CAMERA_NAMES)}")
    return plan


def rank() -> int | None:
    """Return the rank of this process among those of torchrun; None if torchrun did not start it."""
    return int(os.environ["RANK"]) if "TORCHELASTIC_RUN_ID" in os.environ else None


def check_out_folder(folder: Path | None) -> None:
    """Check that --out can be a folder. Raise `InputError` if it is a file."""
    if folder is not None and folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: this is a file; a folder is needed")


def whole_logs(verb: str, logs: "Sequence[Path]") -> "tuple[LogPath, ...]":
    """Return the logs that a verb exports.

    Raises:
        InputError: there are none, or a list of clips has parts of some.
    """
    from foredrive.data.log_paths import find_all_logs

    if not logs:
        raise InputError(f"{verb} needs a log, or a data root with logs")
    log_paths = find_all_logs(logs)
    parts = [log.name for log in log_paths if log.parts_s]
    if parts:
        raise InputError(f"whole logs are exported, not parts of them as of {parts[0]} in a list of clips")
    return log_paths


def check_run(run: Path) -> Path:
    """Return the folder of a run or of a copy of `embedded:NAME`. Raise `InputError` if it holds no run."""
    folder = run_folder(run)
    if not (folder / RUN_CONFIG).is_file():
        raise InputError(f"{folder}: not a run folder (no {RUN_CONFIG})")
    return folder


def check_reconstruction(folder: Path) -> None:
    """Check that a folder holds a reconstruction. Raise `InputError` if it does not."""
    if not (folder / RUN_CONFIG).is_file():
        raise InputError(f"{folder}: not a reconstruction folder (no {RUN_CONFIG})")


def check_file(path: Path | None) -> None:
    """Check that a file exists. Raise `InputError` if it does not."""
    if path is not None and not path.is_file():
        raise InputError(f"{path}: no such file")
