"""Writing of drives and their sensor data as 123D logs, which py123d's own API and viewer can open."""

import contextlib
import dataclasses
import datetime
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Float64, UInt8, UInt16
from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter
from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
from py123d.api.scene.arrow.utils.route_utils import ROUTE_POSITION_KEY
from py123d.api.utils.arrow_metadata_utils import (
    add_metadata_to_arrow_schema,
    get_metadata_from_arrow_schema,
)
from py123d.datatypes import (
    Camera,
    DefaultLidarSegmentationLabel,
    DynamicStateSE3,
    EgoStateSE3,
    EgoStateSE3Metadata,
    Lidar,
    LidarID,
    LidarMetadata,
    LogMetadata,
    MapMetadata,
    PinholeCameraMetadata,
    RouteMetadata,
    Timestamp,
    TrafficLightDetection,
    TrafficLightDetections,
    TrafficLightStatus,
)
from py123d.datatypes.custom.custom_modality import CustomModality, CustomModalityMetadata
from py123d.datatypes.modalities.base_modality import BaseModality
from py123d.datatypes.sensors.base_camera import BaseCameraMetadata
from py123d.geometry import PoseSE3, Vector3D
from py123d.parser.base_dataset_parser import ModalitiesSync, ParsedCamera

from foredrive.data.camera_streams import (
    CameraSpec,
    camera_ids,
    camera_metadata,
    depth_metadata,
    instance_metadata,
    semantic_metadata,
)
from foredrive.data.images import image_size
from foredrive.data.modalities import (
    CAPTION,
    EXPERT_PLAN,
    LIDAR_BEAMS,
    SETTING,
    SIGNAL_LAMPS,
    FullOccupancy,
    occupancy_metadata,
    pack_beams,
    pack_lamps,
    pack_occupancy,
    pack_plan,
    visibility_modality,
)
from foredrive.data.notices import write_notices
from foredrive.data.setting import Setting, pack_setting
from foredrive.data.written_boxes import box_modalities
from foredrive.debugging import profile_step
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.geometry.se3 import log_so3
from foredrive.scene import Boxes, LidarSweep, Trajectory, VoxelSpec

DATASET = "foredrive"
"""123D dataset name of all logs written here. Maps are at maps/foredrive/foredrive_LOCATION.arrow."""

EGO_VEHICLE = EgoStateSE3Metadata(
    vehicle_name="carla_lincoln_mkz_2020",
    length=4.89238,
    width=1.83671,
    height=1.49028,
    wheel_base=2.86048,
    center_to_imu_se3=PoseSE3(x=1.64855, y=0.0, z=1.49028 / 2, qw=1.0, qx=0.0, qy=0.0, qz=0.0),
    rear_axle_to_imu_se3=PoseSE3.identity(),
)
"""The recording vehicle: CARLA's Lincoln MKZ. Its frame is on the ground below the rear axle."""


