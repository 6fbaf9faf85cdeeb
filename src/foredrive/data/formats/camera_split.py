"""Images with poses, split into the cameras of one rig.

Formats such as nerfstudio's list images alone. There are several ways to group them: what the file says,
folders, names, lenses, the order at each time. A grouping is right if the cameras that it makes keep their
places in the rig. Intrinsics alone do not tell cameras apart: those of one type are alike, and estimated ones
differ between the images of one camera.
"""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from foredrive.data.ego_path import interpolated_poses
from foredrive.data.notices import note
from foredrive.errors import InputError

PERIOD_S = 0.1
"""Time between frames without times."""
_MAX_TURN_RAD = np.deg2rad(2.0)
_MAX_SHIFT_OF_PATH, _MAX_SHIFT_OF_BASELINE = 0.02, 0.05
"""Largest deviation of a camera's place to the first one: shares of the path, and of their distance."""
_MIN_INTERPOLATED = 3
"""Fewest images between those of the first camera that show a constant place."""
_MAX_CAMERAS, _MAX_RUNS = 11, 6
"""Most cameras of a log, and runs of digits in a name that are looked at."""
_LENS_VARIES = 0.05
"""Largest difference of intrinsics of one camera: a share of the focal length or of the width."""
_PARTS_OF_DATA = {"train", "val", "test", "training", "validation", "testing", "images", "input", "rgb"}
"""Names of folders that hold parts of a data set and do not name cameras."""


@dataclass(frozen=True)
class PosedImage:
    """One image with its pose."""

    file: Path
    path: str
    """Path of the file within the data set."""
    T_world_cam: Float64[np.ndarray, "4 4"]
    t_s: float | None
    """As the data set has it: s, or ms, µs or ns since 1970."""
    lens: tuple[float, ...]
    """Width, height, focal lengths and centre in px, then distortion."""
    camera: str | None = None
    """Name of the camera, if the data set states it."""


@dataclass(frozen=True)
class RigCamera:
    """One camera of a rig with its images in the order of time."""

    name: str
    files: list[Path]
    t_us: Int64[np.ndarray, "N"]
    T_world_cam: Float64[np.ndarray, "N 4 4"]
    lens: tuple[float, ...]
    T_base_cam: Float64[np.ndarray, "4 4"]
    """Pose in the frame of the first camera of the rig."""


@dataclass(frozen=True)
class _Grouping:
    """A way to tell the cameras of images apart."""

    kind: str
    """Name of the way, for messages."""
    cameras: list[str]
    """Name of the camera of each image."""
    numbers: list[str]
    """Part of each image's name that numbers the frame. Images of equal numbers were taken together."""


def split_into_cameras(images: Sequence[PosedImage], where: str) -> list[RigCamera]:
    """Return the cameras of a rig, the one with most images first.

    Without times for all images, frames are `PERIOD_S` apart in the order of the numbers in their names, and
    images of several cameras with equal numbers were taken at the same time.

    Args:
        images: at least one.
        where: name of their list, for messages.

    Raises:
        InputError: images were taken at the same time, or bear the same number, but no grouping makes cameras
            of them that keep their places.
    """
    fault = ""
    for grouping in _groupings(images):
        times_us = _times_us(images, grouping)
        if times_us is None or not 1 < len(set(grouping.cameras)) <= _MAX_CAMERAS:
            continue
        rig = _rig(images, grouping.cameras, times_us)
        if isinstance(rig, list):
            return rig
        if len(set(times_us)) < len(times_us):
            fault = fault or f"by {grouping.kind}, {rig}"
    one = _Grouping("", ["front"] * len(images), [image.path for image in images])
    times_us = _times_us(images, one)
    if fault or times_us is None:
        fault = fault or "two of them have the same time"
        raise InputError(f"{where}: its images cannot be split into cameras: {fault}")
    rig = _rig(images, one.cameras, times_us)
    if isinstance(rig, str):
        raise InputError(f"{where}: {rig}")
    return rig


def _groupings(images: Sequence[PosedImage]) -> Iterator[_Grouping]:
    """Yield the ways to group images that could be meant, the clearest first."""
    stems = [Path(image.path).stem for image in images]
    # What the file says, then folders, names, lenses, and the order at each time
    if all(image.camera is not None for image in images):
        yield _Grouping("the file", [str(image.camera) for image in images], stems)
    folders = [Path(image.path).parent.name for image in images]
    if not {name.lower() for name in folders} & _PARTS_OF_DATA:
        yield _Grouping("folder", folders, stems)
    # Of the runs of digits at each place in the names, that of the frame leaves the fewest names of cameras.
    parts = [[_without_run(stem, place) for stem in stems] for place in range(_MAX_RUNS)]
    best = min(parts, key=lambda pairs: len({camera for camera, _ in pairs}))
    yield _Grouping("name", [camera for camera, _ in best], [number for _, number in best])
    yield _Grouping("lens", _by_lens(images), stems)
    if all(image.t_s is not None for image in images):
        yield _Grouping("order", _by_order(images), stems)


def _without_run(stem: str, place: int) -> tuple[str, str]:
    """Return a name without its run of digits at a place, and these digits."""
    runs = list(re.finditer(r"\d+", stem))
    if place >= len(runs):
        return stem, ""
    start, end = runs[place].span()
    return f"{stem[:start]}{stem[end:]}".strip("_-. ") or "front", stem[start:end]


def _by_lens(images: Sequence[PosedImage]) -> list[str]:
    kinds: list[tuple[float, ...]] = []
    names = []
    for image in images:
        number = next((k for k, kind in enumerate(kinds) if _alike(kind, image.lens)), len(kinds))
        kinds += [image.lens] if number == len(kinds) else []
        names.append(f"camera_{number}")
    return names


