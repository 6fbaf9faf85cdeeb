"""Cases in which detection protocols differ, and each error, worked out by hand."""

import dataclasses
import math

import numpy as np
import pytest

from foredrive.scene.boxes import UNKNOWN, Attribute
from foredrive.tasks.detection.protocols import (
    DETECTION_PROTOCOLS,
    evaluate_detections,
    hit_errors,
    running_mean,
)
from foredrive.tasks.objects.object_rows import (
    DETECTION_CLASSES,
    ObjectRows,
    counted,
    inside_racks,
    make_rows,
)

NUSCENES, VAD = DETECTION_PROTOCOLS["nuscenes"], DETECTION_PROTOCOLS["vad"]


def at(*places: tuple[float, float], name: str = "car", score: float = math.nan) -> ObjectRows:
    n, xy = len(places), np.array(places).reshape(-1, 2)
    return make_rows(
        np.zeros(n, np.int64),
        np.full(n, DETECTION_CLASSES.index(name)),
        np.pad(xy, ((0, 0), (0, 1))),
        np.full((n, 3), 2.0),
        np.zeros(n),
        score=np.full(n, score),
        from_ego=xy,
        velocity=np.zeros((n, 2)),
    )


NONE = at()


def test_the_ground_that_counts() -> None:
    """nuScenes: less than 50 m away. VAD: less than 30 m along x and less than 15 m along y."""
    cars = at((29.0, 14.0), (31.0, 0.0), (0.0, 16.0), (40.0, 31.0), (50.0, 0.0))
    assert counted(cars, NONE, NUSCENES.region, DETECTION_CLASSES).tolist() == [
        True,
        True,
        True,
        False,
        False,
    ]
    assert counted(cars, NONE, VAD.region, DETECTION_CLASSES).tolist() == [True, False, False, False, False]
    cones = at((29.0, 0.0), (31.0, 0.0), name="traffic_cone")
    assert counted(cones, NONE, NUSCENES.region, DETECTION_CLASSES).tolist() == [True, False]


def test_the_same_detections_under_both_protocols() -> None:
    """One of two cars is found. It is within VAD's ground, the missed one only within nuScenes'."""
    true, found = at((10.0, 0.0), (0.0, 20.0)), at((10.0, 0.0), score=0.9)
    ap = {p.title: evaluate_detections(found, true, NONE, p).by_class["car"].ap[0.5] for p in (NUSCENES, VAD)}
    assert ap["VAD"] == pytest.approx(1.0)
    assert ap["nuScenes"] == pytest.approx(40 / 90)  # recall above .1 up to .5


def test_an_unknown_place_counts_everywhere() -> None:
    lost = dataclasses.replace(at((900.0, 900.0)), from_ego=np.full((1, 2), np.nan))
    assert counted(lost, NONE, NUSCENES.region, DETECTION_CLASSES).tolist() == [True]


def test_cycles_in_a_rack_of_their_frame() -> None:
    """A rack of 2 m around the origin in frame 0 holds neither what is elsewhere, nor a car, nor frame 1."""
    cycles = at((0.5, 0.5), (1.5, 0.0), name="bicycle")
    assert inside_racks(cycles, at((0.0, 0.0)), DETECTION_CLASSES).tolist() == [True, False]
    assert inside_racks(at((0.0, 0.0)), at((0.0, 0.0)), DETECTION_CLASSES).tolist() == [False]
    later = dataclasses.replace(cycles, frame=np.ones(2, np.int64))
    assert inside_racks(later, at((0.0, 0.0)), DETECTION_CLASSES).tolist() == [False, False]


def test_errors_of_a_hit() -> None:
    """3 m and 4 m away; half as long; a quarter turn; 5 m/s too slow; another attribute."""
    moving, parked = np.array([Attribute.VEHICLE_MOVING]), np.array([Attribute.VEHICLE_PARKED])
    true = dataclasses.replace(at((0.0, 0.0)), attribute=moving, velocity=np.array([[3.0, 4.0]]))
    found = dataclasses.replace(
        at((3.0, 4.0)), attribute=parked, size_lwh=np.array([[1.0, 2.0, 2.0]]), yaw=np.array([math.pi / 2])
    )
    errors = {key: value.item() for key, value in hit_errors(found, true).items()}
    expected = {"ate_m": 5.0, "ase": 0.5, "aoe_rad": math.pi / 2, "ave_mps": 5.0, "aae": 1.0}
    assert errors == pytest.approx(expected)


def test_a_barrier_that_is_turned_by_half_has_no_error() -> None:
    true, turned = at((0.0, 0.0)), dataclasses.replace(at((0.0, 0.0)), yaw=np.array([math.pi - 0.1]))
    assert hit_errors(turned, true)["aoe_rad"].item() == pytest.approx(math.pi - 0.1)
    assert hit_errors(turned, true, half_turn=True)["aoe_rad"].item() == pytest.approx(0.1)


def test_truth_without_an_attribute_is_not_judged() -> None:
    """Whatever is said. A detection without an attribute is wrong where the truth has one."""
    some = dataclasses.replace(at((0.0, 0.0)), attribute=np.array([Attribute.CYCLE_WITH_RIDER]))
    none = dataclasses.replace(some, attribute=np.array([UNKNOWN]))
    assert math.isnan(hit_errors(some, none)["aae"].item())
    assert hit_errors(none, some)["aae"].item() == 1.0


def test_cones_have_no_heading_and_barriers_no_velocity() -> None:
    figures = evaluate_detections(
        at((1.0, 0.0), name="traffic_cone", score=0.5), at((1.0, 0.0), name="traffic_cone"), NONE, NUSCENES
    )
    cone, barrier = (figures.by_class[name].errors for name in ("traffic_cone", "barrier"))
    assert [key for key, value in cone.items() if math.isnan(value)] == ["aoe_rad", "ave_mps", "aae"]
    assert [key for key, value in barrier.items() if math.isnan(value)] == ["ave_mps", "aae"]
    assert figures.errors["aoe_rad"] == 1.0  # of the nine other classes, of which nothing is found


def test_nds_of_one_perfect_class() -> None:
    """Cars are perfect, nine classes have nothing. mAP .1; errors .9 of ten classes, or 7/8 of eight.

    Orientation: 8/9 of nine classes. Attribute: the truth has none, which counts as 1 for cars too.
    """
    figures = evaluate_detections(at((5.0, 0.0), score=0.9), at((5.0, 0.0)), NONE, NUSCENES)
    assert figures.mean_ap == pytest.approx(0.1)
    assert figures.errors == pytest.approx(
        {"ate_m": 0.9, "ase": 0.9, "aoe_rad": 8 / 9, "ave_mps": 7 / 8, "aae": 1.0}
    )
    assert figures.nds == pytest.approx((5 * 0.1 + 0.1 + 0.1 + 1 / 9 + 1 / 8 + 0.0) / 10)


def test_the_running_mean_leaves_unknown_values_out() -> None:
    nan = math.nan
    assert running_mean(np.array([nan, 1.0, nan, 0.0])).tolist() == [0.0, 1.0, 1.0, 0.5]
    assert running_mean(np.array([nan, nan])).tolist() == [1.0, 1.0]