@dataclass(frozen=True)
class Frame:
    """Sensor data of one time, with the exact labels."""

    t_us: int
    T_world_ego: Float64[np.ndarray, "4 4"]
    velocity_ego_mps: Float[np.ndarray, "3"]
    acceleration_ego_mps2: Float[np.ndarray, "3"]
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"] | bytes]
    """RGB by camera name, or the bytes of a JPEG, which are kept. A camera may be missing."""
    sweep: LidarSweep | None
    """Unbatched, in the ego frame at `t_us`, with the misses."""
    boxes: Boxes | None
    """Unbatched, in the ego frame at `t_us`; None if the frame is not annotated. Their `visibility` is not
    written, but that of the frame is."""
    _: KW_ONLY
    exposed: dict[str, tuple[int, Float64[np.ndarray, "4 4"]]] = field(default_factory=dict)
    """Time (µs) and ego pose of the images that were not taken at `t_us`, by camera name."""
    misses_known: bool = True
    """Whether `sweep` has the beams that did not return. Otherwise the origins of its beams are not written
    either: they follow from the vehicle's path."""
    occupancy: FullOccupancy | None = None
    visibility: Float[np.ndarray, "M"] | None = None
    """For each of `boxes`, the visible area relative to the area without occlusion, 0 to 1."""
    setting: Setting | None = None
    caption: str | None = None
    expert_plan: Trajectory | None = None
    """Plan of the expert from here, unbatched, in the ego frame at `t_us`."""
    traffic_lights: dict[int, TrafficLightStatus] | None = None
    """States of the traffic lights, by the map ids of the lanes behind their stop lines."""
    signal_lamps: Mapping[int, Float[np.ndarray, "_ 3"]] | None = None
    """Places of the lamps of lights around the vehicle in the world frame, m, by the same ids."""
    depth_m: dict[str, Float[np.ndarray, "_ _"]] = field(default_factory=dict)
    """Depth along the optical axis by camera name; infinite for the sky."""
    semantic: dict[str, UInt8[np.ndarray, "_ _"]] = field(default_factory=dict)
    """`DefaultCameraSegmentationLabel`s by camera name."""
    instance: dict[str, UInt16[np.ndarray, "_ _"]] = field(default_factory=dict)
    """Track ids by camera name; 0 outside all boxes."""
    beam_semantic: UInt8[np.ndarray, "N"] | None = None
    """`DefaultLidarSegmentationLabel`s of the beams of `sweep`."""
    beam_instance: UInt16[np.ndarray, "N"] | None = None
    """Track ids of the beams of `sweep`."""


