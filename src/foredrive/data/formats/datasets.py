"""The data sets that can be converted, by name."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from foredrive.data.formats import py123d_datasets
from foredrive.data.formats.av2_sensor import find_av2
from foredrive.data.formats.bag_log import find_bags
from foredrive.data.formats.kitti_object import find_kitti_object
from foredrive.data.formats.kitti_raw import find_kitti_raw
from foredrive.data.formats.ncore import find_ncore
from foredrive.data.formats.nerfstudio import find_nerfstudio
from foredrive.data.formats.pandaset import find_pandaset
from foredrive.data.formats.raw_log import RawLog


class RawDataset(NamedTuple):
    """A data set whose raw logs can be found and parsed."""

    find: Callable[[Path], Iterator[RawLog]]
    """Yields the raw logs of a folder: of its root, of one log, or of one or two levels above them."""
    layout: str
    """What a folder of the data set contains, for messages."""


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
