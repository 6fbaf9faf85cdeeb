"""Functions that return one frozen configuration each."""

from typing import TYPE_CHECKING

from foredrive.lazy import on_demand

if TYPE_CHECKING:
    from foredrive.recipes.config import Recipe, labelled_by
    from foredrive.recipes.known import RECIPES, find_recipe

__all__ = ["RECIPES", "Recipe", "find_recipe", "labelled_by"]

__getattr__ = on_demand(__name__, {"config": ("Recipe", "labelled_by"), "known": ("RECIPES", "find_recipe")})
