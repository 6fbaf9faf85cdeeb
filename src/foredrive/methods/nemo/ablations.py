"""The rows of NeMo's Tables 1 and 3: one recipe with a part removed or replaced."""

from dataclasses import replace
from typing import Literal

from foredrive.methods.blocks.bev import BevConfig
from foredrive.methods.nemo.recipes import NemoRecipe
from foredrive.methods.recipe import named_after


def nemo_ablations(full: NemoRecipe, bev: BevConfig) -> dict[str, NemoRecipe]:
    """Return all rows by name: the full NeMo first, under its own name, the others as FULL_ROW.

    The full NeMo is `attention` with the losses of pre-training kept in fine-tuning.

    Args:
        full: a recipe with pre-training whose planner attends to the future.
        bev: sizes of the encoder of the planar baseline.
    """
    base = _planning_alone(full, "none")
    planar = replace(base, model=replace(base.model, encoder=bev))
    rows = {
        "scratch": (
            replace(base, pretrain=None),
            "without pre-training; planned from the present volume alone (Table 1)",
        ),
        "base": (base, "pre-trained, then planning alone, from the present volume alone (Table 1)"),
        "concatenation": (
            _planning_alone(full, "concatenation"),
            "base, the predicted volume concatenated to the present one (Table 1)",
        ),
        "attention": (
            _planning_alone(full, "attention"),
            "base, attention to the predicted volume (Table 1)",
        ),
        "bev_scratch": (replace(planar, pretrain=None), "scratch on a BEV encoder (Table 1)"),
        "bev": (
            _pretrained_without(planar, images=True),
            "base on a BEV encoder, pre-trained by occupancy alone (Table 1)",
        ),
        "no_image": (
            _pretrained_without(base, images=True),
            "base, pre-trained without image reconstruction (Table 3)",
        ),
        "no_occupancy": (
            _pretrained_without(base, occupancy=True),
            "base, pre-trained without occupancy prediction (Table 3)",
        ),
        "no_flow": (
            _pretrained_without(base, future=True),
            "base, pre-trained on the present alone (Table 3)",
        ),
    }
    return named_after(full, rows)


def _planning_alone(recipe: NemoRecipe, future: Literal["attention", "concatenation", "none"]) -> NemoRecipe:
    """Return the recipe with fine-tuning by waypoints only."""
    stage = recipe.finetune
    weights = replace(stage.weights, recon=0.0, occ=0.0)
    return replace(
        recipe,
        planner=replace(recipe.planner, future=future),
        finetune=replace(stage, weights=weights, imagine=False),
    )


def _pretrained_without(
    recipe: NemoRecipe, *, images: bool = False, occupancy: bool = False, future: bool = False
) -> NemoRecipe:
    """Return the recipe without one of the three parts of pre-training."""
    stage = recipe.pretrain
    assert stage is not None
    weights = stage.weights
    weights = replace(weights, recon=0.0 if images else weights.recon, occ=0.0 if occupancy else weights.occ)
    return replace(recipe, pretrain=replace(stage, weights=weights, imagine=not future))
