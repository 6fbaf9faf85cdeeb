"""A reconstructed log as neuro-ncap's renderer server, plus sweeps by named lidars.

Source: public repository georghess/neurad-studio, `nerfstudio/scripts/closed_loop`: `/alive`, `/start_time`,
`/get_actors`, `/update_actors`, `/render_image`. Ours are `/sensors`, `/render_sweep` and `/trust`. A rolling
shutter is not seen, since a request has no velocities.
"""

import dataclasses
import functools
import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Float64, UInt8
from PIL import Image
from torch import Tensor

from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.integrations.remote.planner_messages import nuscenes_name
from foredrive.integrations.remote.sent_matrices import read_pose
from foredrive.integrations.remote.sent_tensors import encode_tensors
from foredrive.json_http import validated
from foredrive.json_server import Answer, Raw
from foredrive.methods.reconstruction.edits import Edit, Remove, apply_edits
from foredrive.methods.reconstruction.novel_views import novel_camera_view
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.rendered import RenderedImage
from foredrive.methods.reconstruction.renderer import render_sweep
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.tracks import poses_at
from foredrive.methods.reconstruction.trust import Trust
from foredrive.methods.reconstruction.vehicle import EgoState, LoggedVehicle
from foredrive.methods.reconstruction.views import CameraView
from foredrive.sensors import SpinningLidar
from foredrive.sensors.vehicle import LIDARS

OWN_LIDAR = "LIDAR_TOP"
"""Name of the log's own lidar. Others are those of `sensors.vehicle.LIDARS`, at its place."""
SIZE_TOLERANCE_M = 0.1
"""Largest difference of an actor's size that is taken for rounding, m: actors cannot be stretched."""
MAX_POSES = 10_000


@dataclass(frozen=True)
class SentActor:
    """An actor, as JSON."""

    uuid: str
    """Token of its track in the log."""
    poses: list[list[list[float]]]
    """Actor (x forward, y left, origin in the middle of its box) -> world."""
    timestamps: list[int]
    """Microseconds."""
    dims: list[float]
    """Width, length, height, m."""


@dataclass(frozen=True)
class ImageRequest:
    """A request for an image, as JSON."""

    pose: list[list[float]]
    """Camera (x right, y down, z forward) -> world."""
    timestamp: int
    """Microseconds."""
    camera_name: str
    image_format: Literal["raw", "png", "jpg", "jpeg"] = "raw"


@dataclass(frozen=True)
class SweepRequest:
    """A request for a revolution of a lidar, as JSON."""

    pose: list[list[float]]
    """Lidar (x forward, y left, z up) -> world."""
    timestamp: int
    lidar_name: str = OWN_LIDAR
    twist: tuple[float, float, float, float, float, float] = (0.0,) * 6
    """Velocity (m/s) and turn rate (rad/s) of the vehicle over ground, in its own axes."""


