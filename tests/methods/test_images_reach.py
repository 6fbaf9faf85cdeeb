"""Gates before any long training: what a world model sees in its images reaches the plan."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import pytest
import torch

from foredrive.data import ClipDataset, LogPath
from foredrive.data.batches import stack_records
from foredrive.heads.plan_losses import waypoint_loss
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.recipe import Recipe
from foredrive.runs.build import build_agent
from foredrive.runs.drive.recording import EgosPlan, record_egos
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import Clip, VoxelSpec
from foredrive.sensors.rigs import SURROUND

EGOS, CLIPS, BATCH, STEPS, RATE = 16, 32, 8, 700, 2e-3
IMAGE_HW = (48, 80)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Sequence[LogPath]:
    """Six key frames with images of each of some cars in traffic."""
    rig = SURROUND.of_size(IMAGE_HW)
    logs, failed = record_egos([EgosPlan("Town02", 2000, EGOS)], tmp_path_factory.mktemp("egos"), rig, 1)
    assert not failed
    return logs


def small(name: str) -> Recipe[Any, Any]:
    """A recipe on small images and a coarse grid, whose planner reads the present alone."""
    recipe = find_recipe(name)
    clips = dataclasses.replace(
        recipe.clips,
        image_hw=IMAGE_HW,
        voxels=VoxelSpec(lower_m=(-16.0, -16.0, -1.5), voxel_m=2.0, shape_zyx=(2, 16, 20)),
        future_frames=1,
        future_images=False,
    )
    planner = dataclasses.replace(recipe.planner, width=64, pool=(1, 2, 2), future="none")
    return dataclasses.replace(recipe, clips=clips, planner=planner)


def blacked(clip: Clip) -> Clip:
    """The same clips with black images."""
    return dataclasses.replace(clip, images=torch.zeros_like(clip.images))


def error_m(agent: PlanningAgent[Any], clip: Clip) -> torch.Tensor:
    """The mean distance to the driven path."""
    seen = clip.observed()
    return waypoint_loss(agent.plan(seen, agent.rollout(seen, 0)), clip.future)


def learned(recipe: Recipe[Any, Any], clip: Clip) -> PlanningAgent[Any]:
    """An agent that has learned the clips by heart."""
    torch.manual_seed(0)
    agent = build_agent(recipe, fetch=False).train()
    optimizer = torch.optim.AdamW(agent.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=STEPS, pct_start=0.1)
    generator = torch.Generator().manual_seed(0)
    for _ in range(STEPS):
        loss = error_m(agent, clip[torch.randperm(CLIPS, generator=generator)[:BATCH]])
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(agent.parameters(), 10.0)
        optimizer.step()
        schedule.step()
    return agent.eval()


def test_a_planner_learns_clips_by_heart_from_their_images(logs: Sequence[LogPath]) -> None:
    """Much better than a twin that learns from black images, and worse than it once its images are black."""
    recipe = small("nemo_tiny")
    dataset = ClipDataset(logs, recipe.clips, None)
    chosen = range(0, len(dataset), len(dataset) // CLIPS)[:CLIPS]
    clip = stack_records([dataset.clip(index) for index in chosen])
    seeing, blind = learned(recipe, clip), learned(recipe, blacked(clip))
    with torch.no_grad():
        own_m, twin_m = float(error_m(seeing, clip)), float(error_m(blind, blacked(clip)))
        without_m = float(error_m(seeing, blacked(clip)))
    assert own_m < 0.2 * twin_m
    assert without_m > 1.5 * twin_m