def _by_order(images: Sequence[PosedImage]) -> list[str]:
    """Number the images of each time in the order of the file, if each time has as many."""
    count: dict[float | None, int] = {}
    names = []
    for image in images:
        names.append(f"camera_{count.setdefault(image.t_s, 0)}")
        count[image.t_s] += 1
    return names if len(set(count.values())) == 1 else ["front"] * len(images)


def _times_us(images: Sequence[PosedImage], grouping: _Grouping) -> list[int] | None:
    """Return the times of images, or None if two of one camera would have the same."""
    if all(image.t_s is not None for image in images):
        stamps = [float(image.t_s or 0.0) for image in images]
        times = [round(stamp * _scale_us(max(map(abs, stamps)))) for stamp in stamps]
    else:
        # Frames by the numbers in names, in the order of their values
        ranks = {number: rank for rank, number in enumerate(sorted(set(grouping.numbers), key=_natural))}
        times = [round(PERIOD_S * 1e6) * ranks[number] for number in grouping.numbers]
        # Names alone show several cameras only where each has several images.
        if len(set(grouping.cameras)) > 1 and min(Counter(grouping.cameras).values()) < 2:
            return None
    return times if len(set(zip(grouping.cameras, times, strict=True))) == len(times) else None


def _scale_us(largest: float) -> float:
    """Return how many µs are one unit of stamps: seconds since 1970 stay below 1e11, ms below 1e14."""
    return 1e6 if largest < 1e11 else 1e3 if largest < 1e14 else 1.0 if largest < 1e17 else 1e-3


def _natural(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts numbers in names by their values."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", text)]


def _rig(images: Sequence[PosedImage], names: list[str], times_us: list[int]) -> list[RigCamera] | str:
    """Return the cameras of a grouping, or why they are none."""
    rows: dict[str, list[int]] = {}
    # Rows of each camera in order of time
    for row in np.argsort(times_us, kind="stable").tolist():
        rows.setdefault(names[row], []).append(row)
    # The camera with most images is the base of the rig
    order = sorted(rows, key=lambda name: (-len(rows[name]), min(rows[name])))
    t_us = np.array(times_us, np.int64)
    T = np.stack([image.T_world_cam for image in images])
    base = rows[order[0]]
    cameras = []
    for name in order:
        lenses = np.array([images[row].lens for row in rows[name]])
        # Images of one camera have one size and nearly one lens
        if not all(_alike(images[rows[name][0]].lens, images[row].lens) for row in rows[name]):
            return f"the images of {name} have different sizes or intrinsics"
        T_base_cam = np.eye(4) if name == order[0] else _mount(t_us, T, base, rows[name])
        if T_base_cam is None:
            return f"{name} has no constant place to {order[0]}"
        files = [images[row].file for row in rows[name]]
        # Estimated intrinsics differ a little: their median is the camera's
        if len(np.unique(lenses, axis=0)) > 1:
            note(_plain(name), "calibrations differ a little between images; their median is used")
        lens = tuple(np.median(lenses, axis=0).tolist())
        cameras.append(RigCamera(_plain(name), files, t_us[rows[name]], T[rows[name]], lens, T_base_cam))
    return cameras


def _mount(
    t_us: Int64[np.ndarray, "N"], T: Float64[np.ndarray, "N 4 4"], base: list[int], other: list[int]
) -> Float64[np.ndarray, "4 4"] | None:
    """Return the constant pose of one camera in the frame of another, or None if it varies or is unknown."""
    # Images within the time of the base camera; those at equal times need no interpolation
    inside = [row for row in other if t_us[base[0]] <= t_us[row] <= t_us[base[-1]]]
    shared = [row for row in inside if t_us[row] in t_us[base]]
    used = shared or inside
    if not used or (not shared and len(used) < _MIN_INTERPOLATED):
        return None
    if len(base) == 1:
        T_world_base = T[base]
    else:
        T_world_base = interpolated_poses(t_us[base], T[base], t_us[used].astype(np.float64))
    # Pose of the camera in the base camera's frame at each time
    T_base_cam = np.linalg.inv(T_world_base) @ T[used]
    turns = Rotation.from_matrix(T_base_cam[:, :3, :3])
    mean = turns.mean()
    place = np.median(T_base_cam[:, :3, 3], axis=0)
    # Estimated poses have outliers, so nine of ten images have to agree.
    off_rad = np.percentile((mean.inv() * turns).magnitude(), 90)
    off_m = np.percentile(np.linalg.norm(T_base_cam[:, :3, 3] - place, axis=-1), 90)
    # Limits grow with the path (drift of estimated poses) and with the baseline (scale errors)
    path_m = np.linalg.norm(np.diff(T[base][:, :3, 3], axis=0), axis=-1).sum()
    limit_m = max(_MAX_SHIFT_OF_PATH * path_m, _MAX_SHIFT_OF_BASELINE * float(np.linalg.norm(place)))
    if off_rad > _MAX_TURN_RAD or off_m > limit_m + 1e-6:
        return None
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = mean.as_matrix(), place
    return mount


def _alike(first: tuple[float, ...], second: tuple[float, ...]) -> bool:
    """Return whether two calibrations can be of one camera: the same size, nearly the same lens."""
    if first[:2] != second[:2]:
        return False
    limit_px = _LENS_VARIES * max(first[0], first[2])
    return bool(np.abs(np.subtract(first[2:6], second[2:6])).max() <= limit_px) and bool(
        np.abs(np.subtract(first[6:], second[6:])).max(initial=0.0) <= _LENS_VARIES
    )


def _plain(name: str) -> str:
    """Return a name of letters, digits, dots, dashes and underscores."""
    return re.sub(r"[^\w.-]", "_", name).strip("_.-") or "front"
