"""Scenes of Gaussians as a representation that recipes can name."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.engine.learning_rates import Rate
from foredrive.methods.blocks.losses import ImageFeatures
from foredrive.methods.reconstruction.decoders import CameraDecoderConfig
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.training import SensorViews
from foredrive.methods.splatad.initial import InitialGaussians, initial_scene
from foredrive.methods.splatad.rates import LearningRates
from foredrive.methods.splatad.scene import GaussianScene, saved_scene
from foredrive.methods.splatad.scene_config import GaussianSceneConfig
from foredrive.methods.splatad.training import GaussianSchedule, GaussianTraining
from foredrive.methods.splatad.unseen_ground import add_unseen_ground

_COPIES = 14
"""Copies of each number of a Gaussian: the value, its gradient, two moments, and the tensors that autograd
keeps in a step.
"""
_FLOATS_PER_PIXEL = 600
"""Floats that autograd keeps for each pixel: features, the decoder's hidden layers, SSIM."""


@dataclass(frozen=True)
class GaussianRecipe:
    """A scene of Gaussians (Kerbl et al., 2023; Hess et al., "SplatAD", 2025): a `Representation`."""

    initial: InitialGaussians
    schedule: GaussianSchedule
    scene: GaussianSceneConfig = field(default_factory=GaussianSceneConfig)
    kind: Literal["gaussians"] = "gaussians"

    def begin(self, views: SensorViews, tracks: ActorTracks, cameras: int, reach_m: float) -> GaussianScene:
        """Return the scene before training: Gaussians at lidar points and along pixels."""
        generator = torch.Generator().manual_seed(self.schedule.seed)
        graph = initial_scene(list(views.cameras), list(views.sweeps), tracks, self.initial, generator)
        torch.manual_seed(self.schedule.seed)  # the decoders' weights
        frames = len(views.cameras) + len(views.sweeps)
        return GaussianScene(graph, cameras, self.scene, reach_m, frames)

    def open(self, weights: Path, reach_m: float) -> GaussianScene:
        """Return a scene of the sizes of saved weights, which are to be loaded into it."""
        return saved_scene(weights, self.scene, reach_m)

    def training(
        self, scene: GaussianScene, views: SensorViews, tower: Callable[[], ImageFeatures] | None = None
    ) -> GaussianTraining:
        """Return the training of a scene on views. Gaussians have no perceptual loss."""
        return GaussianTraining(scene, views, self.schedule)

    def complete(self, scene: GaussianScene, T_scene_ego: Float[Tensor, "K 4 4"], views: SensorViews) -> None:
        """Add ground that no sensor saw to a trained scene."""
        add_unseen_ground(scene, T_scene_ego, views.cameras)

    def learning_gib(self, pixels: int) -> float:
        """Estimate the memory that training takes besides its data, GiB, with images of so many pixels."""
        # Numbers of one Gaussian: mean, quaternion, scale, opacity, albedo, features
        floats_per_gaussian = 3 + 4 + 3 + 1 + 3 + self.initial.features
        floats = self.schedule.max_gaussians * floats_per_gaussian * _COPIES + pixels * _FLOATS_PER_PIXEL
        return 4 * floats / 1024**3


def tiny_gaussians() -> GaussianRecipe:
    """Return Gaussians for some minutes on two cores, with images of 480×270."""
    steps = 500
    return GaussianRecipe(
        initial=InitialGaussians(
            lidar_points=45_000,
            unseen_points=30_000,
            pixel_points=100_000,
            near_points=0,
            actor_points=50,
            max_actor_points=1000,
            features=8,
        ),
        schedule=GaussianSchedule(
            steps=steps,
            max_gaussians=275_000,
            # Shapes learn five times as fast as in the longer training of the paper. Colours do not: those
            # that no camera sees would drift.
            rates=LearningRates(
                mean_m=Rate(5e-4, final=0.01),
                quaternion=Rate(5e-3),
                log_scale=Rate(2.5e-2),
                opacity_logit=Rate(0.15),
                albedo=Rate(1e-2),
                feature=Rate(5e-3),
                decoders=Rate(3e-3),
                deformation=Rate(5e-3),
            ),
            images_per_sweep=2,
            beam_stride=4,
            shrink_steps=(steps // 10,),
            grow_from=steps // 10,
            grow_until=steps * 8 // 10,
            grow_every=50,
            checkpoint_every=100,
        ),
        scene=GaussianSceneConfig(CameraDecoderConfig(width=12)),
    )


def small_gaussians() -> GaussianRecipe:
    """Return Gaussians for ten minutes on one core, with images of 480×270."""
    tiny = tiny_gaussians()
    schedule = replace(tiny.schedule, steps=2_000, max_gaussians=400_000, grow_from=100, grow_until=1_600)
    return replace(tiny, schedule=schedule)


def base_gaussians() -> GaussianRecipe:
    """Return our version of SplatAD in its sizes."""
    return GaussianRecipe(
        initial=InitialGaussians(
            lidar_points=1_500_000,
            unseen_points=500_000,
            pixel_points=300_000,
            near_points=300_000,
            actor_points=500,
            max_actor_points=100_000,
            features=13,
            scale=0.2,
        ),
        schedule=GaussianSchedule(
            steps=30_000, max_gaussians=5_000_000, shrink_steps=(3_000, 6_000), checkpoint_every=1_000
        ),
    )


def published_gaussians() -> GaussianRecipe:
    """Return SplatAD with the choices of its reference implementation."""
    return GaussianRecipe(
        initial=InitialGaussians(
            lidar_points=1_500_000,
            unseen_points=500_000,
            pixel_points=0,
            near_points=0,
            actor_points=500,
            max_actor_points=2_000_000,
            features=13,
            near_opacity=0.5,
            scale=0.2,
            random_far_points=300_000,
            random_near_points=300_000,
            random_features=True,
            random_rotations=True,
        ),
        schedule=GaussianSchedule(
            steps=30_000,
            max_gaussians=5_000_000,
            shrink_steps=(3_000, 6_000),
            checkpoint_every=1_000,
            lidar_losses="published",
            rates=LearningRates(
                quaternion=Rate(1e-3, final=1.0),
                log_scale=Rate(5e-3, final=1.0),
                opacity_logit=Rate(5e-2, final=1.0),
                albedo=Rate(2.5e-3, final=1.0),
                feature=Rate(2.5e-3, final=1.0),
                decoders=Rate(1e-3, final=1.0, warmup_steps=500),
                actor_offset=Rate(1e-3, final=0.1, warmup_steps=2_500, until_step=20_001),
                camera_offset=Rate(0.0),
                camera_twist=Rate(0.0),
                camera_late_s=Rate(2e-4, final=5e-4, warmup_steps=10_000),
                frame_velocity=Rate(1e-3, final=1e-3, warmup_steps=1_000),
                frame_turn=Rate(2e-4, final=5e-4, warmup_steps=1_000),
            ),
        ),
        scene=GaussianSceneConfig(
            decoder=CameraDecoderConfig(blocks="residual"),
            background="after_decoder",
            drop_from_alpha=False,
            camera_near_m=0.5,
            lidar_reach_m=300.0,
            frame_velocities=True,
        ),
    )
