"""The recipes that have a name."""

from foredrive.errors import InputError
from foredrive.recipes.config import Recipe
from foredrive.recipes.driveworld import driveworld_base, driveworld_tiny, driveworld_town
from foredrive.recipes.driveworld_rows import driveworld_rows
from foredrive.recipes.nemo import BASE_BEV, TOWN_BEV, nemo_base, nemo_drive, nemo_tiny, nemo_town
from foredrive.recipes.nemo_rows import nemo_rows

RECIPES: dict[str, Recipe] = {
    "nemo_tiny": nemo_tiny(),
    "nemo_drive": nemo_drive(),
    **nemo_rows(nemo_town(), TOWN_BEV),
    **nemo_rows(nemo_base(), BASE_BEV),
    "driveworld_tiny": driveworld_tiny(),
    **driveworld_rows(driveworld_town()),
    **driveworld_rows(driveworld_base()),
}


def find_recipe(name: str) -> Recipe:
    """The recipe of a name.

    Raises:
        InputError: naming the known ones, if there is none of that name.
    """
    if name not in RECIPES:
        raise InputError(f"no recipe {name!r}; there are: {', '.join(RECIPES)}")
    return RECIPES[name]
