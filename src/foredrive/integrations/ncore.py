"""Logs as sequences in NVIDIA's NCore v4 format, written with its own library.

NCore's `rig` is the ego frame, and its `world` that of the log. Each sensor has a store of its own. NCore has
no maps, routes, traffic lights, labels of occupancy or velocities of boxes. Velocities are kept beside the
boxes, for those who convert the sequence back. No renderer or trainer of NCore was run on one
(`docs/how-to/other-tools.md`).
"""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from ncore.data import (
    BBox3,
    CuboidTrackObservation,
    LabelSource,
    OpenCVPinholeCameraModelParameters,
    ShutterType,
)
from ncore.data.v4 import (
    CameraSensorComponent,
    CuboidsComponent,
    IntrinsicsComponent,
    LidarSensorComponent,
    MasksComponent,
    PosesComponent,
    SequenceComponentGroupsReader,
    SequenceComponentGroupsWriter,
)
from ncore.impl.common.transformations import HalfClosedInterval
from upath import UPath

from foredrive.data.boxes import frames_with_boxes, read_boxes
from foredrive.data.cameras import CameraFrame, camera_mount, encoded_image, pinhole_cameras, read_camera
from foredrive.data.formats.ncore import ANNOTATED, OF_FOREDRIVE, VEHICLE, VELOCITY, WHEELBASE
from foredrive.data.formats.ncore_sensors import FRAME_TIMES, FREE_RANGE, RIG, WORLD
from foredrive.data.lidar import frames_with_lidar, lidar_mounts, read_sweep
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.scene import Category, LidarSweep

_SYNTHETIC = "foredrive"
"""Data set whose boxes are exact: recordings of towns."""


def write_ncore(log: Log, folder: Path, tick: Callable[[], None] = lambda: None) -> None:
    """Write a log as a sequence: its stores, and a summary of them.

    Images and sweeps are read one at a time. Beams without a return are written too where the log has them.

    Args:
        log: the log.
        folder: gets NAME.ncore4*.zarr.itar and NAME.json.
        tick: called after each frame.

    Raises:
        InputError: the log has no sensors, or something of it cannot be read.
    """
    cameras, lidar_frames = pinhole_cameras(log), frames_with_lidar(log)
    cameras = {name: camera for name, camera in cameras.items() if len(log.rows(camera.modality_key)[0])}
    if not cameras and not len(lidar_frames):
        raise InputError(f"{log.path.folder}: has neither images of pinhole cameras nor lidar sweeps")
    first_us, last_us = _span(log, cameras, lidar_frames)
    name = log.path.folder.name
    centre_m, size_m = log.ego_box
    writer = SequenceComponentGroupsWriter(
        UPath(folder),
        name,
        name,
        HalfClosedInterval(first_us, last_us + 1),
        {
            VEHICLE: {"centroid": centre_m.tolist(), "dim": size_m.tolist(), "rot": [0.0, 0.0, 0.0]},
            OF_FOREDRIVE: {
                FRAME_TIMES: log.t_us.tolist(),
                ANNOTATED: log.t_us[frames_with_boxes(log)].tolist(),
                WHEELBASE: log.vehicle.wheel_base,
            },
        },
    )
    register = writer.register_component_writer
    poses = register(PosesComponent.Writer, "default")
    intrinsics = register(IntrinsicsComponent.Writer, "default")
    masks = register(MasksComponent.Writer, "default")  # readers expect the component, be it empty
    _write_path(log, poses, first_us, last_us)
    streams = []
    for camera_name, camera in cameras.items():
        poses.store_static_pose(camera_name, RIG, camera_mount(log, camera))
        masks.store_camera_masks(camera_name, {})
        stored = register(CameraSensorComponent.Writer, camera_name, camera_name)
        streams.append(_camera_frames(log, camera, stored, intrinsics))
    if len(lidar_frames):
        streams.append(_lidar_frames(log, lidar_frames, poses, register))
    # All sensors go on together, so that the progress is that of the log
    for _ in range(len(log)):
        for stream in streams:
            next(stream)
        tick()
    for stream in streams:
        next(stream, None)
    _write_boxes(log, register(CuboidsComponent.Writer, "default"))
    stores = writer.finalize()
    summary = SequenceComponentGroupsReader(stores).get_sequence_meta().to_dict()
    (folder / f"{name}.json").write_text(json.dumps(summary, indent=1))


def _span(log: Log, cameras: dict[str, Any], lidar_frames: Int64[np.ndarray, "_"]) -> tuple[int, int]:
    """Return the first and the last time of any frame, image or beam, µs."""
    times = [log.t_us]
    for camera in cameras.values():
        frames, _ = log.rows(camera.modality_key)
        shots = (_exposure_us(log, frame, _camera_at(log, frame, camera)) for frame in frames.tolist())
        times.append(np.array(list(shots)))
    for frame in lidar_frames.tolist():
        stored = read_sweep(log, frame)
        if stored is not None and len(stored[0].dt_s):
            times.append(_times_us(log, frame, stored[0][stored[0].valid]))
    return min(int(part.min()) for part in times), max(int(part.max()) for part in times)


