"""The named recipes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, overload

from foredrive.driver.recipes import DRIVER_RECIPES, DriverRecipe
from foredrive.engine.config import is_recipe_file, nearest_name, overridden, read_values, validated
from foredrive.errors import InputError
from foredrive.methods.driveworld.ablations import driveworld_ablations
from foredrive.methods.driveworld.recipes import driveworld_base, driveworld_tiny, driveworld_town
from foredrive.methods.nemo.ablations import nemo_ablations
from foredrive.methods.nemo.recipes import (
    BASE_BEV,
    TOWN_BEV,
    nemo_base,
    nemo_drive,
    nemo_tiny,
    nemo_town,
    nemo_wide,
)
from foredrive.methods.recipe import Recipe
from foredrive.runs.recipes.reconstruction import (
    RECONSTRUCTION_RECIPES,
    ReconstructionRecipe,
    reconstruction_recipe_from,
)
from foredrive.runs.recipes.world_models import recipe_from

RECIPES: dict[str, Recipe[Any, Any]] = {
    "nemo_tiny": nemo_tiny(),
    "nemo_drive": nemo_drive(),
    "nemo_wide": nemo_wide(),
    **nemo_ablations(nemo_town(), TOWN_BEV),
    **nemo_ablations(nemo_base(), BASE_BEV),
    "driveworld_tiny": driveworld_tiny(),
    **driveworld_ablations(driveworld_town()),
    **driveworld_ablations(driveworld_base()),
}


AnyRecipe = Recipe[Any, Any] | DriverRecipe | ReconstructionRecipe[Any]
T = TypeVar("T", bound=AnyRecipe)


class _Kind(NamedTuple):
    """A kind of recipe."""

    verb: str
    """What `foredrive` does with it."""
    recipes: Mapping[str, AnyRecipe]
    read: Callable[[Any, str], AnyRecipe]
    """Validates plain values from a named source."""
    fits: Callable[[Mapping[str, Any]], bool]
    """Whether the values of a file are of this kind."""


KINDS: dict[type, _Kind] = {
    DriverRecipe: _Kind(
        "train",
        DRIVER_RECIPES,
        lambda values, source: validated(DriverRecipe, values, source),
        lambda values: values.get("kind") == "driver",
    ),
    ReconstructionRecipe: _Kind(
        "reconstruct",
        RECONSTRUCTION_RECIPES,
        reconstruction_recipe_from,
        lambda values: "representation" in values,
    ),
    Recipe: _Kind("train", RECIPES, recipe_from, lambda _: True),
}
"""The kinds of recipes; a file is of the first that fits."""


@overload
def find_recipe(name: str, settings: Sequence[str] = ()) -> Recipe[Any, Any]: ...


@overload
def find_recipe(name: str, settings: Sequence[str] = (), *kinds: type[T]) -> T: ...


def find_recipe(name: str, settings: Sequence[str] = (), *kinds: type) -> Any:
    """Return a recipe by its name or from a YAML file.

    Args:
        name: name of a recipe, or the path of a file.
        settings: entries KEY.KEY=VALUE to replace in the recipe.
        kinds: kinds that are wanted, keys of `KINDS`; by default that of world models.

    Raises:
        InputError: there is no such recipe, it is of another kind, or a setting does not fit it.
    """
    wanted = kinds or (Recipe,)
    kind, values = _values_of(name, wanted)
    if kind not in wanted:
        raise InputError(f"{name}: this recipe is for `foredrive {KINDS[kind].verb}`")
    recipe = KINDS[kind].read(values, name)
    # Entries that a file leaves out have their defaults by now, so that settings may replace these too
    return KINDS[kind].read(overridden(asdict(recipe), settings), name) if settings else recipe


def _values_of(name: str, wanted: Sequence[type]) -> tuple[type, Any]:
    """Return the kind and the plain values of a recipe by its name or from a YAML file.

    Raises:
        InputError: there is none. The message has near names of recipes for the same verbs.
    """
    if is_recipe_file(name):
        values = read_values(Path(name))
        fields = values if isinstance(values, Mapping) else {}
        return next(kind for kind, row in KINDS.items() if row.fits(fields)), values
    for kind, row in KINDS.items():
        if name in row.recipes:
            return kind, asdict(row.recipes[name])
    verbs = {KINDS[kind].verb for kind in wanted}
    names = [recipe for row in KINDS.values() if row.verb in verbs for recipe in row.recipes]
    raise InputError(f"no recipe {name!r}{nearest_name(name, names)}")
