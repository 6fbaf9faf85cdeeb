"""Writing what was driven and sensed as a 123D log that py123d's own API and viewer open."""

import contextlib
import dataclasses
import datetime
import os
import re
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Float64, Int, UInt8
from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter
from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
from py123d.api.scene.arrow.utils.route_utils import ROUTE_POSITION_KEY
from py123d.api.utils.arrow_metadata_utils import (
    add_metadata_to_arrow_schema,
    get_metadata_from_arrow_schema,
)
from py123d.datatypes import (
    BoxDetectionAttributes,
    BoxDetectionSE3,
    BoxDetectionsSE3,
    Camera,
    CameraID,
    DynamicStateSE3,
    EgoStateSE3,
    EgoStateSE3Metadata,
    Lidar,
    LidarID,
    LidarMetadata,
    LogMetadata,
    MapMetadata,
    PinholeCameraMetadata,
    PinholeIntrinsics,
    RouteMetadata,
    Timestamp,
)
from py123d.datatypes.custom.custom_modality import CustomModality, CustomModalityMetadata
from py123d.datatypes.detections.box_detections_metadata import BoxDetectionsSE3Metadata
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.geometry import BoundingBoxSE3, PoseSE3, Vector3D
from py123d.parser.base_dataset_parser import ModalitiesSync
from py123d.parser.registry import NuScenesBoxDetectionLabel as Label

from foredrive.data.modalities import (
    LIDAR_BEAMS,
    FullOccupancy,
    occupancy_metadata,
    pack_beams,
    pack_occupancy,
)
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.geometry.se3 import log_so3, matrix_from_yaw
from foredrive.scene import Boxes, Category, LidarSweep, VoxelSpec

DATASET = "foredrive"
"""123D's data set name of all that is written here; maps lie at maps/foredrive/foredrive_LOCATION.arrow."""

EGO_VEHICLE = EgoStateSE3Metadata(
    vehicle_name="carla_lincoln_mkz_2020",
    length=4.89238,
    width=1.83671,
    height=1.49028,
    wheel_base=2.86048,
    center_to_imu_se3=PoseSE3(x=1.64855, y=0.0, z=1.49028 / 2, qw=1.0, qx=0.0, qy=0.0, qz=0.0),
    rear_axle_to_imu_se3=PoseSE3.identity(),
)
"""The recording vehicle: CARLA's Lincoln MKZ, its frame on the ground below the rear axle."""

LABEL_OF_CATEGORY = {
    Category.CAR: Label.VEHICLE_CAR,
    Category.TRUCK: Label.VEHICLE_TRUCK,
    Category.BUS: Label.VEHICLE_BUS_RIGID,
    Category.TRAILER: Label.VEHICLE_TRAILER,
    Category.CONSTRUCTION_VEHICLE: Label.VEHICLE_CONSTRUCTION,
    Category.MOTORCYCLE: Label.VEHICLE_MOTORCYCLE,
    Category.BICYCLE: Label.VEHICLE_BICYCLE,
    Category.PEDESTRIAN: Label.HUMAN_PEDESTRIAN_ADULT,
    Category.ANIMAL: Label.ANIMAL,
    Category.TRAFFIC_CONE: Label.MOVABLE_OBJECT_TRAFFICCONE,
    Category.BARRIER: Label.MOVABLE_OBJECT_BARRIER,
    Category.OTHER: Label.MOVABLE_OBJECT_DEBRIS,
}
"""nuScenes' labels, which keep every category apart and which py123d reads without Foredrive."""

_CAMERA_IDS_LEFT = (CameraID.PCAM_L0, CameraID.PCAM_L1, CameraID.PCAM_L2)
_CAMERA_IDS_RIGHT = (CameraID.PCAM_R0, CameraID.PCAM_R1, CameraID.PCAM_R2)
_CAMERA_IDS_SPARE = (CameraID.PCAM_STEREO_L, CameraID.PCAM_STEREO_R, CameraID.PCAM_D0)
_AHEAD_RAD = np.deg2rad(22.5)


@dataclass(frozen=True)
class CameraSpec:
    """A pinhole camera without distortion, fixed to the vehicle."""

    name: str
    K: Float[np.ndarray, "3 3"]
    """px, pixel centres at +0.5."""
    T_ego_cam: Float[np.ndarray, "4 4"]
    size_hw: tuple[int, int]


