"""Heads that are trained on the frozen world model of a run, and evaluated with it."""

import copy
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from joint_heads import ALL, small_heads, with_small_heads
from miniature import miniature, miniature_driveworld, with_map
from safetensors.torch import load_file

from foredrive.data import LogPath
from foredrive.engine.checkpoints import save_weights
from foredrive.engine.folder import WEIGHTS
from foredrive.engine.metrics_log import read_metrics
from foredrive.errors import InputError
from foredrive.heads.agents_head import CarriedConfig
from foredrive.heads.probe import task_volumes
from foredrive.methods.driveworld.planes import VectorToPlaneConfig
from foredrive.methods.driveworld.task_prompt import PROMPTS, PromptConfig
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.recipe import Recipe
from foredrive.runs import Run, evaluate_run
from foredrive.runs.build import build_agent
from foredrive.runs.recipes.task_heads import (
    base_heads,
    town_heads,
    with_joint_heads,
    with_settings,
)
from foredrive.runs.train.run import begin_run
from foredrive.runs.train.tasks import TASKS, load_heads, probe_run, train_heads
from foredrive.scene import Example


def test_heads_of_a_run_are_trained_continued_and_evaluated(
    trained: Run, log: LogPath, tmp_path: Path
) -> None:
    logs = [with_map(log, tmp_path)]
    run = probe_run(trained.recipe, logs, tmp_path / "probe", trained.cache_dir, trained.folder)
    before = load_file(run.weights)
    found = train_heads(run, small_heads(("detection", "motion", "map", "occupancy", "instances")))
    assert len(read_metrics(run.folder / TASKS / "metrics.jsonl")) == 2
    assert all(torch.equal(value, before[name]) for name, value in load_file(run.weights).items())
    assert run.start == trained.folder
    result = evaluate_run(run, [log], tmp_path / "evaluated", views=False)
    assert result.summary["detection.frames_counted"] == result.summary["items"]
    assert result.summary["detection.nuscenes.map.nothing_detected"] == 0
    assert {"occupancy.uniad.vpq_near_pct", "occupancy.uniad.vpq_near_pct.persistence"} <= set(result.summary)
    again = train_heads(run, found.recipe)  # is finished
    weights = zip(again.heads.parameters(), found.heads.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in weights)
    with pytest.raises(InputError, match="holds other heads"):
        train_heads(run, small_heads(("detection", "motion"), steps=3))


def test_a_probe_needs_the_truth_of_its_tasks(trained: Run, log: LogPath, tmp_path: Path) -> None:
    run = probe_run(trained.recipe, [log], tmp_path / "probe", trained.cache_dir, trained.folder)
    with pytest.raises(InputError, match=r"no log can train the task 'map'; .*flat: it has no map"):
        train_heads(run, small_heads(("detection", "map")))
    assert not (run.folder / TASKS).exists()


@pytest.mark.slow
def test_instances_of_agents_that_are_carried_on(trained: Run, log: LogPath, tmp_path: Path) -> None:
    """Heads that follow a drive read one clip at a time; their instances stand together in a batch."""
    run = probe_run(trained.recipe, [log], tmp_path / "probe", trained.cache_dir, trained.folder)
    recipe, carried = small_heads(("detection", "instances")), CarriedConfig(agents=2, frames=2)
    assert recipe.heads.agents is not None
    agents = dataclasses.replace(recipe.heads.agents, carried=carried)
    sizes = dataclasses.replace(recipe.heads, agents=agents)
    train_heads(run, dataclasses.replace(recipe, heads=sizes, now_stride_s=carried.dt_s))
    result = evaluate_run(run, [log], tmp_path / "evaluated", views=False)
    assert result.summary["failed"] == 0
    assert "occupancy.uniad.vpq_near_pct.constant_velocity" in result.summary