def _write_path(log: Log, poses: PosesComponent.Writer, first_us: int, last_us: int) -> None:
    """Write the path of the vehicle with all poses of the log."""
    t_us = np.union1d(log.drive_t_us, [first_us, last_us])
    t_us = t_us[(t_us >= first_us) & (t_us <= last_us)]
    if len(t_us) < 2:
        raise InputError(f"{log.path.folder}: NCore needs two poses at different times")
    poses.store_dynamic_pose(RIG, WORLD, _poses_at(log, t_us), t_us.astype(np.uint64))


def _poses_at(log: Log, t_us: Int64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 4 4"]:
    """Return `T_world_ego`, at constant velocity before the first and after the last pose of the log."""
    T, _ = log.poses_at(t_us.astype(np.float64))
    T[:, :3, 3] = log.path_of_point(np.zeros(3), t_us.astype(np.float64))
    return T


def _camera_at(log: Log, frame: int, camera: Any) -> CameraFrame:
    return read_camera(log, frame, camera, (camera.height, camera.width), with_image=False)


def _exposure_us(log: Log, frame: int, camera: CameraFrame) -> tuple[int, int]:
    """Return when the first and the last row are exposed, in order of time."""
    middle_us = int(log.t_us[frame]) + round(camera.exposed_dt_s * 1e6)
    half_us = round(abs(camera.readout_s) * 5e5)
    return middle_us - half_us, middle_us + half_us


def _camera_frames(
    log: Log, camera: Any, stored: CameraSensorComponent.Writer, intrinsics: IntrinsicsComponent.Writer
) -> Iterator[None]:
    """Write the images of a camera, frame by frame, each once.

    The camera is 123D's metadata, which only `data` imports.
    """
    frames, _ = log.rows(camera.modality_key)
    lens = _camera_at(log, int(frames[0]), camera)
    intrinsics.store_camera_intrinsics(camera.camera_name, _opencv(lens, (camera.width, camera.height)))
    with_image, before_us, frame_us = set(frames.tolist()), -1, list[int]()
    for frame in range(len(log)):
        data = encoded_image(log, frame, camera) if frame in with_image else None
        if data is not None:
            span_us = _exposure_us(log, frame, _camera_at(log, frame, camera))
            # Frames of a log that is faster than the camera may share an image
            if span_us[1] > before_us:
                kind = "png" if data.startswith(b"\x89PNG") else "jpeg"
                stored.store_frame(data, kind, np.array(span_us, np.uint64), {}, {})
                before_us = span_us[1]
                frame_us.append(int(log.t_us[frame]))
        yield
    stored.set_generic_data({}, {FRAME_TIMES: frame_us})


def _opencv(lens: CameraFrame, size_wh: tuple[int, int]) -> OpenCVPinholeCameraModelParameters:
    """Return a pinhole with OpenCV's distortion; centres of pixels are at +0.5 in NCore too."""
    K, (k1, k2, p1, p2, k3) = lens.K.double().numpy(), lens.dist.tolist()
    shutter = ShutterType.ROLLING_TOP_TO_BOTTOM if lens.readout_s > 0 else ShutterType.ROLLING_BOTTOM_TO_TOP
    return OpenCVPinholeCameraModelParameters(
        resolution=np.array(size_wh, np.uint64),
        shutter_type=shutter if lens.readout_s else ShutterType.GLOBAL,
        principal_point=K[:2, 2].astype(np.float32),
        focal_length=K[[0, 1], [0, 1]].astype(np.float32),
        radial_coeffs=np.array([k1, k2, k3, 0, 0, 0], np.float32),
        tangential_coeffs=np.array([p1, p2], np.float32),
        thin_prism_coeffs=np.zeros(4, np.float32),
        external_distortion_parameters=None,
    )


def _times_us(log: Log, frame: int, sweep: LidarSweep) -> Int64[np.ndarray, "N"]:
    """Return the times of beams."""
    return np.round(sweep.dt_s.double().numpy() * 1e6).astype(np.int64) + log.t_us[frame]


def _lidar_frames(
    log: Log,
    lidar_frames: Int64[np.ndarray, "_"],
    poses: PosesComponent.Writer,
    register: Callable[..., Any],
) -> Iterator[None]:
    """Write the sweeps of all lidars, frame by frame."""
    mounts, stored = lidar_mounts(log), dict[str, LidarSensorComponent.Writer]()
    frame_us: dict[str, list[int]] = {name: [] for name in mounts}
    last_us = dict.fromkeys(mounts, (-1, -1))
    with_sweep = set(lidar_frames.tolist())
    for frame in range(len(log)):
        read = read_sweep(log, frame) if frame in with_sweep else None
        if read is not None and len(read[0].dt_s):
            sweep = read[0][read[0].valid]
            t_us = _times_us(log, frame, sweep)
            for name, mine in _by_lidar(log, frame, sweep, t_us, mounts).items():
                if not mine.any():
                    continue
                if name not in stored:
                    poses.store_static_pose(name, RIG, mounts[name])
                    stored[name] = register(LidarSensorComponent.Writer, name, name)
                span_us = (int(t_us[mine].min()), int(t_us[mine].max()))
                if span_us[0] <= last_us[name][0] or span_us[1] <= last_us[name][1]:
                    place = f"{log.path.folder}, frame {frame}"
                    raise InputError(f"{place}: the sweep of {name} is not after the one before")
                _write_sweep(log, frame, sweep[mine], t_us[mine], mounts[name], stored[name])
                last_us[name] = span_us
                frame_us[name].append(int(log.t_us[frame]))
        yield
    for name, writer in stored.items():
        writer.set_generic_data({}, {FRAME_TIMES: frame_us[name]})


def _by_lidar(
    log: Log,
    frame: int,
    sweep: LidarSweep,
    t_us: Int64[np.ndarray, "N"],
    mounts: dict[str, Float64[np.ndarray, "4 4"]],
) -> dict[str, Any]:
    """Return which beams each lidar has measured: those that begin nearest to it."""
    if len(mounts) == 1:
        return {name: np.ones(len(t_us), dtype=bool) for name in mounts}
    T_world_ego = log.T_world_ego[frame]
    origins = sweep.origin_ego.double().numpy() @ T_world_ego[:3, :3].T + T_world_ego[:3, 3]
    off_m = np.stack(
        [
            np.linalg.norm(log.path_of_point(T[:3, 3], t_us.astype(np.float64)) - origins, axis=1)
            for T in mounts.values()
        ]
    )
    nearest = off_m.argmin(axis=0)
    return {name: nearest == number for number, name in enumerate(mounts)}


def _write_sweep(
    log: Log,
    frame: int,
    sweep: LidarSweep,
    t_us: Int64[np.ndarray, "N"],
    T_ego_lidar: Float64[np.ndarray, "4 4"],
    stored: LidarSensorComponent.Writer,
) -> None:
    """Write a sweep as rays in the lidar's frame at the time of each, as NCore wants them."""
    times_us, which = np.unique(t_us, return_inverse=True)
    # From the ego frame at the frame's time to the lidar's at the ray's
    T_lidar_ego = np.linalg.inv(_poses_at(log, times_us) @ T_ego_lidar) @ log.T_world_ego[frame]
    R, t = T_lidar_ego[which, :3, :3], T_lidar_ego[which, :3, 3]
    returned = sweep.returned.numpy()
    ends, directions = sweep.points_ego.double().numpy(), sweep.dir_ego.double().numpy()
    # A return stays where it is; a ray without one keeps its direction
    along = np.where(
        returned[:, None],
        np.einsum("nij,nj->ni", R, ends) + t,
        np.einsum("nij,nj->ni", R, directions),
    )
    range_m = np.linalg.norm(along, axis=1)
    element, beam = None, sweep.beam.numpy()
    if len(times_us) <= np.iinfo(np.uint16).max and (beam >= 0).all():
        element = np.stack([beam, which.reshape(-1)], axis=1).astype(np.uint16)
    stored.store_frame(
        (along / np.maximum(range_m, 1e-9)[:, None]).astype(np.float32),
        t_us.astype(np.uint64),
        element,
        np.where(returned, range_m, np.nan)[None].astype(np.float32),
        np.where(returned, sweep.intensity.numpy(), np.nan)[None].astype(np.float32),
        np.array([t_us.min(), t_us.max()], np.uint64),
        {} if returned.all() else {FREE_RANGE: np.where(returned, 0.0, sweep.range_m).astype(np.float32)},
        {},
    )


def _write_boxes(log: Log, stored: CuboidsComponent.Writer) -> None:
    """Write the boxes in the rig's frame at the time of theirs, and their velocities beside them."""
    source = LabelSource.GT_SYNTHETIC if log.metadata.dataset == _SYNTHETIC else LabelSource.EXTERNAL
    observations, velocities = [], []
    for frame in frames_with_boxes(log).tolist():
        boxes, t_us = read_boxes(log, frame), int(log.t_us[frame])
        if boxes is None:
            continue
        boxes = boxes[boxes.valid]
        R_world_ego = log.T_world_ego[frame, :3, :3]
        still = np.zeros((len(boxes.yaw), 1))
        velocities.append(np.hstack([boxes.velocity.double().numpy(), still]) @ R_world_ego.T)
        for centre, size, yaw, track, category in zip(
            boxes.centre.tolist(),
            boxes.size_lwh.tolist(),
            boxes.yaw.tolist(),
            boxes.track_id.tolist(),
            boxes.category.tolist(),
            strict=True,
        ):
            observations.append(
                CuboidTrackObservation(
                    track_id=str(track),
                    class_id=Category(category).name.lower(),
                    timestamp_us=t_us,
                    reference_frame_id=RIG,
                    reference_frame_timestamp_us=t_us,
                    bbox3=BBox3(tuple(centre), tuple(size), (0.0, 0.0, yaw)),
                    source=source,
                )
            )
    stored.store_observations(observations)
    stored.set_generic_data({VELOCITY: np.concatenate([np.zeros((0, 3)), *velocities])})
