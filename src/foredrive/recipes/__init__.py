"""Functions that return one frozen configuration each."""

from typing import TYPE_CHECKING

from foredrive.lazy import on_demand

if TYPE_CHECKING:
    from foredrive.recipes.config import Recipe, with_occupancy_source
    from foredrive.recipes.known import RECIPES, find_recipe

__all__ = ["RECIPES", "Recipe", "find_recipe", "with_occupancy_source"]

__getattr__ = on_demand(
    __name__, {"config": ("Recipe", "with_occupancy_source"), "known": ("RECIPES", "find_recipe")}
)
