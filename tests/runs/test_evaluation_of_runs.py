"""From a trained run to its summary and its report, in miniature."""

import dataclasses
from pathlib import Path

import pytest
import torch
from miniature import write_log

from foredrive.data import LogPath
from foredrive.engine.folder import WEIGHTS
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.runs import ExamplePrediction, Run, evaluate_run, predict_examples
from foredrive.tasks.evaluation.run import EvaluationResult
from foredrive.tasks.planning.protocols import PROTOCOLS
from foredrive.view.run_report import report_on_run, write_run_report

CLIPS = 4
"""Of a log of 5 s: half a second before now, three seconds after it, one each half second."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("evaluated")


@pytest.fixture(scope="module")
def result(trained: Run, log: LogPath, folder: Path) -> EvaluationResult:
    return evaluate_run(trained, [log], folder)


@pytest.fixture(scope="module")
def examples(trained: Run, log: LogPath) -> list[ExamplePrediction]:
    return predict_examples(trained, [log], 2)


def test_the_summary_says_what_it_promises(result: EvaluationResult, folder: Path) -> None:
    summary = read_summary(folder / "summary.json")
    numbers = {
        "occupancy.iou_now",
        "occupancy.iou_future_1s",
        "occupancy.above_ground.iou_now",
        "occupancy.above_ground.iou_now.best_constant",
        "image.psnr_db",
        "planning.uniad.l2_avg_m",
        "planning.uniad.collision_avg_pct",
        "planning.constant_velocity.uniad.l2_avg_m",
        "planning.ego_mlp.uniad.l2_avg_m",
        "planning.stand_still.uniad.l2_avg_m",
        "peak_rss_gib",
        "wall_s",
        "failed",
    }
    assert all(isinstance(summary[key], float | int) for key in numbers)
    for protocol in PROTOCOLS:
        assert f"planning.{protocol}.l2_avg_m" in summary
    assert summary["items"] == CLIPS
    assert summary["failed"] == 0
    assert (summary["clips.past_s"], summary["clips.future_s"], summary["clips.stride_s"]) == (0.5, 3.0, 0.5)
    reasons = ("past", "future", "gap", "unseen")
    assert [summary[f"clips.left_out.{reason}"] for reason in reasons] == [1, 6, 0, 0]  # 11 times in 5 s
    assert result.failures == ()
    assert summary["command_source"] == "driven_future"  # the log has no route
    assert summary["command_source.driven_future"] == CLIPS
    assert summary["recipe"] == "miniature"
    assert {"commit", "command", "machine.cpu", "version.torch"} <= set(summary)
    assert {key for key, value in summary.items() if isinstance(value, dict | list)} == set()


def test_baselines_score_what_they_must_on_a_straight_drive(result: EvaluationResult) -> None:
    """At a constant 5 m/s straight ahead: standing still is off by 5, 10 and 15 m, UniAD's average by 10."""
    summary = result.summary
    assert summary["planning.stand_still.uniad.l2_avg_m"] == pytest.approx(10.0, abs=1e-3)
    assert summary["planning.constant_velocity.uniad.l2_avg_m"] == pytest.approx(0.0, abs=1e-3)
    assert summary["planning.ego_mlp.uniad.l2_avg_m"] == pytest.approx(0.0, abs=1e-2)
    assert 0.5 < summary["occupancy.iou_now.best_constant"] < 1


def test_the_report_is_drawn_from_a_run(
    trained: Run, log: LogPath, result: EvaluationResult, examples: list[ExamplePrediction], tmp_path: Path
) -> None:
    file = tmp_path / "report.html"
    write_run_report(file, report_on_run(trained, [log], result.summary, examples, result.failures))
    html = file.read_text()
    assert "miniature on flat_train/flat" in html
    assert "1 of the 1 evaluated logs were trained on" in html
    assert html.count("flat_train/flat at 2023-11-14") == 2
    assert "http://" not in html.replace("http://www.w3.org", "")


def test_examples_are_spread_over_the_log(trained: Run, examples: list[ExamplePrediction]) -> None:
    past, future = trained.recipe.clips.past_frames, trained.recipe.clips.future_frames
    shape_zyx = trained.recipe.clips.voxels.shape_zyx
    times = [int(example.example.key[0].rpartition("@")[2]) for example in examples]
    assert times[1] - times[0] == 2_000_000  # of eight clips the third and the seventh
    for example in examples:
        assert example.example.clip.t_s.shape == (past + 1 + future,)
        assert example.example.clip.sweeps.valid.any()
        assert example.occupied.shape == (1 + future, *shape_zyx)
        assert example.volume.shape == (trained.recipe.model.channels, *shape_zyx)
        assert example.rendered.shape == (2, 3, 16, 32)
        assert 0 <= example.rendered.min() <= example.rendered.max() <= 1
        assert torch.isfinite(example.plan.xy).all()


def test_figures_do_not_depend_on_the_batch_size(
    trained: Run, log: LogPath, result: EvaluationResult, tmp_path: Path
) -> None:
    single = evaluate_run(trained, [log], tmp_path, batch_size=1).summary
    for key, value in result.summary.items():
        if isinstance(value, float) and key not in ("wall_s", "peak_rss_gib"):
            assert single[key] == pytest.approx(value, rel=1e-4, abs=1e-4, nan_ok=True), key


def test_a_run_that_has_not_finished_a_stage_is_named(trained: Run, log: LogPath, tmp_path: Path) -> None:
    unfinished = dataclasses.replace(trained, folder=tmp_path)
    with pytest.raises(InputError, match="no stage of this run has finished"):
        evaluate_run(unfinished, [log], tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_after_pretraining_alone_its_weights_are_judged(trained: Run, log: LogPath, tmp_path: Path) -> None:
    (tmp_path / "pretrain").mkdir()
    (tmp_path / "pretrain" / WEIGHTS).symlink_to(trained.folder / "pretrain" / WEIGHTS)
    early = dataclasses.replace(trained, folder=tmp_path)
    assert early.weights == tmp_path / "pretrain" / WEIGHTS
    assert evaluate_run(early, [log], tmp_path).summary["failed"] == 0


def test_logs_too_short_for_the_horizon_are_named(trained: Run, tmp_path: Path) -> None:
    short = write_log(tmp_path, frames=31)  # 3 s: less than 0.5 s before now and 3 s after it
    with pytest.raises(InputError, match="too short for one clip"):
        evaluate_run(trained, [short], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_figures_do_not_depend_on_the_number_of_processes(
    trained: Run, log: LogPath, result: EvaluationResult, tmp_path: Path
) -> None:
    shared = evaluate_run(trained, [log], tmp_path, batch_size=1, workers=2)
    single = evaluate_run(trained, [log], tmp_path, batch_size=1)
    for key, value in single.summary.items():
        if isinstance(value, float) and key not in ("wall_s", "peak_rss_gib"):
            assert shared.summary[key] == pytest.approx(value, rel=1e-6, nan_ok=True), key
    assert shared.failures == single.failures == ()
