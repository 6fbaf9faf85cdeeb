"""`foredrive score --task map` and `--task motion`: summary, table, page, and one line for wrong files."""

import json
from pathlib import Path

import pytest
from tasks.maps.test_map_files import FOUND, TRUE, maptr, streammapnet, write
from tasks.motion.test_av2_forecast_files import bus, submission, write_scenario, write_sensor_log
from tasks.motion.test_motion_files import FOUND as AGENTS
from tasks.motion.test_motion_files import TRUE as TRUE_AGENTS

from foredrive.cli.main import main


def test_a_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = write(tmp_path / "results.json", streammapnet(FOUND))
    truth = write(tmp_path / "truth.json", maptr(TRUE, truth=True))
    out = tmp_path / "out"
    assert main(["score", str(results), "--truth", str(truth), "--task", "map", "--out", str(out)]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["task"] == "map"
    assert summary["map.maptr.ap_divider"] == pytest.approx(1 / 3)
    shown = capsys.readouterr().out
    assert "MapTR" in shown
    assert "C-mAP" not in shown  # the files have no identities
    assert (out / "report.html").read_text().count("<table") == 2


def test_a_map_with_other_axes_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A divider ahead of the vehicle, written with the axes of a lidar whose y points ahead."""
    ahead = [[float(x), 0.1 * x] for x in range(0, 14)]
    truth = {"GTs": [{"sample_token": "a", "vectors": [{"pts": ahead, "cls_name": "divider"}]}]}
    flags = ["--truth", str(write(tmp_path / "truth.json", truth)), "--task", "map"]
    for line, told in (([[-y, x] for x, y in ahead], True), (ahead, False)):
        vectors = [{"pts": line, "cls_name": "divider", "confidence_level": 0.9}]
        results = write(tmp_path / "r.json", {"results": [{"sample_token": "a", "vectors": vectors}]})
        assert main(["score", str(results), *flags, "--out", str(tmp_path / "out")]) == 0
        said = [text for text in caplog.messages if "with x and y swapped, then y reversed" in text]
        assert len(said) == told
        caplog.clear()


def test_motion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = write(tmp_path / "results.json", AGENTS)
    truth = write(tmp_path / "truth.json", TRUE_AGENTS)
    out = tmp_path / "out"
    flags = ["score", str(results), "--truth", str(truth), "--task", "motion", "--out", str(out)]
    assert main(flags) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["motion.uniad.car.min_ade_m"] == pytest.approx(0.3)
    assert "SparseDrive" in capsys.readouterr().out
    assert (out / "report.html").read_text().count("<table") == 3
    assert main([*flags, "--poses", str(results)]) == 2
    assert "--poses does not go with --task motion" in capsys.readouterr().err
    write(results, {"elsewhere": []})
    assert main(flags) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert (
        f"{results}: none of its 1 frames is in {truth} (first: elsewhere): results of another split?"
        in error
    )


def test_forecasts_of_argoverse(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A submission of the challenge, and end-to-end forecasts of a sensor log."""
    write_scenario(tmp_path / "val", "one", {"7": 110})
    results = submission(tmp_path / "r.parquet", [("one", "7", 1.0, 3.0)])
    flags = ["--task", "motion", "--out", str(tmp_path / "out")]
    assert main(["score", str(results), "--truth", str(tmp_path / "val"), *flags]) == 0
    assert "brier-minFDE" in capsys.readouterr().out
    write_sensor_log(tmp_path / "sensor" / "log")
    end_to_end = write(tmp_path / "r.json", {"log": {"0": [bus()]}})
    assert main(["score", str(end_to_end), "--truth", str(tmp_path / "sensor"), *flags]) == 0
    shown = capsys.readouterr().out
    assert "mAP_F" in shown
    assert "non linear" in shown
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["motion.argoverse.map_f"] == 1.0
