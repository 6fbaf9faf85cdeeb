"""A rebuilt scene: Gaussians, tracks, sensor corrections and decoders, all learned."""

import dataclasses
import functools
import math
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.geometry.projection import pixel_centres, pixels_to_rays
from foredrive.geometry.se3 import exp_se3, inverse_se3, rotate_vectors, sensor_twist
from foredrive.ops.splat_points import TiledPoints, pixel_points
from foredrive.ops.splatting import BeforeHit, composite_splats
from foredrive.rendering.decoders import ALBEDO, CameraDecoder, LidarDecoder
from foredrive.rendering.gaussians import (
    Gaussians,
    project_camera,
    project_lidar,
    scan_times,
    tiled_lidar_beams,
)
from foredrive.rendering.rendered import PreparedSweep, RenderedImage, RenderedSweep
from foredrive.rendering.scene_config import SceneConfig
from foredrive.rendering.scene_graph import STATIC, SceneGraph, place_gaussians
from foredrive.rendering.tracks import ActorTracks
from foredrive.rendering.views import CameraView, SweepView
from foredrive.sensors import TimedRays

BACKGROUND = 0.5
"""Albedo of the background, where no Gaussian covers a pixel."""
UNSEEN_RGB = (0.149, 0.1647, 0.2157)
"""Colour of the background "after_decoder" outside of training, as in SplatAD's reference implementation."""
_FIRST_VELOCITY_MPS, _FIRST_TURN_RADPS = 0.05, 5e-5
"""Bounds of the initial corrections of the frames' velocities."""
GAUSSIAN_PARAMETERS = ("mean_m", "quaternion", "log_scale", "opacity_logit", "albedo", "feature")
"""Parameters with one row per Gaussian."""
_LEAST_ALPHA = 1e-6


