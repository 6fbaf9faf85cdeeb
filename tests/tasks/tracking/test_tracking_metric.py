"""Tracks of an evaluation, and the simple tracker beside them, on cases worked by hand."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from recorded_street import near_truth, read_batch, record

from foredrive.scene import Example
from foredrive.scene.agents import Agents
from foredrive.tasks.evaluation.results_files import ResultsFiles
from foredrive.tasks.files.frame_keys import continues
from foredrive.tasks.metric import EvaluationContext, Figures
from foredrive.tasks.objects.object_rows import Frames, ObjectRows, make_rows
from foredrive.tasks.objects.reading import read_objects
from foredrive.tasks.predictor import Prediction
from foredrive.tasks.tracking.score import score_tracks
from foredrive.tasks.tracking.tracking_metric import BASELINE, TrackingMetric, greedy_tracks

CLASSES = ("car", "pedestrian", "traffic_cone")


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="module")
def example(logs: Path) -> Example:
    return read_batch(logs)


def rows(boxes: list[tuple[int, str, float, float, float]]) -> ObjectRows:
    """Frame, class, x, velocity along x, score of each; y is 0."""
    n = len(boxes)
    return make_rows(
        np.array([box[0] for box in boxes], dtype=np.int64),
        np.array([CLASSES.index(box[1]) for box in boxes], dtype=np.int64),
        np.array([[box[2], 0.0, 0.0] for box in boxes]),
        np.ones((n, 3)),
        np.zeros(n),
        velocity=np.array([[box[3], 0.0] for box in boxes]),
        score=np.array([box[4] for box in boxes]),
    )


def half_seconds(scenes: list[int]) -> Frames:
    return Frames(np.array(scenes), np.arange(len(scenes)) * 500_000)


def test_a_detection_takes_the_track_that_its_velocity_leads_back_to() -> None:
    """Two cars 3 m apart drive on by 5 m; without velocities, the rear one would be taken for the other."""
    found = rows(
        [(0, "car", 0, 10, 0.9), (0, "car", 3, 10, 0.8), (1, "car", 8, 10, 0.8), (1, "car", 5, 10, 0.9)]
    )
    assert greedy_tracks(found, half_seconds([0, 0]), CLASSES).track.tolist() == [0, 1, 1, 0]


def test_the_higher_score_chooses_first_and_classes_do_not_mix() -> None:
    found = rows(
        [
            (0, "car", 0, 0, 0.9),
            (0, "pedestrian", 0.5, 0, 0.9),
            (1, "car", 1.0, 0, 0.3),
            (1, "car", 1.5, 0, 0.8),
        ]
    )
    assert greedy_tracks(found, half_seconds([0, 0]), CLASSES).track.tolist() == [0, 1, 2, 0]


def test_limits_are_those_of_the_class() -> None:
    """A pedestrian may be 1 m off, a car 4 m; a cone is not tracked."""
    found = rows(
        [
            (0, "car", 0, 0, 0.9),
            (0, "pedestrian", 30, 0, 0.8),
            (0, "traffic_cone", 9, 0, 0.9),
            (1, "car", 3.9, 0, 0.9),
            (1, "pedestrian", 31.1, 0, 0.8),
        ]
    )
    assert greedy_tracks(found, half_seconds([0, 0]), CLASSES).track.tolist() == [0, 1, 0, 2]


def test_a_track_waits_for_two_frames_and_moves_on_meanwhile() -> None:
    """It is at 10 m/s. After two empty frames it is 15 m on; after four it is forgotten."""
    found = rows([(0, "car", 0, 10, 0.9), (3, "car", 15, 10, 0.9), (8, "car", 40, 10, 0.9)])
    assert greedy_tracks(found, half_seconds([0] * 9), CLASSES).track.tolist() == [0, 0, 1]


def test_every_scene_begins_anew() -> None:
    found = rows([(0, "car", 0, 0, 0.9), (1, "car", 0, 0, 0.9)])
    assert greedy_tracks(found, half_seconds([0, 1]), CLASSES).track.tolist() == [0, 1]


def test_a_frame_continues_the_one_before_it_in_its_log() -> None:
    assert continues("a/b@500000", "a/b@1000000")
    assert continues("a/b@500000", "a/b@1500000")  # one key frame is missing
    assert not continues("a/b@500000", "a/b@2000000")
    assert not continues("a/b@500000", "a/b@500000")
    assert not continues("a/b@500000", "a/c@1000000")


def evaluated(prediction: Prediction, example: Example) -> Figures:
    """In two batches."""
    metric = TrackingMetric(EvaluationContext(0.5))
    for part in (slice(0, 5), slice(5, None)):
        metric.update(prediction[part], dataclasses.replace(example[part], key=example.key[part]))
    return {f"tracking.{key}": value for key, value in metric.result().items()}


def of_truth(example: Example, agents: Agents) -> Agents:
    """The log's own boxes with their identities, in the first four rows."""
    boxes = example.clip.boxes[:, example.clip.now]
    names = ("centre", "size_lwh", "yaw", "velocity", "category", "attribute", "track_id")
    first = agents.map_tensors(lambda tensor: tensor[:, :4])
    return dataclasses.replace(first, **{name: getattr(boxes, name) for name in names})


