"""An agent of ours as a driver of AlpaSim: `egodriver.EgodriverService`, over gRPC.

AlpaSim's runtime was never connected (`docs/how-to/other-tools.md`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from carla_driver_interface.driver import BaseDriver, CameraFrame, DriveContext, DriveResult, SessionState
from carla_driver_interface.geometry import Pose
from carla_driver_interface.geometry import Trajectory as TimedPoses
from carla_driver_interface.server import build_server
from jaxtyping import Float64

from foredrive.data.batches import stack_records
from foredrive.data.boxes import no_boxes
from foredrive.data.commands import RouteAhead, command_of, route_ahead
from foredrive.driving.observation import FRAME_DT_S, KeyFrame, no_images
from foredrive.driving.plans import waypoints_of
from foredrive.driving.simple_agents import StraightAgent
from foredrive.errors import InputError
from foredrive.geometry.polylines import arc_lengths
from foredrive.integrations.remote.planner_messages import nuscenes_name
from foredrive.integrations.remote.planner_server import PlannerNeeds, seen_clip
from foredrive.scene import Agent, CameraRig, Command, Trajectory
from foredrive.scene.clip import TARGET

LATE_US = 60_000
"""Largest difference between a key frame's time and that of an image, microseconds."""
KEPT_FRAMES = 128


@dataclass
class _Session:
    agent: Agent
    now_s: float = 0.0


class AlpasimDriver(BaseDriver):
    """Plans for AlpaSim by an agent. Key frames lie 0.5 s apart, counted from each plan's own time.

    Until the session has as many of them as the agent observes, the plan is constant velocity.

    Args:
        name: name that is told to the simulator.
        make: returns a new agent for a drive, given a clock, s.
        needs: what the agent has to be shown.
    """

    frame_history_length = KEPT_FRAMES

    def __init__(self, name: str, make: Callable[[Callable[[], float]], Agent], needs: PlannerNeeds) -> None:
        self.name, self._make, self._needs = name, make, needs
        self._sessions: dict[str, _Session] = {}

    def on_session_start(self, session: SessionState) -> None:
        """Make the agent of a drive; refuse a vehicle without its cameras."""
        self._cameras(session)

        def clock() -> float:
            return self._sessions[session.uuid].now_s

        self._sessions[session.uuid] = _Session(self._make(clock))

    def on_session_close(self, session: SessionState) -> None:
        """Forget the agent of a drive."""
        self._sessions.pop(session.uuid, None)

    def drive(self, ctx: DriveContext) -> DriveResult:
        """Return the agent's plan."""
        session, of_drive = ctx.session, self._sessions[ctx.session.uuid]
        of_drive.now_s = ctx.time_now_us * 1e-6
        cameras = self._cameras(session)
        frames = self._key_frames(session, cameras, ctx.time_now_us)
        if frames is None:
            blind = seen_clip([self._blind(ctx)], None, Command.STRAIGHT)
            plan = StraightAgent(session.speed_mps()).act(stack_records([blind]))
        else:
            command, target = route_of(session.route_waypoints_in_rig)
            rig = _rig(session, cameras) if cameras else None
            plan = of_drive.agent.act(stack_records([seen_clip(frames, rig, command, target)]))
        return DriveResult(timed(plan, ctx.time_now_us))

    def _blind(self, ctx: DriveContext) -> KeyFrame:
        T = ctx.session.ego_trajectory.poses[-1].as_matrix()
        return KeyFrame(ctx.time_now_us * 1e-6, T, ctx.session.speed_mps(), no_images(), None, no_boxes())

    def _cameras(self, session: SessionState) -> list[str]:
        """Return the names of the cameras that the agent observes, as the session calls them.

        Raises:
            InputError: some were not declared.
        """
        by_name = {nuscenes_name(name).lower(): name for name in session.cameras}
        wanted = list(session.cameras) if self._needs.cameras is None else list(self._needs.cameras)
        if missing := [name for name in wanted if nuscenes_name(name).lower() not in by_name]:
            declared = ", ".join(session.cameras) or "none"
            raise InputError(f"cameras not declared: {', '.join(missing)}; declared: {declared}")
        return [by_name[nuscenes_name(name).lower()] for name in wanted]

    def _key_frames(self, session: SessionState, cameras: list[str], now_us: int) -> list[KeyFrame] | None:
        """Return the key frames up to now. None while there are too few."""
        step_us, frames = round(FRAME_DT_S * 1e6), []
        for back in range(self._needs.past_frames, -1, -1):
            at_us = now_us - back * step_us
            pose = _pose_at(session, at_us)
            images = [_image_at(session, name, at_us) for name in cameras]
            if pose is None or any(image is None for image in images):
                return None
            seen = [torch.from_numpy(image.copy()) for image in images if image is not None]
            shown = torch.stack(seen).permute(0, 3, 1, 2) if seen else no_images()
            speed_mps = _speed_at(session, at_us)
            frames.append(KeyFrame(at_us * 1e-6, pose.as_matrix(), speed_mps, shown, None, no_boxes()))
        return frames


