"""A planner that starts from what ego status alone says, as a run."""

import dataclasses
from pathlib import Path

import pytest
import torch
from miniature import miniature
from safetensors.torch import load_file

from benchmarks.common.study import seeded
from foredrive.data import LogPath, collate
from foredrive.methods.planner.ego_mlp import EgoMLPConfig
from foredrive.methods.planner.path_correction import PathCorrectionConfig
from foredrive.methods.planner.path_fit import PathFit
from foredrive.methods.recipe import Recipe
from foredrive.runs import Run, evaluate_run, train_run
from foredrive.runs.export import export_run
from foredrive.runs.open_clips import open_clips
from foredrive.runs.train.path_features import sample_paths
from foredrive.runs.train.run import load_agent


def recipe(lr: float, path: PathFit | None = None) -> Recipe:
    """Fine-tuned from scratch, with a plan of the ego MLP to begin with."""
    small = miniature()
    return dataclasses.replace(
        small,
        pretrain=None,
        planner=dataclasses.replace(
            small.planner,
            history=1,
            ego_mlp=EgoMLPConfig(),
            path=PathCorrectionConfig(distances_m=(2.0, 6.0), width=8, hidden=4),
        ),
        path=path,
        finetune=dataclasses.replace(
            small.finetune, schedule=dataclasses.replace(small.finetune.schedule, lr=lr)
        ),
    )


@pytest.fixture(scope="module")
def run(log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train_run(recipe(lr=1e-2), [log], tmp_path_factory.mktemp("looks"))


def test_with_nothing_learned_it_scores_what_the_ego_mlp_does(log: LogPath, tmp_path: Path) -> None:
    """Whatever the seed of fine-tuning."""
    run = train_run(seeded(recipe(lr=0.0), 1), [log], tmp_path)
    summary = evaluate_run(run, [log], tmp_path).summary
    for protocol in ("uniad", "vad"):
        own, rival = (summary[f"planning.{name}{protocol}.l2_avg_m"] for name in ("", "ego_mlp."))
        assert own == pytest.approx(rival, abs=1e-5)
        assert own < summary[f"planning.stand_still.{protocol}.l2_avg_m"]


def test_fine_tuning_leaves_what_it_starts_from(run: Run, log: LogPath, tmp_path: Path) -> None:
    first = train_run(recipe(lr=0.0), [log], tmp_path)
    before, after = load_file(first.weights), load_file(run.weights)
    base = [name for name in before if name.startswith("planner.ego_mlp.")]
    assert base
    assert all(torch.equal(before[name], after[name]) for name in base)
    assert not torch.equal(before["planner.path.place.0.weight"], after["planner.path.place.0.weight"])


@pytest.mark.slow
def test_what_is_read_along_the_path_is_fitted_first_and_read_once(log: LogPath, tmp_path: Path) -> None:
    fitted = recipe(lr=0.0, path=PathFit(stride_s=0.5, steps=20))
    fitted = dataclasses.replace(fitted, pretrain=miniature().pretrain)  # which leaves planners out
    run = train_run(fitted, [log], tmp_path / "first", tmp_path / "cache")
    kept = list((tmp_path / "cache" / "path_features").glob("*.safetensors"))
    assert len(kept) == 1
    again = train_run(fitted, [log], tmp_path / "second", tmp_path / "cache")
    assert list((tmp_path / "cache" / "path_features").glob("*.safetensors")) == kept
    one, other = load_file(run.weights), load_file(again.weights)
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert one["planner.path.change.2.weight"].abs().max() > 0  # it began at 0
    assert one["planner.path.mean"].abs().max() > 0


@pytest.mark.slow
def test_what_the_decoder_says_is_not_said_twice(log: LogPath, tmp_path: Path) -> None:
    """What the correction is fitted to is all that is planned but itself."""
    fitted = recipe(lr=1e-2, path=PathFit(stride_s=0.5, steps=20))
    run = train_run(fitted, [log], tmp_path / "run")
    joint = load_file(run.folder / "finetune" / "model.safetensors")
    assert joint["planner.path.change.2.weight"].abs().max() == 0  # left alone until its turn
    agent = load_agent(run)
    shown = sample_paths(agent, [log], fitted.clips, tmp_path / "cache", stride_s=0.5)
    agent.planner.path.change[2].weight.data.zero_()
    agent.planner.path.change[2].bias.data.zero_()
    again = sample_paths(agent, [log], fitted.clips, tmp_path / "other", stride_s=0.5)
    torch.testing.assert_close(shown.planned_xy, again.planned_xy, atol=1e-4, rtol=0)
    dataset = open_clips([log], dataclasses.replace(fitted.clips, now_stride_s=0.5), tmp_path / "other")
    planned = agent.act(collate([dataset[0]]).clip.observed()).xy[0, 0]
    torch.testing.assert_close(again.planned_xy[0], planned, atol=1e-4, rtol=0)
    next(agent.world_model.parameters()).data += 0.1
    other = sample_paths(agent, [log], fitted.clips, tmp_path / "other", stride_s=0.5)
    assert not torch.equal(other.values, again.values)  # of other weights


@pytest.mark.slow
def test_it_can_be_exported(run: Run, log: LogPath, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    facts = export_run(run, [log], tmp_path, clips=2)
    for differences in facts["largest_difference"].values():
        assert differences["waypoints_xy"] < 1e-3
