"""Heads of the published sizes: built, counted, and trained for one step on the grid of the base recipes."""

import dataclasses

import pytest
import torch
from joint_heads import ALL

from foredrive.engine.parameter_groups import parameter_groups
from foredrive.heads.heads import TaskHeads, TaskVolume
from foredrive.heads.losses import task_losses
from foredrive.runs.recipes.known import RECIPES
from foredrive.runs.recipes.task_heads import heads_for
from foredrive.scene import Boxes
from foredrive.scene.boxes import unlabelled
from foredrive.scene.map_elements import MapElements, MapRaster, RasterLayer
from foredrive.scene.semantics import SemanticVoxels
from foredrive.scene.task_truth import TaskTruth

FRAMES = 2


def base(tasks: tuple[str, ...]) -> TaskHeads:
    recipe = RECIPES["nemo_base"]
    heads = heads_for(recipe, tasks)
    torch.manual_seed(0)
    return TaskHeads(
        heads.heads, recipe.clips.voxels, channels=recipe.model.channels, raster=heads.truth.raster
    )


def test_base_heads_have_the_sizes_of_published_models() -> None:
    config = heads_for(RECIPES["driveworld_base"], (*ALL, "tracking")).heads
    assert config.width == 256
    assert config.agents is not None
    assert config.elements is not None
    assert (config.agents.queries, config.agents.decoder.layers) == (300, 6)
    assert config.agents.carried is not None
    assert config.agents.carried.agents == 100
    assert (config.elements.elements, config.elements.points) == (50, 20)


def truth_of(spec: object, raster: object, shape: tuple[int, ...]) -> tuple[Boxes, TaskTruth]:
    """Three cars and a divider in each of two frames."""
    n = 3
    boxes = Boxes(
        centre=torch.tensor([[5.0, 2.0, 0.5], [-20.0, 10.0, 0.5], [30.0, -30.0, 0.5]]).expand(FRAMES, n, 3),
        size_lwh=torch.tensor([4.0, 2.0, 1.5]).expand(FRAMES, n, 3),
        yaw=torch.zeros(FRAMES, n),
        velocity=torch.zeros(FRAMES, n, 2),
        track_id=torch.arange(n).expand(FRAMES, n),
        category=torch.zeros(FRAMES, n, dtype=torch.long),
        valid=torch.ones(FRAMES, n, dtype=torch.bool),
        **unlabelled(FRAMES, n),
    )
    known = torch.ones(FRAMES, dtype=torch.bool)
    line = torch.tensor([[-10.0, 1.0], [10.0, 2.0]]).expand(FRAMES, 1, 2, 2)
    elements = MapElements(
        line, torch.ones(FRAMES, 1, 2, dtype=torch.bool), torch.zeros(FRAMES, 1, dtype=torch.long), known
    )
    layers = torch.zeros(FRAMES, len(RasterLayer), *raster.shape_yx, dtype=torch.bool)
    everywhere = torch.ones(FRAMES, *shape, dtype=torch.bool)
    index = torch.full((FRAMES, *shape), 17, dtype=torch.uint8)
    semantics = SemanticVoxels(spec, "occ3d", index, everywhere, everywhere, everywhere)
    return boxes, TaskTruth(None, elements, MapRaster(raster, layers, known), semantics)


@pytest.mark.slow
def test_base_heads_take_a_step_on_a_sequence() -> None:
    """Every parameter gets a gradient that is finite, also without futures."""
    module, recipe = base((*ALL, "tracking")), RECIPES["nemo_base"]
    heads = heads_for(recipe, (*ALL, "tracking"))
    carried = dataclasses.replace(module.config.agents.carried, frames=FRAMES)
    module.config = dataclasses.replace(
        module.config, agents=dataclasses.replace(module.config.agents, carried=carried)
    )
    spec = recipe.clips.voxels
    volume = torch.randn(FRAMES, recipe.model.channels, *spec.shape_zyx, generator=torch.manual_seed(0))
    read = TaskVolume(volume, volume, torch.eye(4).expand(FRAMES, 4, 4))
    poses = torch.eye(4, dtype=torch.float64).expand(FRAMES, 4, 4)
    boxes, truth = truth_of(spec, heads.truth.raster, spec.shape_zyx)
    optimizer = torch.optim.AdamW(parameter_groups(module, 1e-2), 1e-4)
    found = module(dict.fromkeys(module.config.volumes, read), module.config.steps(poses))
    valid = torch.ones(FRAMES, dtype=torch.bool)
    losses = task_losses(found, boxes, valid, truth, spec, None, heads.weights, FRAMES)
    losses["loss"].backward()
    lacking = {name.split(".")[1] for name, p in module.named_parameters() if p.grad is None}
    assert not lacking
    optimizer.step()
    assert all(p.isfinite().all() for p in module.parameters())
    millions = sum(p.numel() for p in module.parameters()) / 1e6
    print(f"{millions:.2f} million parameters")
    assert 10 < millions < 30
