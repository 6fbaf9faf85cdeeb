"""`foredrive recipes` and `foredrive models`."""

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


def models(
    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")] = None,
) -> None:
    """List the trained models that come with the package, or print the card of one.

    A model's name can stand wherever a run is asked for. The towers are those of `foredrive search`.

    Args:
        name: Print the card of this model, such as nemo_town, or of the towers.
    """
    with importing():
        from rich.console import Console

        from foredrive.runs.model_card import find_card, shipped_weights
        from foredrive.view.model_tables import figures_table, models_table
        from foredrive.view.table import print_table

    if name is not None:
        print(find_card(name).read_text(), end="")
        return
    console, weights = Console(), shipped_weights()
    print_table(models_table(weights), console)
    for entry in weights:
        console.print(f"{entry.name}: {entry.data}", markup=False, highlight=False)
        if entry.card is not None:
            print_table(figures_table(entry.card), console)
