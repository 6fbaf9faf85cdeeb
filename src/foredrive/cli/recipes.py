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
        from foredrive.engine.config import explained_yaml
        from foredrive.runs.recipes.known import KINDS, find_recipe

    if name is not None:
        print(explained_yaml(find_recipe(name, (), *KINDS)), end="")
        return
    for kind in reversed(KINDS.values()):
        print(f"foredrive {kind.verb}:")
        for key, entry in kind.recipes.items():
            print(f"  {key:28} {entry.about}")