def serve_alpasim(driver: AlpasimDriver, host: str, port: int) -> tuple[Any, int]:
    """Return a server that is to be started, and its port.

    Raises:
        InputError: the address cannot be served.
    """
    try:
        server, bound = build_server(driver, port, host, mode="alpasim")
    except RuntimeError as error:
        raise InputError(f"{host}:{port} cannot be served: {error}") from error
    return server, bound


def route_of(waypoints: Float64[np.ndarray, "N 3"]) -> tuple[Command, RouteAhead | None]:
    """Return the command and the next points of a route in the ego frame."""
    if len(waypoints) < 2:
        return Command.STRAIGHT, None
    xy = np.asarray(waypoints[:, :2], dtype=float)
    arc_m = arc_lengths(xy)
    route = route_ahead(arc_m, xy, float(arc_m[np.argmin(np.hypot(*xy.T))]), np.eye(4))
    return command_of(float(route.xy[TARGET, 1])), route


def timed(plan: Trajectory, now_us: int) -> TimedPoses:
    """Return a plan as poses over time in the ego frame, from now on. Headings follow the points."""
    points = np.vstack([np.zeros(2), waypoints_of(plan)])
    poses = TimedPoses.empty()
    yaw = 0.0
    for index, (x, y) in enumerate(points.tolist()):
        after = points[min(index + 1, len(points) - 1)] - points[max(index - 1, 0)]
        if index and np.hypot(*after) > 0.05:
            yaw = math.atan2(after[1], after[0])
        poses.append(now_us + round(index * plan.dt_s * 1e6), Pose.from_xyz_yaw(x, y, 0.0, yaw))
    return poses


def _pose_at(session: SessionState, at_us: int) -> Pose | None:
    """Return where the vehicle was at a time; None if the session does not reach back so far."""
    track = session.ego_trajectory
    if not len(track) or at_us < track.timestamps_us[0] - LATE_US:
        return None
    return track.interpolate(at_us)


def _speed_at(session: SessionState, at_us: int) -> float:
    times = np.array(session.ego_trajectory.timestamps_us)
    velocity = session.dynamic_states[int(np.argmin(np.abs(times - at_us)))].linear_velocity
    return float(np.linalg.norm([velocity.x, velocity.y, velocity.z]))


def _image_at(session: SessionState, camera: str, at_us: int) -> np.ndarray | None:
    """Return the image of a camera at a time; None if there is none near it."""
    frames = [frame for frame in session.frame_history.get(camera, []) if isinstance(frame, CameraFrame)]
    nearest = min(frames, key=lambda frame: abs(frame.timestamp_us - at_us), default=None)
    if nearest is None or abs(nearest.timestamp_us - at_us) > LATE_US:
        return None
    return nearest.as_array()


def _rig(session: SessionState, names: list[str]) -> CameraRig:
    """Return the declared cameras.

    Raises:
        InputError: one is no pinhole camera, or they have several sizes.
    """
    K, mounts, dist, sizes = [], [], [], set()
    for name in names:
        camera = session.cameras[name]
        spec, lens = camera.intrinsics, camera.intrinsics.opencv_pinhole_param
        if not spec.HasField("opencv_pinhole_param"):
            raise InputError(f"camera {name}: only pinhole cameras are known; let the renderer show one")
        first_row = [lens.focal_length_x, 0.0, lens.principal_point_x]
        K.append(
            torch.tensor([first_row, [0.0, lens.focal_length_y, lens.principal_point_y], [0.0, 0.0, 1.0]])
        )
        k1, k2, k3 = ([*lens.radial_coeffs] + [0.0] * 3)[:3]
        p1, p2 = ([*lens.tangential_coeffs] + [0.0] * 2)[:2]
        dist.append(torch.tensor([k1, k2, p1, p2, k3]))
        mounts.append(torch.from_numpy(Pose.from_proto(camera.rig_to_camera).as_matrix()).float())
        sizes.add((int(spec.resolution_h), int(spec.resolution_w)))
    if len(sizes) != 1:
        raise InputError(f"cameras have to be of one size, got {sorted(sizes)}")
    (size_hw,) = sizes
    return CameraRig(
        torch.stack(K), torch.stack(mounts), torch.stack(dist), torch.zeros(len(names)), tuple(names), size_hw
    )
