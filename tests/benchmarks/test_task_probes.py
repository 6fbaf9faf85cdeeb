"""The study of task heads on world models: a probe and a joint arm from end to end."""

import dataclasses
from pathlib import Path

import pytest
from joint_heads import small_heads
from miniature import STEPS, miniature

import benchmarks.task_probes as study
from benchmarks.common.study import StudyLogs
from foredrive.data import LogPath
from foredrive.engine.metrics_log import read_metrics
from foredrive.runs import Run

TASKS = ("detection", "motion", "occupancy", "instances")


@pytest.fixture
def small(log: LogPath, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Small heads on a miniature, of one log. Returns the folder of the study."""
    monkeypatch.setattr(study, "ROOT", tmp_path)
    monkeypatch.setattr(study, "CACHE", tmp_path / "cache")
    monkeypatch.setattr(study, "study_logs", lambda share=1.0: StudyLogs((log,), (log,)))
    monkeypatch.setattr(study, "heads_recipe", lambda seed=0: small_heads(TASKS))
    monkeypatch.setattr(study, "of_the_study", lambda name, seed, pretraining_seed: miniature())
    return tmp_path


def test_an_untrained_world_model_is_probed(small: Path) -> None:
    """Figures of heads and baselines are kept, others are not."""
    figures = study.probed("small", study.untrained, "small_untrained", 0)
    assert not list((small / "untrained" / "small_seed0").rglob("metrics.jsonl"))
    assert figures["failed"] == 0
    assert figures["detection.car_ap_2m_30m.nothing_detected"] == 0
    assert {"motion.uniad.car.min_ade_m.constant_velocity", "occupancy.uniad.vpq_near_pct"} < set(figures)
    assert not any(key.startswith(("planning.", "flow.")) for key in figures)


def test_a_joint_arm_goes_on_with_the_pretraining(
    small: Path, trained: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """World model and heads learn together, by the losses of pre-training and those of the heads."""
    monkeypatch.setattr(study, "trained", lambda name, seed: trained)
    figures = study.joint("small", 0)
    assert figures["failed"] == 0
    assert "occupancy.uniad.vpq_near_pct.constant_velocity" in figures
    (folder,) = (small / "task_probes").glob("*/small_joint_seed0")
    (first, *_) = lines = read_metrics(folder / "finetune" / "metrics.jsonl")
    assert len(lines) == small_heads(TASKS).schedule.steps
    assert {"occ", "l1", "task_instances", "tasks"} < set(first)
    assert "wpts" not in first
    recipe = study.joint_recipe(miniature(), small_heads(TASKS))
    assert recipe.finetune.weights == miniature().pretrain.weights
    assert dataclasses.replace(recipe.finetune.schedule, steps=STEPS).lr == miniature().finetune.schedule.lr
