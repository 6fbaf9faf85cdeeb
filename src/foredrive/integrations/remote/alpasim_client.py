"""An agent behind AlpaSim's driver contract (`egodriver.EgodriverService`), over gRPC.

Source: public repository NVlabs/alpasim, `egodriver.proto`, as the package carla-driver-interface has it. A
session is a drive. Before each plan the driver is sent its images, where the vehicle is in a local frame, and
the route; `drive` answers poses over time in that frame. Our local frame is that of the first key frame.
AlpaSim's own drivers were never run (`docs/how-to/other-tools.md`).
"""

import contextlib
import io
import time
import uuid
import weakref
from collections.abc import Callable
from typing import Any

import grpc
import numpy as np
import torch
from carla_driver_interface import protocol
from carla_driver_interface.contract import camera_to_revision, contract_metadata, negotiate
from carla_driver_interface.geometry import Pose, waypoints_to_proto
from carla_driver_interface.geometry import Trajectory as TimedPoses
from jaxtyping import Float64
from PIL import Image
from scipy.spatial.transform import Rotation

from foredrive.driving.observation import FRAME_DT_S, HORIZON_STEPS
from foredrive.driving.simple_agents import plan_of
from foredrive.errors import InputError
from foredrive.geometry.polylines import arc_lengths, points_at
from foredrive.integrations.remote.planner_client import FIRST_US
from foredrive.json_http import Address
from foredrive.scene import CameraRig, Clip, Command, Trajectory

STEP_M, LENGTH_M = 2.0, 40.0
TURN_M = {Command.LEFT: 6.0, Command.RIGHT: -6.0, Command.STRAIGHT: 0.0}
"""How far to the side the route leads within 20 m if its target point is not known."""


class GrpcDriver:
    """An `Agent` that asks an AlpaSim driver. All its errors end the drive as a failed one.

    Args:
        address: address of the driver, and the time that it has for a plan.
        clock: returns the time of the drive, s.
    """

    def __init__(self, address: Address, clock: Callable[[], float]) -> None:
        self._address, self._clock = address, clock
        self._channel = grpc.insecure_channel(str(address), options=protocol.channel_options())
        self._stub: Any = protocol.EgodriverServiceStub(self._channel)
        self._session: str | None = None
        self._sent_us = -1
        self._T_local_world = np.eye(4)

    def act(self, observation: Clip) -> Trajectory:
        """Return the driver's plan, for a batch of one.

        Raises:
            InputError: the driver answers too late, an error, or no plan of 3 s.
        """
        clip, until_s = observation[0], time.monotonic() + self._address.answer_s
        try:
            if self._session is None:
                self._begin(clip, until_s)
            now_us = FIRST_US + round(self._clock() * 1e6)
            for frame, t_s in enumerate(clip.t_s[: clip.now + 1].tolist()):
                at_us = now_us + round(t_s * 1e6)
                if at_us > self._sent_us:
                    self._observe(clip, frame, at_us, until_s)
                    self._sent_us = at_us
            step_us = round(FRAME_DT_S * 1e6)
            asked = protocol.DriveRequest(
                session_uuid=self._session, time_now_us=now_us, time_query_us=now_us + step_us
            )
            answer = self._stub.drive(asked, timeout=_left_s(until_s))
        except grpc.RpcError as error:
            raise _input_error(self._address, error) from error
        T_local_now = self._T_local_world @ clip.T_world_ego[clip.now].numpy()
        return plan_of(points_of(TimedPoses.from_proto(answer.trajectory), T_local_now, now_us)[None, None])

    def _begin(self, clip: Clip, until_s: float) -> None:
        """Begin a session: tell the cameras."""
        _, revision = negotiate(self._stub, timeout=_left_s(until_s))
        session = str(uuid.uuid4())
        request = protocol.DriveSessionRequest(session_uuid=session)
        rig = clip.rig[clip.now]
        cameras = [camera_to_revision(_camera(rig, index), 2, revision) for index in range(len(rig.names))]
        request.rollout_spec.vehicle.available_cameras.extend(cameras)
        self._stub.start_session(request, timeout=_left_s(until_s), metadata=contract_metadata(revision))
        self._session, self._T_local_world = session, np.linalg.inv(clip.T_world_ego[0].numpy())
        weakref.finalize(self, _close, self._channel, self._stub, session)

    def _observe(self, clip: Clip, frame: int, at_us: int, until_s: float) -> None:
        """Send pose, route and images of a key frame."""
        pose = pose_of(self._T_local_world @ clip.T_world_ego[frame].numpy())
        motion = protocol.RolloutEgoTrajectory(session_uuid=self._session)
        motion.trajectory.CopyFrom(TimedPoses([at_us], [pose]).to_proto())
        speed = protocol.Vec3(x=float(clip.ego_speed_mps[frame]))
        motion.dynamic_states.append(protocol.DynamicState(linear_velocity=speed))
        self._stub.submit_egomotion_observation(motion, timeout=_left_s(until_s))
        if frame == clip.now:
            route = protocol.Route(timestamp_us=at_us, waypoints=waypoints_to_proto(_route(clip)))
            request = protocol.RouteRequest(session_uuid=self._session, route=route)
            self._stub.submit_route(request, timeout=_left_s(until_s))
        for camera, name in enumerate(clip.rig.names):
            if bool(clip.image_valid[frame, camera]):
                sent = protocol.RolloutCameraImage(session_uuid=self._session)
                sent.camera_image.logical_id = name
                sent.camera_image.frame_start_us = sent.camera_image.frame_end_us = at_us
                buffer = io.BytesIO()
                Image.fromarray(clip.images[frame, camera].permute(1, 2, 0).numpy()).save(buffer, "PNG")
                sent.camera_image.image_bytes = buffer.getvalue()
                self._stub.submit_image_observation(sent, timeout=_left_s(until_s))


