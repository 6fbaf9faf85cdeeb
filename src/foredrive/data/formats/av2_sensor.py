"""123D parser of Argoverse 2 sensor logs, whole or with parts missing.

py123d's own parser steps from sweep to sweep and stops where a camera, a calibration or a sweep is missing.
It writes empty frames of boxes where a log has no annotations, as in the test split. Here each time of a
sweep or of annotations is a frame, and a frame lacks only the data that is missing in the log.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
from jaxtyping import Float64, Int64
from numpy import ndarray
from py123d.datatypes import (
    BoxDetectionAttributes,
    BoxDetectionSE3,
    BoxDetectionsSE3,
    EgoStateSE3,
    LidarID,
    LidarMergedMetadata,
    LidarMetadata,
    LogMetadata,
    PinholeCameraMetadata,
    Timestamp,
)
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.geometry import BoundingBoxSE3, PoseSE3
from py123d.geometry.transform import rel_to_abs_se3_array
from py123d.geometry.transform.transform_se3 import rel_to_abs_se3
from py123d.parser.av2 import av2_sensor_parser
from py123d.parser.av2.av2_map_parser import Av2MapParser, get_av2_map_metadata
from py123d.parser.av2.utils.av2_constants import (
    AV2_SENSOR_BOX_DETECTIONS_SE3_METADATA,
    AV2_SENSOR_EGO_STATE_SE3_METADATA,
)
from py123d.parser.base_dataset_parser import BaseLogParser, ModalitiesSync, ParsedCamera, ParsedLidar
from py123d.parser.registry import AV2SensorBoxDetectionLabel

from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.notices import note

_POSE = ["tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz"]
_SIZE = ["length_m", "width_m", "height_m"]
_EGO_CATEGORY = "EGO_VEHICLE"
_SWEEP_NS = 100_000_000
"""A sweep's time is that of its start; a frame has the first image of each camera within its sweep."""
_LIDARS = {LidarID.LIDAR_TOP: "up_lidar", LidarID.LIDAR_DOWN: "down_lidar"}
_MOUNTS, _LENSES = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"


