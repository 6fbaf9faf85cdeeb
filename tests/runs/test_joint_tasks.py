"""Task heads that are trained with the world model, and planners that attend to what they find."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from joint_heads import ALL, small_heads, with_small_heads
from miniature import STEPS, miniature, miniature_driveworld, with_map, with_steps
from safetensors.torch import load_file

from foredrive.data import LogPath, collate
from foredrive.engine.metrics_log import read_metrics
from foredrive.errors import InputError
from foredrive.integrations.graph import AgentGraph, GraphInputs
from foredrive.methods.recipe import Recipe
from foredrive.runs import Run, evaluate_run, load_agent, open_run, train_run
from foredrive.runs.build import build_agent, build_objective
from foredrive.runs.drive.seeing_agents import SeeingAgent, following
from foredrive.runs.export import export_run
from foredrive.runs.open_clips import open_clips
from foredrive.runs.recipes.task_heads import base_heads, heads_for, with_joint_heads
from foredrive.runs.recipes.world_models import load_recipe
from foredrive.runs.train.kept_parts import load_perception
from foredrive.runs.train.tasks import load_heads, probe_run, train_heads

WITHOUT_MAP = ("detection", "motion", "occupancy", "instances")
"""Tasks that the log has truth of."""
TERMS = ("centres", "cells", "queries", "velocity", "attribute", "motion", "voxels", "instances")


def test_a_joint_run_is_trained_end_to_end_and_evaluated(trained: Run, log: LogPath, tmp_path: Path) -> None:
    """The losses of the heads reach the world model, whose weights differ from those without heads."""
    recipe = with_small_heads(trained.recipe, WITHOUT_MAP, attends=("agents",))
    run = train_run(recipe, [log], tmp_path / "run", trained.cache_dir, trained.folder)
    assert load_recipe(run.folder / "config.yaml") == run.recipe
    lines = read_metrics(run.folder / "finetune" / "metrics.jsonl")
    assert lines[0]["tasks"] == pytest.approx(0.5 * sum(lines[0][f"task_{name}"] for name in TERMS), rel=1e-4)
    alone = load_file(trained.weights)
    joint = load_file(run.weights)
    assert any(not torch.equal(value, joint[name]) for name, value in alone.items() if "encoder" in name)
    summary = evaluate_run(run, [log], tmp_path / "evaluated", views=False).summary
    assert summary["failed"] == 0
    assert summary["detection.frames_counted"] == summary["items"]
    assert {"motion.uniad.car.min_ade_m", "occupancy.uniad.vpq_near_pct.constant_velocity"} < set(summary)


@pytest.mark.parametrize(
    ("make", "imagining"), [(miniature, "motion"), (miniature_driveworld, "states.prior_net")]
)
def test_instances_train_the_imagination(
    make: Callable[[], Recipe], imagining: str, log: LogPath, tmp_path: Path
) -> None:
    """The gradient of the vehicles' later cells reaches what only imagined key frames use, and the images."""
    recipe = with_joint_heads(make(), small_heads(("detection", "instances")))
    data = open_clips([log], recipe.clips, tmp_path)
    torch.manual_seed(0)
    agent = build_agent(recipe, fetch=False)
    objective = build_objective(recipe, recipe.finetune, agent)
    losses = objective(collate([data[0], data[3]]), torch.Generator().manual_seed(0))
    losses["task_instances"].backward()
    assert recipe.name == f"{make().name} (detection+instances)"
    for part in (imagining, "backbone"):
        gradients = [value.grad for value in agent.world_model.get_submodule(part).parameters()]
        assert max(float(grad.abs().max()) for grad in gradients if grad is not None) > 0, part
    assert all(value.grad is None for value in agent.planner.parameters())

    slow = dataclasses.replace(recipe, tasks=None, clips=dataclasses.replace(recipe.clips, frame_dt_s=0.25))
    with pytest.raises(InputError, match=r"key frames are 0\.25 s apart, instances need 0\.5 s"):
        with_joint_heads(slow, small_heads(("detection", "instances")))


