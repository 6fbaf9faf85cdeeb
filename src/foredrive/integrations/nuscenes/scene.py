"""One log as a scene of nuScenes: its sensor files, its mask of the map, and its rows of the tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8
from PIL import Image

from foredrive.data.boxes import frames_with_boxes
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.recorded import read_caption
from foredrive.data.truth.map_elements import log_map, read_shared_drivable
from foredrive.data.truth.map_lines import Line
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.integrations.nuscenes.annotations import annotations_at, instances_of
from foredrive.integrations.nuscenes.streams import LIDAR, Stream, streams_of
from foredrive.integrations.nuscenes.tables import TABLES_OF_A_LOG, Row, link, pose, token

CELL_M = 0.1
"""The devkit's resolution of masks."""
MARGIN_M = 100.0
"""Distance around the driven path, or around a shared map, that a mask covers."""
MAX_CELLS = 400_000_000
"""Size of the largest mask: a square of 2 km."""


@dataclass(frozen=True)
class MapMask:
    """A mask of the drivable area, placed in the world frame."""

    token: str
    """Logs that share a map have the same mask."""
    cells: UInt8[np.ndarray, "Y X"]
    """255 on drivable ground, else 0. The first row is that of the largest y, as in an image."""
    lower_m: Float64[np.ndarray, "2"]
    """Lower corner in the world frame, in whole metres. The devkit takes it for the origin."""


def draw_map_mask(log: Log) -> MapMask:
    """Draw the drivable areas of the map that a log shares with others, else those around its path.

    A shared map is drawn whole, unless it is too large or the log leaves it. Without a map nothing is
    drivable. Around too long a path the mask has a single cell, where nothing is drivable.

    Raises:
        InputError: the map cannot be read.
    """
    driven = log.T_world_ego[:, :2, 3]
    shared = read_shared_drivable(log)
    if shared:
        corners = np.concatenate([ring[:, :2] for area in shared for ring in area])
        lower_m, size_xy = _grid(corners)
        upper_m = lower_m + size_xy * CELL_M
        if size_xy.prod() <= MAX_CELLS and (driven >= lower_m).all() and (driven <= upper_m).all():
            names = (log.metadata.dataset, log.metadata.location, *lower_m, *size_xy)
            return MapMask(token("map", *names), _drawn(shared, lower_m, size_xy), lower_m)
    lower_m, size_xy = _grid(driven)
    own = token("map", log.path.name)
    if size_xy.prod() > MAX_CELLS:
        return MapMask(own, np.zeros((1, 1), dtype=np.uint8), lower_m)
    road_map = log_map(log)
    return MapMask(own, _drawn([] if road_map is None else road_map.drivable, lower_m, size_xy), lower_m)