def test_kept_volumes_are_shared_and_those_of_the_world_model(
    trained: Run, log: LogPath, tmp_path: Path
) -> None:
    """A damaged file is made anew, and nothing else is."""
    recipe = small_heads(("detection", "motion"))
    run = probe_run(trained.recipe, [log], tmp_path / "one", tmp_path / "cache", trained.folder)
    train_heads(run, recipe)
    files = sorted((tmp_path / "cache" / "volumes").rglob("*.safetensors"))
    times = [file.stat().st_mtime_ns for file in files]
    other = probe_run(trained.recipe, [log], tmp_path / "two", tmp_path / "cache", trained.folder)
    train_heads(other, recipe)
    assert [file.stat().st_mtime_ns for file in files] == times
    one, two = (load_file(each.folder / TASKS / WEIGHTS) for each in (run, other))
    assert all(torch.equal(value, two[name]) for name, value in one.items())

    volume = load_file(files[0])["volume"].clone()  # the file is mapped
    assert volume.shape == (1, 8, 2, 16, 16)
    files[0].write_bytes(b"damaged")
    third = probe_run(trained.recipe, [log], tmp_path / "three", tmp_path / "cache", trained.folder)
    train_heads(third, recipe)
    assert [file.stat().st_mtime_ns for file in files[1:]] == times[1:]
    # Made in another batch, so some values are rounded to the next number of 16 bits.
    torch.testing.assert_close(load_file(files[0])["volume"], volume, atol=2e-3, rtol=2e-3)


def test_a_probe_keeps_the_recipe_of_its_world_model(trained: Run, log: LogPath, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"its recipe is not .*config.yaml"):
        probe_run(miniature_driveworld(), [log], tmp_path / "probe", None, trained.folder)
    assert not (tmp_path / "probe").exists()
    assert load_heads(trained) is None
    assert trained.recipe == miniature()


def prompted_driveworld() -> Recipe:
    """`miniature_driveworld` with a prompt for each task, whose encodings tests draw."""
    recipe = miniature_driveworld()
    prompt = PromptConfig(
        expand=VectorToPlaneConfig(widths=(8, 4)), encoding=16, text_encoder="", prompts=tuple(PROMPTS)
    )
    return dataclasses.replace(recipe, model=dataclasses.replace(recipe.model, prompt=prompt))


def agent_of(recipe: Recipe) -> PlanningAgent:
    torch.manual_seed(0)
    agent = build_agent(recipe, fetch=False).eval()
    if agent.world_model.prompt is not None:
        agent.world_model.prompt.encodings.normal_()
    return agent


def with_other_prompts(agent: PlanningAgent, names: Sequence[str]) -> PlanningAgent:
    """The agent with other encodings of some prompts."""
    other = copy.deepcopy(agent)
    for name in names:
        other.world_model.prompt.encodings[other.world_model.prompt.prompts.index(name)] *= -1
    return other


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recipe", "volume_of", "volumes"),
    [
        (prompted_driveworld(), None, 4),
        (prompted_driveworld(), "occupancy", 1),
        (miniature_driveworld(), None, 1),
    ],
)
def test_a_probe_on_a_driveworld_keeps_each_volume_once(
    recipe: Recipe, volume_of: Any, volumes: int, log: LogPath, tmp_path: Path
) -> None:
    """Four tasks have four prompts, unless all heads read one volume. Without prompts they share it."""
    cache, start = tmp_path / "cache", tmp_path / "start"
    begin_run(recipe, [log], start, cache, start)
    (start / "finetune").mkdir()
    save_weights(agent_of(recipe), start / "finetune" / WEIGHTS)
    run = probe_run(recipe, [with_map(log, tmp_path)], tmp_path / "probe", cache, start)
    heads = small_heads((*ALL, "tracking"))
    assert heads.heads.volume_of == "occupancy"
    train_heads(run, dataclasses.replace(heads, heads=dataclasses.replace(heads.heads, volume_of=volume_of)))
    kept = [load_file(file) for file in (cache / "volumes").rglob("*.safetensors")]
    assert {len(each["volume"]) for each in kept} == {volumes}
    for each in kept[:1]:
        others = [each["volume"][n] for n in range(1, volumes)]
        assert not any(torch.equal(each["volume"][0], other) for other in others)
    summary = evaluate_run(run, [log], tmp_path / "evaluated", views=False).summary
    assert summary["failed"] == 0
    assert {"tracking.nuscenes.ids", "motion.uniad.car.epa"} < summary.keys()


