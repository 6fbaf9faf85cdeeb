"""Sequences in NVIDIA's NCore v4 format, read with its own library.

A frame is a sweep of the lidar with most rays, at the time of its end, or an image of the camera with most
images. Ego frame and camera frames are those of NCore. Lenses other than pinholes with OpenCV's five
coefficients become ideal pinholes by the library's camera models.
"""

import importlib.util
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float64, Int64, Shaped, UInt8
from py123d.datatypes import LogMetadata
from scipy.spatial.transform import Rotation

from foredrive.data.camera_streams import CameraSpec
from foredrive.data.category_names import category_or_other
from foredrive.data.formats.guard import DEFAULT_PERIOD_S, PartSequence, nearest_parts
from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.images import check_size, image_size, read_rgb, whole_jpeg
from foredrive.data.lidar import concatenate
from foredrive.data.log_paths import LogPath
from foredrive.data.notices import note
from foredrive.data.own_logs import Box, Vehicle, write_log
from foredrive.errors import InputError
from foredrive.scene import LidarSweep

if TYPE_CHECKING:
    from ncore.data import CameraModelParameters
    from ncore.data.v4 import SequenceLoaderV4

RIG, WORLD = "rig", "world"
VEHICLE = "vehicle-bbox"
"""Key of the vehicle's box in the data of a sequence, as in NVIDIA's own clips."""
OF_FOREDRIVE = "foredrive"
"""Key of what an export keeps beside NCore's own data: times of frames, annotated frames, wheelbase."""
FRAME_TIMES, ANNOTATED, WHEELBASE = "frame_timestamps_us", "annotated_timestamps_us", "wheelbase_m"
FREE_RANGE, VELOCITY = "free_range_m", "velocity_world_mps"
"""Names of what an export adds to its sweeps and to its boxes."""
_SPLIT = "ncore_train"
_STORES = "*.ncore4*.zarr*"
_MAX_FOV_RAD = np.deg2rad(110.0)
"""Largest field of view of an image that is made a pinhole's."""


def find_ncore(source: Path) -> Iterator[RawLog]:
    """Yield the sequences of a folder. The stores of a sequence are files or folders BASE.ncore4*.zarr*.

    If BASE.json is beside them, it says which stores belong to the sequence.

    Raises:
        InputError: the package of the format is not installed.
    """
    for folder in folders_with(source, _STORES):
        bases = sorted({store.name.partition(".ncore4")[0] for store in folder.glob(_STORES)})
        for base in bases:
            yield RawLog(folder, NCoreLog(folder, base))


@dataclass(frozen=True)
class NCoreLog:
    """One sequence, as a log that writes itself."""

    folder: Path
    base: str
    """Beginning of the names of its stores."""

    def get_log_metadata(self) -> LogMetadata:
        """Return split and name of the log: that of its stores."""
        name = re.sub(r"[^\w.-]", "-", self.base)
        return LogMetadata("own", _SPLIT, name, location=None)

    def write(self, out: Path, tick: Callable[[], None]) -> LogPath:
        """Read poses, calibrations and boxes first, then images and sweeps one at a time."""
        sequence = open_sequence(self.folder, self.base)
        kept: dict[str, Any] = sequence.generic_meta_data.get(OF_FOREDRIVE, {})
        path_us, path = _path(sequence)
        t_us = _frame_times(sequence, kept)
        inside = (t_us >= path_us[0]) & (t_us <= path_us[-1])
        if not inside.any():
            raise InputError("no frame lies in the time of the poses")
        t_us = t_us[inside]
        T_world_ego = sequence.pose_graph.evaluate_poses(RIG, WORLD, t_us.astype(np.uint64))
        cameras = {name: _Images(sequence, name, t_us) for name in _cameras(sequence)}
        sweeps = _Sweeps(sequence, t_us, T_world_ego) if _lidars(sequence) else None
        # A sensor of which nothing can be read is an error
        for parts in [*cameras.values(), *([] if sweeps is None else [sweeps])]:
            parts.check()
        if sequence.radar_ids:
            note("radars", f"not read: {', '.join(sequence.radar_ids)}")
        return write_log(
            out,
            self.get_log_metadata().log_name,
            t_us * 1e-6,
            T_world_ego,
            cameras=[images.spec for images in cameras.values()],
            images=cameras,
            image_t_s={name: images.t_us * 1e-6 for name, images in cameras.items()},
            sweeps=sweeps,
            boxes=_boxes(sequence, t_us, T_world_ego, kept),
            vehicle=_vehicle(sequence, kept),
            path=(path_us * 1e-6, path),
            split=_SPLIT,
            tick=tick,
        )


