"""The data sets that can be converted, by name. Their parsers are imported when they are used."""

import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from foredrive.data.formats.raw_log import RawLog


@dataclass(frozen=True)
class RawDataset:
    """A data set whose raw logs can be found and parsed."""

    home: str
    """MODULE.FUNCTION in this folder; the function yields the raw logs of a folder."""
    layout: str
    """What a folder of the data set contains, for messages."""
    note: str = ""
    """Remark behind the name in the help text."""

    def find(self, source: Path) -> "Iterator[RawLog]":
        """Yield the raw logs of a folder: of its root, of one log, or of one or two levels above them.

        Raises:
            InputError: a package that the parser needs is not installed.
        """
        module, _, function = self.home.partition(".")
        logs: Iterator[RawLog] = getattr(importlib.import_module(f"{__package__}.{module}"), function)(source)
        return logs


DATASETS: dict[str, RawDataset] = {
    "pandaset": RawDataset("pandaset.find_pandaset", "annotations/cuboids"),
    "av2": RawDataset("av2_sensor.find_av2", "city_SE3_egovehicle.feather"),
    "nuscenes": RawDataset(
        "py123d_datasets.nuscenes", "v1.0-trainval, v1.0-test, v1.0-mini or v1.0-NAME with scene.json"
    ),
    "nuscenes-sweeps": RawDataset("py123d_datasets.nuscenes_sweeps", "the same as for nuscenes", "10 Hz"),
    "nuplan": RawDataset("py123d_datasets.nuplan", "nuplan-v1.1/splits/mini, trainval or test"),
    "waymo": RawDataset("py123d_datasets.waymo", "training, validation or testing with *.tfrecord"),
    "waymo-motion": RawDataset("py123d_datasets.waymo_motion", "training, validation, … with *.tfrecord-*"),
    "kitti360": RawDataset("py123d_datasets.kitti360", "calibration/calib_cam_to_pose.txt"),
    "kitti-raw": RawDataset("kitti_raw.find_kitti_raw", "velodyne_points/data"),
    "kitti-object": RawDataset(
        "kitti_object.find_kitti_object", "calib/*.txt beside velodyne/*.bin or image_2/*.png"
    ),
    "griffin": RawDataset("py123d_datasets.griffin", "griffin-release/vehicle-side"),
    "truckdrive": RawDataset("py123d_datasets.truckdrive", "calibrations/calib_tf_tree_full.json"),
    "physical-ai-av": RawDataset(
        "py123d_datasets.physical_ai_av",
        "clip_index.parquet beside unpacked labels/egomotion and lidar/lidar_top_360fov",
    ),
    "ncore": RawDataset("ncore.find_ncore", "*.ncore4*.zarr.itar or .zarr", "NCore v4"),
    "nureasoning": RawDataset("py123d_datasets.nureasoning", "train/*/*/metadata.json"),
    "nerfstudio": RawDataset("nerfstudio.find_nerfstudio", "transforms.json", "folders with transforms.json"),
    "rosbag": RawDataset(
        "bag_log.find_bags",
        "BAG.topics.yaml beside a .bag, .db3, .mcap or the folder of a bag",
        "ROS 1, ROS 2 and MCAP",
    ),
}
"""A data set is a line here and a parser beside it, or a function of `py123d_datasets`."""


def datasets_help() -> str:
    """Return the names of all data sets, with their notes, for help."""
    names = [f"{name} ({row.note})" if row.note else name for name, row in DATASETS.items()]
    return ", ".join(names[:-1]) + f" or {names[-1]}"
