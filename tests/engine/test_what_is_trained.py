"""In every stage of every recipe, what is trained gets a gradient; only matrices and filters decay."""

import itertools
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from joint_heads import ALL, with_small_heads, with_truth
from miniature import shrunk
from torch import nn

from foredrive.engine.checkpoints import load_checkpoint, save_checkpoint
from foredrive.engine.parameter_groups import parameter_groups
from foredrive.errors import InputError
from foredrive.runs.build import build_agent, build_objective
from foredrive.runs.recipes.known import RECIPES
from foredrive.scene import Example

STAGES = [
    (name, stage)
    for name, stage in itertools.product(RECIPES, ("pretrain", "finetune"))
    if getattr(RECIPES[name], stage) is not None
]


@pytest.mark.parametrize(("name", "stage"), STAGES)
def test_after_a_step_no_trainable_parameter_is_without_a_gradient(
    name: str, stage: str, make_example: Callable[..., Example]
) -> None:
    recipe = shrunk(RECIPES[name])
    clips = recipe.clips
    example = make_example(past=clips.past_frames, future=clips.future_frames, spec=clips.voxels)
    torch.manual_seed(0)
    built = recipe.of_pretraining if stage == "pretrain" else recipe
    if built.clips.tasks is not None:
        example = with_truth(example, built.clips.tasks)
    objective = build_objective(built, getattr(recipe, stage), build_agent(built, fetch=False)).train()
    objective(example, torch.Generator().manual_seed(0))["loss"].backward()
    lacking = [key for key, p in objective.named_parameters() if p.requires_grad and p.grad is None]
    assert not lacking
    moved = [key for key, p in objective.named_parameters() if not p.requires_grad and p.grad is not None]
    assert not moved


@pytest.mark.parametrize("name", ["nemo_town", "driveworld_tiny", "driveworld_town"])
def test_with_heads_that_a_planner_attends_to_none_is_without_a_gradient(
    name: str, make_example: Callable[..., Example]
) -> None:
    """Gradients of the plan reach the world model through the heads' queries too. The batch is a sequence."""
    recipe = with_small_heads(shrunk(RECIPES[name]), (*ALL, "tracking"), attends=("agents", "map"))
    clips = recipe.clips
    assert clips.tasks is not None
    example = make_example(past=clips.past_frames, future=clips.future_frames, spec=clips.voxels)
    torch.manual_seed(0)
    objective = build_objective(recipe, recipe.finetune, build_agent(recipe, fetch=False)).train()
    losses = objective(with_truth(example, clips.tasks), torch.Generator().manual_seed(0))
    losses["loss"].backward()
    lacking = [key for key, p in objective.named_parameters() if p.requires_grad and p.grad is None]
    assert not lacking
    with pytest.raises(InputError, match="the clip has no truth of their tasks"):
        objective(example, torch.Generator().manual_seed(0))


class EveryKind(nn.Module):
    """One of each module that recipes have, and a query."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(4, 4)
        self.filters = nn.Conv3d(4, 4, 3)
        self.attention = nn.MultiheadAttention(4, 2)
        self.cell = nn.GRUCell(4, 4)
        self.norms = nn.ModuleList([nn.LayerNorm(4), nn.BatchNorm2d(4), nn.GroupNorm(2, 4)])
        self.words = nn.Embedding(3, 4)
        self.query = nn.Parameter(torch.zeros(5, 4))
        self.weight = nn.Parameter(torch.zeros(4, 4))
        self.still = nn.Linear(4, 4).requires_grad_(False)


def test_matrices_and_filters_decay_and_nothing_else() -> None:
    model = EveryKind()
    decayed, kept = parameter_groups(model, 0.3)
    names = {parameter: name for name, parameter in model.named_parameters()}
    assert {names[p] for p in decayed["params"]} == {
        "linear.weight",
        "filters.weight",
        "attention.in_proj_weight",
        "attention.out_proj.weight",
        "cell.weight_ih",
        "cell.weight_hh",
    }
    assert (decayed["weight_decay"], kept["weight_decay"]) == (0.3, 0.0)
    both = [*decayed["params"], *kept["params"]]
    assert len(both) == len(set(both)) == sum(p.requires_grad for p in model.parameters())


def test_without_a_gradient_only_what_decays_shrinks() -> None:
    model = EveryKind()
    for parameter in model.parameters():
        nn.init.ones_(parameter)
        parameter.grad = torch.zeros_like(parameter)
    torch.optim.AdamW(parameter_groups(model, 0.5), lr=0.1).step()
    shrunk_names = {name for name, p in model.named_parameters() if (p == 0.95).all()}
    assert shrunk_names == {name for name, p in model.named_parameters() if not (p == 1).all()}
    assert {"linear.weight", "filters.weight"} < shrunk_names
    assert not {"linear.bias", "query", "weight", "words.weight", "norms.0.weight"} & shrunk_names


def test_a_checkpoint_of_an_optimizer_with_one_group_is_one_clear_line(tmp_path: Path) -> None:
    model = EveryKind()
    trained = [p for p in model.parameters() if p.requires_grad]
    before = torch.optim.AdamW(trained, lr=0.1)
    for parameter in trained:
        parameter.grad = torch.ones_like(parameter)
    before.step()
    checkpoint = save_checkpoint(tmp_path, model, before, step=7)
    assert load_checkpoint(checkpoint, model, torch.optim.AdamW(trained)) == 7
    with pytest.raises(InputError, match="earlier version") as caught:
        load_checkpoint(checkpoint, model, torch.optim.AdamW(parameter_groups(model, 0.1)))
    assert str(checkpoint) in str(caught.value)
    assert "\n" not in str(caught.value)