UNTRAINED = tuple(name for name in PROMPTS if name not in ("occupancy", "forecast"))
"""Prompts that pre-training does not decode with."""


@pytest.mark.parametrize("joint", [False, True])
def test_a_probe_depends_on_no_prompt_that_pretraining_has_not_seen(
    joint: bool, make_example: Callable[..., Example]
) -> None:
    recipe, heads = prompted_driveworld(), small_heads((*ALL, "tracking"))
    agent = agent_of(recipe)
    clip = make_example(past=recipe.clips.past_frames, future=0, spec=recipe.clips.voxels).clip
    sizes = with_joint_heads(recipe, heads).tasks.heads if joint else heads.heads
    with torch.no_grad():
        read, changed = (
            task_volumes(one.world_model, one.world_model.observe(clip), sizes.volumes).volume
            for one in (agent, with_other_prompts(agent, UNTRAINED))
        )
    assert torch.equal(read, changed) != joint


@pytest.mark.parametrize("task", ["tracking", "detection"])
def test_agents_that_are_carried_read_the_prompt_of_their_task(
    task: Any, make_example: Callable[..., Example]
) -> None:
    """Detection is that of heads from before tracking had a prompt that was read."""
    recipe = with_small_heads(prompted_driveworld(), ("map", "tracking"))
    sizes = recipe.tasks.heads
    carried = dataclasses.replace(sizes.agents.carried, task=task)
    sizes = dataclasses.replace(sizes, agents=dataclasses.replace(sizes.agents, carried=carried))
    recipe = dataclasses.replace(recipe, tasks=dataclasses.replace(recipe.tasks, heads=sizes))
    agent = agent_of(recipe)
    clip = make_example(past=recipe.clips.past_frames, future=0, spec=recipe.clips.voxels).clip
    logits = {}
    with torch.no_grad():
        for name in ("none", "tracking", "detection"):
            one = agent if name == "none" else with_other_prompts(agent, (name,))
            output = one.perceive(one.world_model.observe(clip))
            logits[name] = output.agents[-1].boxes.logits
    for name in ("tracking", "detection"):
        assert torch.equal(logits[name], logits["none"]) == (name != task)


@pytest.mark.parametrize("make", [town_heads, base_heads])
def test_tasks_choose_heads_and_truth(make: Any) -> None:
    alone = make(["map"])
    assert alone.heads.tasks == ("map",)
    assert alone.truth.semantics is None
    assert make(["detection"]).heads.tasks == ("detection",)
    assert make(["motion"]).heads.tasks == ("detection", "motion")
    both = make(["occupancy", "motion"])
    assert both.heads.tasks == ("detection", "motion", "occupancy")
    assert both.truth.raster is None
    assert both.heads.frames == 1
    tracks = make(["tracking", "map"])
    assert tracks.heads.tasks == ("tracking", "map")
    assert tracks.heads.volumes == ("occupancy",)
    assert (tracks.heads.frames, tracks.now_stride_s) == (4, 0.5)


def test_wrong_tasks_and_settings_are_one_line() -> None:
    with pytest.raises(InputError, match="the task 'planning' has no head; heads can be trained for det"):
        town_heads(["planning"])
    with pytest.raises(InputError, match="the task 'detect' is unknown"):
        town_heads(["detect"])
    recipe = with_settings(town_heads(["map"]), ["schedule.steps=7", "weights.map.points=2.0"])
    assert (recipe.schedule.steps, recipe.weights.map.points) == (7, 2.0)
    with pytest.raises(InputError, match="no entry 'stepz'"):
        with_settings(town_heads(["map"]), ["schedule.stepz=7"])
