"""Scores of files of detections: parts that add up, figures by hand, comparisons."""

import math
from pathlib import Path

import numpy as np
import pytest
from tasks.files_of_detections import box, write_coco_truth, write_list, write_nuscenes

from foredrive.errors import InputError
from foredrive.tasks.detection.files import read_detections
from foredrive.tasks.detection.frames import DetectionSet
from foredrive.tasks.detection.score import ScoreConfig, score_frames
from foredrive.tasks.detection.summary import compare_scores, summarise_scores


def drives(folder: Path, *, error_m: float, seed: int = 0) -> DetectionSet:
    """Twelve frames of as many scenes: five cars, all found with the error; two detections of nothing."""
    rng, other = np.random.default_rng(seed), np.random.default_rng(99)
    truth, found = {}, {}
    for n in range(12):
        at = rng.uniform(-40, 40, (5, 2))
        moved = at + error_m * other.normal(size=at.shape)
        truth[f"f{n}"] = [box(*xy, scene_token=f"s{n}", ego_translation=[*xy, 0.0]) for xy in at]
        found[f"f{n}"] = [box(*xy, detection_score=0.9) for xy in moved]
        found[f"f{n}"] += [box(*rng.uniform(-40, 40, 2), detection_score=s) for s in (0.3, 0.05)]
    return read_detections(
        write_nuscenes(folder / "found.json", found), write_nuscenes(folder / "gt.json", truth)
    )


def test_one_certain_pair_by_hand(tmp_path: Path) -> None:
    """r = .9, σ as assumed, no error: the parts are known but for the background's small share."""
    truth = write_nuscenes(tmp_path / "gt.json", {"a": [box(5.0, 5.0)]})
    results = write_nuscenes(tmp_path / "found.json", {"a": [box(5.0, 5.0, detection_score=0.9)]})
    read = read_detections(results, truth)
    (score,) = score_frames(read)
    linear = sum(math.log(s * math.sqrt(2 * math.pi)) for s in (0.5, 0.5, 0.3, 0.15, 0.15, 0.15))
    heading = math.log(2 * math.pi * np.i0(25.0)) - 25.0
    assert score.parts["localisation"] == pytest.approx(linear + heading, abs=1e-4)
    assert score.parts["classification"] == pytest.approx(-math.log(0.9), abs=1e-4)
    assert score.parts["expected_background"] == pytest.approx(1.0)
    assert score.nll == pytest.approx(sum(score.parts.values()), abs=1e-9)
    figures = summarise_scores(read, [score]).figures
    assert figures["map"] == pytest.approx(1.0)
    assert figures["gospa.distance"] == 0.0
    spread = 0.5**2 + 0.5**2 + 0.3**2
    assert figures["pgospa.localisation"] == pytest.approx(0.9 * spread)
    assert figures["pgospa.existence"] == pytest.approx(0.1 * 2.0)
    assert figures["calibration.d_ece"] == pytest.approx(0.1)


def test_what_objects_cost_adds_up_to_the_parts(tmp_path: Path) -> None:
    for score in score_frames(drives(tmp_path, error_m=0.7)):
        assert score.objects.localisation.sum() == pytest.approx(score.parts["localisation"], abs=1e-9)
        assert score.objects.classification.sum() == pytest.approx(score.parts["classification"], abs=1e-9)
        assert score.objects.missed.sum() == pytest.approx(score.parts["missed"], abs=1e-9)
        assert score.nll == pytest.approx(sum(score.parts.values()), abs=1e-9)
        assert np.isnan(score.detections.has_object).tolist() == [False] * 6 + [True]


def test_worse_detections_are_found_worse_beyond_chance(tmp_path: Path) -> None:
    good, bad = drives(tmp_path, error_m=0.4), drives(tmp_path, error_m=1.5)
    ours, theirs = score_frames(good), score_frames(bad)
    compared, uncompared = compare_scores(ours, theirs)
    assert uncompared == 0
    assert compared.high < 0
    assert compared.p_value < 0.01
    assert compared.mean == pytest.approx(np.mean([s.nll for s in ours]) - np.mean([s.nll for s in theirs]))
    with pytest.raises(InputError, match="same frames"):
        compare_scores(ours, theirs[:-1])
    better, worse = summarise_scores(good, ours).figures, summarise_scores(bad, theirs).figures
    for figure in ("crps.x_m", "energy_score", "gospa.distance", "pgospa.distance", "std.best_factor"):
        assert better[figure] < worse[figure], figure  # type: ignore[operator]
    assert better["map"] > worse["map"]  # type: ignore[operator]
    assert better["by_class.car.objects"] == 60
    assert better["by_range.from_40_m.objects"] == sum(
        int((f.range_m >= 40).sum() - (f.range_m >= 60).sum()) for f in good.frames if f.range_m is not None
    )


