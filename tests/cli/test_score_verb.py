"""`foredrive score`: what it writes, and what a user is told whose files do not fit."""

import json
import math
import re
from pathlib import Path

import pytest
from html_pages import EVIL, assert_harmless
from tasks.files_of_detections import box, write_nuscenes

from foredrive.cli.main import main
from foredrive.search.rows import SCORES
from foredrive.search.scores import read_scores


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """Two scenes of a frame each; one detector is 0.2 m off, the other 1.5 m."""
    truth = {f: [box(5.0, y, "<car>", scene_token=f) for y in (0.0, 9.0)] for f in ("a", "b")}
    return {
        "truth": write_nuscenes(tmp_path / "gt.json", truth),
        **{
            name: write_nuscenes(
                tmp_path / f"{name}.json",
                {f: [box(5.0 + off, y, "<car>", detection_score=0.9) for y in (0.0, 9.0)] for f in "ab"},
            )
            for name, off in (("near", 0.2), ("far", 1.5))
        },
    }


def test_figures_and_a_report_that_loads_nothing(files: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "scores"
    arguments = ["--truth", str(files["truth"]), "--against", str(files["far"]), "--out", str(out)]
    assert main(["score", str(files["near"]), *arguments]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frames"] == 2
    assert summary["map"] == pytest.approx(1.0)
    expected = 2 * 0.5 * (0.2**2 - 1.5**2) / 0.5**2  # two cars whose x has a standard deviation of 0.5 m
    assert summary["against.difference"] == pytest.approx(expected, abs=0.05)
    assert summary["against.map"] == pytest.approx(0.5)  # 1.5 m is within two of four thresholds
    assert summary["against.p_value"] == pytest.approx(0.5, abs=0.05)  # two scenes prove nothing
    page = (out / "report.html").read_text()
    assert page.count("<svg") == 4  # two diagrams, two frames
    assert not re.search(r'(src|href)="(?!data:|#)', page)


def test_the_background_can_be_switched_off(files: dict[str, Path], tmp_path: Path) -> None:
    """An object of which nothing is said makes its frame impossible: counted in the summary."""
    lone = write_nuscenes(tmp_path / "lone.json", {"a": [box(5.0, 0.0, "<car>", detection_score=0.9)]})
    arguments = ["--truth", str(files["truth"]), "--out", str(tmp_path / "out"), "--background-rate", "0"]
    assert main(["score", str(lone), *arguments]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["background_rate"], summary["pmb_nll.frames_infinite"]) == (0, 2)
    assert "pmb_nll.mean" not in summary


def test_names_from_outside_run_nothing(tmp_path: Path) -> None:
    frames = {EVIL: [box(5.0, 0.0, EVIL, scene_token=EVIL, detection_score=0.9)]}
    truth, results, other = (
        write_nuscenes(tmp_path / f"{name}{EVIL}.json", frames) for name in ("truth", "results", "other")
    )
    out = tmp_path / "out"
    arguments = ["--truth", str(truth), "--against", str(other), "--out", str(out)]
    assert main(["score", str(results), *arguments]) == 0
    # both files in title and heading, the other in the table, the frame, the category's average precision
    assert_harmless((out / "report.html").read_text(), times=4 + 1 + 1 + 1)


def test_an_index_takes_the_frames_scores(files: dict[str, Path], tmp_path: Path) -> None:
    names = ("town/drive@1000000", "town/drive@1500000")
    truth = write_nuscenes(tmp_path / "truth.json", {name: [box(5.0, 0.0, "car")] for name in names})
    boxes = {names[0]: [box(5.0, 0.0, "car", detection_score=0.9)], names[1]: []}
    results = write_nuscenes(tmp_path / "results.json", boxes)
    assert main(["score", str(results), "--truth", str(truth), "--out", str(tmp_path / "out")]) == 0
    found = read_scores(tmp_path / "out" / "frames.jsonl")
    assert set(found) == set(names)
    for scores in found.values():
        assert set(scores) == set(SCORES)
        assert sum(value for name, value in scores.items() if name != "nll") < scores["nll"] + 1.0
    assert found[names[1]]["missed"] > found[names[0]]["missed"] + 3.0  # an object far from any detection


def test_scores_that_are_not_finite_are_kept(tmp_path: Path) -> None:
    line = {"frame": "town/drive@5", "nll": "inf", "missed": "inf", "false": 0.5}
    (tmp_path / "frames.jsonl").write_text(json.dumps(line))
    scores = read_scores(tmp_path / "frames.jsonl")["town/drive@5"]
    assert scores == {"nll": math.inf, "missed": math.inf, "false": 0.5}


def test_wrong_files_are_one_line(files: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    missing = files["truth"].with_name("none.json")
    assert main(["score", str(missing), "--truth", str(files["truth"])]) == 2
    assert capsys.readouterr().err == f"foredrive: {missing}: No such file or directory\n"