def test_figures_are_those_of_the_results_file(logs: Path, example: Example, tmp_path: Path) -> None:
    """The world frame turns, pitches and rolls under the vehicle; identities change every third frame."""
    prediction = near_truth(example)
    printed = evaluated(prediction, example)
    with ResultsFiles.written_to(tmp_path) as files:
        files.add(prediction, example)
    assert json.loads((tmp_path / "tracking.json").read_text())["results"]
    scored = score_tracks(*read_objects(tmp_path / "tracking.json", logs, "tracking"))
    both = [key for key in printed if key in scored and "frames" not in key]
    assert len(both) > 60
    for key in both:
        assert scored[key] == pytest.approx(printed[key], rel=1e-6, abs=1e-6), key
    assert float(printed["tracking.nuscenes.ids"]) > 0


def test_true_boxes_switch_nowhere_and_the_simple_tracker_keeps_them(example: Example) -> None:
    agents = near_truth(example).agents
    assert agents is not None
    figures = evaluated(Prediction(agents=of_truth(example, agents)), example)
    for suffix in ("", BASELINE):
        assert figures[f"tracking.nuscenes.car.amota{suffix}"] == pytest.approx(1.0)
        assert figures[f"tracking.nuscenes.ids{suffix}"] == 0
    assert figures["tracking.scenes"] == 1


def test_cars_within_30_m_have_a_figure_of_their_own(example: Example) -> None:
    """One of the two cars stays 40 m ahead and is never found; the other one is, at all times."""
    agents = near_truth(example).agents
    assert agents is not None
    boxes = example.clip.boxes
    far, score = boxes.centre.clone(), torch.ones(len(agents.score), 4)
    far[:, :, 1, :2] = torch.tensor([40.0, 0.0])
    score[:, 1] = 0.0
    clip = dataclasses.replace(example.clip, boxes=dataclasses.replace(boxes, centre=far))
    found = dataclasses.replace(of_truth(example, agents), score=score)
    figures = evaluated(Prediction(agents=found), dataclasses.replace(example, clip=clip))
    for suffix in ("", BASELINE):
        assert figures[f"tracking.car_amota_30m{suffix}"] == pytest.approx(1.0)
        assert figures[f"tracking.car_ids_30m{suffix}"] == 0
        assert float(figures[f"tracking.nuscenes.car.amota{suffix}"]) < 0.6


def test_without_identities_there_is_the_baseline_alone(example: Example) -> None:
    agents = near_truth(example).agents
    assert agents is not None
    none = dataclasses.replace(agents, track_id=torch.full_like(agents.track_id, -1))
    figures = evaluated(Prediction(agents=none), example)
    assert "tracking.nuscenes.amota" not in figures
    assert f"tracking.nuscenes.amota{BASELINE}" in figures


def test_a_drive_is_cut_where_frames_are_missing(example: Example) -> None:
    """Without the cut, the tracks would be filled over the gap."""
    agents = near_truth(example).agents
    assert agents is not None
    kept = torch.tensor([0, 1, 2, 7, 8, 9])
    part = dataclasses.replace(example[kept], key=tuple(example.key[k] for k in kept.tolist()))
    figures = evaluated(Prediction(agents=of_truth(part, agents[kept])), part)
    assert figures["tracking.scenes"] == 2
    assert figures["tracking.frames_counted"] == 6
    assert figures["tracking.nuscenes.car.gt"] == 2 * 6
