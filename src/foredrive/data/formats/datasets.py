"""The data sets that can be converted, by name."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from py123d.parser.av2.av2_map_parser import Av2MapParser

from foredrive.data.av2_sensor import Av2SensorParser
from foredrive.data.formats import py123d_datasets
from foredrive.data.formats.bag_log import find_bags
from foredrive.data.formats.kitti_object import KittiObjectParser
from foredrive.data.formats.kitti_raw import KittiRawParser
from foredrive.data.formats.nerfstudio import find_nerfstudio
from foredrive.data.formats.nuscenes_keyframe import NuScenesKeyframeParser
from foredrive.data.formats.pandaset import PandasetParser
from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.images import is_image


@dataclass(frozen=True)
class RawDataset:
    """A data set whose raw logs can be found and parsed."""

    find: Callable[[Path], Iterator[RawLog]]
    """Yields the raw logs of a folder: of its root, of one log, or of one or two levels above them."""
    layout: str
    """What a folder of the data set contains, for messages."""


def _pandaset(source: Path) -> Iterator[RawLog]:
    for folder in folders_with(source, "annotations/cuboids"):
        yield RawLog(folder, PandasetParser(folder, folder.name, "pandaset_train"))


def _av2(source: Path) -> Iterator[RawLog]:
    for folder in folders_with(source, "city_SE3_egovehicle.feather"):
        kind = folder.parent.name if folder.parent.name in ("train", "val", "test") else "val"
        split = f"av2-sensor_{kind}"
        yield RawLog(folder, Av2SensorParser(folder, split), Av2MapParser(folder, split))


def _nuscenes_keyframe(source: Path) -> Iterator[RawLog]:
    for folder in folders_with(source, "v1.0-*/sample_data.json"):
        yield RawLog(folder, NuScenesKeyframeParser(folder, "nuscenes_val"))


def _kitti_object(source: Path) -> Iterator[RawLog]:
    for folder in folders_with(source, "calib"):
        split = "kitti_test" if folder.name == "testing" else "kitti_train"
        sensed = {file.stem for file in folder.glob("velodyne/*.bin")}
        sensed |= {file.stem for file in folder.glob("image_2/*") if is_image(file)}
        for frame in sorted(name for name in sensed if not name.startswith(".")):
            yield RawLog(folder, KittiObjectParser(folder, frame, split))


def _kitti_raw(source: Path) -> Iterator[RawLog]:
    for folder in folders_with(source, "velodyne_points/data"):
        yield RawLog(folder, KittiRawParser(folder, "kitti-raw_train"))


DATASETS: dict[str, RawDataset] = {
    "pandaset": RawDataset(_pandaset, "annotations/cuboids"),
    "av2": RawDataset(_av2, "city_SE3_egovehicle.feather"),
    "nuscenes-keyframe": RawDataset(_nuscenes_keyframe, "v1.0-*/sample_data.json"),
    "kitti-object": RawDataset(_kitti_object, "calib/*.txt beside velodyne/*.bin or image_2/*.png"),
    "kitti-raw": RawDataset(_kitti_raw, "velodyne_points/data"),
    "rosbag": RawDataset(find_bags, "BAG.topics.yaml beside a .bag, .db3, .mcap or the folder of a bag"),
    "nerfstudio": RawDataset(find_nerfstudio, "transforms.json"),
    "nuscenes": RawDataset(
        py123d_datasets.nuscenes, "v1.0-trainval, v1.0-test, v1.0-mini or v1.0-NAME with scene.json"
    ),
    "nuscenes-sweeps": RawDataset(py123d_datasets.nuscenes_sweeps, "the same as for nuscenes"),
    "nuplan": RawDataset(py123d_datasets.nuplan, "nuplan-v1.1/splits/mini, trainval or test"),
    "kitti360": RawDataset(py123d_datasets.kitti360, "calibration/calib_cam_to_pose.txt"),
    "waymo": RawDataset(py123d_datasets.waymo, "training, validation or testing with *.tfrecord"),
    "waymo-motion": RawDataset(py123d_datasets.waymo_motion, "training, validation, … with *.tfrecord-*"),
    "griffin": RawDataset(py123d_datasets.griffin, "griffin-release/vehicle-side"),
    "truckdrive": RawDataset(py123d_datasets.truckdrive, "calibrations/calib_tf_tree_full.json"),
    "physical-ai-av": RawDataset(py123d_datasets.physical_ai_av, "clip_index.parquet"),
    "ncore": RawDataset(py123d_datasets.ncore, "clips/*/pai_*.json"),
    "nureasoning": RawDataset(py123d_datasets.nureasoning, "train/*/*/metadata.json"),
}
"""Parsers of our own, then those of py123d."""
