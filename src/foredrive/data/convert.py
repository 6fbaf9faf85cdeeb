"""Conversion of raw datasets to self-contained 123D logs."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from py123d.api.map.arrow.arrow_map_writer import ArrowMapWriter
from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter
from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
from py123d.parser.av2.av2_map_parser import Av2MapParser
from py123d.parser.av2.av2_sensor_parser import Av2SensorLogParser
from py123d.parser.base_dataset_parser import BaseLogParser, BaseMapParser

from foredrive.data.arrow_files import reading
from foredrive.data.av2_partial import Av2PartialParser
from foredrive.data.kitti_object import KittiObjectParser
from foredrive.data.kitti_raw import KittiRawParser
from foredrive.data.log_paths import LogPath
from foredrive.data.nuscenes_keyframe import NuScenesKeyframeParser
from foredrive.data.pandaset import PandasetParser
from foredrive.errors import InputError
from foredrive.files import atomic_path

LogParsers = Iterator[tuple[Path, BaseLogParser, BaseMapParser | None]]


def convert(source: Path, dataset: str, out: Path) -> list[LogPath]:
    """Convert a raw dataset into 123D logs that contain their images and sweeps.

    Missing velocities are left out, not inferred, and no routes are derived. An existing log of the same name
    is replaced.

    Args:
        source: folder of one raw log, or a folder (of folders) of raw logs.
        dataset: one of `DATASETS`.
        out: 123D data root.

    Returns:
        The written logs.

    Raises:
        InputError: the dataset is unknown, or the source has no raw logs of it or cannot be read.
    """
    if dataset not in DATASETS:
        raise InputError(f"unknown data set {dataset!r}; there are: {', '.join(DATASETS)}")
    source = Path(source)
    if not source.is_dir():
        raise InputError(f"{source}: no such folder")
    logs = [_convert_one(*item, Path(out)) for item in DATASETS[dataset](source)]
    if not logs:
        raise InputError(f"{source}: no {dataset} log here")
    return logs


def _convert_one(folder: Path, log: BaseLogParser, map_: BaseMapParser | None, out: Path) -> LogPath:
    config = LogWriterConfig(
        camera_store_option="jpeg_binary",
        lidar_store_option="binary",
        lidar_codec="ipc_lz4",
        write_route=False,
    )
    with reading(folder, "the raw log"):
        metadata = log.get_log_metadata()
        final = out / "logs" / metadata.split / metadata.log_name
        with atomic_path(final) as temporary:
            scratch = temporary.parent
            if map_ is not None:
                map_writer = ArrowMapWriter(True, maps_root=scratch, logs_root=scratch)
                map_writer.reset(map_.get_map_metadata())
                for item in map_.iter_map_objects():
                    map_writer.write_map_object(item)
                (scratch / metadata.split / metadata.log_name).mkdir(parents=True)
                map_writer.close()
            writer = ArrowLogWriter(config, scratch, scratch)
            writer.reset(metadata)
            for frame in log.iter_modalities_sync():
                writer.write_sync(frame)
            writer.close()
            os.replace(scratch / metadata.split / metadata.log_name, temporary)
    return LogPath(final.absolute(), out.absolute() / "maps")


def _folders_with(source: Path, file: str) -> list[Path]:
    """Return `source`, or else the folders one or two levels below it that contain `file`."""
    for depth in range(3):
        found = sorted(source.glob("*/" * depth + file))
        if found:
            return [item.parents[file.count("/")] for item in found]
    return []


def _pandaset(source: Path) -> LogParsers:
    for folder in _folders_with(source, "annotations/cuboids"):
        yield folder, PandasetParser(folder, folder.name, "pandaset_train"), None


def _av2(source: Path) -> LogParsers:
    for folder in _folders_with(source, "city_SE3_egovehicle.feather"):
        kind = folder.parent.name if folder.parent.name in ("train", "val", "test") else "val"
        split = f"av2-sensor_{kind}"
        whole = (folder / "sensors" / "cameras").is_dir()
        parser = Av2SensorLogParser(folder, split, "sweep") if whole else Av2PartialParser(folder, split)
        yield folder, parser, Av2MapParser(folder, split)


def _nuscenes_keyframe(source: Path) -> LogParsers:
    for folder in _folders_with(source, "v1.0-*/sample_data.json"):
        yield folder, NuScenesKeyframeParser(folder, "nuscenes_val"), None


def _kitti_object(source: Path) -> LogParsers:
    for folder in _folders_with(source, "velodyne"):
        split = "kitti_test" if folder.name == "testing" else "kitti_train"
        for sweep in sorted(folder.glob("velodyne/*.bin")):
            yield sweep, KittiObjectParser(folder, sweep.stem, split), None


def _kitti_raw(source: Path) -> LogParsers:
    for folder in _folders_with(source, "velodyne_points/data"):
        yield folder, KittiRawParser(folder, "kitti-raw_train"), None


DATASETS: dict[str, Callable[[Path], LogParsers]] = {
    "pandaset": _pandaset,
    "av2": _av2,
    "nuscenes-keyframe": _nuscenes_keyframe,
    "kitti-object": _kitti_object,
    "kitti-raw": _kitti_raw,
}
"""Functions that find and parse the raw logs of each dataset. For full nuScenes and all other datasets, use
py123d's own `py123d-conversion`."""
