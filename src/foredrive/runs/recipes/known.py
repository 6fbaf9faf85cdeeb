"""The named recipes."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from foredrive.driver.recipes import DRIVER_RECIPES, DriverRecipe
from foredrive.engine.config import is_recipe_file, nearest_name, overridden, read_values, validated
from foredrive.errors import InputError
from foredrive.methods.driveworld.ablations import driveworld_ablations
from foredrive.methods.driveworld.recipes import driveworld_base, driveworld_tiny, driveworld_town
from foredrive.methods.nemo.ablations import nemo_ablations
from foredrive.methods.nemo.recipes import BASE_BEV, TOWN_BEV, nemo_base, nemo_drive, nemo_tiny, nemo_town
from foredrive.methods.recipe import Recipe
from foredrive.runs.recipes.world_models import load_recipe, recipe_from

RECIPES: dict[str, Recipe[Any, Any]] = {
    "nemo_tiny": nemo_tiny(),
    "nemo_drive": nemo_drive(),
    **nemo_ablations(nemo_town(), TOWN_BEV),
    **nemo_ablations(nemo_base(), BASE_BEV),
    "driveworld_tiny": driveworld_tiny(),
    **driveworld_ablations(driveworld_town()),
    **driveworld_ablations(driveworld_base()),
}


def find_recipe(name: str, settings: Sequence[str] = ()) -> Recipe[Any, Any]:
    """Return a recipe by its name or from a YAML file.

    Args:
        name: a key of `RECIPES`, or the path of a file.
        settings: entries KEY.KEY=VALUE to replace in the recipe.

    Raises:
        InputError: there is no such recipe, or a setting does not fit it.
    """
    if is_recipe_file(name):
        recipe = load_recipe(Path(name))
    elif name in RECIPES:
        recipe = RECIPES[name]
    else:
        raise InputError(f"no recipe {name!r}{nearest_name(name, [*RECIPES, *DRIVER_RECIPES])}")
    return recipe_from(overridden(asdict(recipe), settings), name) if settings else recipe


def find_driver_recipe(name: str, settings: Sequence[str] = ()) -> DriverRecipe | None:
    """Return the recipe of a driver as `find_recipe` does. None: the name is that of another recipe.

    Raises:
        InputError: the file cannot be read, or a setting does not fit.
    """
    if is_recipe_file(name):
        values = read_values(Path(name))
        if not isinstance(values, dict) or values.get("kind") != "driver":
            return None
    elif name in DRIVER_RECIPES:
        values = asdict(DRIVER_RECIPES[name])
    else:
        return None
    recipe: DriverRecipe = validated(DriverRecipe, overridden(values, settings), name)
    return recipe
