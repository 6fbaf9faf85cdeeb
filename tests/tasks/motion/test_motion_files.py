"""Files of forecast agents: what is read, in which frames, and wrong entries named."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from foredrive.errors import InputError
from foredrive.tasks.motion.files import STEPS, read_agents
from foredrive.tasks.motion.score import score_agent_files

EGO = (400.0, 1000.0)
HALF_TURN = [0.0, 0.0, 0.0, 1.0]


def future(x: float, y: float, speed_mps: float = 2.0) -> list[list[float]]:
    """Along global x."""
    return [[x + 0.5 * speed_mps * t, y] for t in range(1, STEPS + 1)]


def box(x: float, y: float, name: str = "car", **more: Any) -> dict[str, Any]:
    """A box at a place relative to the ego vehicle, along global axes."""
    return {
        "translation": [EGO[0] + x, EGO[1] + y, 1.0],
        "detection_name": name,
        "ego_translation": [x, y, 0.0],
        **more,
    }


def true_box(x: float, y: float, name: str = "car", steps: int = STEPS, **more: Any) -> dict[str, Any]:
    return box(x, y, name, traj=future(EGO[0] + x, EGO[1] + y)[:steps], num_pts=5, **more)


def found_box(x: float, y: float, score: float = 0.9, name: str = "car", **more: Any) -> dict[str, Any]:
    futures = [future(EGO[0] + x, EGO[1] + y), future(EGO[0] + x, EGO[1] + y, 5.0)]
    given = {"detection_score": score, "predict_traj": futures, "predict_traj_score": [0.7, 0.3]}
    return box(x, y, name, **{**given, **more})


TRUE = {"a": [true_box(10.0, 2.0), true_box(-8.0, 3.0, "pedestrian")], "b": [true_box(20.0, 0.0, steps=4)]}
FOUND = {"a": [found_box(10.3, 2.0), found_box(-8.0, 3.5, 0.8, "pedestrian")], "b": []}


def write(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def files(tmp_path: Path, found: Any = FOUND, true: Any = TRUE) -> tuple[Path, Path]:
    return write(tmp_path / "results.json", found), write(tmp_path / "truth.json", true)


def test_figures_by_hand(tmp_path: Path) -> None:
    """A car 0.3 m ahead of itself all along; another is not found; VAD needs the heading."""
    read = read_agents(*files(tmp_path, {"meta": {}, "results": FOUND}))
    assert (read.frames, read.heading_known, read.futures_placed) == (2, False, True)
    figures = score_agent_files(read)
    assert figures["motion.uniad.car.min_ade_m"] == pytest.approx(0.3)
    assert figures["motion.uniad.car.epa"] == pytest.approx(0.5)
    assert figures["motion.sparsedrive.pedestrian.min_fde_m"] == pytest.approx(0.5)
    assert figures["motion.moving.car.agents"] == 1  # the other's future is cut short
    assert not any(key.startswith("motion.vad.") for key in figures)


def test_ego_poses_place_the_rectangle(tmp_path: Path) -> None:
    """Turned around, the car 10 m along global x is behind the vehicle, to its right."""
    poses = {token: {"translation": [*EGO, 0.0], "rotation": HALF_TURN} for token in "ab"}
    read = read_agents(*files(tmp_path, true={"results": TRUE, "ego_poses": poses}))
    assert read.heading_known
    np.testing.assert_allclose(read.true.xy[0], [-10.0, -2.0], atol=1e-9)
    np.testing.assert_allclose(read.true.future_xy[0, 0], [-11.0, -2.0], atol=1e-9)
    np.testing.assert_allclose(read.predicted.future_xy[0, 1, 0], [-12.8, -2.0], atol=1e-9)
    assert read.true.steps_known(STEPS).tolist() == [12, 12, 4]
    assert score_agent_files(read)["motion.vad.car.epa"] == pytest.approx(1.0)


def test_futures_in_the_lidars_frame_are_compared_with_each_other(tmp_path: Path) -> None:
    """UniAD's files: no figures of moving vehicles, which need the place of the box as well."""
    true = {"a": [box(10.0, 2.0, traj=future(2.0, 10.0), num_pts=3)]}
    found = {"a": [found_box(10.0, 2.0, predict_traj=[future(2.0, 11.0)], predict_traj_score=[1.0])]}
    read = read_agents(*files(tmp_path, found, true))
    assert not read.futures_placed
    figures = score_agent_files(read)
    assert figures["motion.uniad.car.min_fde_m"] == pytest.approx(1.0)
    assert not any(key.startswith("motion.moving.") for key in figures)
    mixed = {"a": [found_box(10.0, 2.0)]}
    with pytest.raises(InputError, match="box 0: its futures are not in the same frame as those"):
        read_agents(*files(tmp_path, mixed, true))


