"""Recipes for rebuilding logs from Gaussians."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from foredrive.errors import InputError
from foredrive.recipes.config import is_recipe_file, overridden, read_values, validated
from foredrive.recipes.known import nearest_name
from foredrive.recipes.old_formats import upgraded_reconstruction
from foredrive.rendering.decoders import CameraDecoderConfig
from foredrive.rendering.initial import InitialGaussians
from foredrive.rendering.scene_config import SceneConfig
from foredrive.training.gaussian_rates import LearningRates, Rate
from foredrive.training.rebuilding import RebuildSchedule


@dataclass(frozen=True)
class RebuildRecipe:
    """All settings of a reconstruction, except where the log is."""

    name: str
    image_hw: tuple[int, int]
    initial: InitialGaussians
    schedule: RebuildSchedule
    cameras: tuple[str, ...] | None = None
    """Names of cameras, their own or 123D's; None takes all."""
    hold_out_every: int = 2
    """The last frame of every group of this size is held out for evaluation; 0 holds out none."""
    actors: bool = True
    """Give moving actors their own Gaussians. If False, everything is static."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    drop: bool = True
    """Beams may fail to return. If False, all return."""
    about: str = field(default="", compare=False)
    """One line for lists of recipes."""


def gaussians_tiny() -> RebuildRecipe:
    """Return a recipe for some minutes on two cores, with images of 480×270."""
    steps = 500
    return RebuildRecipe(
        name="gaussians_tiny",
        about="a log rebuilt from Gaussians in minutes on two CPU cores",
        image_hw=(270, 480),
        initial=InitialGaussians(
            lidar_points=45_000,
            unseen_points=30_000,
            pixel_points=100_000,
            near_points=0,
            actor_points=50,
            max_actor_points=1000,
            features=8,
        ),
        schedule=RebuildSchedule(
            steps=steps,
            max_gaussians=275_000,
            rates=LearningRates(
                mean_m=Rate(5e-4, final=0.01), albedo=Rate(1e-2), feature=Rate(5e-3), decoders=Rate(3e-3)
            ),
            images_per_sweep=2,
            beam_stride=4,
            shrink_steps=(steps // 10,),
            grow_from=steps // 10,
            grow_until=steps * 8 // 10,
            grow_every=50,
            checkpoint_every=100,
        ),
        scene=SceneConfig(CameraDecoderConfig(width=12)),
    )


def gaussians_base() -> RebuildRecipe:
    """Return our version of SplatAD in its sizes, for a GPU. `gaussians_published` is nearer to it."""
    return RebuildRecipe(
        name="gaussians_base",
        about="our version of SplatAD in its sizes, for a GPU",
        image_hw=(1080, 1920),
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
        schedule=RebuildSchedule(
            steps=30_000, max_gaussians=5_000_000, shrink_steps=(3_000, 6_000), checkpoint_every=1_000
        ),
    )


def gaussians_published() -> RebuildRecipe:
    """Return SplatAD with the choices of its reference implementation, for a GPU.

    docs/architecture.md lists what still differs.
    """
    return RebuildRecipe(
        name="gaussians_published",
        about="SplatAD with the choices of its reference implementation, for a GPU",
        image_hw=(1080, 1920),
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
        schedule=RebuildSchedule(
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
        scene=SceneConfig(
            decoder=CameraDecoderConfig(blocks="residual"),
            background="after_decoder",
            drop_from_alpha=False,
            camera_near_m=0.5,
            lidar_reach_m=300.0,
            frame_velocities=True,
        ),
    )


REBUILD_RECIPES: dict[str, RebuildRecipe] = {
    recipe.name: recipe for recipe in (gaussians_tiny(), gaussians_base(), gaussians_published())
}


def load_rebuild_recipe(path: Path) -> RebuildRecipe:
    """Read a recipe from YAML, in today's format or an earlier one. Raises the errors of `load_recipe`."""
    recipe: RebuildRecipe = validated(RebuildRecipe, upgraded_reconstruction(read_values(path)), str(path))
    return recipe


def find_rebuild_recipe(name: str, settings: Sequence[str] = ()) -> RebuildRecipe:
    """Return a recipe by its name or from a YAML file. Arguments and errors are those of `find_recipe`."""
    if is_recipe_file(name):
        recipe = load_rebuild_recipe(Path(name))
    elif name in REBUILD_RECIPES:
        recipe = REBUILD_RECIPES[name]
    else:
        raise InputError(f"no recipe {name!r} to rebuild logs{nearest_name(name, REBUILD_RECIPES)}")
    return validated(RebuildRecipe, overridden(asdict(recipe), settings), name) if settings else recipe
