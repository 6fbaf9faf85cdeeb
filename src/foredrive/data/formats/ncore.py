"""Sequences in NVIDIA's NCore v4 format, read with its own library.

A frame is a sweep of the lidar with most sweeps, at the time of its end, or an image of the camera with most
images. Ego frame and camera frames are those of NCore. Lenses other than pinholes with OpenCV's five
coefficients become ideal pinholes by the library's camera models.
"""

import importlib.util
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, Int64
from py123d.datatypes import LogMetadata
from scipy.spatial.transform import Rotation

from foredrive.data.category_names import category_or_other
from foredrive.data.ego_path import MAX_GAP_S, in_holes
from foredrive.data.formats.guard import DEFAULT_PERIOD_S
from foredrive.data.formats.ncore_sensors import (
    FRAME_TIMES,
    RIG,
    WORLD,
    Images,
    Sweeps,
    cameras_of,
    exposures,
    lidars_of,
)
from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.log_paths import LogPath
from foredrive.data.notices import note
from foredrive.data.own_logs import Box, Vehicle, write_log
from foredrive.errors import InputError

if TYPE_CHECKING:
    from ncore.data.v4 import SequenceLoaderV4

VEHICLE = "vehicle-bbox"
"""Key of the vehicle's box in the data of a sequence, as in NVIDIA's own clips."""
OF_FOREDRIVE = "foredrive"
"""Key of what an export keeps beside NCore's own data: times of frames, annotated frames, wheelbase."""
ANNOTATED, WHEELBASE, VELOCITY = "annotated_timestamps_us", "wheelbase_m", "velocity_world_mps"
"""Names of what an export adds to a sequence, and of the velocities of its boxes."""
_SPLIT = "ncore_train"
_STORES = "*.ncore4*.zarr*"


def find_ncore(source: Path) -> Iterator[RawLog]:
    """Yield the sequences of a folder. The stores of a sequence are files or folders BASE.ncore4*.zarr*.

    If BASE.json is beside them, it says which stores belong to the sequence.
    """
    for folder in folders_with(source, _STORES):
        bases = sorted({store.name.partition(".ncore4")[0] for store in folder.glob(_STORES)})
        for base in bases:
            yield RawLog(folder, NCoreLog(folder, base))


@dataclass(frozen=True)
class NCoreLog:
    """One sequence, as a log that writes itself."""

    folder: Path
    base: str
    """Beginning of the names of its stores."""

    def get_log_metadata(self) -> LogMetadata:
        """Return split and name of the log: that of its stores."""
        name = re.sub(r"[^\w.-]", "-", self.base)
        return LogMetadata("own", _SPLIT, name, location=None)

    def write(self, out: Path, tick: Callable[[], None]) -> LogPath:
        """Read poses, calibrations and boxes first, then images and sweeps one at a time."""
        sequence = open_sequence(self.folder, self.base)
        kept: dict[str, Any] = sequence.generic_meta_data.get(OF_FOREDRIVE, {})
        path_us, path = _path(sequence)
        t_us = _frame_times(sequence, kept)
        inside = (t_us >= path_us[0]) & (t_us <= path_us[-1])
        if not inside.any():
            raise InputError("no frame lies in the time of the poses")
        for outside_us in t_us[~inside].tolist():
            note("frames", "before the first or after the last pose, left out", f"{outside_us} µs")
        holes = in_holes(path_us, path, t_us)
        for hole_us in t_us[holes].tolist():
            note("frames", f"between poses more than {MAX_GAP_S:g} s apart, left out", f"{hole_us} µs")
        t_us = t_us[inside & ~holes]
        if not len(t_us):
            raise InputError(f"no frame lies between poses at most {MAX_GAP_S:g} s apart")
        T_world_ego = sequence.pose_graph.evaluate_poses(RIG, WORLD, t_us.astype(np.uint64))
        cameras = {name: Images(sequence, name, t_us) for name in cameras_of(sequence)}
        sweeps = Sweeps(sequence, t_us, T_world_ego) if lidars_of(sequence) else None
        # A sensor of which nothing can be read is an error
        for parts in [*cameras.values(), *([] if sweeps is None else [sweeps])]:
            parts.check()
        if sequence.radar_ids:
            note("radars", f"not read: {', '.join(sequence.radar_ids)}")
        return write_log(
            out,
            self.get_log_metadata().log_name,
            t_us * 1e-6,
            T_world_ego,
            cameras=[images.spec for images in cameras.values()],
            images=cameras,
            image_t_s={name: images.t_us * 1e-6 for name, images in cameras.items()},
            sweeps=sweeps,
            boxes=_boxes(sequence, t_us, T_world_ego, kept),
            vehicle=_vehicle(sequence, kept),
            path=(path_us * 1e-6, path),
            split=_SPLIT,
            tick=tick,
        )


