"""`foredrive recipes`."""

from typing import Annotated

import tyro

from foredrive.lazy import importing


def recipes(
    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="RECIPE")] = None,
) -> None:
    """List the recipes, or print one as YAML, to edit it and pass it to `train` or `reconstruct`.

    Comments say what each entry means.

    Args:
        name: Print this recipe; without a name, all recipes are listed.
    """
    with importing():
        from foredrive.driver.recipes import DRIVER_RECIPES
        from foredrive.engine.config import explained_yaml
        from foredrive.runs.recipes.known import RECIPES, find_driver_recipe, find_recipe
        from foredrive.runs.recipes.rebuilding import REBUILD_RECIPES, find_rebuild_recipe

    if name is not None:
        driver = find_driver_recipe(name)
        recipe = driver or (find_rebuild_recipe(name) if name in REBUILD_RECIPES else find_recipe(name))
        print(explained_yaml(recipe), end="")
        return
    for verb, table in (("train", RECIPES), ("train", DRIVER_RECIPES), ("reconstruct", REBUILD_RECIPES)):
        print(f"foredrive {verb}:")
        for key, entry in table.items():
            print(f"  {key:28} {entry.about}")