class LogWriter:
    """A context manager that writes one log. The log gets its final name only on a clean exit.

    The log is at root/logs/SPLIT/NAME and replaces a log of that name. The same input gives the same bytes.

    Args:
        root: 123D data root.
        split: name that ends in _train, _val or _test, as py123d requires.
        cameras: all cameras that may appear in a frame, at most 11.
        map_dir: root/maps with the map of `location` (`maps.write_map`). None if the log has no map.
        location: town name, or None.
        route_xyz: route to follow, world frame, m, or None.
        vehicle: the recording vehicle.
        dataset: 123D name of the data set.

    Raises:
        InputError: the split is invalid, there are too many cameras, the map is missing, a frame does not
            fit, a pose is NaN, time runs backwards, or there are no frames.
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
        *,
        vehicle: EgoStateSE3Metadata = EGO_VEHICLE,
        dataset: str = DATASET,
    ) -> None:
        if not re.fullmatch(r"[a-z0-9-]+_(train|val|test)", split):
            raise InputError(f"split {split!r} must be lower case and end in _train, _val or _test")
        self.folder = Path(root) / "logs" / split / log_name
        self._metadata = LogMetadata(dataset, split, log_name, location, _map_metadata(map_dir, location))
        self._vehicle = vehicle
        self._cameras = {spec.name: (spec, camera_metadata(spec, id_)) for spec, id_ in camera_ids(cameras)}
        self._route_xyz = route_xyz
        self._stack = contextlib.ExitStack()
        self._lidar: LidarMetadata | None = None
        self._spec: VoxelSpec | None = None
        self._previous: Frame | None = None

    def __enter__(self) -> "LogWriter":
        self._final = self._stack.enter_context(atomic_path(self.folder, alone=True))
        config = LogWriterConfig(
            camera_store_option="jpeg_binary",
            lidar_store_option="binary",
            lidar_codec="ipc_lz4",
            write_route=False,  # It would be derived from the driven path, which is not a provided route
        )
        # py123d writes SCRATCH/SPLIT/NAME; the folder is moved to its final place at the end
        scratch = self._final.parent
        self._writer = ArrowLogWriter(config, scratch, scratch)
        self._writer.reset(self._metadata)
        if self._route_xyz is not None:
            self._writer.set_route(self._route_xyz)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # After an error the scratch folder is removed, and a log of the same name stays
        if kind is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            if self._previous is None:
                raise InputError(f"{self.folder}: a log needs at least one frame")
            self._writer.close()
            written = self._final.parent / self._metadata.split / self._metadata.log_name
            _date_route_by(written, self._previous.t_us)
            write_notices(written)
            os.replace(written, self._final)

    def write(self, frame: Frame) -> None:
        """Append a frame. Times must increase."""
        profile_step()
        if not np.isfinite(frame.T_world_ego).all():
            raise InputError(f"{self.folder}: the ego pose at {frame.t_us} µs is not finite")
        if self._previous is not None and frame.t_us <= self._previous.t_us:
            raise InputError(
                f"{self.folder}: time runs backwards, {frame.t_us} µs after {self._previous.t_us} µs"
            )
        modalities = [self._ego_state(frame), *self._images(frame), *self._label_images(frame)]
        if frame.boxes is not None:
            modalities += box_modalities(frame.boxes, frame.T_world_ego, frame.t_us)
        if frame.sweep is not None:
            modalities += self._sweep(frame, frame.sweep)
        if frame.occupancy is not None:
            modalities.append(self._occupancy(frame.t_us, frame.occupancy))
        if frame.visibility is not None:
            shares = frame.visibility.tolist()
            modalities.append(visibility_modality(shares, Timestamp.from_us(frame.t_us)))
        if frame.setting is not None:
            modalities.append(_custom(frame, SETTING, pack_setting(frame.setting)))
        if frame.caption is not None:
            modalities.append(_custom(frame, CAPTION, {"text": frame.caption}))
        if frame.signal_lamps is not None:
            modalities.append(_custom(frame, SIGNAL_LAMPS, pack_lamps(frame.signal_lamps)))
        if frame.expert_plan is not None:
            modalities.append(_custom(frame, EXPERT_PLAN, pack_plan(frame.expert_plan)))
        if frame.traffic_lights is not None:
            lights = [TrafficLightDetection(*shown) for shown in sorted(frame.traffic_lights.items())]
            modalities.append(TrafficLightDetections(lights, Timestamp.from_us(frame.t_us)))
        self._writer.write_sync(ModalitiesSync(Timestamp.from_us(frame.t_us), modalities))
        self._previous = frame

    def _ego_state(self, frame: Frame) -> EgoStateSE3:
        turn_rate = np.zeros(3)
        if self._previous is not None:
            # The mean turn rate since the previous frame, in the ego axes
            turned = torch.from_numpy(self._previous.T_world_ego[:3, :3].T @ frame.T_world_ego[:3, :3])
            turn_rate = log_so3(turned).numpy() / ((frame.t_us - self._previous.t_us) * 1e-6)
        return EgoStateSE3.from_rear_axle(
            rear_axle_se3=_pose(frame.T_world_ego),
            metadata=self._vehicle,
            timestamp=Timestamp.from_us(frame.t_us),
            dynamic_state_se3=DynamicStateSE3(
                velocity=Vector3D.from_array(frame.velocity_ego_mps.astype(np.float64)),
                acceleration=Vector3D.from_array(frame.acceleration_ego_mps2.astype(np.float64)),
                angular_velocity=Vector3D.from_array(turn_rate),
            ),
        )

    def _images(self, frame: Frame) -> Iterator[BaseModality]:
        for name, image in frame.images.items():
            size_hw = image_size(image) if isinstance(image, bytes) else image.shape[:2]
            yield self._camera(frame, self._declared(name, size_hw), image)

    def _label_images(self, frame: Frame) -> Iterator[Camera]:
        for name, depth_m in frame.depth_m.items():
            depth = depth_metadata(self._declared(name, depth_m.shape))
            yield self._camera(frame, depth, depth.encode_depth(depth_m))
        for name, label in frame.semantic.items():
            yield self._camera(frame, semantic_metadata(self._declared(name, label.shape)), label)
        for name, track_id in frame.instance.items():
            yield self._camera(frame, instance_metadata(self._declared(name, track_id.shape)), track_id)

    def _declared(self, name: str, size_hw: tuple[int, ...]) -> PinholeCameraMetadata:
        """Return the metadata of an image's camera.

        Raises:
            InputError: the camera was not declared, or the image has another size.
        """
        if name not in self._cameras:
            raise InputError(f"{self.folder}: image of camera {name!r}, which was not declared")
        spec, metadata = self._cameras[name]
        if size_hw != tuple(spec.size_hw):
            raise InputError(f"{self.folder}: image of {name} is {size_hw}, not {spec.size_hw}")
        return metadata

    def _camera(
        self, frame: Frame, metadata: BaseCameraMetadata, image: np.ndarray | bytes
    ) -> Camera | ParsedCamera:
        spec, _ = self._cameras[metadata.camera_name]
        t_us, T_world_ego = frame.exposed.get(spec.name, (frame.t_us, frame.T_world_ego))
        T_world_cam, exposed = _pose(T_world_ego @ spec.T_ego_cam), Timestamp.from_us(t_us)
        if isinstance(image, bytes):
            return ParsedCamera(metadata, exposed, T_world_cam, byte_string=image)
        return Camera(metadata, image, T_world_cam, exposed)

    def _sweep(self, frame: Frame, sweep: LidarSweep) -> list[BaseModality]:
        t_us, kept = frame.t_us, sweep.valid & sweep.returned
        returns = sweep[kept]
        if (returns.beam > 255).any():
            raise InputError(f"{self.folder}: 123D stores only the lidar channels 0 to 255")
        if self._lidar is None:  # Static extrinsics, from the beam nearest to the frame's time
            position = sweep.origin_ego[sweep.dt_s.abs().argmin()].tolist() if len(sweep.dt_s) else [0, 0, 0]
            classes = None if frame.beam_semantic is None else DefaultLidarSegmentationLabel
            self._lidar = LidarMetadata("lidar", LidarID.LIDAR_TOP, PoseSE3(*position, 1, 0, 0, 0), classes)
        dt_us = np.round(returns.dt_s.numpy().astype(np.float64) * 1e6).astype(np.int64)
        features = {
            "intensity": np.round(returns.intensity.numpy() * 255).astype(np.uint8),
            "timestamps": t_us + dt_us,
        }
        # A negative channel is unknown
        if (returns.beam >= 0).all():
            features["channel"] = returns.beam.numpy().astype(np.uint8)
        if frame.beam_semantic is not None:
            features["semantic"] = frame.beam_semantic[kept.numpy()]
        if frame.beam_instance is not None:
            features["instance"] = frame.beam_instance[kept.numpy()]
        # Start and end include the beams that did not return
        seen_us = sweep.dt_s[sweep.valid].double() * 1e6
        start_us, end_us = (int(seen_us.min()), int(seen_us.max())) if len(seen_us) else (0, 0)
        lidar = Lidar(
            timestamp=Timestamp.from_us(t_us + start_us),
            timestamp_end=Timestamp.from_us(t_us + end_us),
            metadata=self._lidar,
            point_cloud_3d=returns.points_ego.numpy().astype(np.float32),
            point_cloud_features=features,
        )
        return [lidar, _custom(frame, LIDAR_BEAMS, pack_beams(sweep))] if frame.misses_known else [lidar]

    def _occupancy(self, t_us: int, occupancy: FullOccupancy) -> CustomModality:
        self._spec = self._spec or occupancy.spec
        if occupancy.spec != self._spec:
            raise InputError(f"{self.folder}: the occupancy grid changes within the log")
        metadata = occupancy_metadata(occupancy.spec)
        return CustomModality(pack_occupancy(occupancy), metadata, Timestamp.from_us(t_us))


def _custom(frame: Frame, kind: str, data: dict[str, Any]) -> CustomModality:
    return CustomModality(data, CustomModalityMetadata(kind), Timestamp.from_us(frame.t_us))


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


def _date_route_by(folder: Path, t_us: int) -> None:
    """Set the date of the route file to the log's last time, because py123d writes the wall-clock time."""
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