def test_a_second_stage_begins_with_the_heads_of_the_first(
    trained: Run, log: LogPath, tmp_path: Path
) -> None:
    """As in UniAD: first tracks, then all tasks and the planner, on an encoder that stays as it is."""
    first = with_small_heads(trained.recipe, ("detection", "tracking"))
    no_plan = dataclasses.replace(first.finetune.weights, wpts=0.0)
    first = dataclasses.replace(first, finetune=dataclasses.replace(first.finetune, weights=no_plan))
    one = train_run(first, [log], tmp_path / "one", trained.cache_dir, trained.folder)
    tasks = ("detection", "tracking", "motion", "occupancy", "instances")
    second = dataclasses.replace(with_small_heads(trained.recipe, tasks), transfer="perception")

    begun = build_agent(second, fetch=False)
    load_perception(begun, one.weights)
    before, start = load_file(one.weights), begun.state_dict()
    learned = {name for name in before if name.startswith(("world_model.", "heads."))}
    assert all(torch.equal(start[name], before[name]) for name in learned)
    assert {"heads.agents.renew.1.weight", "heads.planes.join.0.weight"} < learned < start.keys()

    two = train_run(second, [log], tmp_path / "two", trained.cache_dir, one.folder)
    after = load_file(two.weights)
    kept = {name for name in before if name.startswith(("world_model.backbone.", "world_model.encoder."))}
    assert any("running_mean" in name for name in kept)
    assert all(torch.equal(before[name], after[name]) for name in kept)
    for part in ("world_model.motion.", "heads.agents.layers.", "heads.planes."):
        assert any(not torch.equal(before[name], after[name]) for name in before if name.startswith(part))
    assert not (two.folder / "pretrain").exists()
    alone = dataclasses.replace(trained.recipe, transfer="perception")
    with pytest.raises(InputError, match="which trains heads: name them with --tasks"):
        train_run(alone, [log], tmp_path / "no", trained.cache_dir, one.folder)
    with pytest.raises(InputError, match="has no task heads that were trained with its world model"):
        train_run(second, [log], tmp_path / "no", trained.cache_dir, trained.folder)
    assert not (tmp_path / "no").exists()


@pytest.mark.slow
def test_tracks_are_learned_jointly_and_by_a_probe(trained: Run, log: LogPath, tmp_path: Path) -> None:
    """Either way the evaluation follows the drive, beside a tracker of the same detections."""
    tasks = ("detection", "tracking")
    recipe = with_small_heads(trained.recipe, tasks, attends=("agents",))
    joint = train_run(recipe, [log], tmp_path / "joint", trained.cache_dir, trained.folder)
    probe = probe_run(trained.recipe, [log], tmp_path / "probe", trained.cache_dir, trained.folder)
    train_heads(probe, small_heads(tasks))
    for run in (joint, probe):
        summary = evaluate_run(run, [log], tmp_path / "evaluated", views=False).summary
        assert summary["failed"] == 0
        assert summary["tracking.scenes"] == 1
        for key in ("amota", "ids", "car.recall"):
            assert f"tracking.nuscenes.{key}" in summary
            assert f"tracking.nuscenes.{key}.greedy_association" in summary
    short = dataclasses.replace(recipe.clips, now_stride_s=1.0)
    with pytest.raises(InputError, match=r"no log has 2 clips that are 0\.5 s apart"):
        train_run(
            dataclasses.replace(recipe, clips=short),
            [log],
            tmp_path / "no",
            trained.cache_dir,
            trained.folder,
        )


@pytest.mark.parametrize("make", [miniature, miniature_driveworld])
def test_an_interrupted_joint_run_goes_on_to_the_same_bits(
    make: Callable[[], Recipe], log: LogPath, tmp_path: Path
) -> None:
    whole = with_small_heads(make(), WITHOUT_MAP, attends=("agents",))
    first = train_run(whole, [log], tmp_path / "whole", tmp_path / "cache")
    cut = tmp_path / "cut"
    train_run(with_steps(whole, STEPS, 1), [log], cut, tmp_path / "cache", first.folder)
    (cut / "finetune" / "model.safetensors").unlink()
    (cut / "tasks" / "priors.safetensors").unlink()
    config = cut / "config.yaml"
    config.write_text((first.folder / "config.yaml").read_text())
    again = train_run(whole, [log], cut, tmp_path / "cache", first.folder)
    one, two = load_file(first.weights), load_file(again.weights)
    assert [line["step"] for line in read_metrics(cut / "finetune" / "metrics.jsonl")] == [1, 2, 3]
    assert all(torch.equal(value, two[name]) for name, value in one.items())


