"""123D parsers for Argoverse 2 sensor logs that lack cameras, calibration, annotations or most sweeps.

py123d's own parser steps from sweep to sweep, needs the folders of all cameras, and writes empty frames of
boxes where a log has no annotations, as in the test split.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
from jaxtyping import Float64
from py123d.datatypes import (
    BoxDetectionAttributes,
    BoxDetectionSE3,
    BoxDetectionsSE3,
    EgoStateSE3,
    LidarID,
    LidarMergedMetadata,
    LidarMetadata,
    LogMetadata,
    Timestamp,
)
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.geometry import BoundingBoxSE3, PoseSE3
from py123d.geometry.transform import rel_to_abs_se3_array
from py123d.parser.av2.av2_map_parser import get_av2_map_metadata
from py123d.parser.av2.utils.av2_constants import (
    AV2_SENSOR_BOX_DETECTIONS_SE3_METADATA,
    AV2_SENSOR_EGO_STATE_SE3_METADATA,
)
from py123d.parser.base_dataset_parser import BaseLogParser, ModalitiesSync, ParsedLidar
from py123d.parser.registry import AV2SensorBoxDetectionLabel

from foredrive.data.notices import note

_POSE = ["tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz"]
_SIZE = ["length_m", "width_m", "height_m"]
_EGO_CATEGORY = "EGO_VEHICLE"
_SWEEP_NS = 100_000_000
_LIDARS = {LidarID.LIDAR_TOP: "up_lidar", LidarID.LIDAR_DOWN: "down_lidar"}


class Av2PartialParser(BaseLogParser):
    """Parser of an AV2 sensor log without images.

    Args:
        folder: folder of the log. It must have city_SE3_egovehicle.feather and map/.
        split: 123D split, e.g. av2-sensor_val.
    """

    def __init__(self, folder: Path, split: str) -> None:
        self._folder = Path(folder)
        self._split = split

    def get_log_metadata(self) -> LogMetadata:
        """Return the log's metadata. Name and map are the same as in py123d's parser."""
        map_metadata = get_av2_map_metadata(self._split, self._folder, dataset="av2-sensor")
        location = map_metadata.location
        return LogMetadata("av2-sensor", self._split, self._folder.name, location, map_metadata)

    def iter_modalities_sync(self) -> Iterator[ModalitiesSync]:
        """Yield the ego pose at each time of a sweep or of annotations, with what there is of the two."""
        file = next(iter(sorted(self._folder.glob("annotations*.feather"))), None)
        annotations = None if file is None else feather.read_table(file)
        poses = feather.read_table(self._folder / "city_SE3_egovehicle.feather")
        row_at = {t_ns: row for row, t_ns in enumerate(poses["timestamp_ns"].to_pylist())}
        pose_rows = _columns(poses, _POSE)
        lidars = self._lidars()
        empty = np.zeros(0, np.int64)
        annotated_ns = empty if annotations is None else annotations["timestamp_ns"].to_numpy()
        sweeps = {int(sweep.stem): sweep for sweep in self._folder.glob("sensors/lidar/[0-9]*.feather")}
        if sweeps and not lidars:
            note("lidar", "left out; calibration/egovehicle_SE3_sensor.feather is missing")
            sweeps = {}
        for timestamp_ns in sorted({*annotated_ns.tolist(), *sweeps}):
            if timestamp_ns not in row_at:
                note("city_SE3_egovehicle.feather", "times without a pose, left out", f"{timestamp_ns} ns")
                continue
            timestamp = Timestamp.from_ns(timestamp_ns)
            pose = PoseSE3.from_array(pose_rows[row_at[timestamp_ns]])
            modalities: list[BaseModality] = [
                EgoStateSE3.from_imu(pose, AV2_SENSOR_EGO_STATE_SE3_METADATA, timestamp)
            ]
            rows = annotated_ns == timestamp_ns
            if annotations is not None and rows.any():
                modalities.append(_boxes(annotations.filter(pa.array(rows)), pose, timestamp))
            sweep = sweeps.get(timestamp_ns)
            if sweep is not None:
                modalities.append(
                    ParsedLidar(
                        metadata=LidarMergedMetadata(lidars),
                        start_timestamp=timestamp,
                        end_timestamp=Timestamp.from_ns(timestamp_ns + _SWEEP_NS),
                        dataset_root=self._folder,
                        relative_path=sweep.relative_to(self._folder),
                    )
                )
            yield ModalitiesSync(timestamp, modalities)

    def _lidars(self) -> dict[LidarID, LidarMetadata]:
        file = self._folder / "calibration" / "egovehicle_SE3_sensor.feather"
        if not file.is_file():
            return {}
        sensors = feather.read_table(file)
        mounted = dict(zip(sensors["sensor_name"].to_pylist(), _columns(sensors, _POSE), strict=True))
        return {
            id_: LidarMetadata(name, id_, PoseSE3.from_array(mounted[name])) for id_, name in _LIDARS.items()
        }


class WithoutBoxes(BaseLogParser):
    """A parser of a log without annotations, whose frames have no boxes in place of empty lists of them."""

    def __init__(self, parser: BaseLogParser) -> None:
        self._parser = parser

    def get_log_metadata(self) -> LogMetadata:
        """Return the log's metadata."""
        return self._parser.get_log_metadata()

    def iter_modalities_sync(self) -> Iterator[ModalitiesSync]:
        """Yield the frames."""
        for frame in self._parser.iter_modalities_sync():
            sensed = [one for one in frame.modalities if not isinstance(one, BoxDetectionsSE3)]
            yield ModalitiesSync(frame.timestamp, sensed)


def _boxes(rows: pa.Table, ego: PoseSE3, timestamp: Timestamp) -> BoxDetectionsSE3:
    """Return the boxes of one time, without the ego vehicle. AV2 has no velocities."""
    box = _columns(rows, _POSE + _SIZE)
    box[:, :7] = rel_to_abs_se3_array(ego, box[:, :7])
    detections = [
        BoxDetectionSE3(
            BoxDetectionAttributes(AV2SensorBoxDetectionLabel.deserialize(category), track, points),
            BoundingBoxSE3.from_array(values),
        )
        for values, category, track, points in zip(
            box,
            rows["category"].to_pylist(),
            rows["track_uuid"].to_pylist(),
            rows["num_interior_pts"].to_pylist(),
            strict=True,
        )
        if category != _EGO_CATEGORY
    ]
    return BoxDetectionsSE3(detections, timestamp, AV2_SENSOR_BOX_DETECTIONS_SE3_METADATA)


def _columns(table: pa.Table, names: list[str]) -> Float64[np.ndarray, "N K"]:
    return np.stack([table[name].to_numpy().astype(np.float64) for name in names], axis=-1)