def test_other_names_of_the_fields(tmp_path: Path) -> None:
    """SparseDrive's `trajs`, tracking results, MFEval's `class_name`; boxes without points."""
    given = found_box(10.0, 2.0)
    sparse = {k: v for k, v in given.items() if not k.startswith("predict")} | {
        "trajs": given["predict_traj"]
    }
    tracking = {k: v for k, v in sparse.items() if not k.startswith("detection")}
    tracking |= {"tracking_name": "car", "tracking_score": 0.9}
    mfeval = {"translation": given["translation"][:2], "class_name": "car", "detection_score": 0.9}
    mfeval |= {"traj": given["predict_traj"], "traj_prob": [0.5, 0.5]}
    for each in (sparse, tracking, mfeval):
        figures = score_agent_files(read_agents(*files(tmp_path, {"a": [each]})))
        assert figures["motion.uniad.car.min_ade_m"] == pytest.approx(0.0)
    unseen = {"a": [{**TRUE["a"][0], "num_pts": 0}], "b": TRUE["b"]}
    assert not read_agents(*files(tmp_path, true=unseen)).true.seen[0]


WRONG: dict[str, tuple[Any, str]] = {
    "class": (
        {"a": [found_box(1.0, 1.0, name="tram")]},
        "box 0: the class 'tram' is not one of car",
    ),
    "score": ({"a": [found_box(1.0, 1.0, 1.5)]}, "frame a, box 0: the score 1.5 is not in [0, 1]"),
    "no score": ({"a": [found_box(1.0, 1.0, detection_score=None)]}, "frame a, box 0 has no score"),
    "place": ({"a": [found_box(1.0, 1.0, translation=[math.nan, 0, 0])]}, "its translation is not finite"),
    "nan": (
        {"a": [found_box(1.0, 1.0), found_box(1.0, 1.0, predict_traj=[[[math.nan, 0.0]] * 12])]},
        "frame a, box 1: its futures are not finite",
    ),
    "short": (
        {"a": [found_box(1.0, 1.0, predict_traj=[[[401.0, 1001.0]] * 6])]},
        "frame a, box 0: its futures are not [K, 12, 2] (x, y at steps of 0.5 s)",
    ),
    "ragged": (
        {"a": [found_box(1.0, 1.0), found_box(1.0, 1.0, predict_traj=[future(401.0, 1001.0)])]},
        "frame a, box 1: its futures are [1, 12, 2], those before [2, 12, 2]",
    ),
    "probabilities": (
        {"a": [found_box(1.0, 1.0, predict_traj_score=[1.0])]},
        "frame a, box 0 has 1 probabilities for 2 futures",
    ),
    "split": ({"x": []}, "none of its 1 frames is in "),
    "object": ({"a": ["box"]}, "frame a, box 0 is no object"),
    "list": ([], "not an object of boxes by sample token"),
    "lists": ({"a": 3}, "there must be a list of boxes by sample token"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_entries_are_named(name: str, tmp_path: Path) -> None:
    content, message = WRONG[name]
    results, truth = files(tmp_path, content)
    with pytest.raises(InputError) as caught:
        read_agents(results, truth)
    assert str(caught.value).startswith(f"{results}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_wrong_truth_is_named(tmp_path: Path) -> None:
    no_future = {"a": [box(10.0, 2.0)]}
    no_ego = {"a": [{k: v for k, v in TRUE["a"][0].items() if k != "ego_translation"}]}
    found = {"a": [{k: v for k, v in FOUND["a"][0].items() if k != "ego_translation"}]}
    for true, message in (
        (no_future, "frame a, box 0 has no traj"),
        (no_ego, "frame a does not tell where the ego vehicle is"),
        ({}, "holds no frames"),
    ):
        results, truth = files(tmp_path, found if true else {}, true)
        with pytest.raises(InputError, match=message) as caught:
            read_agents(results, truth)
        assert str(caught.value).startswith(f"{truth}: ")
