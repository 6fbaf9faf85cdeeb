"""Studies: what an arm is trained on, and what is kept of its figures."""

import json
from pathlib import Path

import pytest
from miniature import miniature

from benchmarks.common.benchmark import study_identity
from benchmarks.common.study import RECONSTRUCTED_BY, StudyLogs, pandaset_log, run_arm, seeded, share_of
from benchmarks.common.world_models import DECIDED_BY, TASKS_DECIDED_BY
from foredrive.data import LogPath
from foredrive.engine.metrics_log import read_metrics
from foredrive.errors import InputError
from foredrive.runs import Run

LOGS = tuple(LogPath(Path(f"log{i}"), Path("maps")) for i in range(7))


def test_a_share_is_the_first_whole_drives() -> None:
    assert share_of(LOGS, 1.0) == LOGS
    assert share_of(LOGS, 0.3) == LOGS[:2]
    assert share_of(LOGS, 0.01) == LOGS[:1]


def test_a_seed_reaches_both_stages_and_changes_nothing_else() -> None:
    recipe = seeded(miniature(), 7)
    assert recipe.pretrain is not None
    assert recipe.pretrain.schedule.seed == recipe.finetune.schedule.seed == 7
    assert seeded(recipe, 0) == miniature()


def test_a_conversion_that_fails_leaves_nothing_that_looks_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FOREDRIVE_REAL_DATA", str(tmp_path))
    broken = tmp_path / "pandaset" / "001" / "meta"
    broken.mkdir(parents=True)
    (broken / "gps.json").write_text("[]")
    for _ in range(2):  # the second time it is not taken for converted
        with pytest.raises(InputError, match="pandaset"):
            pandaset_log(tmp_path / "converted")
        assert not (tmp_path / "converted").exists()


def test_an_arm_is_trained_and_judged_once(trained: Run, tmp_path: Path) -> None:
    logs = StudyLogs(train=trained.logs, test=trained.logs)
    figures = run_arm(trained.recipe, logs, tmp_path / "few", tmp_path / "cache", start=trained.folder)
    again = run_arm(trained.recipe, logs, tmp_path / "few", tmp_path / "cache", start=trained.folder)
    assert again == figures
    summary = json.loads((tmp_path / "few" / "summary.json").read_text())
    (tmp_path / "few" / "summary.json").write_text(json.dumps(summary | {"planning.uniad.l2_avg_m": 9.0}))
    kept = run_arm(trained.recipe, logs, tmp_path / "few", tmp_path / "cache", start=trained.folder)
    assert kept["l2_m"] == 9.0
    assert figures["failed"] == 0
    assert 0 <= figures["occupancy_iou"] <= 1
    assert figures["l2_m"] == figures["uniad.l2_avg_m"] != figures["vad.l2_avg_m"]
    assert figures["stand_still.uniad.l2_avg_m"] > 0
    assert {"above_ground.iou_now.best_constant", "iou_future_1s"} <= set(figures)
    lines = read_metrics(tmp_path / "few" / "finetune" / "metrics.jsonl")
    assert figures["train_s"] == pytest.approx(sum(line["step_s"] for line in lines))


@pytest.mark.parametrize("entry", [*RECONSTRUCTED_BY, *DECIDED_BY, *TASKS_DECIDED_BY])
def test_code_that_decides_figures_exists(entry: str) -> None:
    assert len(study_identity({}, (entry,))) == 16
