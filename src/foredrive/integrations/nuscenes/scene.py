"""One log as a scene of nuScenes: its sensor files, its mask of the map, and its rows of the tables."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from PIL import Image

from foredrive.data.boxes import frames_with_boxes
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.recorded import read_caption
from foredrive.errors import InputError
from foredrive.export.nuscenes.annotations import annotations_at, instances_of
from foredrive.export.nuscenes.map_mask import draw_map_mask
from foredrive.export.nuscenes.samples import Samples, choose_samples
from foredrive.export.nuscenes.streams import LIDAR, Stream, streams_of
from foredrive.export.nuscenes.tables import TABLES_OF_A_LOG, Row, link, pose, token
from foredrive.files import atomic_path

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
        found = read_sweep(log, frame) if frame in frames_of.get(LIDAR, ()) else None
        sweep = None if found is None else found[0]
        for stream in streams:
            data = stream.encode(frame, sweep) if frame in frames_of[stream.channel] else None
            if data is not None:
                row = _reading_row(log, stream, frame, samples, is_key=frame in key)
                with atomic_path(dataroot / row["filename"]) as file:
                    file.write_bytes(data)
                readings[stream.channel].append(row)
                at = {"token": row["ego_pose_token"], "timestamp": row["timestamp"]}
                tables["ego_pose"].append(at | pose(stream.T_world_ego(frame)))
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