@dataclass(frozen=True)
class Frame:
    """All that was sensed at one time, with the exact labels."""

    t_us: int
    T_world_ego: Float64[np.ndarray, "4 4"]
    velocity_ego_mps: Float[np.ndarray, "3"]
    acceleration_ego_mps2: Float[np.ndarray, "3"]
    images: dict[str, UInt8[np.ndarray, "_ _ 3"]]
    """RGB by camera name; a camera may be missing."""
    sweep: LidarSweep | None
    """Unbatched, in the ego frame at `t_us`, misses included."""
    boxes: Boxes
    """Unbatched, in the ego frame at `t_us`."""
    occupancy: FullOccupancy | None = None
    lidar_points: Int[np.ndarray, "M"] | None = None
    """Returns from each of `boxes`: 0 where it is hidden; None if they were not counted."""


class LogWriter:
    """Context manager that writes one log; it appears under its final name only on clean exit.

    The log lies at root/logs/SPLIT/NAME and replaces one of that name. The same input gives the same bytes.

    Args:
        root: 123D data root.
        split: ends in _train, _val or _test, which py123d goes by.
        cameras: specs of every camera that may appear in a frame, at most 11.
        map_dir: root/maps with the map of `location` in it (`maps.write_map`); None: the log has no map.
        location: town name, None if there is none.
        route_xyz: the route to follow, world frame, m; None if there is none.

    Raises:
        InputError: on a bad split, too many cameras, a missing map, a frame that does not fit, a NaN pose,
            time that runs backwards, no frames at all.
    """

    def __init__(
        self,
        root: Path,
        split: str,
        log_name: str,
        cameras: list[CameraSpec],
        map_dir: Path | None,
        location: str | None,
        route_xyz: Float[np.ndarray, "M 3"] | None,
    ) -> None:
        if not re.fullmatch(r"[a-z0-9-]+_(train|val|test)", split):
            raise InputError(f"split {split!r} must be lower case and end in _train, _val or _test")
        self.folder = Path(root) / "logs" / split / log_name
        self._metadata = LogMetadata(DATASET, split, log_name, location, _map_metadata(map_dir, location))
        self._cameras = {spec.name: (spec, _camera_metadata(spec, id_)) for spec, id_ in _camera_ids(cameras)}
        self._route_xyz = route_xyz
        self._stack = contextlib.ExitStack()
        self._lidar: LidarMetadata | None = None
        self._spec: VoxelSpec | None = None
        self._previous: Frame | None = None

    def __enter__(self) -> "LogWriter":
        self._final = self._stack.enter_context(atomic_path(self.folder))
        config = LogWriterConfig(
            camera_store_option="jpeg_binary",
            lidar_store_option="binary",
            lidar_codec="ipc_lz4",
            write_route=False,  # a route derived from the driven path is not a route
        )
        scratch = self._final.parent
        self._writer = ArrowLogWriter(config, scratch, scratch)
        self._writer.reset(self._metadata)
        if self._route_xyz is not None:
            self._writer.set_route(self._route_xyz)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            if self._previous is None:
                raise InputError(f"{self.folder}: a log needs at least one frame")
            self._writer.close()
            written = self._final.parent / self._metadata.split / self._metadata.log_name
            _date_route_by(written, self._previous.t_us)
            os.replace(written, self._final)

    def write(self, frame: Frame) -> None:
        """Append a frame; times increase."""
        if not np.isfinite(frame.T_world_ego).all():
            raise InputError(f"{self.folder}: the ego pose at {frame.t_us} µs is not finite")
        if self._previous is not None and frame.t_us <= self._previous.t_us:
            raise InputError(
                f"{self.folder}: time runs backwards, {frame.t_us} µs after {self._previous.t_us} µs"
            )
        modalities = [self._ego_state(frame), _boxes(frame), *self._images(frame)]
        if frame.sweep is not None:
            modalities += self._sweep(frame.t_us, frame.sweep)
        if frame.occupancy is not None:
            modalities.append(self._occupancy(frame.t_us, frame.occupancy))
        self._writer.write_sync(ModalitiesSync(Timestamp.from_us(frame.t_us), modalities))
        self._previous = frame

    def _ego_state(self, frame: Frame) -> EgoStateSE3:
        turn_rate = np.zeros(3)
        if self._previous is not None:
            turned = torch.from_numpy(self._previous.T_world_ego[:3, :3].T @ frame.T_world_ego[:3, :3])
            turn_rate = log_so3(turned).numpy() / ((frame.t_us - self._previous.t_us) * 1e-6)
        return EgoStateSE3.from_rear_axle(
            rear_axle_se3=_pose(frame.T_world_ego),
            metadata=EGO_VEHICLE,
            timestamp=Timestamp.from_us(frame.t_us),
            dynamic_state_se3=DynamicStateSE3(
                velocity=Vector3D.from_array(frame.velocity_ego_mps.astype(np.float64)),
                acceleration=Vector3D.from_array(frame.acceleration_ego_mps2.astype(np.float64)),
                angular_velocity=Vector3D.from_array(turn_rate),
            ),
        )

    def _images(self, frame: Frame) -> list[BaseModality]:
        cameras: list[BaseModality] = []
        for name, image in frame.images.items():
            if name not in self._cameras:
                raise InputError(f"{self.folder}: image of camera {name!r}, which was not declared")
            spec, metadata = self._cameras[name]
            if image.shape[:2] != tuple(spec.size_hw):
                raise InputError(f"{self.folder}: image of {name} is {image.shape[:2]}, not {spec.size_hw}")
            pose = _pose(frame.T_world_ego @ spec.T_ego_cam)
            cameras.append(Camera(metadata, image, pose, Timestamp.from_us(frame.t_us)))
        return cameras

    def _sweep(self, t_us: int, sweep: LidarSweep) -> list[BaseModality]:
        returns = sweep[sweep.valid & sweep.returned]
        if (returns.beam > 255).any():
            raise InputError(f"{self.folder}: 123D holds lidar channels 0 to 255")
        if self._lidar is None:  # static extrinsics, from the beam nearest the frame's time
            position = sweep.origin_ego[sweep.dt_s.abs().argmin()].tolist() if len(sweep.dt_s) else [0, 0, 0]
            self._lidar = LidarMetadata("lidar", LidarID.LIDAR_TOP, PoseSE3(*position, 1, 0, 0, 0))
        dt_us = np.round(returns.dt_s.numpy().astype(np.float64) * 1e6).astype(np.int64)
        features = {
            "intensity": np.round(returns.intensity.numpy() * 255).astype(np.uint8),
            "timestamps": t_us + dt_us,
        }
        if (returns.beam >= 0).all():
            features["channel"] = returns.beam.numpy().astype(np.uint8)
        seen_us = sweep.dt_s[sweep.valid].double() * 1e6
        start_us, end_us = (int(seen_us.min()), int(seen_us.max())) if len(seen_us) else (0, 0)
        lidar = Lidar(
            timestamp=Timestamp.from_us(t_us + start_us),
            timestamp_end=Timestamp.from_us(t_us + end_us),
            metadata=self._lidar,
            point_cloud_3d=returns.points_ego.numpy().astype(np.float32),
            point_cloud_features=features,
        )
        beams = CustomModality(
            pack_beams(sweep), CustomModalityMetadata(LIDAR_BEAMS), Timestamp.from_us(t_us)
        )
        return [lidar, beams]

    def _occupancy(self, t_us: int, occupancy: FullOccupancy) -> CustomModality:
        self._spec = self._spec or occupancy.spec
        if occupancy.spec != self._spec:
            raise InputError(f"{self.folder}: the occupancy grid changes within the log")
        metadata = occupancy_metadata(occupancy.spec)
        return CustomModality(pack_occupancy(occupancy), metadata, Timestamp.from_us(t_us))


