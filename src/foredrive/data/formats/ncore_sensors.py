"""Images and sweeps of NCore v4, read with NVIDIA's own library and camera models."""

import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float64, Int64, Shaped, UInt8

from foredrive.data.camera_streams import CameraSpec
from foredrive.data.formats.guard import PartSequence, nearest_parts
from foredrive.data.images import check_size, image_size, read_rgb, whole_jpeg
from foredrive.data.lidar import concatenate
from foredrive.data.notices import note
from foredrive.errors import InputError
from foredrive.scene import LidarSweep

if TYPE_CHECKING:
    from ncore.data import CameraModelParameters
    from ncore.data.v4 import SequenceLoaderV4

RIG, WORLD = "rig", "world"
FRAME_TIMES, FREE_RANGE = "frame_timestamps_us", "free_range_m"
"""Names of what an export adds to its sensors: the frames of its images and sweeps, and the ranges of beams
without a return."""
_MAX_FOV_RAD = np.deg2rad(110.0)
"""Largest field of view of an image that is made a pinhole's."""


def lidars_of(sequence: "SequenceLoaderV4") -> list[Any]:
    """Return the lidars that have sweeps."""
    lidars = (sequence.get_lidar_sensor(name) for name in sorted(sequence.lidar_ids))
    return [lidar for lidar in lidars if lidar.frames_count]


def cameras_of(sequence: "SequenceLoaderV4") -> list[str]:
    """Return the names of the cameras that have images; a notice tells of the others."""
    names = []
    for name in sorted(sequence.camera_ids):
        if sequence.get_camera_sensor(name).frames_count:
            names.append(name)
        else:
            note(name, "left out; without images")
    return names


def exposures(sequence: "SequenceLoaderV4", camera: str) -> tuple[Int64[np.ndarray, "N"], float]:
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


class Images(PartSequence):
    """The images of a camera beside each frame, read when they are asked for."""

    def __init__(self, sequence: "SequenceLoaderV4", name: str, t_us: Int64[np.ndarray, "T"]) -> None:
        super().__init__(name, "images", len(t_us))
        self._sensor = sequence.get_camera_sensor(name)
        # NCore's evaluate_poses(a, b) maps points from a to b
        at_us = t_us[:1].astype(np.uint64)
        (T_rig_cam,) = sequence.pose_graph.evaluate_poses(name, RIG, at_us).astype(np.float64)
        taken_us, readout_s = exposures(sequence, name)
        self._rows, self._near = nearest_parts(_frames_of(self._sensor.camera_reader, taken_us), t_us)
        self.t_us = np.where(self._near, taken_us[self._rows], t_us)
        K, dist, self._rectified = _pinhole(self._sensor.model_parameters, name)
        width, height = (int(size) for size in self._sensor.model_parameters.resolution)
        self.spec = CameraSpec(name, K, T_rig_cam, (height, width), readout_s, dist)
        with contextlib.suppress(KeyError):  # the component may lack a camera
            for mask in self._sensor.get_mask_images():
                note(name, "masks, not read", mask)

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


class Sweeps(PartSequence):
    """The sweeps of all lidars at each frame as one, read when they are asked for."""

    def __init__(
        self,
        sequence: "SequenceLoaderV4",
        t_us: Int64[np.ndarray, "T"],
        T_world_ego: Float64[np.ndarray, "T 4 4"],
    ) -> None:
        super().__init__("lidar", "sweeps", len(t_us))
        self._t_us, self._T_world_ego, self._graph = t_us, T_world_ego, sequence.pose_graph
        self._lidars = lidars_of(sequence)
        for lidar in self._lidars:
            (T,) = sequence.pose_graph.evaluate_poses(lidar.sensor_id, RIG, t_us[:1].astype(np.uint64))
            if np.linalg.det(T[:3, :3]) < 0:
                raise InputError(f"the mount of {lidar.sensor_id} mirrors; it is no rotation")
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
