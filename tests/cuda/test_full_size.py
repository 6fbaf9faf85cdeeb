"""A training step at the papers' sizes on a card without values: shapes and devices fit."""

import contextlib
import dataclasses
from typing import Any

import joint_heads
import pytest
import torch
from conftest import synthetic_example
from valueless import CARD, Valueless

from foredrive.methods.recipe import Recipe
from foredrive.runs.build import build_agent, build_objective
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import Clip, Example

CAMERAS = 6


def full_size(recipe: Recipe[Any, Any]) -> Example:
    """An example for a recipe, with six images of its size a frame, on the card."""
    clips = recipe.clips
    made = synthetic_example(
        batch=1, past=clips.past_frames, future=clips.future_frames, cameras=CAMERAS, spec=clips.voxels
    )
    if clips.tasks is not None:
        made = joint_heads.with_truth(made, clips.tasks)
    height, width = clips.image_hw
    images = torch.empty(1, made.clip.images.shape[1], CAMERAS, 3, height, width, dtype=torch.uint8)
    rig = dataclasses.replace(made.clip.rig, size_hw=(height, width))
    clip = dataclasses.replace(made.clip, images=images, rig=rig)
    return dataclasses.replace(made, clip=clip).to(CARD)


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers in place of values, and autocast, which knows no such device."""
    autocast = torch.autocast
    monkeypatch.setattr(
        torch,
        "autocast",
        lambda kind, *given, **named: (
            contextlib.nullcontext() if str(kind) == CARD.type else autocast(kind, *given, **named)
        ),
    )


@pytest.mark.parametrize("name", ["nemo_base", pytest.param("driveworld_base", marks=pytest.mark.slow)])
def test_a_step_of_each_stage_at_full_size(name: str, card: None, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = find_recipe(name)
    backbone = dataclasses.replace(recipe.model.backbone, weights=None)
    recipe = dataclasses.replace(recipe, model=dataclasses.replace(recipe.model, backbone=backbone))
    past = recipe.clips.past_frames
    # Read from the times of frames, which have no values here
    monkeypatch.setattr(Clip, "now", property(lambda clip: min(past, clip.t_s.shape[-1] - 1)))
    agent = build_agent(recipe, fetch=False)
    for stage in (recipe.pretrain, recipe.finetune):
        if hasattr(stage, "perceptual"):
            stage = dataclasses.replace(stage, perceptual=None)  # Its weights are not in the package
        objective = build_objective(recipe, stage, agent).to(CARD)
        with Valueless():
            losses = objective(full_size(recipe), torch.Generator())
            losses["loss"].backward()
        assert all(value.device == CARD for value in losses.values())
        learned = [p for p in objective.parameters() if p.requires_grad]
        assert sum(p.grad is not None for p in learned) > 0.5 * len(learned)


@pytest.mark.parametrize(
    "line",
    [
        "card + torch.ones(3)",
        "torch.nn.functional.linear(card, torch.ones(2, 3))",
        "card.gather(0, torch.zeros(2, dtype=torch.int64))",
        "torch.ones(3)[torch.zeros(1, dtype=torch.int64, device=card.device)]",
    ],
)
def test_a_tensor_of_the_host_beside_one_of_the_card_is_refused(line: str) -> None:
    """Controls; two of these pass on the bare device."""
    with Valueless(), pytest.raises(RuntimeError, match="device"):
        eval(line, {"torch": torch, "card": torch.empty(3, device=CARD)})
