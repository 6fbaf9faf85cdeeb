"""Small task heads, and truth for batches of arbitrary examples."""

import dataclasses
from collections.abc import Sequence

import torch

from foredrive.data.clip_config import TaskTruthConfig
from foredrive.heads.agents_head import AgentHeadConfig, CarriedConfig
from foredrive.heads.decoder import DecoderConfig
from foredrive.heads.map_head import MapHeadConfig
from foredrive.heads.motion_head import MotionConfig
from foredrive.methods.recipe import Recipe
from foredrive.runs.recipes.task_heads import TaskHeadsRecipe, town_heads, with_joint_heads
from foredrive.scene import Example
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.map_elements import MapElements, MapRaster, RasterLayer
from foredrive.scene.semantics import SemanticVoxels
from foredrive.scene.task_truth import TaskTruth

ALL = ("detection", "motion", "map", "occupancy")


def small_heads(tasks: Sequence[str], steps: int = 2) -> TaskHeadsRecipe:
    recipe, decoder = town_heads(tasks), DecoderConfig(layers=1, heads=2)
    agents = recipe.heads.agents
    sizes = dataclasses.replace(
        recipe.heads,
        width=16,
        max_cells=8,
        agents=agents
        and AgentHeadConfig(
            queries=6,
            decoder=decoder,
            motion=agents.motion and MotionConfig(decoder=decoder),
            carried=agents.carried and CarriedConfig(agents=2, born=0.0, frames=2),
        ),
        elements=recipe.heads.elements and MapHeadConfig(elements=3, points=4, decoder=decoder),
    )
    schedule = dataclasses.replace(recipe.schedule, steps=steps, batch_size=2, warmup_steps=0)
    return dataclasses.replace(recipe, heads=sizes, schedule=schedule)


def with_small_heads(recipe: Recipe, tasks: Sequence[str] = ALL, attends: Sequence[str] = ()) -> Recipe:
    """The recipe with heads that are trained with it, and a planner that attends to some of them."""
    planner = dataclasses.replace(recipe.planner, attends=tuple(attends))
    return with_joint_heads(dataclasses.replace(recipe, planner=planner), small_heads(tasks))


def with_truth(example: Example, config: TaskTruthConfig) -> Example:
    """The example with futures at constant velocity, one divider each, and arbitrary grids."""
    clip, rng = example.clip, torch.Generator().manual_seed(0)
    batch, boxes = clip.t_s.shape[0], clip.boxes.centre.shape[2]
    now = clip.boxes[:, clip.now]
    xy = now.centre[:, :, None, :2].expand(batch, boxes, 12, 2)
    valid = torch.ones(batch, boxes, 12, dtype=torch.bool)
    truth = TaskTruth(futures=AgentFutures(xy, torch.zeros(xy.shape[:3]), valid, 0.5))
    known = torch.ones(batch, dtype=torch.bool)
    if config.elements_lw_m is not None:
        lines = torch.tensor([[-5.0, 1.0], [5.0, 2.0]]).expand(batch, 1, 2, 2)
        there = torch.ones(batch, 1, 2, dtype=torch.bool)
        elements = MapElements(lines, there, torch.zeros(batch, 1, dtype=torch.long), known)
        truth = dataclasses.replace(truth, elements=elements)
    if config.raster is not None:
        layers = torch.rand(batch, len(RasterLayer), *config.raster.shape_yx, generator=rng) > 0.8
        truth = dataclasses.replace(truth, raster=MapRaster(config.raster, layers, known))
    if config.semantics is not None:
        shape = (batch, *example.occupancy.spec.shape_zyx)
        index = torch.randint(0, 18, shape, generator=rng, dtype=torch.uint8)
        seen = torch.ones(shape, dtype=torch.bool)
        semantics = SemanticVoxels(example.occupancy.spec, config.semantics, index, seen, seen, seen)
        truth = dataclasses.replace(truth, semantics=semantics)
    return dataclasses.replace(example, truth=truth)
