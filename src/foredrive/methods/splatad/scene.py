"""A reconstructed scene of Gaussians, with decoders of their features."""

import functools
import math
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.geometry.projection import pixel_centres, pixels_to_rays
from foredrive.geometry.se3 import exp_se3, inverse_se3, rotate_vectors
from foredrive.methods.reconstruction.decoders import ALBEDO, CameraDecoder, LidarDecoder
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene, saved_tracks
from foredrive.methods.reconstruction.rendered import RenderedImage, RenderedSweep
from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.tracks import nonrigid_rows
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.methods.splatad.beams import PreparedSweep, prepared_sweep
from foredrive.methods.splatad.camera import project_camera
from foredrive.methods.splatad.content import RIGID, GaussianContent, gaussians_of
from foredrive.methods.splatad.deformation import Deformation
from foredrive.methods.splatad.lidar import project_lidar
from foredrive.methods.splatad.placing import project_scene
from foredrive.methods.splatad.scene_config import GaussianSceneConfig
from foredrive.ops.splat_points import TiledPoints, pixel_points
from foredrive.ops.splatting import BeforeHit, composite_splats

BACKGROUND = 0.5
"""Albedo of the background, where no Gaussian covers a pixel."""
UNSEEN_RGB = (0.149, 0.1647, 0.2157)
"""Colour of the background "after_decoder" outside of training, as in SplatAD's reference implementation."""
GAUSSIAN_PARAMETERS = ("mean_m", "quaternion", "log_scale", "opacity_logit", "albedo", "feature")
"""Parameters with one row per Gaussian."""
_LEAST_ALPHA = 1e-6