def test_images_with_overlaps_by_hand(tmp_path: Path) -> None:
    """One hit of overlap .8, one detection of another class, one object missed."""
    truth = write_coco_truth(
        tmp_path / "gt.json",
        [
            {"image_id": 1, "category_id": 3, "bbox": [0, 0, 10, 10]},
            {"image_id": 1, "category_id": 3, "bbox": [50, 50, 10, 10]},
        ],
    )
    records = [
        {"image_id": 1, "category_id": 3, "bbox": [0, 0, 10, 8], "score": 0.6},
        {"image_id": 1, "category_id": 7, "bbox": [50, 50, 10, 10], "score": 0.3},
    ]
    read = read_detections(write_list(tmp_path / "found.json", records), truth)
    figures = summarise_scores(read, score_frames(read)).figures
    half = 51 / 101  # precision 1 up to recall .5
    assert figures["map_at.0.50"] == pytest.approx(half)
    assert figures["map_at.0.80"] == pytest.approx(half)
    assert figures["map_at.0.85"] == 0.0
    assert figures["calibration.d_ece"] == pytest.approx((0.4 + 0.3) / 2)
    assert figures["calibration.la_ece"] == pytest.approx((0.2 + 0.3) / 2)
    assert figures["calibration.object_level"] == pytest.approx((0.4**2 + 1 + 0.3**2) / 2, abs=1e-5)
    assert figures["gospa.missed"] == pytest.approx(50.0**2 / 2 / 2)  # one of two images
    assert figures["frames"] == 2
    assert figures["pmb_nll.frames_infinite"] == 0
    assert 0.2 < figures["pdq"] < math.sqrt(0.6) / 2  # type: ignore[operator]
    assert figures["by_size.from_0_px.objects"] == 2
    assert "object_cost.by_relevance" not in figures


def test_relevance_stands_beside_what_is_not_weighted(tmp_path: Path) -> None:
    """The found object counts three times as much as the missed one."""
    truth = [box(0.0, 0.0, relevance=3.0), box(30.0, 30.0, relevance=1.0)]
    found = {"a": [box(0.0, 0.0, detection_score=0.9)]}
    read = read_detections(
        write_nuscenes(tmp_path / "found.json", found), write_nuscenes(tmp_path / "gt.json", {"a": truth})
    )
    (score,) = score_frames(read)
    figures = summarise_scores(read, [score]).figures
    cost = score.objects.localisation + score.objects.classification + score.objects.missed
    assert figures["object_cost"] == pytest.approx(cost.mean())
    assert figures["object_cost.by_relevance"] == pytest.approx((3 * cost[0] + cost[1]) / 4)
    assert cost[1] > 10 > cost[0]
    silent = [{**each, "relevance": 0.0} for each in truth]
    read = read_detections(tmp_path / "found.json", write_nuscenes(tmp_path / "gt.json", {"a": silent}))
    assert summarise_scores(read, score_frames(read)).figures["object_cost.by_relevance"] is None


def test_no_objects_at_all(tmp_path: Path) -> None:
    """What is said of an empty street is false, and no slice is of anything."""
    found = {"a": [box(0.0, 0.0, detection_score=0.9)]}
    read = read_detections(
        write_nuscenes(tmp_path / "found.json", found), write_nuscenes(tmp_path / "gt.json", {"a": []})
    )
    figures = summarise_scores(read, score_frames(read)).figures
    assert figures["pmb_nll.false"] == pytest.approx(-math.log(0.1))
    assert figures["pmb_nll.mean"] == pytest.approx(-math.log(0.1) + 1.0)  # and one object more was expected
    assert figures["by_class.car.objects"] == 0
    assert figures["calibration.object_level"] is None


