"""A log rebuilt in seconds: hardly any Gaussians, hardly trained. What stands is an actor too."""

from foredrive.recipes.gaussians import GaussianRecipe
from foredrive.recipes.rebuilding import RebuildRecipe
from foredrive.rendering.decoders import CameraDecoderConfig
from foredrive.rendering.gaussians.initial import InitialGaussians
from foredrive.rendering.gaussians.scene_config import GaussianSceneConfig
from foredrive.training.gaussian_training import GaussianSchedule

SMALLEST = RebuildRecipe(
    name="smallest",
    image_hw=(24, 48),
    moves_m=0.0,
    representation=GaussianRecipe(
        initial=InitialGaussians(
            lidar_points=1100,
            unseen_points=400,
            pixel_points=1000,
            near_points=0,
            actor_points=80,
            features=2,
        ),
        schedule=GaussianSchedule(steps=2, max_gaussians=3000, beam_stride=4),
        scene=GaussianSceneConfig(CameraDecoderConfig(width=8)),
    ),
)