def open_sequence(folder: Path, base: str) -> "SequenceLoaderV4":
    """Open the stores of a sequence, or those that BASE.json beside them names.

    Raises:
        InputError: the package of the format is missing, or the sequence has no poses of the rig.
    """
    if importlib.util.find_spec("ncore") is None:
        raise InputError("NCore needs the package nvidia-ncore: pip install 'foredrive[ncore]'")
    import numcodecs.registry
    from ncore.data import v4

    # A store names the codecs of its arrays; this one would unpickle what is in the file
    numcodecs.registry.codec_registry.pop("pickle", None)
    summary = folder / f"{base}.json"
    stores = [summary] if summary.is_file() else sorted(folder.glob(f"{base}.ncore4*.zarr*"))
    reader = v4.SequenceComponentGroupsReader(stores)

    def instance(component: Any) -> str | None:
        names = list(reader.open_component_readers(component.Reader))
        return "default" if "default" in names else next(iter(names), None)

    poses, intrinsics = instance(v4.PosesComponent), instance(v4.IntrinsicsComponent)
    if poses is None or intrinsics is None:
        raise InputError(f"{base}: the sequence has no {'poses' if poses is None else 'intrinsics'}")
    masks, cuboids = instance(v4.MasksComponent), instance(v4.CuboidsComponent)
    return v4.SequenceLoaderV4(reader, poses, intrinsics, masks, cuboids)


def _path(sequence: "SequenceLoaderV4") -> tuple[Int64[np.ndarray, "P"], Float64[np.ndarray, "P 4 4"]]:
    """Return times and poses of the rig in the world, as they are stored."""
    edges = dict(sequence._poses_reader.get_dynamic_poses())
    if (RIG, WORLD) in edges:
        poses, times = edges[RIG, WORLD]
    elif (WORLD, RIG) in edges:
        inverse, times = edges[WORLD, RIG]
        poses = np.linalg.inv(inverse)
    else:
        names = ", ".join(f"{source} to {target}" for source, target in edges) or "none"
        raise InputError(f"no moving pose of {RIG} in {WORLD}; there are: {names}")
    return times.astype(np.int64), poses.astype(np.float64)


def _frame_times(sequence: "SequenceLoaderV4", kept: dict[str, Any]) -> Int64[np.ndarray, "T"]:
    """Return the times of the frames: those of an export, else of the sensor with most data."""
    if FRAME_TIMES in kept:
        return np.array(kept[FRAME_TIMES], dtype=np.int64)
    lidars = lidars_of(sequence)
    if lidars:
        return max((one.frames_timestamps_us[:, 1] for one in lidars), key=len).astype(np.int64)
    cameras = cameras_of(sequence)
    if not cameras:
        raise InputError("the sequence has neither images nor sweeps")
    return max((exposures(sequence, name)[0] for name in cameras), key=len)


