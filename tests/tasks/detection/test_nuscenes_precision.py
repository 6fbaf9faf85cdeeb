"""Average precision of nuScenes: the boxes that the devkit counts, by hand, and parity with the devkit.

The devkit pins NumPy 1, but `pip install --no-deps nuscenes-devkit pyquaternion cachetools` is enough here.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tasks.files_of_detections import box, write_nuscenes

from foredrive.engine.summary import Figures
from foredrive.tasks.detection.files import read_detections
from foredrive.tasks.detection.nuscenes_results import BICYCLE_RACK
from foredrive.tasks.detection.score import score_frames
from foredrive.tasks.detection.summary import summarise_scores
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES

Boxes = list[dict[str, Any]]


def figures_of(folder: Path, truth: dict[str, Boxes], found: dict[str, Boxes]) -> Figures:
    read = read_detections(
        write_nuscenes(folder / "found.json", found), write_nuscenes(folder / "gt.json", truth)
    )
    return summarise_scores(read, score_frames(read)).figures


def at(x: float, y: float, name: str = "car", **more: Any) -> dict[str, Any]:
    """A box at this place from an ego vehicle at (1000, 500)."""
    return box(1000.0 + x, 500.0 + y, name, ego_translation=[x, y, 1.0], **more)


def test_only_boxes_within_the_range_of_their_class_count(tmp_path: Path) -> None:
    """A surer false car at 80 m, and pedestrians at 45 m, missed or false, cost nothing; cars at 49 m do."""
    truth = [at(5.0, 0.0), at(49.0, 0.0), at(0.0, 45.0, "pedestrian"), at(0.0, 8.0, "pedestrian")]
    found = [
        at(5.0, 0.0, detection_score=0.5),
        at(80.0, 0.0, detection_score=0.9),
        at(0.0, 8.0, "pedestrian", detection_score=0.5),
        at(0.0, 44.0, "pedestrian", detection_score=0.9),
    ]
    figures = figures_of(tmp_path, {"a": truth}, {"a": found})
    assert figures["ap.pedestrian"] == pytest.approx(1.0)
    assert figures["ap.car"] == pytest.approx(40 / 90)  # half of the cars are found, all without a false one
    found.append(at(49.0, 0.3, detection_score=0.2))
    assert figures_of(tmp_path, {"a": truth}, {"a": found})["map"] == pytest.approx(1.0)


def test_objects_without_points_do_not_count(tmp_path: Path) -> None:
    truth = [at(5.0, 0.0, num_pts=9), at(15.0, 0.0, num_pts=0)]
    found = [at(5.0, 0.0, detection_score=0.9)]
    figures = figures_of(tmp_path, {"a": truth}, {"a": found})
    assert figures["map"] == pytest.approx(1.0)
    assert figures["objects"] == 2  # the likelihood is of all


def test_cycles_in_a_rack_do_not_count(tmp_path: Path) -> None:
    """The rack is 4 m x 2 m: a bicycle 1.5 m along it is inside, one 1.5 m across it is not."""
    rack = at(10.0, 0.0, BICYCLE_RACK, yaw=np.pi / 2)
    truth = [at(10.0, 1.5, "bicycle"), at(11.5, 0.0, "bicycle"), at(10.0, 0.5), rack]
    found = [
        at(10.0, -1.0, "bicycle", detection_score=0.9),
        at(11.5, 0.0, "bicycle", detection_score=0.5),
        at(10.0, 0.5, detection_score=0.5),
    ]
    figures = figures_of(tmp_path, {"a": truth}, {"a": found})
    assert figures["map"] == pytest.approx(1.0)
    assert figures["objects"] == 3  # a rack is no object
    assert not [key for key in figures if BICYCLE_RACK in key]


def test_a_match_is_closer_than_the_threshold(tmp_path: Path) -> None:
    truth, found = {"a": [at(5.0, 0.0)]}, {"a": [at(5.5, 0.0, detection_score=0.9)]}
    figures = figures_of(tmp_path, truth, found)
    assert figures["map_at.0.5_m"] == 0.0
    assert figures["map_at.1_m"] == pytest.approx(1.0)


def random_drive(rng: np.random.Generator) -> tuple[dict[str, Boxes], dict[str, Boxes]]:
    """Frames of objects up to 60 m away, racks, near detections and false ones, many with equal scores."""
    truth, found = {}, {}
    names = sorted(DETECTION_CLASSES)
    for n in range(12):
        places = [(*rng.uniform(-45, 45, 2), str(rng.choice(names))) for _ in range(25)]
        truth[f"f{n}"] = [at(x, y, name, num_pts=int(rng.integers(0, 6))) for x, y, name in places]
        truth[f"f{n}"] += [at(*rng.uniform(-30, 30, 2), BICYCLE_RACK) for _ in range(8)]
        moved = [(x + rng.normal(), y + rng.normal(), name) for x, y, name in places if rng.random() < 0.8]
        moved += [(*rng.uniform(-60, 60, 2), str(rng.choice(names))) for _ in range(10)]
        found[f"f{n}"] = [
            at(x, y, name, detection_score=round(float(rng.random()), 1)) for x, y, name in moved
        ]
    return truth, found
