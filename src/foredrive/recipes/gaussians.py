"""How logs are rebuilt from Gaussians."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from foredrive.errors import InputError
from foredrive.recipes.config import is_recipe_file, load_values, overridden, validated
from foredrive.recipes.known import nearest_name
from foredrive.rendering.initial import InitialSize
from foredrive.training.rebuilding import LearningRates, RebuildSchedule


@dataclass(frozen=True)
class RebuildRecipe:
    """Everything that decides a reconstruction, but for where the log is."""

    name: str
    image_hw: tuple[int, int]
    initial: InitialSize
    schedule: RebuildSchedule
    cameras: tuple[str, ...] | None = None
    """By their own or 123D's names; None takes all."""
    hold_out_every: int = 2
    """Of so many frames the last is not learned from, and judged on; 0 learns from all."""
    actors: bool = True
    """What moves has Gaussians of its own; False: all stands still."""
    decoder_width: int = 32
    """Channels of the camera's decoder."""
    rolling: bool = True
    """Rows of an image and beams of a sweep look at their own times."""
    drop: bool = True
    """Beams may fail to return; False: all do."""
    about: str = field(default="", compare=False)
    """One line for lists of recipes."""


def gaussians_tiny() -> RebuildRecipe:
    """Some minutes on two cores, images of 480×270."""
    steps = 500
    return RebuildRecipe(
        name="gaussians_tiny",
        about="a log rebuilt from Gaussians in minutes on two CPU cores",
        image_hw=(270, 480),
        initial=InitialSize(
            lidar_points=45_000,
            unseen_points=30_000,
            pixel_points=100_000,
            near_points=0,
            actor_points=50,
            actor_points_most=1000,
            features=8,
        ),
        schedule=RebuildSchedule(
            steps=steps,
            most_gaussians=275_000,
            rates=LearningRates(mean_m=5e-4, albedo=1e-2, feature=5e-3, decoders=3e-3),
            images_per_sweep=2,
            beam_stride=4,
            shrink_steps=(steps // 10,),
            grow_from=steps // 10,
            grow_until=steps * 8 // 10,
            grow_every=50,
            checkpoint_every=100,
        ),
        decoder_width=12,
    )


def gaussians_base() -> RebuildRecipe:
    """SplatAD as published, for a GPU: all cameras at full size, 30 000 steps, five million Gaussians."""
    return RebuildRecipe(
        name="gaussians_base",
        about="SplatAD's sizes, for a GPU",
        image_hw=(1080, 1920),
        initial=InitialSize(
            lidar_points=1_500_000,
            unseen_points=500_000,
            pixel_points=300_000,
            near_points=300_000,
            actor_points=500,
            actor_points_most=100_000,
            features=13,
            scale=0.2,
        ),
        schedule=RebuildSchedule(
            steps=30_000, most_gaussians=5_000_000, shrink_steps=(3_000, 6_000), checkpoint_every=1_000
        ),
    )


REBUILD_RECIPES: dict[str, RebuildRecipe] = {
    recipe.name: recipe for recipe in (gaussians_tiny(), gaussians_base())
}


def find_rebuild_recipe(name: str, settings: Sequence[str] = ()) -> RebuildRecipe:
    """Return a recipe by its name or from a YAML file; arguments and errors as of `find_recipe`."""
    if is_recipe_file(name):
        recipe = load_values(RebuildRecipe, Path(name))
    elif name in REBUILD_RECIPES:
        recipe = REBUILD_RECIPES[name]
    else:
        raise InputError(f"no recipe {name!r} to rebuild logs{nearest_name(name, REBUILD_RECIPES)}")
    return validated(RebuildRecipe, overridden(asdict(recipe), settings), name) if settings else recipe
