"""Forecasts for Argoverse 2: submissions of the challenge, end-to-end forecasts, real logs, wrong entries."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.parquet as parquet
import pytest

from foredrive.errors import InputError
from foredrive.tasks.motion.av2_sensor import CLASSES, read_end_to_end
from foredrive.tasks.motion.score import OBSERVED, PREDICTED, read_challenge, score_motion_results

LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def write_scenario(folder: Path, name: str, tracks: dict[str, int]) -> None:
    """Tracks along x at 1 m/s, of so many steps."""
    rows = [(track, t) for track, steps in tracks.items() for t in range(steps)]
    table = {
        "track_id": [track for track, _ in rows],
        "timestep": [t for _, t in rows],
        "position_x": [0.1 * t for _, t in rows],
        "position_y": [0.0 for _ in rows],
    }
    (folder / name).mkdir(parents=True)
    parquet.write_table(pa.table(table), folder / name / f"scenario_{name}.parquet")


def submission(path: Path, rows: list[tuple[str, str, float, float]], steps: int = PREDICTED) -> Path:
    """Futures of (scenario, track, probability, metres aside)."""
    x = [[0.1 * t for t in range(OBSERVED, OBSERVED + steps)] for _ in rows]
    table = {
        "scenario_id": [row[0] for row in rows],
        "track_id": [row[1] for row in rows],
        "probability": [row[2] for row in rows],
        "predicted_trajectory_x": x,
        "predicted_trajectory_y": [[row[3]] * steps for row in rows],
    }
    parquet.write_table(pa.table(table), path)
    return path


def test_a_submission_by_hand(tmp_path: Path) -> None:
    """3 m aside with p = .6, and 1 m with p = .4; another scenario is not in the results."""
    write_scenario(tmp_path / "val", "one", {"7": 110, "8": 60})
    write_scenario(tmp_path / "val", "two", {"9": 110})
    results = submission(tmp_path / "r.parquet", [("one", "7", 0.6, 3.0), ("one", "7", 0.4, -1.0)])
    figures = score_motion_results(results, tmp_path / "val")
    assert figures["motion.argoverse.min_fde_m"] == pytest.approx(1.0)
    assert figures["motion.argoverse.brier_min_fde_m"] == pytest.approx(1.36)
    assert figures["motion.argoverse.miss_rate"] == 0.0
    assert figures["motion.argoverse.min_fde_m_k1"] == pytest.approx(3.0)
    assert figures["motion.argoverse.miss_rate_k1"] == 1.0
    assert figures["scenarios_without_results"] == 1


@pytest.mark.parametrize(
    ("rows", "steps", "message"),
    [
        ([("three", "7", 1.0, 0.0)], PREDICTED, "scenario three, track 7 is not in .*: of another split"),
        ([("one", "8", 1.0, 0.0)], PREDICTED, "scenario one, track 8 has no whole future"),
        ([("one", "7", 0.6, 0.0)], PREDICTED, "scenario one, track 7: its probabilities do not add up to 1"),
        ([("one", "7", 1.0, np.nan)], PREDICTED, "scenario one, track 7: a future is not finite"),
        ([("one", "7", 1.0, 0.0)], 30, "scenario one, track 7: a future has 30 steps, not 60"),
    ],
)
def test_wrong_submissions_are_named(
    rows: list[tuple[str, str, float, float]], steps: int, message: str, tmp_path: Path
) -> None:
    write_scenario(tmp_path / "val", "one", {"7": 110, "8": 60})
    results = submission(tmp_path / "r.parquet", rows, steps)
    with pytest.raises(InputError, match=message) as caught:
        read_challenge(results, tmp_path / "val")
    assert str(caught.value).startswith(f"{results}: ")


def test_columns_and_files_are_named(tmp_path: Path) -> None:
    write_scenario(tmp_path / "val", "one", {"7": 110})
    parquet.write_table(pa.table({"scenario_id": ["one"]}), tmp_path / "r.parquet")
    with pytest.raises(InputError, match=r"r\.parquet: has no column track_id"):
        read_challenge(tmp_path / "r.parquet", tmp_path / "val")
    (tmp_path / "r.parquet").write_text("no table")
    with pytest.raises(InputError, match=r"r\.parquet: not a table that can be read"):
        read_challenge(tmp_path / "r.parquet", tmp_path / "val")


def write_sensor_log(folder: Path) -> None:
    """A bus 10 m ahead that drives 1 m/s, for 4 s at 10 Hz; the vehicle stands at (100, 50), turned left."""
    folder.mkdir(parents=True)
    t_ns = [n * 100_000_000 for n in range(41)]
    boxes = {
        "timestamp_ns": t_ns,
        "track_uuid": ["b"] * 41,
        "category": ["BUS"] * 41,
        "tx_m": [10.0 + 0.1 * n for n in range(41)],
        "ty_m": [0.0] * 41,
        "tz_m": [0.0] * 41,
    }
    feather.write_feather(pa.table(boxes), folder / "annotations.feather")
    pose = {"tx_m": 100.0, "ty_m": 50.0, "tz_m": 0.0, "qw": 0.5**0.5, "qx": 0.0, "qy": 0.0, "qz": 0.5**0.5}
    table = pa.table({"timestamp_ns": t_ns, **{name: [value] * 41 for name, value in pose.items()}})
    feather.write_feather(table, folder / "city_SE3_egovehicle.feather")


def bus(aside_m: float = 0.0, **more: Any) -> dict[str, Any]:
    """The bus in the city frame: ahead is along y."""
    path = [[100.0 + aside_m, 60.0 + 0.5 * t] for t in range(1, 7)]
    agent = {"name": "BUS", "current_translation_m": [100.0, 60.0], "detection_score": 0.8}
    return {**agent, "prediction_m": [path] * 5, "score": [0.2] * 5, **more}


def test_end_to_end_by_hand(tmp_path: Path) -> None:
    """At 0 s all six steps are known, at 2 s four: 0.5 m/s per step; found in the first frame alone."""
    write_sensor_log(tmp_path / "val" / "log")
    results = tmp_path / "r.json"
    results.write_text(json.dumps({"log": {"0": [bus(0.4)], "2000000000": []}}))
    read = read_end_to_end(results, tmp_path / "val")
    assert read.true.steps_known(6).tolist() == [6, 4]
    np.testing.assert_allclose(read.true.xy, [[0.0, 10.0], [0.0, 12.0]], atol=1e-9)
    np.testing.assert_allclose(read.true.future_xy[0, :2], [[0.0, 10.5], [0.0, 11.0]], atol=1e-9)
    figures = score_motion_results(results, tmp_path / "val")
    assert figures["motion.argoverse.BUS.static.ade_m"] == pytest.approx(
        0.4
    )  # 3 m, where the mean bus has 14
    # precision 1 up to recall 1/2
    assert figures["motion.argoverse.BUS.static.map_f"] == pytest.approx(51 / 101)
    assert figures["motion.argoverse.map_f"] == pytest.approx(51 / 101)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"log": {"0": [bus(name="TRAM")]}}, "log log, 0 ns, agent 0: the class 'TRAM' is not one of"),
        ({"log": {"0": [bus(detection_score=2.0)]}}, "log log, 0 ns, agent 0: the score 2 is not in"),
        ({"log": {"0": [bus(prediction_m=[[[1.0, 2.0]]])]}}, "agent 0 has no prediction_m of 60 number"),
        ({"log": {"0": [bus(score=[float("nan")] * 5)]}}, "agent 0: its score is not finite"),
        ({"log": {"50": []}}, "log log is not annotated at 50 ns"),
        ({"other": {"0": []}}, "log other is not in .*: of another split"),
        ({"log": {"now": []}}, "'now' is no time in ns"),
        ([], "there must be frames by time"),
    ],
)
def test_wrong_end_to_end_results_are_named(content: Any, message: str, tmp_path: Path) -> None:
    write_sensor_log(tmp_path / "val" / "log")
    results = tmp_path / "r.json"
    results.write_text(json.dumps(content))
    with pytest.raises(InputError, match=message) as caught:
        read_end_to_end(results, tmp_path / "val")
    assert str(caught.value).startswith(f"{results}: ")


@pytest.mark.real
def test_a_real_log_is_perfect_against_itself(real_data: Path, tmp_path: Path) -> None:
    """Each agent of five frames predicted as it drove: mAP_F 1 for every class and motion that is there."""
    folder = real_data / "av2"
    times = feather.read_table(folder / LOG / "annotations.feather")["timestamp_ns"].unique().to_pylist()
    results = tmp_path / "r.json"
    results.write_text(json.dumps({LOG: {str(t): [] for t in sorted(times)[:50:10]}}))
    true = read_end_to_end(results, folder).true
    poses = feather.read_table(folder / LOG / "city_SE3_egovehicle.feather").to_pydict()
    frames = [str(t) for t in sorted(times)[:50:10]]
    found: dict[str, list[Any]] = {time: [] for time in frames}
    for n in np.flatnonzero(true.steps_known(6) > 0):
        time = frames[true.frame[n]]
        row = poses["timestamp_ns"].index(int(time))
        ego = np.array([poses["tx_m"][row], poses["ty_m"][row]])
        path = true.future_xy[n].copy()
        path[true.steps_known(6)[n] :] = path[true.steps_known(6)[n] - 1]
        found[time].append(
            {
                "name": CLASSES[true.category[n]],
                "current_translation_m": (true.xy[n] + ego).tolist(),
                "detection_score": 0.9,
                "prediction_m": np.repeat(path[None] + ego, 5, axis=0).tolist(),
                "score": [1.0, 0.0, 0.0, 0.0, 0.0],
            }
        )
    results.write_text(json.dumps({LOG: found}))
    figures = score_motion_results(results, folder)
    assert figures["motion.argoverse.linear.fde_m"] == pytest.approx(0.0, abs=1e-6)
    assert figures["motion.argoverse.PEDESTRIAN.map_f"] > 0.9
    assert figures["motion.frames_counted"] == 5
