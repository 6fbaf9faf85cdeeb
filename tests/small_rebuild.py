"""A log rebuilt in seconds: hardly any Gaussians, hardly trained."""

from foredrive.recipes.gaussians import RebuildRecipe
from foredrive.rendering.decoders import CameraDecoderConfig
from foredrive.rendering.initial import InitialGaussians
from foredrive.rendering.scene_config import SceneConfig
from foredrive.training.rebuilding import RebuildSchedule

SMALLEST = RebuildRecipe(
    name="smallest",
    image_hw=(24, 48),
    initial=InitialGaussians(
        lidar_points=1100, unseen_points=400, pixel_points=1000, near_points=0, actor_points=80, features=2
    ),
    schedule=RebuildSchedule(steps=2, max_gaussians=3000, beam_stride=4),
    scene=SceneConfig(CameraDecoderConfig(width=8)),
)
