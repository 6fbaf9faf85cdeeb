"""The study of task heads on frozen world models: one arm from end to end, and the recipes of its rows."""

import dataclasses
from pathlib import Path

import pytest
from joint_heads import small_heads
from miniature import miniature

import benchmarks.task_probes as study
from foredrive.data import LogPath
from foredrive.runs import Run, open_run, train_run
from foredrive.runs.recipes.known import RECIPES


def test_rows_pretrain_their_own_world_model_and_nothing_else() -> None:
    """Row "rssm" has no statics, neither in pre-training nor in the world model that is probed."""
    assert {f"{study.DRIVEWORLD}_{row}" for row in study.ROWS} <= set(RECIPES)
    row = RECIPES[f"{study.DRIVEWORLD}_rssm"]
    alone = study.world_model_alone(row)
    assert row.model.statics is not None
    assert alone.model.statics is None
    assert (alone.transfer, alone.pretrained_model, alone.path) == ("world_model", None, None)
    assert alone.finetune.schedule.steps == 0
    assert alone.pretrain.schedule.steps == row.pretrain.schedule.steps


def test_an_arm_from_end_to_end(log: LogPath, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An untrained world model is probed; figures of heads and baselines are kept, others are not."""

    def untrained(seed: int) -> Run:
        recipe = dataclasses.replace(miniature(), pretrain=None)
        run = train_run(study.world_model_alone(recipe), [log], tmp_path / f"world{seed}", tmp_path / "cache")
        return open_run(run.folder)

    monkeypatch.setattr(study, "ROOT", tmp_path)
    monkeypatch.setattr(study, "logs_of", lambda drives: ((log,), (log,)))
    monkeypatch.setattr(study, "heads_recipe", lambda seed: small_heads(("detection", "motion", "occupancy")))
    figures = study.probed("small", untrained)(0)
    assert figures["failed"] == 0
    assert figures["detection.car_ap_2m_30m.nothing_detected"] == 0
    assert "motion.uniad.car.min_ade_m.constant_velocity" in figures
    assert not any(key.startswith(("planning.", "flow.")) for key in figures)
