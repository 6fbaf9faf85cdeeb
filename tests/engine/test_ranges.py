"""Numbers of schedules out of range: one clear error for each, in code and in recipes."""

import dataclasses
import math
from typing import Any

import pytest

from foredrive.engine.learning_rates import Rate
from foredrive.engine.loop import Schedule
from foredrive.engine.one_cycle import OneCycle
from foredrive.errors import InputError
from foredrive.methods.neurad.recipes import tiny_field
from foredrive.methods.planner.ego_mlp_fit import EgoMLPFit
from foredrive.methods.planner.path_fit import PathFit
from foredrive.methods.splatad.recipes import tiny_gaussians
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe

SCHEDULES = {
    "training": Schedule(batch_size=2, lr=1e-3, steps=5),
    "field": tiny_field().schedule,
    "gaussians": tiny_gaussians().schedule,
    "ego_mlp": EgoMLPFit(),
    "path": PathFit(),
    "rate": Rate(1e-3),
    "one_cycle": OneCycle(),
}


@pytest.mark.parametrize(
    ("schedule", "entry", "wrong", "told"),
    [
        ("training", "steps", -3, "steps is -3, but has to be 0 or more"),
        ("training", "batch_size", 0, "batch_size is 0, but has to be 1 or more"),
        ("training", "lr", math.nan, "lr is nan"),
        ("training", "epochs", -1, "epochs is -1"),
        ("field", "steps", -3, "steps is -3"),
        ("field", "poses_every", 0, "poses_every is 0"),
        ("field", "mirror_share", 1.5, "mirror_share is 1.5, but is a share from 0 to 1"),
        ("gaussians", "steps", -3, "steps is -3"),
        ("gaussians", "shrink_steps", (10, -5), "shrink_steps is -5"),
        ("gaussians", "grow_every", 0, "grow_every is 0"),
        ("ego_mlp", "steps", -3, "steps is -3"),
        ("path", "batch_size", 0, "batch_size is 0"),
        ("rate", "first", -1e-3, "first is -0.001"),
        ("one_cycle", "rise_share", -0.1, "rise_share is -0.1"),
    ],
)
def test_a_number_out_of_range_is_named(schedule: str, entry: str, wrong: Any, told: str) -> None:
    with pytest.raises(InputError, match=told):
        dataclasses.replace(SCHEDULES[schedule], **{entry: wrong})  # type: ignore[type-var]


def test_none_and_no_steps_are_allowed() -> None:
    """Nothing is trained then: studies of pre-training alone use it."""
    assert dataclasses.replace(SCHEDULES["training"], steps=0).total_steps(10) == 0  # type: ignore[type-var]
    assert Schedule(batch_size=2, lr=0.1, epochs=3).total_steps(10) == 15


@pytest.mark.parametrize("recipe", ["field_tiny", "gaussians_tiny"])
def test_a_setting_of_a_recipe_is_refused_in_one_line_with_its_place(recipe: str) -> None:
    with pytest.raises(InputError) as refused:
        find_recipe(recipe, ["representation.schedule.steps=-3"], ReconstructionRecipe)
    (line,) = str(refused.value).splitlines()
    assert f"{recipe}: not a recipe: representation.schedule: " in line
    assert "steps is -3, but has to be 0 or more" in line