def open_sequence(folder: Path, base: str) -> "SequenceLoaderV4":
    """Open the stores of a sequence, or those that BASE.json beside them names.

    Raises:
        InputError: the package of the format is missing, or the sequence has no poses of the rig.
    """
    if importlib.util.find_spec("ncore") is None:
        raise InputError("NCore needs the package nvidia-ncore: pip install 'foredrive[ncore]'")
    import numcodecs.registry
    from ncore.data import v4

    # A store names the codecs of its arrays; this one would unpickle what is in the file
    numcodecs.registry.codec_registry.pop("pickle", None)
    summary = folder / f"{base}.json"
    stores = [summary] if summary.is_file() else sorted(folder.glob(f"{base}.ncore4*.zarr*"))
    reader = v4.SequenceComponentGroupsReader(stores)

    def instance(component: Any) -> str | None:
        names = list(reader.open_component_readers(component.Reader))
        return "default" if "default" in names else next(iter(names), None)

    poses, intrinsics = instance(v4.PosesComponent), instance(v4.IntrinsicsComponent)
    if poses is None or intrinsics is None:
        raise InputError(f"{base}: the sequence has no {'poses' if poses is None else 'intrinsics'}")
    return v4.SequenceLoaderV4(reader, poses, intrinsics, None, instance(v4.CuboidsComponent))


def _path(sequence: "SequenceLoaderV4") -> tuple[Int64[np.ndarray, "P"], Float64[np.ndarray, "P 4 4"]]:
    """Return times and poses of the rig in the world, as they are stored."""
    edges = dict(sequence._poses_reader.get_dynamic_poses())
    if (RIG, WORLD) in edges:
        poses, times = edges[RIG, WORLD]
    elif (WORLD, RIG) in edges:
        inverse, times = edges[WORLD, RIG]
        poses = np.linalg.inv(inverse)
    else:
        names = ", ".join(f"{source} to {target}" for source, target in edges) or "none"
        raise InputError(f"no moving pose of {RIG} in {WORLD}; there are: {names}")
    return times.astype(np.int64), poses.astype(np.float64)


def _frame_times(sequence: "SequenceLoaderV4", kept: dict[str, Any]) -> Int64[np.ndarray, "T"]:
    """Return the times of the frames: those of an export, else of the sensor with most data."""
    if FRAME_TIMES in kept:
        return np.array(kept[FRAME_TIMES], dtype=np.int64)
    lidars = _lidars(sequence)
    if lidars:
        return max((one.frames_timestamps_us[:, 1] for one in lidars), key=len).astype(np.int64)
    cameras = _cameras(sequence)
    if not cameras:
        raise InputError("the sequence has neither images nor sweeps")
    return max((_exposures(sequence, name)[0] for name in cameras), key=len)


def _lidars(sequence: "SequenceLoaderV4") -> list[Any]:
    """Return the lidars that have sweeps."""
    lidars = (sequence.get_lidar_sensor(name) for name in sorted(sequence.lidar_ids))
    return [lidar for lidar in lidars if lidar.frames_count]


def _cameras(sequence: "SequenceLoaderV4") -> list[str]:
    """Return the names of the cameras that have images; a notice tells of the others."""
    names = []
    for name in sorted(sequence.camera_ids):
        if sequence.get_camera_sensor(name).frames_count:
            names.append(name)
        else:
            note(name, "left out; without images")
    return names


def _exposures(sequence: "SequenceLoaderV4", camera: str) -> tuple[Int64[np.ndarray, "N"], float]:
    """Return when the middle row of each image is exposed, and the time from first to last row, s.

    NCore gives begin and end of each image. An image of a global shutter belongs to its begin, as in the
    library's own projections.
    """
    from ncore.data import ShutterType

    sensor = sequence.get_camera_sensor(camera)
    span_us, shutter = sensor.frames_timestamps_us.astype(np.int64), sensor.model_parameters.shutter_type
    if shutter == ShutterType.GLOBAL:
        return span_us[:, 0], 0.0
    middle_us = span_us.mean(axis=1).round().astype(np.int64)
    readout_s = float(np.median(np.diff(span_us, axis=1))) * 1e-6
    if shutter == ShutterType.ROLLING_TOP_TO_BOTTOM:
        return middle_us, readout_s
    if shutter == ShutterType.ROLLING_BOTTOM_TO_TOP:
        return middle_us, -readout_s
    note(camera, f"shutter {shutter.name} was read as a global one")
    return middle_us, 0.0