def test_no_detections_at_all(tmp_path: Path) -> None:
    """Every object is left to the uniform background: -log of one object over its region and classes."""
    truth = write_nuscenes(tmp_path / "gt.json", {"a": [box(0.0, 0.0)]})
    read = read_detections(write_nuscenes(tmp_path / "found.json", {}), truth)
    (score,) = score_frames(read)
    volume = 120 * 120 * 20 * 7**3 * 2 * math.pi
    assert score.nll == pytest.approx(1.0 + math.log(volume), abs=1e-6)
    figures = summarise_scores(read, [score]).figures
    assert figures["map"] == 0.0
    assert figures["frames_without_detections"] == 1


def test_the_rate_of_the_uniform_background_is_an_option(tmp_path: Path) -> None:
    """λ is its rate over the region. Without it, an undetected object is impossible, and counted."""
    truth = {"a": [box(0.0, 0.0)], "b": [box(5.0, 5.0)], "c": []}
    found = {"b": [box(5.0, 5.0, detection_score=0.9)]}
    read = read_detections(
        write_nuscenes(tmp_path / "found.json", found), write_nuscenes(tmp_path / "gt.json", truth)
    )
    one, three, none = (score_frames(read, ScoreConfig(background_rate=rate)) for rate in (1.0, 3.0, 0.0))
    assert three[0].nll == pytest.approx(one[0].nll + 2.0 - math.log(3), abs=1e-9)
    assert three[2].nll == pytest.approx(3.0)
    assert none[0].nll == none[0].parts["missed"] == math.inf
    assert none[1].nll == pytest.approx(none[1].parts["localisation"] - math.log(0.9), abs=1e-9)
    assert none[2].nll == 0.0
    figures = summarise_scores(read, none).figures
    assert figures["pmb_nll.frames_infinite"] == 1
    assert figures["pmb_nll.mean"] == pytest.approx(none[1].nll / 2)
    assert figures["object_cost"] == pytest.approx(none[1].nll)
    assert figures["by_class.car.objects"] == 1


def test_what_else_a_detector_names_changes_no_other_frame(tmp_path: Path) -> None:
    """The background is of the truth's classes, so that two detectors are compared by the same one."""
    truth = write_nuscenes(tmp_path / "gt.json", {"a": [box(5.0, 5.0)], "b": [box(30.0, 5.0, "bus")]})
    found = {"a": [box(5.0, 6.0, detection_score=0.9)], "b": []}
    plain = read_detections(write_nuscenes(tmp_path / "found.json", found), truth)
    found["b"].append(box(-30.0, 0.0, "moon", detection_score=0.5))
    other = read_detections(write_nuscenes(tmp_path / "found.json", found), truth)
    assert (plain.classes, other.classes) == (["bus", "car"], ["bus", "car", "moon"])
    ours, theirs = score_frames(plain), score_frames(other)
    assert theirs[0].nll == pytest.approx(ours[0].nll, abs=1e-5)  # a class has 1e-6 of another's probability
    assert theirs[1].nll == pytest.approx(ours[1].nll - math.log(0.5), abs=1e-5)


def test_ranges_are_those_of_frames_where_the_ego_vehicle_is_known(tmp_path: Path) -> None:
    at = {"a": box(105.0, 0.0, ego_translation=[5.0, 0.0, 0.0]), "b": box(900.0, 0.0)}
    truth = write_nuscenes(tmp_path / "gt.json", {name: [each] for name, each in at.items()})
    found = {name: [{**each, "detection_score": 0.9}] for name, each in at.items()}
    read = read_detections(write_nuscenes(tmp_path / "found.json", found), truth)
    figures = summarise_scores(read, score_frames(read)).figures
    assert figures["by_range.from_0_m.objects"] == 1
    assert figures["calibration.d_ece.from_0_m"] == pytest.approx(0.1)
    for each in at.values():
        each.pop("ego_translation", None)
    truth = write_nuscenes(tmp_path / "gt.json", {name: [each] for name, each in at.items()})
    found = {name: [{**each, "detection_score": 0.9}] for name, each in at.items()}
    read = read_detections(write_nuscenes(tmp_path / "found.json", found), truth)
    assert not [key for key in summarise_scores(read, score_frames(read)).figures if "range" in key]