def check_driver(address: Address, within_s: float) -> None:
    """Check that a driver answers.

    Raises:
        InputError: it does not in time.
    """
    with grpc.insecure_channel(str(address), options=protocol.channel_options()) as channel:
        try:
            stub: Any = protocol.EgodriverServiceStub(channel)
            stub.get_version(protocol.Empty(), timeout=within_s, wait_for_ready=True)
        except grpc.RpcError as error:
            raise InputError(f"no driver is alive: {_input_error(address, error)}") from error


def _input_error(address: Address, error: Any) -> InputError:
    """Return an error of gRPC as one line."""
    late = error.code() is grpc.StatusCode.DEADLINE_EXCEEDED
    why = f"no answer within {address.answer_s:g} s" if late else f"{error.code().name}: {error.details()}"
    return InputError(f"grpc://{address}: {' '.join(why.split())[:300]}")


def _left_s(until_s: float) -> float:
    return max(0.001, until_s - time.monotonic())


def _close(channel: Any, stub: Any, session: str) -> None:
    """End a session. Whether the driver still answers does not matter."""
    with contextlib.suppress(grpc.RpcError, ValueError):
        stub.close_session(protocol.DriveSessionCloseRequest(session_uuid=session), timeout=1.0)
    channel.close()


def pose_of(T: Float64[np.ndarray, "4 4"]) -> Pose:
    """Return a transform as the contract's pose."""
    return Pose.from_rotation(T[:3, 3], Rotation.from_matrix(T[:3, :3]))


def _camera(rig: CameraRig, index: int) -> Any:
    """Return a camera as the contract declares it: x right, y down, z forward."""
    K, (k1, k2, p1, p2, k3) = rig.K[index], rig.dist[index].tolist()
    lens = protocol.OpenCVPinholeCameraParam(
        principal_point_x=float(K[0, 2]),
        principal_point_y=float(K[1, 2]),
        focal_length_x=float(K[0, 0]),
        focal_length_y=float(K[1, 1]),
        radial_coeffs=[k1, k2, k3, 0.0, 0.0, 0.0],
        tangential_coeffs=[p1, p2],
    )
    spec = protocol.CameraSpec(
        opencv_pinhole_param=lens,
        logical_id=rig.names[index],
        resolution_h=rig.size_hw[0],
        resolution_w=rig.size_hw[1],
        shutter_type=protocol.ShutterType.GLOBAL,
    )
    mount = pose_of(rig.T_ego_cam[index].double().numpy()).to_proto()
    return protocol.AvailableCamera(intrinsics=spec, rig_to_camera=mount, logical_id=rig.names[index])


def _route(clip: Clip) -> Float64[np.ndarray, "N 3"]:
    """Return points of the route ahead in the ego frame: through the route's points, and straight on."""
    command = Command(int(clip.command)) if bool(clip.command_valid) else Command.STRAIGHT
    given = clip.route_xy[clip.route_valid].double().numpy()
    if not len(given):
        given = np.array([[20.0, TURN_M[command]]])
    corners = np.concatenate([np.zeros((1, 2)), given])
    step = corners[-1] - corners[-2]
    beyond = corners[-1] + LENGTH_M * step / max(float(np.linalg.norm(step)), 1e-6)
    corners = np.concatenate([corners, beyond[None]])
    xy = points_at(corners, arc_lengths(corners), np.arange(0.0, LENGTH_M + 1e-6, STEP_M))
    return np.column_stack([xy, np.zeros(len(xy))])


def points_of(plan: TimedPoses, T_local_now: Float64[np.ndarray, "4 4"], now_us: int) -> torch.Tensor:
    """Return the points of a plan at the next key frames in the ego frame, m.

    Raises:
        InputError: the plan is not finite, begins after the first key frame, or ends before 3 s.
    """
    times = [now_us + round(FRAME_DT_S * 1e6) * step for step in range(1, HORIZON_STEPS + 1)]
    if len(plan) < 2 or plan.timestamps_us[0] > times[0] or plan.timestamps_us[-1] < times[-1]:
        horizon_s = HORIZON_STEPS * FRAME_DT_S
        raise InputError(f"the driver answered {len(plan)} poses, which do not cover {horizon_s:g} s")
    poses = [plan.interpolate(at_us) for at_us in times]
    positions = np.array([pose.position for pose in poses if pose is not None])
    if not np.isfinite(positions).all():
        raise InputError(f"the driver answered positions that are not finite: {positions.tolist()}")
    T_now_local = np.linalg.inv(T_local_now)
    return torch.from_numpy((positions @ T_now_local[:3, :3].T + T_now_local[:3, 3])[:, :2]).float()