def _vehicle(sequence: "SequenceLoaderV4", kept: dict[str, Any]) -> Vehicle:
    """Return the size of the vehicle. A car of middle size is assumed where the sequence has none."""
    box: Any = sequence.generic_meta_data.get(VEHICLE)
    usual = Vehicle()
    if not isinstance(box, dict) or not {"centroid", "dim"} <= box.keys():
        note("vehicle", f"no {VEHICLE}; a car of {usual.length_m} x {usual.width_m} m is assumed")
        return usual
    length_m, width_m, height_m = (float(value) for value in box["dim"])
    if WHEELBASE not in kept:
        note("vehicle", f"no wheelbase; {usual.wheelbase_m} m is assumed")
    wheelbase_m = float(kept.get(WHEELBASE, usual.wheelbase_m))
    return Vehicle(length_m, width_m, height_m, wheelbase_m, float(box["centroid"][0]))


class _Images(PartSequence):
    """The images of a camera beside each frame, read when they are asked for."""

    def __init__(self, sequence: "SequenceLoaderV4", name: str, t_us: Int64[np.ndarray, "T"]) -> None:
        super().__init__(name, "images", len(t_us))
        self._sensor = sequence.get_camera_sensor(name)
        # NCore's evaluate_poses(a, b) maps points from a to b
        at_us = t_us[:1].astype(np.uint64)
        (T_rig_cam,) = sequence.pose_graph.evaluate_poses(name, RIG, at_us).astype(np.float64)
        taken_us, readout_s = _exposures(sequence, name)
        self._rows, self._near = nearest_parts(_frames_of(self._sensor.camera_reader, taken_us), t_us)
        self.t_us = np.where(self._near, taken_us[self._rows], t_us)
        K, dist, self._rectified = _pinhole(self._sensor.model_parameters, name)
        width, height = (int(size) for size in self._sensor.model_parameters.resolution)
        self.spec = CameraSpec(name, K, T_rig_cam, (height, width), readout_s, dist)
        masks = list(self._sensor.get_mask_images())
        if masks:
            note(name, f"masks, not read: {', '.join(masks)}")

    def _part(self, frame: int) -> UInt8[np.ndarray, "H W 3"] | bytes | None:
        if not self._near[frame]:
            return None
        row = int(self._rows[frame])
        return self._read(f"{self.t_us[frame]} µs", lambda: self._image(row))

    def _image(self, row: int) -> UInt8[np.ndarray, "H W 3"] | bytes:
        data = bytes(self._sensor.get_frame_data(row).get_encoded_image_data())
        if self._rectified is None and whole_jpeg(data) is not None:
            height, width = image_size(data)
            if (height, width) != self.spec.size_hw:
                raise InputError(f"an image of {width} x {height} px; the calibration has another size")
            return data
        image = check_size(read_rgb(data), self.spec.size_hw)
        return image if self._rectified is None else self._rectified(image)


def _pinhole(
    lens: "CameraModelParameters", name: str
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "5"] | None, Callable[[Any], Any] | None]:
    """Return K, OpenCV's k1 k2 p1 p2 k3 if there are any, and what makes an image a pinhole's if need be."""
    from ncore import sensors
    from ncore.data import IdealPinholeCameraModelParameters, OpenCVPinholeCameraModelParameters

    pinhole, dist, rectified = lens, None, None
    simple = lens.external_distortion_parameters is None
    if simple and isinstance(lens, OpenCVPinholeCameraModelParameters):
        simple = not lens.radial_coeffs[3:].any() and not lens.thin_prism_coeffs.any()
        if simple and not lens.is_distortion_free:
            dist = np.array([*lens.radial_coeffs[:2], *lens.tangential_coeffs, lens.radial_coeffs[2]])
    else:
        simple = simple and isinstance(lens, IdealPinholeCameraModelParameters)
    if not simple:
        # The widest pinhole that still looks like one: its edges stretch with the field of view
        natural = IdealPinholeCameraModelParameters.natural_fov(lens)
        fov = None if natural.max() <= _MAX_FOV_RAD else float(_MAX_FOV_RAD)
        pinhole = IdealPinholeCameraModelParameters.from_source(lens, fov)
        models = (sensors.CameraModel.from_parameters(one, device="cpu") for one in (lens, pinhole))
        rectifier = sensors.Rectificator(*models)

        def rectified(image: Any) -> Any:
            return rectifier.apply(image.copy()).numpy()

        degrees = " x ".join(f"{value:.0f}" for value in np.rad2deg(pinhole.fov()))
        note(name, f"images of the lens {lens.type()} were made those of a pinhole of {degrees} degrees")
    K = np.diag([*pinhole.focal_length.astype(np.float64), 1.0])
    K[:2, 2] = pinhole.principal_point  # pixel centres at +0.5, as here
    return K, dist, rectified


