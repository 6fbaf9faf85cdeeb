"""A 123D parser for Argoverse 2 sensor logs without cameras, calibration or most sweeps.

py123d's own parser steps from sweep to sweep and needs the folders of all cameras. This parser steps from one
annotated time to the next and uses the available sweeps.
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

_POSE = ["tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz"]
_SIZE = ["length_m", "width_m", "height_m"]
_EGO_CATEGORY = "EGO_VEHICLE"
_SWEEP_NS = 100_000_000
_LIDARS = {LidarID.LIDAR_TOP: "up_lidar", LidarID.LIDAR_DOWN: "down_lidar"}


class Av2PartialParser(BaseLogParser):
    """Parser of an AV2 sensor log without images.

    Args:
        folder: folder of the log. It must have annotations*.feather, city_SE3_egovehicle.feather and map/.
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
        """Yield ego pose and boxes at every annotated time, and the sweep of that time if there is one."""
        annotations = feather.read_table(next(self._folder.glob("annotations*.feather")))
        poses = feather.read_table(self._folder / "city_SE3_egovehicle.feather")
        row_at = {t_ns: row for row, t_ns in enumerate(poses["timestamp_ns"].to_pylist())}
        pose_rows = _columns(poses, _POSE)
        lidars = self._lidars()
        annotated_ns = annotations["timestamp_ns"].to_numpy()
        for timestamp_ns in np.unique(annotated_ns).tolist():
            timestamp = Timestamp.from_ns(timestamp_ns)
            pose = PoseSE3.from_array(pose_rows[row_at[timestamp_ns]])
            ego = EgoStateSE3.from_imu(pose, AV2_SENSOR_EGO_STATE_SE3_METADATA, timestamp)
            boxes = _boxes(annotations.filter(pa.array(annotated_ns == timestamp_ns)), pose, timestamp)
            modalities: list[BaseModality] = [ego, boxes]
            sweep = self._folder / "sensors" / "lidar" / f"{timestamp_ns}.feather"
            if lidars and sweep.is_file():
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