def _grid(points: Float64[np.ndarray, "N 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Return lower corner (whole metres) and size in cells of the grid around points."""
    lower_m = np.floor(points.min(axis=0) - MARGIN_M)
    upper_m = np.ceil(points.max(axis=0) + MARGIN_M)
    return lower_m, np.round((upper_m - lower_m) / CELL_M).astype(np.int64)


def _drawn(
    areas: Sequence[Sequence[Line]], lower_m: np.ndarray, size_xy: np.ndarray
) -> UInt8[np.ndarray, "Y X"]:
    cells = np.zeros(size_xy[::-1], dtype=np.uint8)
    for area in areas:
        rings = [(ring[:, :2] - lower_m) / CELL_M for ring in area]
        upside_down = [np.column_stack([ring[:, 0], len(cells) - ring[:, 1]]) for ring in rings]
        cv2.fillPoly(cells, [np.round(ring).astype(np.int32) for ring in upside_down], 255)
    return cells


@dataclass(frozen=True)
class Samples:
    """The key frames of a log, in order of time."""

    log_name: str
    frames: Int64[np.ndarray, "K"]
    t_us: Int64[np.ndarray, "K"]

    def token_of(self, frame: int) -> str:
        """Return the sample of a frame: its own or the next one, after the last one that.

        The devkit interpolates boxes of a frame between its sample and the sample before.
        """
        nearest = min(int(np.searchsorted(self.frames, frame)), len(self.frames) - 1)
        return token("sample", self.log_name, self.t_us[nearest])

    def rows(self, scene_token: str) -> list[Row]:
        """Return the table `sample`."""
        rows: list[Row] = [
            {"token": self.token_of(frame), "timestamp": t_us, "scene_token": scene_token}
            for frame, t_us in zip(self.frames.tolist(), self.t_us.tolist(), strict=True)
        ]
        link(rows)
        return rows


def choose_samples(log: Log, rate_hz: float, present: dict[str, Int64[np.ndarray, "_"]]) -> Samples:
    """Choose frames at a rate. Each has all that the log has: samples of nuScenes lack no sensor.

    After a gap the next whole frame is chosen.

    Args:
        log: the log.
        rate_hz: samples a second.
        present: the frames at which each sensor has data, by its name; those of the boxes too.

    Raises:
        InputError: no frame has everything.
    """
    whole = np.arange(len(log))
    for frames in present.values():
        whole = np.intersect1d(whole, frames)
    if not len(whole):
        counts = ", ".join(f"{name} {len(frames)}" for name, frames in present.items())
        raise InputError(f"{log.path.folder}: no frame has all sensors and boxes (frames with: {counts})")
    t_us, step_us, slack_us = log.t_us[whole], 1e6 / rate_hz, 0.5e6 * log.period_s
    chosen = [0]
    while True:
        wanted_us = t_us[chosen[-1]] + step_us
        frame = max(int(np.searchsorted(t_us, wanted_us - slack_us)), chosen[-1] + 1)
        if frame >= len(t_us):
            break
        if frame + 1 < len(t_us) and abs(t_us[frame + 1] - wanted_us) < abs(t_us[frame] - wanted_us):
            frame += 1
        chosen.append(frame)
    return Samples(log.path.name, whole[chosen], t_us[chosen])


Tables = dict[str, list[Row]]


@dataclass(frozen=True)
class SceneOptions:
    """Select what is written of a log."""

    rate_hz: float = 2.0
    """Samples (key frames) a second."""
    sweeps: bool = True
    """Write the frames between the samples too."""


def write_scene(log: Log, dataroot: Path, options: SceneOptions, tick: Callable[[], None]) -> Tables:
    """Write the sensor files of a log, and return its rows of all tables that belong to one log.

    The global frame is the log's world frame, moved by whole metres so that the mask of the map begins at 0:
    nuScenes' masks have no other place. The row of the log says by how much (`world_offset_m`).

    Args:
        log: the log.
        dataroot: gets `samples`, `sweeps` and `maps`.
        options: what is written.
        tick: called after each frame.

    Raises:
        InputError: the log has no sensors, no frame has all of them, or something cannot be read.
    """
    streams = streams_of(log)
    if not streams:
        raise InputError(f"{log.path.folder}: has neither images of pinhole cameras nor lidar sweeps")
    present = {stream.channel: stream.present for stream in streams}
    boxed = frames_with_boxes(log)
    samples = choose_samples(log, options.rate_hz, present | ({"boxes": boxed} if len(boxed) else {}))
    tables, offset_m = _log_tables(log, dataroot)
    scene_token = token("scene", log.path.name)
    tables["sample"] = samples.rows(scene_token)
    tables["scene"] = [_scene_row(log, samples, scene_token)]
    for stream in streams:
        sensor, calibrated = stream.sensor_rows(log.path.name)
        tables["sensor"].append(sensor)
        tables["calibrated_sensor"].append(calibrated)
    _write_readings(log, dataroot, streams, samples, options, tables, tick)
    for row in (*tables["ego_pose"], *tables["sample_annotation"]):
        row["translation"][:2] = np.subtract(row["translation"][:2], offset_m).tolist()
    return tables


def scene_name(log: Log) -> str:
    """Return the name of a log's scene, which begins with its split."""
    return log.path.name.replace("/", "-")


def _log_tables(log: Log, dataroot: Path) -> tuple[Tables, Float64[np.ndarray, "2"]]:
    """Write the mask of the map. Return the tables with log and map, and the global frame's offset."""
    mask, log_token = draw_map_mask(log), token("log", log.path.name)
    with atomic_path(dataroot / "maps" / f"{mask.token}.png") as file:
        Image.fromarray(mask.cells).save(file, "PNG")
    tables: Tables = {name: [] for name in TABLES_OF_A_LOG}
    tables["log"] = [
        {
            "token": log_token,
            "logfile": log.path.name,
            "vehicle": log.vehicle.vehicle_name,
            "date_captured": datetime.fromtimestamp(log.t_us[0] * 1e-6, UTC).strftime("%Y-%m-%d"),
            "location": log.metadata.location or "",
            "world_offset_m": mask.lower_m.tolist(),
        }
    ]
    tables["map"] = [
        {
            "token": mask.token,
            "log_tokens": [log_token],
            "category": "semantic_prior",
            "filename": f"maps/{mask.token}.png",
        }
    ]
    return tables, mask.lower_m


def _scene_row(log: Log, samples: Samples, scene_token: str) -> Row:
    first, last = (samples.token_of(frame) for frame in samples.frames[[0, -1]].tolist())
    return {
        "token": scene_token,
        "log_token": token("log", log.path.name),
        "nbr_samples": len(samples.frames),
        "first_sample_token": first,
        "last_sample_token": last,
        "name": scene_name(log),
        "description": read_caption(log, int(samples.frames[0])) or "",
    }


def _write_readings(
    log: Log,
    dataroot: Path,
    streams: list[Stream],
    samples: Samples,
    options: SceneOptions,
    tables: Tables,
    tick: Callable[[], None],
) -> None:
    """Write all sensor files, frame by frame, and fill the tables of readings and boxes."""
    frames_of = {one.channel: set(one.written(samples.frames, sweeps=options.sweeps)) for one in streams}
    readings: dict[str, list[Row]] = {one.channel: [] for one in streams}
    key, boxes = set(samples.frames.tolist()), []
    for frame in sorted(set().union(*frames_of.values())):
        stored = read_sweep(log, frame) if frame in frames_of.get(LIDAR, ()) else None
        sweep = None if stored is None else stored[0]
        for stream in streams:
            data = stream.encode(frame, sweep) if frame in frames_of[stream.channel] else None
            if data is not None:
                row = _reading_row(log, stream, frame, samples, is_key=frame in key)
                with atomic_path(dataroot / row["filename"]) as file:
                    file.write_bytes(data)
                readings[stream.channel].append(row)
                time = {"token": row["ego_pose_token"], "timestamp": row["timestamp"]}
                tables["ego_pose"].append(time | pose(stream.T_world_ego(frame)))
        if frame in key:
            boxes += annotations_at(log, frame, samples.token_of(frame), sweep)
        tick()
    for rows in readings.values():
        link(rows)
        tables["sample_data"] += rows
    tables["instance"] = instances_of(log, boxes)
    tables["sample_annotation"] = [annotation for _, _, annotation in boxes]


def _reading_row(log: Log, stream: Stream, frame: int, samples: Samples, *, is_key: bool) -> Row:
    """Return the row of a reading in `sample_data`, without its neighbours."""
    own, t_us = token("sample_data", log.path.name, stream.channel, log.t_us[frame]), int(stream.t_us[frame])
    folder = "samples" if is_key else "sweeps"
    height, width = stream.size_hw
    return {
        "token": own,
        "sample_token": samples.token_of(frame),
        "ego_pose_token": own,
        "calibrated_sensor_token": token("calibrated_sensor", log.path.name, stream.channel),
        "timestamp": t_us,
        "fileformat": stream.ending.split(".")[0],
        "is_key_frame": is_key,
        "height": height,
        "width": width,
        "filename": f"{folder}/{stream.channel}/{scene_name(log)}__{stream.channel}__{t_us}.{stream.ending}",
    }