class _Sweeps(PartSequence):
    """The sweeps of all lidars at each frame as one, read when they are asked for."""

    def __init__(
        self,
        sequence: "SequenceLoaderV4",
        t_us: Int64[np.ndarray, "T"],
        T_world_ego: Float64[np.ndarray, "T 4 4"],
    ) -> None:
        super().__init__("lidar", "sweeps", len(t_us))
        self._t_us, self._T_world_ego, self._graph = t_us, T_world_ego, sequence.pose_graph
        self._lidars = _lidars(sequence)
        self._nearest = [
            nearest_parts(_frames_of(lidar.lidar_reader, lidar.frames_timestamps_us[:, 1]), t_us)
            for lidar in self._lidars
        ]

    def _part(self, frame: int) -> LidarSweep | None:
        rows = [
            (lidar, int(nearest[frame]))
            for lidar, (nearest, near) in zip(self._lidars, self._nearest, strict=True)
            if near[frame]
        ]
        if not rows:
            return None
        place = f"{self._t_us[frame]} µs"
        return self._read(place, lambda: concatenate([self._sweep(*row, frame) for row in rows]))

    def _sweep(self, lidar: Any, row: int, frame: int) -> LidarSweep:
        """Return the first return of each ray of a lidar, in the ego frame at the frame's time."""
        reader, end_us = lidar.lidar_reader, int(lidar.frames_timestamps_us[row, 1])
        direction = reader.get_frame_ray_bundle_data(end_us, "direction").astype(np.float64)
        if not np.allclose(np.linalg.norm(direction, axis=1), 1.0, atol=1e-3):
            raise InputError("directions of rays are not of length 1")
        ray_us = reader.get_frame_ray_bundle_data(end_us, "timestamp_us")
        is_return = reader.get_frame_ray_bundle_return_valid_mask(end_us)
        if len(is_return) > 1:
            note(lidar.sensor_id, "sweeps of several returns; the first of each ray was read")
        returned, first = is_return.any(axis=0), is_return.argmax(axis=0)
        distance_m, intensity = (
            np.take_along_axis(values, first[None], axis=0)[0]
            for name in ("distance_m", "intensity")
            for values in [reader.get_frame_ray_bundle_return_data(end_us, name, None)]
        )
        # Rays are in the sensor's frame at their own times, which many of them share
        times_us, which = np.unique(ray_us, return_inverse=True)
        T_ego_world = np.linalg.inv(self._T_world_ego[frame])
        T = (T_ego_world @ self._graph.evaluate_poses(lidar.sensor_id, WORLD, times_us))[which]
        # NCore has no range of rays without a return: what an export keeps, else that of the farthest return
        free_m = distance_m[returned].max(initial=0.0)
        if reader.has_frame_generic_data(end_us, FREE_RANGE):
            free_m = reader.get_frame_generic_data(end_us, FREE_RANGE)
        return LidarSweep(
            origin_ego=torch.from_numpy(T[:, :3, 3]).float(),
            dir_ego=torch.from_numpy(np.einsum("nij,nj->ni", T[:, :3, :3], direction)).float(),
            range_m=torch.from_numpy(np.where(returned, distance_m, free_m)).float(),
            returned=torch.from_numpy(returned),
            intensity=torch.from_numpy(np.where(returned, intensity, 0.0)).float(),
            dt_s=torch.from_numpy((ray_us.astype(np.int64) - self._t_us[frame]) * 1e-6).float(),
            beam=torch.from_numpy(self._channels(reader, end_us, len(direction))),
            valid=torch.ones(len(direction), dtype=torch.bool),
        )

    def _channels(self, reader: Any, end_us: int, count: int) -> Int64[np.ndarray, "N"]:
        """Return the row of each ray in the lidar's pattern; -1 where it is unknown or lidars are several."""
        if len(self._lidars) > 1 or not reader.has_frame_ray_bundle_data(end_us, "model_element"):
            return np.full(count, -1)
        rows = reader.get_frame_ray_bundle_data(end_us, "model_element")[:, 0].astype(np.int64)
        return rows if not len(rows) or rows.max() <= 255 else np.full(count, -1)