class Av2SensorParser(BaseLogParser):
    """Parser of an AV2 sensor log.

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
        """Yield the ego pose at each time of a sweep or of annotations, with the data of that time."""
        poses = _poses(self._folder)
        annotations = _annotations(self._folder)
        sweeps, lidars = self._sweeps()
        frames_ns = sorted({*annotations, *sweeps})
        cameras = self._cameras(frames_ns)
        _note_missing("frames", "missing", frames_ns, frames_ns)
        for t_ns in frames_ns:
            pose = poses.get(t_ns)
            if pose is None:
                note("city_SE3_egovehicle.feather", "times without a pose, left out", f"{t_ns} ns")
                continue
            timestamp = Timestamp.from_ns(t_ns)
            modalities: list[BaseModality] = [
                EgoStateSE3.from_imu(pose, AV2_SENSOR_EGO_STATE_SE3_METADATA, timestamp)
            ]
            if t_ns in annotations:
                modalities.append(_boxes(annotations[t_ns], pose, timestamp))
            elif annotations:
                note("annotations", "frames without boxes", f"{t_ns} ns")
            if t_ns in sweeps:
                end = Timestamp.from_ns(t_ns + _SWEEP_NS)
                relative = sweeps[t_ns].relative_to(self._folder)
                metadata = LidarMergedMetadata(lidars)
                modalities.append(ParsedLidar(metadata, timestamp, end, self._folder, relative_path=relative))
            elif sweeps:
                note("lidar", "missing sweeps", f"{t_ns} ns")
            modalities += [
                image for camera in cameras if (image := camera.image(t_ns, poses, self._folder)) is not None
            ]
            yield ModalitiesSync(timestamp, modalities)

    def _sweeps(self) -> tuple[dict[int, Path], dict[LidarID, LidarMetadata]]:
        """Return the sweeps by time, ns, and the calibrated lidars. Both are empty if either is missing."""
        sweeps = _files_by_time(self._folder / "sensors" / "lidar", ".feather")
        mounts = self._folder / _MOUNTS
        if not sweeps:
            note("lidar", "no sweeps")
            return {}, {}
        if not mounts.is_file():
            note("lidar", f"left out; {_MOUNTS} is missing")
            return {}, {}
        table = feather.read_table(mounts)
        mounted = dict(zip(table["sensor_name"].to_pylist(), _columns(table, _POSE), strict=True))
        return sweeps, {
            id_: LidarMetadata(name, id_, PoseSE3.from_array(mounted[name]))
            for id_, name in _LIDARS.items()
            if name in mounted
        }

    def _cameras(self, frames_ns: Sequence[int]) -> list["_Camera"]:
        """Return the cameras that have images and a calibration; the others are named in notices."""
        folders = {
            path.name: path for path in sorted(self._folder.glob("sensors/cameras/*")) if path.is_dir()
        }
        if not folders:
            note("cameras", "no images; sensors/cameras is missing or empty")
            return []
        lacking = [name for name in (_MOUNTS, _LENSES) if not (self._folder / name).is_file()]
        if lacking:
            note("cameras", f"left out; without {', '.join(lacking)}")
            return []
        calibrated = av2_sensor_parser._get_av2_pinhole_camera_metadatas(self._folder)
        metadata = {camera.camera_name: camera for camera in calibrated.values()}
        for name in sorted(folders.keys() - metadata.keys()):
            note(name, "left out; without a calibration")
        cameras = []
        for name, camera in metadata.items():
            images = _files_by_time(folders[name], ".jpg") if name in folders else {}
            if not images:
                note(name, f"no images; sensors/cameras/{name} is missing or empty")
                continue
            _note_missing(name, "missing images", list(images), frames_ns)
            cameras.append(_Camera(camera, images, np.array(list(images), np.int64)))
        return cameras


@dataclass(frozen=True)
class _Camera:
    """A camera with its images by time, ns, in order."""

    metadata: PinholeCameraMetadata
    images: dict[int, Path]
    times_ns: Int64[ndarray, "N"]

    def image(self, t_ns: int, poses: dict[int, PoseSE3], root: Path) -> ParsedCamera | None:
        """Return the first image from the start of a sweep to its end. None: there is none with a pose."""
        # The first image at or after the start of the sweep
        n = int(np.searchsorted(self.times_ns, t_ns))
        if n == len(self.times_ns) or self.times_ns[n] - t_ns >= _SWEEP_NS:
            return None
        exposed_ns = int(self.times_ns[n])
        if exposed_ns not in poses:
            note(self.metadata.camera_name, "images without a pose, left out", f"{exposed_ns} ns")
            return None
        return ParsedCamera(
            metadata=self.metadata,
            timestamp=Timestamp.from_ns(exposed_ns),
            # The vehicle moves within a sweep, so the camera's pose is that of its own exposure
            camera_to_global_se3=rel_to_abs_se3(poses[exposed_ns], self.metadata.camera_to_imu_se3),
            dataset_root=root,
            relative_path=self.images[exposed_ns].relative_to(root),
        )


def _poses(log: Path) -> dict[int, PoseSE3]:
    """Return the ego pose at each time, ns."""
    table = feather.read_table(log / "city_SE3_egovehicle.feather")
    poses = map(PoseSE3.from_array, _columns(table, _POSE))
    return dict(zip(table["timestamp_ns"].to_pylist(), poses, strict=True))


def _annotations(log: Path) -> dict[int, pa.Table]:
    """Return the annotated boxes by time, ns; none, with a notice, where the log has no annotations."""
    file = next(iter(sorted(log.glob("annotations*.feather"))), None)
    if file is None:
        note("annotations", "missing; the log has no boxes")
        return {}
    table = feather.read_table(file).sort_by("timestamp_ns")
    # Rows are sorted by time, so each time has a contiguous slice of rows
    times_ns, start = np.unique(table["timestamp_ns"].to_numpy(), return_index=True)
    ends = [*start[1:], len(table)]
    return {int(t): table.slice(a, b - a) for t, a, b in zip(times_ns, start, ends, strict=True)}


def _files_by_time(folder: Path, suffix: str) -> dict[int, Path]:
    """Return the files whose names are times, ns, in the order of time."""
    return dict(sorted((int(f.stem), f) for f in folder.glob(f"[0-9]*{suffix}") if f.stem.isdecimal()))


def _note_missing(subject: str, text: str, times_ns: Sequence[int], frames_ns: Sequence[int]) -> None:
    """Note where a sensor has no data between the first and the last frame, judged by its own period."""
    if not frames_ns:
        return
    steps_ns = np.diff(times_ns)
    period_ns = float(np.median(steps_ns)) if len(steps_ns) > 1 else float(_SWEEP_NS)
    # A step of n periods lacks n - 1 items
    missing = np.round(steps_ns / period_ns).astype(np.int64) - 1
    before, after = ((times_ns[0] - frames_ns[0]) // period_ns, (frames_ns[-1] - times_ns[-1]) // period_ns)
    for start_ns, count in zip([frames_ns[0], *times_ns], [before, *missing, after], strict=True):
        for _ in range(int(count)):
            note(subject, text, f"after {start_ns} ns")


def _boxes(rows: pa.Table, ego: PoseSE3, timestamp: Timestamp) -> BoxDetectionsSE3:
    """Return the boxes of one time, without the ego vehicle. AV2 has no velocities."""
    box = _columns(rows, _POSE + _SIZE)
    # AV2's boxes are in the ego frame at their time
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


def find_av2(source: Path) -> Iterator[RawLog]:
    """Yield the raw logs of a folder: of its root, of one log, or of one or two levels above them."""
    for folder in folders_with(source, "city_SE3_egovehicle.feather"):
        kind = folder.parent.name if folder.parent.name in ("train", "val", "test") else "val"
        split = f"av2-sensor_{kind}"
        yield RawLog(folder, Av2SensorParser(folder, split), Av2MapParser(folder, split))
