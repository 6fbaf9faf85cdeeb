"""The data sets that py123d parses: where their logs lie, and what their parsers need.

py123d's parsers find the logs below a root by the published folders of each data set. Pickles in these data
sets are read by an allow-list (`safe_pickle`), which takes the place of `pickle` in the parsers' modules.

Modules are changed by functions `_…_parser`, which every process calls that gets a log (`RawLog.prepare`).
"""

import dataclasses
import importlib
import importlib.util
import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from py123d.datatypes import BoxDetectionSE3, BoxDetectionsSE3, EgoStateSE3, LogMetadata, MapMetadata
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.parser.base_dataset_parser import BaseDatasetParser, BaseLogParser, ModalitiesSync

from foredrive.data.formats.nuscenes_tables import NuScenesTablesParser, nuscenes_tables
from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.safe_pickle import PlainPickle, load_records
from foredrive.errors import InputError

_NUREASONING = "py123d.parser.nureasoning.utils.nureasoning_schema"
_NUPLAN_UNPICKLES = ("common.sql_types", "nuplan_db.nuplan_scenario_queries")
_NUPLAN_LISTS = [
    ("nuplan.database.common.data_types", n) for n in ("Translation", "Rotation", "CameraIntrinsic")
]
"""Modules of nuplan-devkit that unpickle columns of a data base, and the lists that these columns hold."""

NEEDS = {
    "nuscenes": "pip install scikit-learn && pip install --no-deps nuscenes-devkit==1.2.0 descartes",
    "nuplan": "pip install 'py123d[nuplan]' and nuplan-devkit from github.com/motional/nuplan-devkit",
    "tensorflow": "pip install tensorflow-cpu",
}
"""How to install what parsers need. nuscenes-devkit asks for NumPy 1, so --no-deps, but runs with NumPy 2."""


def nuscenes(source: Path) -> Iterator[RawLog]:
    """Find the scenes of nuScenes (whole, mini or test), at their key frames."""
    yield from _nuscenes(source, "nuscenes")


def nuscenes_sweeps(source: Path) -> Iterator[RawLog]:
    """Find the scenes of nuScenes at 10 Hz: with the sweeps between key frames and interpolated boxes."""
    yield from _nuscenes(source, "nuscenes-interpolated")


def _nuscenes(source: Path, name: str) -> Iterator[RawLog]:
    versions = {
        "v1.0-trainval": [f"{name}_train", f"{name}_val"],
        "v1.0-test": [f"{name}_test"],
        "v1.0-mini": [f"{name}-mini_train", f"{name}-mini_val"],
    }
    for version, splits in versions.items():
        # nuScenes' own versions, by py123d's parser
        for root in folders_with(source, f"{version}/scene.json"):
            module = _nuscenes_parser()
            maps = root if (root / "maps" / "expansion").is_dir() else None
            yield from _of(module.NuScenesParser(splits, root, maps), root / version, _nuscenes_parser)
    # Other versions, by the parser of tables
    for root in folders_with(source, "v[0-9]*-*/scene.json"):
        for tables in sorted(root.glob("v[0-9]*-*")):
            if tables.name not in versions and (tables / "scene.json").is_file():
                yield from _own_scenes(tables, sweeps=name != "nuscenes")


def _own_scenes(tables: Path, *, sweeps: bool) -> Iterator[RawLog]:
    """Find the scenes of a data set in nuScenes' format. Their splits are those of its splits.json."""
    noted, split_of = tables / "splits.json", dict[str, str]()
    if noted.is_file():
        for split, names in json.loads(noted.read_bytes()).items():
            split_of |= dict.fromkeys(names, split)
    scenes = nuscenes_tables(tables).rows["scene"]
    if not scenes:
        raise InputError(f"{tables / 'scene.json'}: has no scenes")
    for token, scene in scenes.items():
        split = f"nuscenes_{split_of.get(scene['name'], 'train')}"
        yield RawLog(tables.parent, NuScenesTablesParser(tables, split, token, sweeps=sweeps))


def _nuscenes_parser() -> Any:
    """Return py123d's parser, made to leave speeds out without a CAN bus; it writes 0 m/s there."""
    parser = _module("nuscenes.nuscenes_parser", "nuscenes")
    extraction = _module("nuscenes.utils.nuscenes_extraction", "nuscenes")
    real_bus, find = parser.NuScenesCanBus, extraction._find_dynamic_state_from_can_bus
    # The replacement is made once
    if real_bus is _can_bus:
        return parser

    def speed(bus: Any, scene: str, t_us: int) -> Any:
        try:
            has_speed = bus is not None and bool(bus.get_messages(scene, "pose"))
        except Exception:  # the devkit's own error for a scene without messages
            has_speed = False
        return find(bus, scene, t_us) if has_speed else None

    extraction._find_dynamic_state_from_can_bus = speed
    parser.NuScenesCanBus = _can_bus
    return parser