class GaussianScene(ReconstructedScene):
    """A `ReconstructedScene` of Gaussians (Kerbl et al., 2023), rendered as in SplatAD (Hess et al., 2025).

    Args:
        graph: initial scene of Gaussians.
        cameras: number of cameras in the rig.
        config: parts of the scene.
        reach_m: reach of the log's lidar.
        frames: number of training images and sweeps, in this order, with velocities of their own.
    """

    actor: Tensor
    code: Tensor | None

    def __init__(
        self,
        graph: SceneGraph,
        cameras: int,
        config: GaussianSceneConfig | None = None,
        reach_m: float = math.inf,
        frames: int = 0,
    ) -> None:
        config = config or GaussianSceneConfig()
        content = gaussians_of(graph)
        own, features = content.gaussians, content.gaussians.feature.shape[1] - ALBEDO
        camera_decoder = CameraDecoder(
            features, cameras, config.decoder
        )  # drawn before the frames' velocities
        lidar_decoder = LidarDecoder(features, config.drop_from_alpha)
        reach_m = reach_m if config.lidar_reach_m is None else config.lidar_reach_m
        super().__init__(graph.tracks, cameras, reach_m, frames, config.frame_velocities)
        self.config = config
        self.mean_m = nn.Parameter(own.mean_m)
        self.quaternion = nn.Parameter(own.quaternion)
        self.log_scale = nn.Parameter(own.log_scale)
        self.opacity_logit = nn.Parameter(own.opacity_logit)
        self.albedo = nn.Parameter(own.feature[:, :ALBEDO])
        self.feature = nn.Parameter(own.feature[:, ALBEDO:])
        self.register_buffer("actor", content.actor)
        self.camera_decoder, self.lidar_decoder = camera_decoder, lidar_decoder
        nonrigid = nonrigid_rows(graph.tracks)
        deformed = config.deformed_people and bool(nonrigid.any())
        code = torch.where(nonrigid, nonrigid.cumsum(0) - 1, RIGID)
        self.deformation = Deformation(graph.tracks) if deformed else None
        self.register_buffer("code", code if deformed else None, persistent=False)

    @property
    def gaussians(self) -> Gaussians:
        """All Gaussians; those of actors are in their own frames."""
        feature = torch.cat([self.albedo, self.feature], dim=-1)
        return Gaussians(self.mean_m, self.quaternion, self.log_scale, self.opacity_logit, feature)

    @property
    def content(self) -> GaussianContent:
        """The Gaussians, and what each belongs to."""
        return GaussianContent(self.gaussians, self.actor, self.deformation, self.code)

    @property
    def sizes(self) -> dict[str, int]:
        """The number of Gaussians."""
        return {"gaussians": len(self.actor)}

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
        # Parameters get the size of the saved ones; their values are loaded later
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
            # Parameters cannot grow in place: they are replaced
            setattr(self, name, nn.Parameter(torch.cat([getattr(self, name).detach(), added[name].detach()])))
        none = self.actor.new_full((len(gaussians.opacity_logit),), STATIC)
        self.actor = torch.cat([self.actor, none])

    def camera(
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
            mirror: see `place_actors`.
            frame: index of a training image, for `frame_twist`.
            background_rgb: colour of the background "after_decoder"; None: `UNSEEN_RGB`.
        """
        exposed = self.corrected_camera(view, frame)
        T_cam_scene = inverse_se3(exposed.T_scene_cam)
        # Gaussians at the time of exposure, with velocities for the time of each row
        splats = project_scene(
            graph,
            exposed.t_s,
            mirror,
            lambda gaussians, velocity_mps, among: project_camera(
                gaussians,
                T_cam_scene,
                view.K,
                view.dist,
                view.size_hw,
                velocity_mps=velocity_mps,
                among=among,
                twist_cam=exposed.twist_cam,
                near_m=self.config.camera_near_m,
            ),
        )
        readout_s = view.readout_s if self.config.rolling else 0.0
        seen = composite_splats(splats, _pixels(view.size_hw, readout_s), median=False)
        feature = seen.feature
        # Where light passes through, grey albedo fills up the rest before decoding
        if self.config.background == "albedo":
            grey = BACKGROUND * (1 - seen.alpha)[:, None]
            feature = torch.cat([feature[:, :ALBEDO] + grey, feature[:, ALBEDO:]], dim=-1)
        # Viewing direction of each pixel, which the decoder reads
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
            # The expected depth is a weighted sum: dividing by alpha gives the mean over the stopped light
            range_m=seen.expected_range_m.unflatten(0, view.size_hw) / alpha.clamp_min(_LEAST_ALPHA),
            alpha=alpha,
        )

    def prepare_sweep(self, view: SweepView) -> PreparedSweep:
        """Return the beams of a sweep for `sweep`, see `prepared_sweep`."""
        return prepared_sweep(view, self.config.rolling)

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
            points: result of `prepare_sweep`.
            t_s: time of the sweep.
            hit_range_m, before_hit: see `composite_splats`.
            mirror: see `place_actors`.
            frame: index of a training sweep, counted after the images, for `frame_twist`.
        """
        T_scene_lidar, twist = points.T_scene_lidar.to(self.mean_m), points.twist_lidar.to(self.mean_m)
        scan_s = None if points.scan_s is None else points.scan_s.to(self.mean_m)
        if frame is not None:
            more = self.frame_twist(frame)
            # The correction also moves the lidar between the sweep's time and its middle
            T_scene_lidar, twist = T_scene_lidar @ exp_se3(points.middle_s * more), twist + more
        T_lidar_scene = inverse_se3(T_scene_lidar)
        # The Gaussians are placed at the middle of the sweep, the time 0 of its beams
        splats = project_scene(
            graph,
            t_s + points.middle_s,
            mirror,
            lambda gaussians, velocity_mps, among: project_lidar(
                gaussians,
                T_lidar_scene,
                velocity_mps=velocity_mps,
                among=among,
                twist_lidar=twist,
                reach_m=self.reach_m,
                scan_s=scan_s,
            ),
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


def saved_scene(weights: Path, config: GaussianSceneConfig, reach_m: float) -> GaussianScene:
    """Return a scene of the sizes of saved weights, which are to be loaded into it.

    Raises:
        InputError: the file cannot be read or holds no weights of a scene of Gaussians.
    """
    try:
        saved = load_file(weights)
        features = saved["albedo"].shape[1] + saved["feature"].shape[1]
        gaussians = Gaussians(
            saved["mean_m"],
            saved["quaternion"],
            saved["log_scale"],
            saved["opacity_logit"],
            saved["albedo"].new_zeros(len(saved["albedo"]), features),
        )
        graph = SceneGraph(saved_tracks(saved), GaussianContent(gaussians, saved["actor"]))
        cameras, frames = len(saved["camera_late_s"]), len(saved.get("frame_velocity", ()))
    except (OSError, SafetensorError, KeyError) as error:
        raise InputError(f"{weights}: not the weights of a scene: {error}") from error
    return GaussianScene(graph, cameras, config, reach_m, frames)


@functools.lru_cache(maxsize=16)
def _pixels(size_hw: tuple[int, int], readout_s: float) -> TiledPoints:
    return pixel_points(size_hw, readout_s)