@pytest.mark.slow
def test_a_planner_attends_to_frozen_heads_of_a_probe(trained: Run, log: LogPath, tmp_path: Path) -> None:
    """World model and heads stay as they are, statistics of norms too; the plan depends on what is found."""
    logs = [with_map(log, tmp_path)]
    probe = probe_run(trained.recipe, logs, tmp_path / "probe", trained.cache_dir, trained.folder)
    heads = train_heads(probe, small_heads(("detection", "motion", "map", "instances")))
    planner = dataclasses.replace(trained.recipe.planner, attends=("agents", "map"))
    recipe = dataclasses.replace(trained.recipe, transfer="frozen", planner=planner)
    run = train_run(recipe, [log], tmp_path / "run", trained.cache_dir, probe.folder)
    again = train_run(recipe, [log], tmp_path / "run", trained.cache_dir, probe.folder)  # is finished
    assert again.recipe == run.recipe == open_run(run.folder).recipe
    before, after = load_file(trained.weights), load_file(run.weights)
    for name, value in before.items():
        if name.startswith("world_model."):
            assert torch.equal(value, after[name]), name
    for name, value in heads.heads.state_dict().items():
        assert torch.equal(value, after[f"heads.{name}"]), name
    assert (run.folder / "finetune" / "model.safetensors").is_file()
    assert not (run.folder / "pretrain").exists()
    agent = load_agent(run)
    clip = collate([open_clips([log], run.recipe.clips, run.cache_dir)[k] for k in (0, 3)]).clip.observed()
    with torch.no_grad():
        plan = agent.act(clip)
        agent.heads.agents.kind.weight += 1.0
        assert (agent.act(clip).xy - plan.xy).abs().max() > 1e-5
    summary = evaluate_run(run, [log], tmp_path / "evaluated", views=False).summary
    assert summary["failed"] == 0
    assert {"detection.nuscenes.map", "occupancy.uniad.vpq_near_pct"} <= summary.keys()


def test_an_agent_drives_with_the_agents_that_it_carries_on_as_in_training(
    trained: Run, log: LogPath
) -> None:
    """Frame by frame its plans are those of a training sequence, and those of single frames after a gap."""
    recipe = with_small_heads(trained.recipe, ("detection", "tracking"), attends=("agents",))
    torch.manual_seed(0)
    agent = build_agent(recipe, fetch=False).eval()
    clips = dataclasses.replace(recipe.clips, now_stride_s=recipe.clips.frame_dt_s)
    data = open_clips([log], clips, trained.cache_dir)
    first, second = (collate([data[number]]).clip.observed() for number in (0, 1))
    both = collate([data[0], data[1]]).clip.observed()
    with torch.no_grad():
        beliefs = agent.rollout(both, agent.planner.imagined_frames)
        sequence = agent.plan(both, beliefs, agent.perceive(beliefs[0], sequences=both))
    time_s = [10.0, 10.5, 20.0]
    driving = following(SeeingAgent(agent, recipe.clips.image_hw, "cpu"), lambda: time_s.pop(0))
    plans = [driving.act(first), driving.act(second), driving.act(second)]
    for number in (0, 1):
        torch.testing.assert_close(plans[number].xy[0], sequence.xy[number], atol=1e-4, rtol=1e-4)
    assert (plans[1].xy - plans[2].xy).abs().max() > 1e-4
    torch.testing.assert_close(plans[2].xy, agent.act(second).xy)