def _can_bus(dataroot: str) -> Any:
    """Return the messages of nuScenes' CAN bus, or None where they were not downloaded."""
    bus = importlib.import_module("nuscenes.can_bus.can_bus_api")
    return bus.NuScenesCanBus(dataroot) if (Path(dataroot) / "can_bus").is_dir() else None


def nuplan(source: Path) -> Iterator[RawLog]:
    """Find nuPlan's logs below nuplan-v1.1/splits, with maps/ and nuplan-v1.1/sensor_blobs/ if present."""
    for kind, splits in {
        "mini": [f"nuplan-mini_{part}" for part in ("train", "val", "test")],
        "trainval": ["nuplan_train", "nuplan_val"],
        "test": ["nuplan_test"],
    }.items():
        for root in folders_with(source, f"nuplan-v1.1/splits/{kind}"):
            sensors = root / "nuplan-v1.1" / "sensor_blobs"
            parser = _nuplan_parser().NuplanParser(splits, root, root / "maps", sensors)
            yield from _of(parser, root, _nuplan_parser)


def _nuplan_parser() -> Any:
    """Return py123d's parser; every module that unpickles has the restricted reader."""
    module = _module("nuplan.nuplan_parser", "nuplan")
    unpickling = [importlib.import_module(f"nuplan.database.{name}") for name in _NUPLAN_UNPICKLES]
    for reader in (module, *unpickling):
        reader.pickle = PlainPickle(_NUPLAN_LISTS)
    return module


def kitti360(source: Path) -> Iterator[RawLog]:
    """Find KITTI-360's drives. Their boxes are filtered anew: no precomputed pickle is read."""
    for root in folders_with(source, "calibration/calib_cam_to_pose.txt"):
        drives = [folder.name for folder in sorted((root / "data_2d_raw").glob("*_sync"))]
        parser = _kitti360_parser().Kitti360Parser(["kitti360_train"], root, root, 80.0, drives, [], [])
        for raw in _of(parser, root, _kitti360_parser):
            yield dataclasses.replace(raw, log=_WithOwnCache(raw.log))


def _kitti360_parser() -> Any:
    module = _module("kitti360.kitti360_parser")
    module.pickle = PlainPickle()
    return module


class _WithOwnCache(BaseLogParser):
    """A parser of KITTI-360 whose filtered boxes lie in a folder of their own while it is read."""

    def __init__(self, parser: Any) -> None:
        self._parser = parser

    def get_log_metadata(self) -> LogMetadata:
        """Return the log's metadata."""
        return self._parser.get_log_metadata()

    def iter_modalities_sync(self) -> Iterator[ModalitiesSync]:
        """Yield the frames."""
        with tempfile.TemporaryDirectory() as cache:
            self._parser._detection_cache_root = Path(cache)
            yield from self._parser.iter_modalities_sync()


def waymo(source: Path) -> Iterator[RawLog]:
    """Find the segments of the Waymo Open Dataset (perception) in training, validation and testing."""
    kinds = {"training": "train", "validation": "val", "testing": "test"}
    for folder, kind in kinds.items():
        for root in folders_with(source, f"{folder}/*.tfrecord"):
            module = _module("wod.wod_perception_parser", "tensorflow")
            yield from _of(module.WODPerceptionParser([f"wod-perception_{kind}"], root), root / folder)


def waymo_motion(source: Path) -> Iterator[RawLog]:
    """Find the scenarios of the Waymo Open Motion Dataset: tracks, lights and maps without sensors."""
    for folder, split in {
        "training": "wod-motion_train",
        "validation": "wod-motion_val",
        "testing": "wod-motion_test",
        "training_20s": "wod-motion-20s_train",
        "validation_interactive": "wod-motion-interactive_val",
        "testing_interactive": "wod-motion-interactive_test",
    }.items():
        for root in folders_with(source, f"{folder}/*.tfrecord*"):
            module = _module("wod.wod_motion_parser", "tensorflow")
            yield from _of(module.WODMotionParser([split], root), root / folder)


def griffin(source: Path) -> Iterator[RawLog]:
    """Find the vehicle's scenes of Griffin, which CARLA rendered, with the maps of its towns."""
    for folder in folders_with(source, "griffin-release/vehicle-side"):
        module = _module("griffin.griffin_parser")
        splits = [f"{folder.name}_{kind}" for kind in ("train", "val")]
        yield from _of(module.GriffinParser(splits, folder.parent), folder)


def truckdrive(source: Path) -> Iterator[RawLog]:
    """Find TruckDrive's scenes. Those of its test split have no poses and are left out."""
    folders = folders_with(source, "calibrations/calib_tf_tree_full.json")
    for root in dict.fromkeys(folder.parent for folder in folders):
        scenes = [folder.name for folder in folders if folder.parent == root]
        parser = _truckdrive_parser().TruckDriveDatasetParser(root, scenes)
        for raw in _of(parser, root, _truckdrive_parser):
            yield dataclasses.replace(raw, log=_Changed(raw.log, _without_motion))