def _vehicle(sequence: "SequenceLoaderV4", kept: dict[str, Any]) -> Vehicle:
    """Return the size of the vehicle. A car of middle size is assumed where the sequence has none."""
    box: Any = sequence.generic_meta_data.get(VEHICLE)
    usual = Vehicle()
    if not isinstance(box, dict) or not {"centroid", "dim"} <= box.keys():
        note("vehicle", f"no {VEHICLE}; a car of {usual.length_m} x {usual.width_m} m is assumed")
        return usual
    length_m, width_m, height_m = (float(value) for value in box["dim"])
    if WHEELBASE not in kept:
        note("vehicle", f"no wheelbase; {usual.wheelbase_m} m is assumed")
    wheelbase_m = float(kept.get(WHEELBASE, usual.wheelbase_m))
    return Vehicle(length_m, width_m, height_m, wheelbase_m, float(box["centroid"][0]))


def _boxes(
    sequence: "SequenceLoaderV4",
    t_us: Int64[np.ndarray, "T"],
    T_world_ego: Float64[np.ndarray, "T 4 4"],
    kept: dict[str, Any],
) -> list[list[Box] | None] | None:
    """Return the boxes of each frame. A frame without any is not annotated, unless an export says it is."""
    if sequence._cuboids_reader is None:
        return None
    boxes: list[dict[int, Box] | None] = [None] * len(t_us)
    for annotated in np.flatnonzero(np.isin(t_us, kept.get(ANNOTATED, []))).tolist():
        boxes[annotated] = {}
    observations = list(sequence.get_cuboid_track_observations())
    track_numbers = _track_numbers([one.track_id for one in observations])
    velocity_mps = np.full((len(observations), 3), np.nan)
    if sequence._cuboids_reader.has_generic_data(VELOCITY):
        velocity_mps = sequence._cuboids_reader.get_generic_data(VELOCITY)
    for row, one in enumerate(observations):
        frame = _frame_of_box(one.timestamp_us, t_us)
        if frame is None:
            note("cuboids", "boxes without a frame beside them, left out", f"{one.timestamp_us} µs")
            continue
        track, of_frame = track_numbers[one.track_id], boxes[frame] or {}
        if track in of_frame:
            note("cuboids", "boxes of a track that its frame has already, left out", f"{one.timestamp_us} µs")
            continue
        T_ego_world = np.linalg.inv(T_world_ego[frame])
        at_us = np.array(one.reference_frame_timestamp_us, np.uint64)
        T_ego_ref = T_ego_world @ sequence.pose_graph.evaluate_poses(one.reference_frame_id, WORLD, at_us)
        R_ego_box = T_ego_ref[:3, :3] @ Rotation.from_euler("xyz", one.bbox3.rot).as_matrix()
        x, y, z = (T_ego_ref[:3, :3] @ one.bbox3.centroid + T_ego_ref[:3, 3]).tolist()
        length, width, height = (float(value) for value in one.bbox3.dim)
        vx, vy, _ = (T_ego_world[:3, :3] @ velocity_mps[row]).tolist()
        of_frame[track] = Box(
            category_or_other(one.class_id, "cuboids").name,
            track,
            (x, y, z),
            (length, width, height),
            float(np.arctan2(R_ego_box[1, 0], R_ego_box[0, 0])),
            (vx, vy) if np.isfinite([vx, vy]).all() else None,
        )
        boxes[frame] = of_frame
    return [None if one is None else list(one.values()) for one in boxes]


def _frame_of_box(observed_us: int, t_us: Int64[np.ndarray, "T"]) -> int | None:
    """Return the frame that a box belongs to, or None.

    A sweep ends at its frame, so an object that it saw belongs to the next frame, up to a period later.
    """
    period_us = float(np.median(np.diff(t_us))) if len(t_us) > 1 else 1e6 * DEFAULT_PERIOD_S
    after = int(np.searchsorted(t_us, observed_us))
    if after < len(t_us) and t_us[after] - observed_us < period_us:
        return after
    if after > 0 and observed_us - t_us[after - 1] <= 0.5 * period_us:
        return after - 1
    return None


def _track_numbers(names: list[str]) -> dict[str, int]:
    """Return a number for each track: its name if all names are numbers."""
    distinct = sorted(set(names))
    if all(re.fullmatch(r"0|[1-9]\d{0,17}", name) for name in distinct):
        return {name: int(name) for name in distinct}
    return {name: number for number, name in enumerate(distinct)}
