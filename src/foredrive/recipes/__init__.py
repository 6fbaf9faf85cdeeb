"""Python functions that return one frozen configuration each, and the runs put together from them."""

from foredrive.errors import InputError
from foredrive.recipes.config import Recipe, labelled_by
from foredrive.recipes.demo import DemoSize, full_demo, quick_demo, run_demo
from foredrive.recipes.evaluate import Inspection, evaluate_run, inspect_run
from foredrive.recipes.nemo import BASE_BEV, TOWN_BEV, nemo_base, nemo_tiny, nemo_town
from foredrive.recipes.nemo_rows import nemo_rows
from foredrive.recipes.train import Run, find_all_logs, open_run, train_run

RECIPES: dict[str, Recipe] = {
    "nemo_tiny": nemo_tiny(),
    **nemo_rows(nemo_town(), TOWN_BEV),
    **nemo_rows(nemo_base(), BASE_BEV),
}


def find_recipe(name: str) -> Recipe:
    """The recipe of a name.

    Raises:
        InputError: naming the known ones, if there is none of that name.
    """
    if name not in RECIPES:
        raise InputError(f"no recipe {name!r}; there are: {', '.join(RECIPES)}")
    return RECIPES[name]


__all__ = [
    "RECIPES",
    "DemoSize",
    "Inspection",
    "Recipe",
    "Run",
    "evaluate_run",
    "find_all_logs",
    "find_recipe",
    "full_demo",
    "inspect_run",
    "labelled_by",
    "open_run",
    "quick_demo",
    "run_demo",
    "train_run",
]