def _boxes(frame: Frame) -> BoxDetectionsSE3:
    metadata = BoxDetectionsSE3Metadata(Label)
    R_world_ego = frame.T_world_ego[:3, :3]
    valid = frame.boxes.valid
    boxes = frame.boxes[valid]
    counted = frame.lidar_points
    points = [None] * len(boxes.yaw) if counted is None else counted[valid.numpy()].tolist()
    T_ego_box = matrix_from_yaw(boxes.yaw.double(), boxes.centre.double()).numpy()
    detections = []
    for T, size, velocity, track, category, hits in zip(
        frame.T_world_ego @ T_ego_box,
        boxes.size_lwh.tolist(),
        boxes.velocity.double().numpy(),
        boxes.track_id.tolist(),
        boxes.category.tolist(),
        points,
        strict=True,
    ):
        known = np.isfinite(velocity).all()
        over_ground = Vector3D.from_array(R_world_ego @ [*velocity, 0.0]) if known else None
        attributes = BoxDetectionAttributes(LABEL_OF_CATEGORY[Category(category)], str(track), hits)
        detections.append(BoxDetectionSE3(attributes, BoundingBoxSE3(_pose(T), *size), over_ground))
    return BoxDetectionsSE3(detections, Timestamp.from_us(frame.t_us), metadata)