def test_the_graph_of_an_agent_that_attends_is_the_agent(trained: Run, log: LogPath) -> None:
    recipe = with_small_heads(trained.recipe, ("detection", "motion"), attends=("agents",))
    torch.manual_seed(0)
    agent = build_agent(recipe, fetch=False).eval()
    data = open_clips([log], recipe.clips, trained.cache_dir)
    observed = collate([data[0]]).clip.observed()
    graph = AgentGraph(agent, data.camera_names, recipe.clips.image_hw, steps=1)
    with torch.no_grad():
        plan = agent.act(observed)
        found = graph(*GraphInputs.from_clip(observed, agent))
    torch.testing.assert_close(found["waypoints_xy"], plan.xy[:, 0])


@pytest.mark.slow
def test_an_agent_that_attends_is_exported(trained: Run, log: LogPath, tmp_path: Path) -> None:
    recipe = with_small_heads(trained.recipe, ("detection", "motion"), attends=("agents",))
    run = train_run(recipe, [log], tmp_path / "run", trained.cache_dir, trained.folder)
    report = export_run(run, [log], tmp_path / "exported", clips=1)
    for found in report["largest_difference"].values():
        assert found["waypoints_xy"] < 1e-3


def test_combinations_that_cannot_be_are_one_line(trained: Run, log: LogPath, tmp_path: Path) -> None:
    joint = with_small_heads(trained.recipe, ("occupancy",))
    wrong = dataclasses.replace(joint, planner=dataclasses.replace(joint.planner, attends=("agents",)))
    with pytest.raises(InputError, match="attends names agents, but no head finds them: train with det"):
        train_run(wrong, [log], tmp_path / "wrong", trained.cache_dir, trained.folder)
    without = dataclasses.replace(wrong, tasks=None)
    with pytest.raises(InputError, match="attends names agents, but no head finds them"):
        train_run(without, [log], tmp_path / "wrong", trained.cache_dir)
    frozen = dataclasses.replace(trained.recipe, transfer="frozen")
    with pytest.raises(InputError, match="transfer is frozen; --start has to name a trained run"):
        train_run(frozen, [log], tmp_path / "wrong", trained.cache_dir)
    with pytest.raises(InputError, match="keeps the heads of --start: no --tasks"):
        with_joint_heads(frozen, small_heads(("map",)))
    unread = dataclasses.replace(joint, clips=dataclasses.replace(joint.clips, tasks=None))
    with pytest.raises(InputError, match=r"clips\.tasks reads no truth"):
        train_run(unread, [log], tmp_path / "wrong", trained.cache_dir, trained.folder)
    mapped = with_small_heads(trained.recipe, ("map",))
    with pytest.raises(InputError, match=r"no log can train the task 'map'; .*flat: it has no map"):
        train_run(mapped, [log], tmp_path / "wrong", trained.cache_dir, trained.folder)
    with pytest.raises(InputError, match="no entry 'detektion'"):
        with_joint_heads(trained.recipe, small_heads(ALL), ["weights.detektion=2"])
    assert not (tmp_path / "wrong").exists()
    run = train_run(joint, [log], tmp_path / "joint", trained.cache_dir, trained.folder)
    with pytest.raises(InputError, match="nothing to probe"):
        probe_run(run.recipe, [log], tmp_path / "wrong", trained.cache_dir, run.folder)


def test_large_grids_get_heads_of_the_published_sizes() -> None:
    small = miniature()
    large = dataclasses.replace(
        small.clips, voxels=dataclasses.replace(small.clips.voxels, shape_zyx=(16, 200, 200))
    )
    base = heads_for(dataclasses.replace(small, clips=large), ["detection"])
    assert base == base_heads(["detection"])
    assert heads_for(small, ["detection"]).heads.width == 64


def test_a_run_that_has_only_pre_trained_has_no_heads_yet(log: LogPath, tmp_path: Path) -> None:
    recipe = with_small_heads(miniature(), ("detection",), attends=("agents",))
    run = train_run(recipe, [log], tmp_path)
    (tmp_path / "finetune" / "model.safetensors").unlink()
    assert load_agent(run).heads is None
    assert load_heads(run) is None
