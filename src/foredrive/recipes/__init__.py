"""Python functions that return one frozen configuration each, and the runs put together from them."""

from typing import TYPE_CHECKING

from foredrive.lazy import on_demand

if TYPE_CHECKING:
    from foredrive.recipes.config import Recipe, labelled_by
    from foredrive.recipes.demo import DemoSize, full_demo, quick_demo, run_demo
    from foredrive.recipes.evaluate import Inspection, evaluate_run, inspect_run
    from foredrive.recipes.known import RECIPES, find_recipe
    from foredrive.recipes.train import Run, find_all_logs, open_run, train_run

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

__getattr__ = on_demand(
    __name__,
    {
        "config": ("Recipe", "labelled_by"),
        "demo": ("DemoSize", "full_demo", "quick_demo", "run_demo"),
        "evaluate": ("Inspection", "evaluate_run", "inspect_run"),
        "known": ("RECIPES", "find_recipe"),
        "train": ("Run", "find_all_logs", "open_run", "train_run"),
    },
)