def _pose(T: Float64[np.ndarray, "4 4"]) -> PoseSE3:
    return PoseSE3.from_transformation_matrix(T)


def _map_metadata(map_dir: Path | None, location: str | None) -> MapMetadata | None:
    if map_dir is None:
        return None
    file = Path(map_dir) / DATASET / f"{DATASET}_{location}.arrow"
    if not file.is_file():
        raise InputError(f"{file}: no such map; write the town's map before its logs")
    with pa.memory_map(str(file)) as source:
        return get_metadata_from_arrow_schema(pa.ipc.open_file(source).schema, MapMetadata)


def _camera_metadata(spec: CameraSpec, camera_id: CameraID) -> PinholeCameraMetadata:
    return PinholeCameraMetadata(
        camera_name=spec.name,
        camera_id=camera_id,
        intrinsics=PinholeIntrinsics.from_camera_matrix(spec.K.astype(np.float64)),
        distortion=None,
        width=spec.size_hw[1],
        height=spec.size_hw[0],
        camera_to_imu_se3=_pose(spec.T_ego_cam.astype(np.float64)),
        is_undistorted=True,
    )


def _camera_ids(cameras: list[CameraSpec]) -> list[tuple[CameraSpec, CameraID]]:
    """Give each camera a 123D id by where it looks: ahead, behind, left and right from front to back."""
    azimuth = {c.name: float(np.arctan2(c.T_ego_cam[1, 2], c.T_ego_cam[0, 2])) for c in cameras}
    spare = [*_CAMERA_IDS_SPARE, *_CAMERA_IDS_LEFT[::-1], *_CAMERA_IDS_RIGHT[::-1]]
    if len(azimuth) < len(cameras):
        raise InputError(f"camera names are not unique: {[c.name for c in cameras]}")
    taken: dict[CameraID, CameraSpec] = {}
    left_over = []
    for camera in sorted(cameras, key=lambda c: abs(azimuth[c.name])):
        angle = azimuth[camera.name]
        if abs(angle) <= _AHEAD_RAD:
            wanted: tuple[CameraID, ...] = (CameraID.PCAM_F0,)
        elif abs(angle) >= np.pi - _AHEAD_RAD:
            wanted = (CameraID.PCAM_B0,)
        else:
            wanted = _CAMERA_IDS_LEFT if angle > 0 else _CAMERA_IDS_RIGHT
        free = [id_ for id_ in wanted if id_ not in taken]
        if free:
            taken[free[0]] = camera
        else:
            left_over.append(camera)
    for camera in left_over:
        free = [id_ for id_ in spare if id_ not in taken]
        if not free:
            raise InputError(f"123D names at most 11 cameras, got {len(cameras)}")
        taken[free[0]] = camera
    return [(camera, id_) for id_, camera in taken.items()]


def _date_route_by(folder: Path, t_us: int) -> None:
    """Date the route file by the log's own last time: py123d stamps it with the wall clock."""
    file = folder / f"{ROUTE_POSITION_KEY}.arrow"
    if not file.is_file():
        return
    with pa.OSFile(str(file)) as source:
        table = pa.ipc.open_file(source).read_all()
    route = get_metadata_from_arrow_schema(table.schema, RouteMetadata)
    when = datetime.datetime.fromtimestamp(t_us // 1_000_000, datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    source_info = dataclasses.replace(route.cache_source_info, computed_at=when)
    route = dataclasses.replace(route, cache_source_info=source_info)
    schema = add_metadata_to_arrow_schema(table.schema, route)
    with pa.OSFile(str(file), "wb") as sink, pa.ipc.new_file(sink, schema) as writer:
        writer.write_table(table.cast(schema))
