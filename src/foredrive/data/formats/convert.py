"""Conversion of raw data sets to self-contained 123D logs."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from py123d.api.map.arrow.arrow_map_writer import ArrowMapWriter
from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter
from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
from py123d.datatypes import LogMetadata
from py123d.parser.base_dataset_parser import BaseLogParser, BaseMapParser, ModalitiesSync

from foredrive.data.formats import py123d_datasets
from foredrive.data.formats.av2_sensor import find_av2
from foredrive.data.formats.bag_log import find_bags
from foredrive.data.formats.guard import SensorFiles, check_finite, check_inside, check_names, reading_raw
from foredrive.data.formats.kitti_object import find_kitti_object
from foredrive.data.formats.kitti_raw import find_kitti_raw
from foredrive.data.formats.ncore import find_ncore
from foredrive.data.formats.nerfstudio import find_nerfstudio
from foredrive.data.formats.pandaset import find_pandaset
from foredrive.data.formats.raw_log import OwnLog, RawLog
from foredrive.data.log_paths import LogPath
from foredrive.data.notices import collecting, write_notices
from foredrive.debugging import profile_step
from foredrive.errors import InputError
from foredrive.files import atomic_path


class RawDataset(NamedTuple):
    """A data set whose raw logs can be found and parsed."""

    find: Callable[[Path], Iterator[RawLog]]
    """Yields the raw logs of a folder: of its root, of one log, or of one or two levels above them."""
    layout: str
    """Names what a folder of the data set contains, for messages."""


DATASETS = {
    "pandaset": RawDataset(find_pandaset, "annotations/cuboids"),
    "av2": RawDataset(find_av2, "city_SE3_egovehicle.feather"),
    "nuscenes": RawDataset(
        py123d_datasets.nuscenes, "v1.0-trainval, v1.0-test, v1.0-mini or v1.0-NAME with scene.json"
    ),
    "nuscenes-sweeps": RawDataset(py123d_datasets.nuscenes_sweeps, "the same as for nuscenes"),
    "nuplan": RawDataset(py123d_datasets.nuplan, "nuplan-v1.1/splits/mini, trainval or test"),
    "waymo": RawDataset(py123d_datasets.waymo, "training, validation or testing with *.tfrecord"),
    "waymo-motion": RawDataset(py123d_datasets.waymo_motion, "training, validation, … with *.tfrecord-*"),
    "kitti360": RawDataset(py123d_datasets.kitti360, "calibration/calib_cam_to_pose.txt"),
    "kitti-raw": RawDataset(find_kitti_raw, "velodyne_points/data"),
    "kitti-object": RawDataset(find_kitti_object, "calib/*.txt beside velodyne/*.bin or image_2/*.png"),
    "griffin": RawDataset(py123d_datasets.griffin, "griffin-release/vehicle-side"),
    "truckdrive": RawDataset(py123d_datasets.truckdrive, "calibrations/calib_tf_tree_full.json"),
    "physical-ai-av": RawDataset(
        py123d_datasets.physical_ai_av,
        "clip_index.parquet beside unpacked labels/egomotion and lidar/lidar_top_360fov",
    ),
    "ncore": RawDataset(find_ncore, "*.ncore4*.zarr.itar or .zarr"),
    "nureasoning": RawDataset(py123d_datasets.nureasoning, "train/*/*/metadata.json"),
    "nerfstudio": RawDataset(find_nerfstudio, "transforms.json"),
    "rosbag": RawDataset(find_bags, "BAG.topics.yaml beside a .bag, .db3, .mcap or the folder of a bag"),
}
"""A data set is a line here, its parser or a function of `py123d_datasets`, and a name in the help."""


def convert(source: Path, dataset: str, out: Path) -> list[LogPath]:
    """Convert a raw dataset into 123D logs that contain their images and sweeps, one after the other.

    Missing velocities are left out, not inferred, and no routes are derived. An existing log of the same name
    is replaced. `runs.convert` converts many logs at once and keeps those that are there.

    Args:
        source: folder of one raw log, or a folder (of folders) of raw logs.
        dataset: one of `DATASETS`.
        out: 123D data root.

    Returns:
        The written logs.

    Raises:
        InputError: the dataset is unknown, or the source has no raw logs of it or cannot be read.
    """
    return [convert_log(raw, Path(out)) for raw in find_raw_logs(Path(source), dataset)]


def find_raw_logs(source: Path, dataset: str, topics: Path | None = None) -> Iterator[RawLog]:
    """Yield the raw logs of a data set in a folder.

    Args:
        source: folder of one raw log, or of many; for bags also a file.
        dataset: one of `DATASETS`.
        topics: the YAML of a bag; None: that beside it.

    Raises:
        InputError: the data set is unknown, there is no log of it, or an index of it cannot be read.
    """
    if dataset not in DATASETS:
        raise InputError(f"unknown data set {dataset!r}; there are: {', '.join(DATASETS)}")
    if not source.exists():
        raise InputError(f"{source}: no such folder")
    kind, any_log = DATASETS[dataset], False
    logs = kind.find(source) if topics is None else find_bags(source, topics)
    while True:
        # Errors of a parser become an error that names the log
        with reading_raw(source):
            raw = next(logs, None)
        if raw is None:
            break
        any_log = True
        yield raw
    if not any_log:
        raise InputError(f"{source}: no {dataset} log here (looked for {kind.layout})")


def log_path(metadata: LogMetadata, out: Path) -> LogPath:
    """Return the path of a raw log in a data root, whether it has been converted or not.

    Raises:
        InputError: its name would lead out of the data root.
    """
    check_names(metadata)
    folder = out / "logs" / metadata.split / metadata.log_name
    return LogPath(folder.absolute(), out.absolute() / "maps")


def convert_log(raw: RawLog, out: Path, tick: Callable[[], None] = lambda: None) -> LogPath:
    """Convert one raw log, and its map unless that is shared and there. Notices are kept beside the log.

    Args:
        raw: the log.
        out: 123D data root.
        tick: called after each frame.

    Raises:
        InputError: a file of it cannot be read, names a file outside of the data set, or it has no frames.
    """
    with reading_raw(raw.source), collecting():
        metadata = raw.log.get_log_metadata()
        path = log_path(metadata, out)
        if isinstance(raw.log, OwnLog):
            return raw.log.write(out, tick)
        # The log appears complete or not at all
        with atomic_path(path.folder, alone=True) as temporary:
            scratch = temporary.parent
            if raw.map is not None:
                _write_map(raw.map, scratch, out)
            if not _write_frames(raw.log, metadata, raw.source, scratch, tick):
                raise InputError(f"{raw.source}: the raw log has no frames")
            write_notices(scratch / metadata.split / metadata.log_name)
            os.replace(scratch / metadata.split / metadata.log_name, temporary)
    return path


def _write_frames(
    log: BaseLogParser, metadata: LogMetadata, source: Path, scratch: Path, tick: Callable[[], None]
) -> int:
    config = LogWriterConfig(
        camera_store_option="jpeg_binary",
        lidar_store_option="binary",
        lidar_codec="ipc_lz4",
        write_route=False,
    )
    writer = ArrowLogWriter(config, scratch, scratch)
    writer.reset(metadata)
    files, frames = SensorFiles(source, metadata.dataset), 0
    # Frames of the parser, checked and loaded one at a time
    for frame in log.iter_modalities_sync():
        for modality in frame.modalities:
            check_inside(modality, source)
            check_finite(modality, source)
        loaded = [modality for parsed in frame.modalities if (modality := files.load(parsed)) is not None]
        writer.write_sync(ModalitiesSync(frame.timestamp, loaded))
        frames += 1
        tick()
        profile_step()
    # A sensor of which nothing can be read is an error
    files.check()
    writer.close()
    return frames


def _write_map(parser: BaseMapParser, scratch: Path, out: Path) -> None:
    """Write the map of one log below `scratch`, or a shared map below `out` unless it is there."""
    metadata = parser.get_map_metadata()
    check_names(metadata)
    # A map of one log lies beside it
    if metadata.map_is_per_log:
        _fill_map(parser, scratch, scratch)
        (scratch / metadata.split / metadata.log_name).mkdir(parents=True, exist_ok=True)
        return
    name = Path(metadata.dataset) / f"{metadata.dataset}_{metadata.location}.arrow"
    final = out / "maps" / name
    # A shared map is written once
    if final.is_file():
        return
    with atomic_path(final) as temporary:
        _fill_map(parser, temporary.parent, temporary.parent)
        # The map appears complete or not at all
        os.replace(temporary.parent / name, temporary)


def _fill_map(parser: BaseMapParser, maps_root: Path, logs_root: Path) -> None:
    writer = ArrowMapWriter(True, maps_root=maps_root, logs_root=logs_root)
    writer.reset(parser.get_map_metadata())
    for item in parser.iter_map_objects():
        writer.write_map_object(item)
    metadata = parser.get_map_metadata()
    if metadata.map_is_per_log:
        (logs_root / metadata.split / metadata.log_name).mkdir(parents=True, exist_ok=True)
    writer.close()