def _frames_of(reader: Any, own_us: Shaped[np.ndarray, "N"]) -> Int64[np.ndarray, "N"]:
    """Return the times of the frames that data of a sensor belong to: their own, or what an export says."""
    return np.array(reader.generic_meta_data.get(FRAME_TIMES, own_us), dtype=np.int64)


def _boxes(
    sequence: "SequenceLoaderV4",
    t_us: Int64[np.ndarray, "T"],
    T_world_ego: Float64[np.ndarray, "T 4 4"],
    kept: dict[str, Any],
) -> list[list[Box] | None] | None:
    """Return the boxes of each frame. A frame without any is not annotated, unless an export says it is."""
    if sequence._cuboids_reader is None:
        return None
    boxes: list[dict[int, Box] | None] = [None] * len(t_us)
    for annotated in np.flatnonzero(np.isin(t_us, kept.get(ANNOTATED, []))).tolist():
        boxes[annotated] = {}
    observations = list(sequence.get_cuboid_track_observations())
    track_numbers = _track_numbers([one.track_id for one in observations])
    velocity_mps = np.full((len(observations), 3), np.nan)
    if sequence._cuboids_reader.has_generic_data(VELOCITY):
        velocity_mps = sequence._cuboids_reader.get_generic_data(VELOCITY)
    for row, one in enumerate(observations):
        frame = _frame_of_box(one.timestamp_us, t_us)
        if frame is None:
            note("cuboids", "boxes without a frame beside them, left out", f"{one.timestamp_us} µs")
            continue
        track, of_frame = track_numbers[one.track_id], boxes[frame] or {}
        if track in of_frame:
            note("cuboids", "boxes of a track that its frame has already, left out", f"{one.timestamp_us} µs")
            continue
        T_ego_world = np.linalg.inv(T_world_ego[frame])
        at_us = np.array(one.reference_frame_timestamp_us, np.uint64)
        T_ego_ref = T_ego_world @ sequence.pose_graph.evaluate_poses(one.reference_frame_id, WORLD, at_us)
        R_ego_box = T_ego_ref[:3, :3] @ Rotation.from_euler("XYZ", one.bbox3.rot).as_matrix()
        x, y, z = (T_ego_ref[:3, :3] @ one.bbox3.centroid + T_ego_ref[:3, 3]).tolist()
        length, width, height = (float(value) for value in one.bbox3.dim)
        vx, vy, _ = (T_ego_world[:3, :3] @ velocity_mps[row]).tolist()
        of_frame[track] = Box(
            category_or_other(one.class_id, "cuboids").name,
            track,
            (x, y, z),
            (length, width, height),
            float(np.arctan2(R_ego_box[1, 0], R_ego_box[0, 0])),
            (vx, vy) if np.isfinite([vx, vy]).all() else None,
        )
        boxes[frame] = of_frame
    return [None if one is None else list(one.values()) for one in boxes]


def _frame_of_box(observed_us: int, t_us: Int64[np.ndarray, "T"]) -> int | None:
    """Return the frame that a box belongs to, or None.

    A sweep ends at its frame, so an object that it saw belongs to the next frame, up to a period later.
    """
    period_us = float(np.median(np.diff(t_us))) if len(t_us) > 1 else 1e6 * DEFAULT_PERIOD_S
    after = int(np.searchsorted(t_us, observed_us))
    if after < len(t_us) and t_us[after] - observed_us < period_us:
        return after
    if after > 0 and observed_us - t_us[after - 1] <= 0.5 * period_us:
        return after - 1
    return None


def _track_numbers(names: list[str]) -> dict[str, int]:
    """Return a number for each track: its name if all names are numbers."""
    distinct = sorted(set(names))
    if all(re.fullmatch(r"0|[1-9]\d{0,17}", name) for name in distinct):
        return {name: int(name) for name in distinct}
    return {name: number for number, name in enumerate(distinct)}
