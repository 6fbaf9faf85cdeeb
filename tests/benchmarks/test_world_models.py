"""Studies of world models: which rows share a pre-training, and one arm from end to end."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from miniature import miniature

import benchmarks.common.world_models as study
from benchmarks.common.study import StudyLogs
from foredrive.data import LogPath
from foredrive.engine.metrics_log import read_metrics
from foredrive.runs import open_run


@pytest.fixture
def folders(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Folder and recipe of every pre-training that is asked for; none is trained."""
    asked: dict[str, Any] = {}

    def train_run(recipe: Any, logs: Any, folder: Path, cache: Path) -> Path:
        asked[folder.name] = recipe
        return folder

    monkeypatch.setattr(study, "train_run", train_run)
    monkeypatch.setattr(study, "study_logs", lambda share=1.0: StudyLogs((), ()))
    return asked


def test_rows_that_differ_after_pretraining_share_it(folders: dict[str, Any]) -> None:
    def of(name: str, seed: int = 0, pretraining_seed: int = 0) -> Any:
        return study.pretrained(study.of_the_study(name, seed, pretraining_seed))

    usual = of("nemo_town")
    assert of("nemo_town_base") == of("nemo_town_attention") == of("nemo_town", seed=5) == usual
    assert of("nemo_town", pretraining_seed=1) != usual
    assert len({usual, of("nemo_town_bev"), of("nemo_town_no_image"), of("nemo_town_no_flow")}) == 4
    assert of("driveworld_town_prompts") == of("driveworld_town")
    rows = ("prompts", "mln", "dmb", "ssp", "rssm", "occupancy", "carried")
    assert len({of(f"driveworld_town_{row}") for row in rows}) == len(rows)
    half = study.pretrained(study.of_the_study("driveworld_town", 0, 0), 0.5)
    assert half != of("driveworld_town")
    for recipe in folders.values():
        assert recipe.finetune.schedule.steps == 0
        assert recipe.finetune.schedule.seed == recipe.pretrain.schedule.seed
        assert recipe.clips.occupancy_source == "recorded"
        assert (recipe.tasks, recipe.pretrained_model, recipe.path) == (None, None, None)
    plain = folders[of("driveworld_town_rssm").name]
    assert plain.model.statics is None
    assert plain.pretrain.schedule.steps == study.STEPS["driveworld"]


def test_an_arm_from_end_to_end(log: LogPath, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second arm begins with the pre-training of the first; task heads are trained and judged."""
    monkeypatch.setattr(study, "ROOT", tmp_path)
    monkeypatch.setattr(study, "STEPS", {"nemo": 2})
    monkeypatch.setattr(study, "FINETUNING_STEPS", 2)
    monkeypatch.setattr(study, "find_recipe", lambda name: miniature())
    monkeypatch.setattr(study, "with_occupancy_source", lambda recipe, source: recipe)
    monkeypatch.setattr(study, "study_logs", lambda share=1.0: StudyLogs((log,), (log,)))
    first = study.fine_tuned(study.of_the_study("small", 0, 0), tmp_path / "first")
    assert first["failed"] == 0
    assert "detection.car_ap_2m_30m" not in first
    (begun,) = (tmp_path / "pretrained").iterdir()
    assert len(read_metrics(begun / "pretrain" / "metrics.jsonl")) == 2
    made = (begun / "pretrain" / "model.safetensors").stat().st_mtime_ns
    second = study.fine_tuned(
        study.of_the_study("small", 1, 0), tmp_path / "second", tasks=("detection", "motion")
    )
    assert (begun / "pretrain" / "model.safetensors").stat().st_mtime_ns == made
    assert open_run(tmp_path / "second").start == begun
    assert {"detection.car_ap_2m_30m", "detection.nuscenes.map", "l2_m"} < set(second)
    assert second["ego_mlp.uniad.l2_avg_m"] == first["ego_mlp.uniad.l2_avg_m"]
    recipe = study.of_the_study("small", 0, 0)
    scratch = dataclasses.replace(recipe, pretrain=None)
    study.fine_tuned(scratch, tmp_path / "scratch")
    assert open_run(tmp_path / "scratch").start is None