def _truckdrive_parser() -> Any:
    constants = _module("truckdrive.truckdrive_constants")
    if not hasattr(constants, "DEFAULT_VEHICLE_HEIGHT_M"):
        constants.DEFAULT_VEHICLE_HEIGHT_M = 4.0  # py123d 0.7.0 has this line at the end of a comment
    return _module("truckdrive.truckdrive_parser")


class _Changed(BaseLogParser):
    """A parser whose modalities are changed, or left out where `change` returns None."""

    def __init__(self, parser: Any, change: Callable[[BaseModality], BaseModality | None]) -> None:
        self._parser, self._change = parser, change

    def get_log_metadata(self) -> LogMetadata:
        """Return the log's metadata."""
        return self._parser.get_log_metadata()

    def iter_modalities_sync(self) -> Iterator[ModalitiesSync]:
        """Yield the frames."""
        for sync in self._parser.iter_modalities_sync():
            changed = [self._change(modality) for modality in sync.modalities]
            yield ModalitiesSync(sync.timestamp, [modality for modality in changed if modality is not None])


def _without_motion(modality: BaseModality) -> BaseModality:
    """Leave speeds out. py123d's parser of TruckDrive writes 0 m/s for the vehicle and all boxes."""
    if isinstance(modality, EgoStateSE3):
        return EgoStateSE3.from_imu(modality.imu_se3, modality.metadata, modality.timestamp, None)
    if isinstance(modality, BoxDetectionsSE3):
        boxes = [
            BoxDetectionSE3(box.attributes, box.bounding_box_se3, None) for box in modality.box_detections
        ]
        return BoxDetectionsSE3(boxes, modality.timestamp, modality.metadata)
    return modality


def physical_ai_av(source: Path) -> Iterator[RawLog]:
    """Find the downloaded clips of NVIDIA's PhysicalAI-Autonomous-Vehicles, with or without labels."""
    for root in folders_with(source, "clip_index.parquet"):
        module = _module("physical_ai_av.physical_ai_av_parser")
        splits = [f"physical-ai-av_{kind}" for kind in ("train", "val", "test")]
        for raw in _of(module.PhysicalAIAVParser(splits, root), root):
            clip = raw.log.get_log_metadata().log_name
            ego = root / "labels" / "egomotion" / f"{clip}.egomotion.parquet"
            lidar = root / "lidar" / "lidar_top_360fov" / f"{clip}.lidar_top_360fov.parquet"
            boxes = root / "labels" / "obstacle.offline" / f"{clip}.obstacle.offline.parquet"
            # py123d gives all clips of a chunk whose calibration is there, and frames without labels no boxes
            if ego.is_file() and lidar.is_file():
                yield raw if boxes.is_file() else RawLog(root, _Changed(raw.log, _without_boxes))


def _without_boxes(modality: BaseModality) -> BaseModality | None:
    return None if isinstance(modality, BoxDetectionsSE3) else modality


def nureasoning(source: Path) -> Iterator[RawLog]:
    """Find the clips of nuReasoning (mini)."""
    for root in folders_with(source, "train/*/*/metadata.json"):
        parser = _nureasoning_parser().NureasoningParser(["nureasoning-mini_train"], root)
        yield from _of(parser, root, _nureasoning_parser)


def _nureasoning_parser() -> Any:
    module, maps = _module("nureasoning.nureasoning_parser"), _module("nureasoning.nureasoning_map_parser")
    module.load_schema_pickle = maps.load_schema_pickle = _load_nureasoning
    return module


def _load_nureasoning(file: Path) -> Any:
    return load_records(Path(file), _NUREASONING, {"data_schema": _NUREASONING})


def _module(name: str, needs: str = "") -> Any:
    """Import a module of py123d's parsers.

    Raises:
        InputError: the package that it needs is missing. The message says how to install it.
    """
    if needs and importlib.util.find_spec(needs) is None:
        raise InputError(f"py123d's parser {name} needs the package {needs}: {NEEDS[needs]}")
    return importlib.import_module(f"py123d.parser.{name}")


def _of(
    parser: BaseDatasetParser, source: Path, prepare: Callable[[], object] | None = None
) -> Iterator[RawLog]:
    """Yield the logs of a parser, each with its map."""
    # Maps by log, or by location where they are shared
    maps = {_map_key(one.get_map_metadata()): one for one in parser.get_map_parsers()}
    for log in parser.get_log_parsers():
        metadata = log.get_log_metadata()
        entry = maps.get((metadata.split, metadata.log_name)) or maps.get(
            (metadata.dataset, metadata.location)
        )
        yield RawLog(source, log, entry, prepare)


def _map_key(metadata: MapMetadata) -> tuple[str | None, str | None]:
    """Return split and name of the log that a map is of, or data set and location of a shared map."""
    if metadata.map_is_per_log:
        return metadata.split, metadata.log_name
    return metadata.dataset, metadata.location
