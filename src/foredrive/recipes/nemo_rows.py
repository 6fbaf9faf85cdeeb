"""The rows of NeMo's Tables 1 and 3: one recipe with a part removed or replaced."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from foredrive.models.bev import BevConfig
from foredrive.recipes.nemo import NemoRecipe

ROWS = {
    "scratch": "without pre-training; planned from the present volume alone (Table 1)",
    "base": "pre-trained, then planning alone, from the present volume alone (Table 1)",
    "concatenation": "base, the predicted volume concatenated to the present one (Table 1)",
    "attention": "base, attention to the predicted volume (Table 1)",
    "bev_scratch": "scratch on a BEV encoder (Table 1)",
    "bev": "base on a BEV encoder, pre-trained by occupancy alone (Table 1)",
    "no_image": "base, pre-trained without image reconstruction (Table 3)",
    "no_occupancy": "base, pre-trained without occupancy prediction (Table 3)",
    "no_flow": "base, pre-trained on the present alone (Table 3)",
}
"""The change of each row of the paper's tables."""


def nemo_rows(full: NemoRecipe, bev: BevConfig) -> dict[str, NemoRecipe]:
    """Return all rows by name: the full NeMo first, under its own name, the others as FULL_ROW.

    Rows of Table 1:
    - `scratch`: no pre-training.
    - `base`: pre-training, then planning only, from the present volume.
    - `concatenation`, `attention`: `base` with the predicted volume.
    - The full model: `attention`, with the losses of pre-training kept in fine-tuning.
    - `bev_scratch`, `bev`: `scratch` and `base` with a BEVFormer-like encoder, pre-trained by occupancy only.

    Rows of Table 3: `base` without `no_image` reconstruction, without `no_occupancy` prediction, or without
    `no_flow`, that is, pre-trained on the present only.

    Args:
        full: a recipe with pre-training whose planner attends to the future.
        bev: sizes of the baseline's encoder.
    """
    rows: dict[str, Callable[[NemoRecipe], NemoRecipe]] = {
        "scratch": lambda recipe: replace(_planning_alone(recipe, "none"), pretrain=None),
        "base": lambda recipe: _planning_alone(recipe, "none"),
        "concatenation": lambda recipe: _planning_alone(recipe, "concatenation"),
        "attention": lambda recipe: _planning_alone(recipe, "attention"),
        "bev_scratch": lambda recipe: replace(_planning_alone(_in_bev(recipe, bev), "none"), pretrain=None),
        "bev": lambda recipe: _pretrained_with(
            _planning_alone(_in_bev(recipe, bev), "none"), image=False, occupancy=True, flow=True
        ),
        "no_image": lambda recipe: _pretrained_with(
            _planning_alone(recipe, "none"), image=False, occupancy=True, flow=True
        ),
        "no_occupancy": lambda recipe: _pretrained_with(
            _planning_alone(recipe, "none"), image=True, occupancy=False, flow=True
        ),
        "no_flow": lambda recipe: _pretrained_with(
            _planning_alone(recipe, "none"), image=True, occupancy=True, flow=False
        ),
    }
    found = {full.name: full}
    for name, change in rows.items():
        about = f"{full.name}: {ROWS[name]}"
        found[f"{full.name}_{name}"] = replace(change(full), name=f"{full.name}_{name}", about=about)
    return found


def _planning_alone(recipe: NemoRecipe, future: Literal["attention", "concatenation", "none"]) -> NemoRecipe:
    """Return the recipe with fine-tuning by waypoints only."""
    stage = recipe.finetune
    weights = replace(stage.weights, recon=0.0, occ=0.0)
    return replace(
        recipe,
        planner=replace(recipe.planner, future=future),
        finetune=replace(stage, weights=weights, imagine=False),
    )


def _in_bev(recipe: NemoRecipe, bev: BevConfig) -> NemoRecipe:
    return replace(recipe, model=replace(recipe.model, encoder=bev))


def _pretrained_with(recipe: NemoRecipe, *, image: bool, occupancy: bool, flow: bool) -> NemoRecipe:
    """Return the recipe with some of the three parts of pre-training."""
    stage = recipe.pretrain
    assert stage is not None
    weights = stage.weights
    weights = replace(weights, recon=weights.recon if image else 0.0, occ=weights.occ if occupancy else 0.0)
    return replace(recipe, pretrain=replace(stage, weights=weights, imagine=flow))