class RebuiltScene(nn.Module):
    """The learned parts of a log's scene.

    Args:
        graph: initial scene.
        cameras: number of cameras in the rig.
        config: parts of the scene.
        reach_m: reach of the log's lidar.
        frames: number of training images and sweeps, in this order, with velocities of their own.
    """

    actor: Tensor
    category: Tensor
    key_t_s: Tensor
    present: Tensor
    size_lwh: Tensor
    track_id: Tensor
    T_scene_actor: Tensor

    def __init__(
        self,
        graph: SceneGraph,
        cameras: int,
        config: SceneConfig | None = None,
        reach_m: float = math.inf,
        frames: int = 0,
    ) -> None:
        super().__init__()
        self.config = config = config or SceneConfig()
        self.reach_m = reach_m if config.lidar_reach_m is None else config.lidar_reach_m
        own = graph.gaussians
        self.mean_m = nn.Parameter(own.mean_m)
        self.quaternion = nn.Parameter(own.quaternion)
        self.log_scale = nn.Parameter(own.log_scale)
        self.opacity_logit = nn.Parameter(own.opacity_logit)
        self.albedo = nn.Parameter(own.feature[:, :ALBEDO])
        self.feature = nn.Parameter(own.feature[:, ALBEDO:])
        self.register_buffer("actor", graph.actor)
        tracks = graph.tracks
        for name in ("track_id", "category", "size_lwh", "T_scene_actor", "present"):
            self.register_buffer(name, getattr(tracks, name))
        self.register_buffer("key_t_s", tracks.t_s)
        self.actor_offset = nn.Parameter(torch.zeros(*tracks.present.shape, 6))
        """Offsets of key poses, in the actors' own axes: m, rad."""
        self.camera_offset = nn.Parameter(torch.zeros(cameras, 6))
        """Offsets of the camera mounts, in the cameras' own axes: m, rad."""
        self.camera_twist = nn.Parameter(torch.zeros(cameras, 6))
        """Corrections of the cameras' velocities and turn rates."""
        self.camera_late_s = nn.Parameter(torch.zeros(cameras))
        """Delay of each camera's exposure with respect to its logged time, s."""
        features = self.feature.shape[1]
        self.camera_decoder = CameraDecoder(features, cameras, config.decoder)
        self.lidar_decoder = LidarDecoder(features, config.drop_from_alpha)
        self.frame_velocity = self.frame_turn = None
        if config.frame_velocities:
            self.frame_velocity = nn.Parameter(_FIRST_VELOCITY_MPS * (2 * torch.rand(frames, 3) - 1))
            self.frame_turn = nn.Parameter(_FIRST_TURN_RADPS * (2 * torch.rand(frames, 3) - 1))

    @property
    def gaussians(self) -> Gaussians:
        """All Gaussians; those of actors are in their own frames."""
        feature = torch.cat([self.albedo, self.feature], dim=-1)
        return Gaussians(self.mean_m, self.quaternion, self.log_scale, self.opacity_logit, feature)

    @property
    def tracks(self) -> ActorTracks:
        """The tracks with learned offsets."""
        logged = ActorTracks(
            self.track_id, self.category, self.size_lwh, self.key_t_s, self.T_scene_actor, self.present
        )
        return logged.moved(self.actor_offset)

    @property
    def graph(self) -> SceneGraph:
        """The scene with its current parameters."""
        return SceneGraph(self.gaussians, self.actor, self.tracks)

    def resize(self, file: Path) -> None:
        """Resize the parameters for the weights in a file, which may hold another number of Gaussians.

        Raises:
            InputError: the file cannot be read or holds no weights of a scene.
        """
        try:
            with safe_open(file, "pt") as saved:
                count = saved.get_slice("actor").get_shape()[0]
        except (OSError, SafetensorError) as error:
            raise InputError(f"{file}: weights of a scene cannot be read: {error}") from error
        self.actor = self.actor.new_zeros(count)
        for name in GAUSSIAN_PARAMETERS:
            old = getattr(self, name)
            setattr(self, name, nn.Parameter(old.new_zeros(count, *old.shape[1:])))

    def add_static(self, gaussians: Gaussians) -> None:
        """Add Gaussians to the static part."""
        added = {
            name: getattr(gaussians, name) for name in ("mean_m", "quaternion", "log_scale", "opacity_logit")
        }
        added |= {"albedo": gaussians.feature[:, :ALBEDO], "feature": gaussians.feature[:, ALBEDO:]}
        for name in GAUSSIAN_PARAMETERS:
            setattr(self, name, nn.Parameter(torch.cat([getattr(self, name).detach(), added[name].detach()])))
        none = self.actor.new_full((len(gaussians.opacity_logit),), STATIC)
        self.actor = torch.cat([self.actor, none])

    def frame_twist(self, frame: int | None) -> Float[Tensor, "6"]:
        """Return the learned correction of a training frame's twist; 0 for None, and if there are none."""
        if frame is None or self.frame_velocity is None or self.frame_turn is None:
            return self.mean_m.new_zeros(6)
        return torch.cat([self.frame_velocity[frame], self.frame_turn[frame]])

    def forward(
        self,
        graph: SceneGraph,
        view: CameraView,
        mirror: Bool[Tensor, "A"] | None = None,
        frame: int | None = None,
        background_rgb: Float[Tensor, "3"] | None = None,
    ) -> RenderedImage:
        """Render an image.

        Args:
            graph: this scene, or an edited version of it.
            view: the camera; its image is not read.
            mirror: see `place_gaussians`.
            frame: index of a training image, for `frame_twist`.
            background_rgb: colour of the background "after_decoder"; None: `UNSEEN_RGB`.
        """
        late_s, twist = self.camera_late_s[view.sensor], view.twist_cam + self.camera_twist[view.sensor]
        if frame is not None:
            twist = twist + self.frame_twist(frame)
        T_scene_cam = view.T_scene_cam @ exp_se3(self.camera_offset[view.sensor]) @ exp_se3(late_s * twist)
        placed = place_gaussians(graph, view.t_s + late_s, mirror)
        splats = project_camera(
            placed.gaussians,
            inverse_se3(T_scene_cam),
            view.K,
            view.dist,
            view.size_hw,
            velocity_mps=placed.velocity_mps,
            twist_cam=twist,
            near_m=self.config.camera_near_m,
        )
        seen = composite_splats(splats, _pixels(view.size_hw, view.readout_s if self.config.rolling else 0.0))
        feature = seen.feature
        if self.config.background == "albedo":
            grey = BACKGROUND * (1 - seen.alpha)[:, None]
            feature = torch.cat([feature[:, :ALBEDO] + grey, feature[:, ALBEDO:]], dim=-1)
        rays = pixels_to_rays(pixel_centres(view.size_hw).to(view.K).flatten(0, 1), view.K, view.dist)
        direction = rotate_vectors(view.T_scene_cam, rays)
        alpha = seen.alpha.unflatten(0, view.size_hw)
        rgb = self.camera_decoder(
            feature.unflatten(0, view.size_hw), direction.unflatten(0, view.size_hw), view.sensor
        )
        if self.config.background == "after_decoder":
            colour = rgb.new_tensor(UNSEEN_RGB) if background_rgb is None else background_rgb.to(rgb)
            rgb = rgb + (1 - alpha) * colour[:, None, None]
        return RenderedImage(
            rgb=rgb,
            range_m=seen.expected_range_m.unflatten(0, view.size_hw) / alpha.clamp_min(_LEAST_ALPHA),
            alpha=alpha,
        )

    def prepare_sweep(self, view: SweepView) -> PreparedSweep:
        """Return the beams of a sweep in the lidar's frame: axes of the vehicle, origin at the lidar.

        Time 0 of the beams is the middle of the sweep. The motion of each Gaussian is right at the time at
        which its azimuth is scanned.
        """
        beams = view.beams
        rays = TimedRays(beams.origin_ego, beams.dir_ego, beams.dt_s)
        T_ego_lidar = torch.eye(4).to(beams.origin_ego)
        if len(beams.dt_s):
            T_ego_lidar[:3, 3] = beams.origin_ego[beams.dt_s.abs().argmin()]
        twist, middle_s = view.twist_ego, 0.0
        if not self.config.rolling:
            twist, rays = torch.zeros_like(twist), dataclasses.replace(rays, dt_s=torch.zeros_like(rays.dt_s))
        elif len(rays.dt_s):
            middle_s = float(rays.dt_s.min() + rays.dt_s.max()) / 2
        tiles = tiled_lidar_beams(rays, T_ego_lidar, twist, middle_s)
        return PreparedSweep(
            tiles=tiles,
            scan_s=scan_times(tiles) if bool(tiles.time_s.any()) else None,
            dir_scene=rotate_vectors(view.T_scene_ego, beams.dir_ego),
            T_scene_lidar=view.T_scene_ego @ exp_se3(middle_s * twist) @ T_ego_lidar,
            twist_lidar=sensor_twist(T_ego_lidar, view.twist_ego),
            middle_s=middle_s,
        )

    def sweep(
        self,
        graph: SceneGraph,
        points: PreparedSweep,
        t_s: float,
        hit_range_m: Float[Tensor, "P"] | None = None,
        mirror: Bool[Tensor, "A"] | None = None,
        before_hit: BeforeHit = "weights",
        frame: int | None = None,
    ) -> RenderedSweep:
        """Render a sweep.

        Args:
            graph: this scene, or an edited version of it.
            points: from `prepare_sweep`.
            t_s: time of the sweep.
            hit_range_m, before_hit: see `composite_splats`.
            mirror: see `place_gaussians`.
            frame: index of a training sweep, counted after the images, for `frame_twist`.
        """
        placed = place_gaussians(graph, t_s + points.middle_s, mirror)
        T_scene_lidar = points.T_scene_lidar.to(placed.velocity_mps)
        twist = points.twist_lidar.to(placed.velocity_mps)
        if frame is not None:
            more = self.frame_twist(frame)
            T_scene_lidar, twist = T_scene_lidar @ exp_se3(points.middle_s * more), twist + more
        splats = project_lidar(
            placed.gaussians,
            inverse_se3(T_scene_lidar),
            velocity_mps=placed.velocity_mps,
            twist_lidar=twist,
            reach_m=self.reach_m,
            scan_s=None if points.scan_s is None else points.scan_s.to(placed.velocity_mps),
        )
        seen = composite_splats(splats, points.tiles, hit_range_m, before_hit=before_hit)
        intensity, drop_logit = self.lidar_decoder(
            seen.feature, seen.alpha, points.dir_scene.to(seen.feature)
        )
        return RenderedSweep(
            range_m=seen.expected_range_m / seen.alpha.clamp_min(_LEAST_ALPHA),
            median_range_m=seen.median_range_m,
            intensity=intensity,
            drop_logit=drop_logit,
            alpha=seen.alpha,
            alpha_before_hit=seen.alpha_before_hit,
        )


@functools.lru_cache(maxsize=16)
def _pixels(size_hw: tuple[int, int], readout_s: float) -> TiledPoints:
    return pixel_points(size_hw, readout_s)