class RenderService:
    """Answers to the requests of a simulator that drives in a reconstructed log.

    Args:
        scene: the reconstructed scene.
        vehicle: the vehicle that recorded the log.
        names: the name of each actor by its track id.
        start_us: time of the log's start, microseconds.
        trust: returns what the reconstruction expects of its images. It is called once, when it is first
            asked for: it takes some seconds for each camera.
    """

    def __init__(
        self,
        scene: ReconstructedScene,
        vehicle: LoggedVehicle,
        names: Mapping[int, str],
        start_us: int,
        trust: Callable[[], Trust],
    ) -> None:
        self._scene, self._vehicle, self._start_us = scene, vehicle, start_us
        self._trust = functools.cache(trust)
        self._logged: SceneGraph = scene.graph
        self._graph: SceneGraph = scene.graph
        self._names = {number: names.get(number, str(number)) for number in self._ids()}
        self._cameras = {
            key: index
            for index, name in enumerate(vehicle.rig.names)
            for key in (name, name.upper(), nuscenes_name(name))
        }

    def answers(self) -> Mapping[tuple[str, str], Answer]:
        """Return the answers by method and path."""
        return {
            ("GET", "/alive"): lambda _: True,
            ("GET", "/start_time"): lambda _: self._start_us,
            ("GET", "/sensors"): lambda _: self._sensors(),
            ("GET", "/get_actors"): lambda _: [dataclasses.asdict(actor) for actor in self._actors()],
            ("POST", "/update_actors"): self._update_actors,
            ("POST", "/render_image"): self._render_image,
            ("POST", "/render_sweep"): self._render_sweep,
            ("POST", "/trust"): self._judge_image,
        }

    def _ids(self) -> list[int]:
        ids: list[int] = self._logged.tracks.track_id.tolist()
        return ids

    def _sensors(self) -> dict[str, object]:
        """Return the names of all sensors, and where they are mounted."""
        rig, T_ego_lidar = self._vehicle.rig, self._vehicle.T_ego_lidar
        return {
            "cameras": [nuscenes_name(name) for name in rig.names],
            "camera2image": rig.K.tolist(),
            "camera2ego": rig.T_ego_cam.tolist(),
            "size_hw": list(rig.size_hw),
            "lidars": self._lidar_names(),
            "lidar2ego": None if T_ego_lidar is None else T_ego_lidar.tolist(),
        }

    def _lidar_names(self) -> list[str]:
        if self._vehicle.T_ego_lidar is None:
            return []
        return [*([OWN_LIDAR] if self._vehicle.lidar is not None else []), *LIDARS]

    def _actors(self) -> list[SentActor]:
        """Return the actors that are there now, each with its poses at the key times when it is."""
        tracks, actors = self._graph.tracks.map_tensors(lambda tensor: tensor.detach().cpu()), []
        T_world_actor = self._vehicle.T_world_scene @ tracks.T_scene_actor.double()
        for row, track_id in enumerate(tracks.track_id.tolist()):
            present = tracks.present[row]
            length, width, height = tracks.size_lwh[row].tolist()
            times = [self._start_us + round(t_s * 1e6) for t_s in tracks.t_s[present].tolist()]
            poses = T_world_actor[row, present].tolist()
            actors.append(SentActor(self._names[track_id], poses, times, [width, length, height]))
        return actors

    def _update_actors(self, body: object) -> None:
        """Replace all actors by the given ones, which are actors of the log on other ways."""
        sent: list[SentActor] = validated(list[SentActor], body, "/update_actors")
        ids = {name: number for number, name in self._names.items()}
        for actor in sent:
            if actor.uuid not in ids:
                some_ids = ", ".join(list(ids)[:8]) or "none"
                raise InputError(f"there is no actor {actor.uuid!r}; some of those in the log: {some_ids}")
        given = {ids[actor.uuid]: actor for actor in sent}
        if len(given) < len(sent):
            raise InputError("an actor is sent twice")
        removed: list[Edit] = [Remove(number) for number in self._ids() if number not in given]
        graph = apply_edits(self._logged, removed).graph
        tracks = graph.tracks
        poses, present = tracks.T_scene_actor.clone(), tracks.present.clone()
        for number, actor in given.items():
            row = tracks.index_of(number)
            on_keys, key_present = self._on_key_times(actor, tracks.size_lwh[row], tracks.t_s)
            poses[row], present[row] = on_keys.to(poses), key_present.to(present.device)
        self._graph = dataclasses.replace(
            graph, tracks=dataclasses.replace(tracks, T_scene_actor=poses, present=present)
        )

    def _on_key_times(
        self, actor: SentActor, size_lwh: Float[Tensor, "3"], key_t_s: Float[Tensor, "K"]
    ) -> tuple[Float[Tensor, "K 4 4"], Tensor]:
        """Return the poses of an actor in the scene at key times, and when it is there."""
        count = len(actor.timestamps)
        if not 0 < count <= MAX_POSES or len(actor.poses) != count or len(actor.dims) != 3:
            raise InputError(
                f"actor {actor.uuid}: needs 1 to {MAX_POSES} poses, as many timestamps, and 3 dims"
            )
        width, length, height = actor.dims
        size = torch.tensor([length, width, height]).to(size_lwh)
        if not bool(((size - size_lwh).abs() <= SIZE_TOLERANCE_M).all()):
            raise InputError(f"actor {actor.uuid}: its dims are {actor.dims}, but actors keep their size")
        t_s = torch.tensor([(time_us - self._start_us) * 1e-6 for time_us in actor.timestamps])
        if not bool((t_s.diff() > 0).all()):
            raise InputError(f"actor {actor.uuid}: its timestamps do not increase")
        T_world_actor = torch.stack([read_pose(pose, f"actor {actor.uuid}: a pose") for pose in actor.poses])
        T = (inverse_se3(self._vehicle.T_world_scene) @ T_world_actor).float()[None]
        keys = key_t_s.cpu()
        step_s = float(keys.diff().median()) if len(keys) > 1 else 0.0
        present = (keys >= t_s[0] - step_s) & (keys <= t_s[-1] + step_s)
        return torch.stack([poses_at(t_s, T, at_s)[0][0] for at_s in keys.tolist()]), present

    def _render_image(self, body: object) -> Raw:
        asked: ImageRequest = validated(ImageRequest, body, "/render_image")
        image = self._rendered(asked)[1].rgb_8bit.permute(1, 2, 0).contiguous()
        if asked.image_format == "raw":
            return Raw(encode_tensors(image).encode(), "text/plain")
        return _picture(image, "png" if asked.image_format == "png" else "jpeg")

    def _judge_image(self, body: object) -> dict[str, object]:
        """Return how good the image of a request is expected to be, and along the logged way."""
        asked: ImageRequest = validated(ImageRequest, body, "/trust")
        rendered, trust = self._rendered(asked), self._trust()
        psnr_db = trust.psnr_db(self._graph, [rendered])
        return {
            "expected_psnr_db": psnr_db,
            "logged_psnr_db": trust.reference_db,
            "trusted": trust.trusts(psnr_db),
        }

    @torch.no_grad()
    def _rendered(self, asked: ImageRequest) -> tuple[CameraView, RenderedImage]:
        """Render the image of a request.

        Raises:
            InputError: there is no such camera, the pose is wrong, or the log does not last until then.
        """
        rig = dataclasses.replace(self._vehicle.rig, exposed_dt_s=None)
        if asked.camera_name not in self._cameras:
            raise InputError(f"no camera {asked.camera_name!r}; there are: {', '.join(self._cameras)}")
        camera = self._cameras[asked.camera_name]
        T_world_cam = read_pose(asked.pose, "pose")
        ego = self._ego(T_world_cam @ inverse_se3(rig.T_ego_cam[camera].double()), asked.timestamp)
        view = novel_camera_view(rig, camera, ego)
        return view, self._scene.camera(self._graph, view.to(self._scene.device))

    @torch.no_grad()
    def _render_sweep(self, body: object) -> Raw:
        asked: SweepRequest = validated(SweepRequest, body, "/render_sweep")
        T_ego_lidar = self._vehicle.T_ego_lidar
        if T_ego_lidar is None or asked.lidar_name not in self._lidar_names():
            names = ", ".join(self._lidar_names()) or "none, since the log had none"
            raise InputError(f"no lidar {asked.lidar_name!r}; there are: {names}")
        if not all(map(math.isfinite, asked.twist)):
            raise InputError(f"twist has to be finite, got {asked.twist}")
        lidar = self._lidar(asked.lidar_name, T_ego_lidar)
        T_lidar_ego = inverse_se3(T_ego_lidar.double())
        ego = self._ego(read_pose(asked.pose, "pose") @ T_lidar_ego, asked.timestamp, asked.twist)
        sweep = render_sweep(self._scene, self._graph, lidar, ego)
        hit = sweep.valid & sweep.returned
        sent = {
            "xyz": transform_points(T_lidar_ego.float(), sweep.points_ego[hit]),
            "intensity": sweep.intensity[hit],
            "time_s": sweep.dt_s[hit],
            "channel": sweep.beam[hit],
        }
        return Raw(encode_tensors(sent).encode(), "text/plain")

    def _lidar(self, name: str, T_ego_lidar: Float[Tensor, "4 4"]) -> SpinningLidar:
        own = self._vehicle.lidar
        return own if name == OWN_LIDAR and own is not None else LIDARS[name](T_ego_lidar, 10.0)

    def _ego(
        self, T_world_ego: Float64[Tensor, "4 4"], timestamp_us: int, twist: tuple[float, ...] = (0.0,) * 6
    ) -> EgoState:
        t_s = (timestamp_us - self._start_us) * 1e-6
        self._vehicle.check_time(t_s)
        T_scene_ego = (inverse_se3(self._vehicle.T_world_scene) @ T_world_ego).float()
        return EgoState(T_scene_ego, torch.tensor(twist), t_s)


def _picture(image: UInt8[Tensor, "H W 3"], kind: str) -> Raw:
    buffer = io.BytesIO()
    Image.fromarray(image.numpy()).save(buffer, format=kind.upper())
    return Raw(buffer.getvalue(), f"image/{kind}")
