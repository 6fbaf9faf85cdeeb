"""Open-loop protocols on hand-computed cases in which they differ."""

import dataclasses
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from foredrive.errors import InputError
from foredrive.scene import Boxes, Category, Trajectory
from foredrive.scene.boxes import unlabelled
from foredrive.tasks.planning.obstacles import Obstacles
from foredrive.tasks.planning.protocols import LIDAR_FORWARD_M, PROTOCOLS, STEP_S, STEPS
from foredrive.tasks.planning.scores import PlanScores, score_plan

NAMES = sorted(PROTOCOLS)


def path(xy: list[tuple[float, float]], yaw: float = 0.0, valid_steps: int = STEPS) -> Trajectory:
    return Trajectory(
        xy=torch.tensor(xy, dtype=torch.float32)[None, None],
        yaw=torch.full((1, 1, len(xy)), yaw),
        valid=(torch.arange(len(xy)) < valid_steps)[None, None],
        log_prob=torch.zeros(1, 1),
        dt_s=STEP_S,
    )


def straight(speed_mps: float, valid_steps: int = STEPS) -> Trajectory:
    return path([(speed_mps * STEP_S * k, 0.0) for k in range(1, STEPS + 1)], valid_steps=valid_steps)


@dataclasses.dataclass(frozen=True)
class Thing:
    """A square box that is there at some steps (1 … 6)."""

    steps: tuple[int, ...]
    x: float
    y: float
    size: float = 0.4
    category: Category = Category.CAR
    tracked_now: bool = True
    tracked_lately: bool = True


def obstacles(*things: Thing, annotated_steps: int = STEPS) -> Obstacles:
    m = max(len(things), 1)
    centre, category = torch.zeros(1, STEPS, m, 3), torch.zeros(1, STEPS, m, dtype=torch.long)
    size, valid = torch.ones(1, STEPS, m, 3), torch.zeros(1, STEPS, m, dtype=torch.bool)
    now, lately = valid.clone(), valid.clone()
    for i, thing in enumerate(things):
        centre[0, :, i, 0], centre[0, :, i, 1], category[0, :, i] = thing.x, thing.y, int(thing.category)
        size[0, :, i] = thing.size
        for step in thing.steps:
            valid[0, step - 1, i] = step <= annotated_steps
            now[0, step - 1, i], lately[0, step - 1, i] = thing.tracked_now, thing.tracked_lately
    return Obstacles(
        boxes=Boxes(
            centre=centre,
            size_lwh=size,
            yaw=torch.zeros(1, STEPS, m),
            velocity=torch.zeros(1, STEPS, m, 2),
            track_id=torch.arange(m).expand(1, STEPS, m),
            category=category,
            valid=valid,
            **unlabelled(1, STEPS, m),
        ),
        annotated=(torch.arange(STEPS) < annotated_steps)[None],
        tracked_now=now,
        tracked_lately=lately,
        annotated_now=torch.ones(1, dtype=torch.bool),
    )


def score(name: str, plan: Trajectory, driven: Trajectory, around: Obstacles) -> PlanScores:
    return score_plan(plan, driven, around, PROTOCOLS[name])


def approx(values: list[float]) -> object:
    return pytest.approx(values, abs=1e-6)


def test_one_plan_five_numbers() -> None:
    # Driven: 5 m/s straight ahead. Planned: the same, and k metres to the left at step k, an error of k.
    driven = straight(5.0)
    plan = path([(2.5 * k, 1.0 * k) for k in range(1, STEPS + 1)])
    # On the plan, 1.2 m ahead of the rear axle (within the vehicle wherever a protocol puts it):
    on_plan = {k: (2.5 * k + 1.2, 1.0 * k + 0.3) for k in range(1, STEPS + 1)}
    around = obstacles(
        Thing((2,), *on_plan[2]),  # a car
        Thing((3,), *on_plan[3], tracked_now=False),  # a car hidden now, seen half a second ago
        Thing((4,), *on_plan[4], category=Category.PEDESTRIAN),
        Thing((5,), *on_plan[5], category=Category.TRAFFIC_CONE),
        Thing((6,), *on_plan[6], tracked_now=False, tracked_lately=False),  # a car that turns up later
    )
    # Who counts what, by step:       car 2 | hidden car 3 | pedestrian 4 | cone 5 | late car 6
    #   ST-P3 (seen within 1 s)         x           x               x
    #   UniAD (vehicles)                x           x                                   x
    #   VAD (seen now)                  x                           x
    #   SparseDrive (everything)        x           x               x          x        x
    #   BEV-Planner (vehicles)          x           x                                   x
    l2_mean, l2_at = [1.5, 2.5, 3.5], [2.0, 4.0, 6.0]  # (1 + 2) / 2, (1 + … + 4) / 4, (1 + … + 6) / 6
    expected = {
        "stp3": (l2_mean, [1 / 2, 3 / 4, 3 / 6]),
        "uniad": (l2_at, [1.0, 0.0, 1.0]),  # at steps 2, 4, 6
        "vad": (l2_mean, [1 / 2, 2 / 4, 2 / 6]),
        "sparsedrive": (l2_mean, [1 / 2, 3 / 4, 5 / 6]),
        "bevplanner": (l2_mean, [1.0, 1.0, 1.0]),  # any step up to then
    }
    for name, (l2_m, collision) in expected.items():
        scores = score(name, plan, driven, around)
        assert scores.l2_m[0].tolist() == approx(l2_m), name
        assert scores.collision[0].tolist() == approx(collision), name
        assert scores.driven_collision[0].tolist() == [0.0, 0.0, 0.0], name
        assert bool(scores.counted), name
        assert bool(scores.collision_counted), name


@pytest.mark.parametrize("name", NAMES)
def test_driving_what_was_driven_scores_zero(name: str) -> None:
    driven = straight(5.0)
    scores = score(name, driven, driven, obstacles(Thing((1, 2, 3, 4, 5, 6), 8.0, 4.0)))
    assert scores.l2_m.tolist() == [[0.0, 0.0, 0.0]]
    assert scores.collision.tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize("name", NAMES)
def test_a_plan_through_a_parked_car(name: str) -> None:
    # 2 m per step past a car of 1.2 × 1.2 m at 7.8 … 9.0 m; driven was not at all.
    plan = straight(4.0)
    standing = straight(0.0)
    around = obstacles(Thing(tuple(range(1, STEPS + 1)), 8.4, 0.0, size=1.2))
    scores = score(name, plan, standing, around)
    # The ego box reaches from 0.6 m behind the rear axle to 3.5 m ahead of it (ST-P3: from 1.5 m behind to
    # 2.5 m ahead), and so touches the car while the axle is at 4.3 … 9.6 m (ST-P3: 5.3 … 10.5 m): at steps 3
    # and 4 (ST-P3: 3, 4 and 5).
    expected = {
        "stp3": [0.0, 2 / 4, 3 / 6],
        "uniad": [0.0, 1.0, 0.0],
        "vad": [0.0, 2 / 4, 2 / 6],
        "sparsedrive": [0.0, 2 / 4, 2 / 6],
        "bevplanner": [0.0, 1.0, 1.0],
    }
    assert scores.collision[0].tolist() == approx(expected[name])


@pytest.mark.parametrize("name", NAMES)
def test_steps_at_which_the_driven_car_collides_are_skipped_but_counted(name: str) -> None:
    driven = straight(4.0)
    # A box rides along with the vehicle at steps 1 and 2: it "collides" there, and so would the same plan.
    riding = [Thing((k,), 2.0 * k + 1.2, 0.0) for k in (1, 2)]
    ahead = Thing((4,), 2.0 * 4 + 1.2, 4.0)
    plan = path([(2.0 * k, 0.0 if k < 4 else 4.0) for k in range(1, STEPS + 1)])
    scores = score(name, plan, driven, obstacles(*riding, ahead))
    mean = [0.0, 1 / 4, 1 / 6]  # step 4 alone, over all steps
    expected = {"uniad": [0.0, 1.0, 0.0], "bevplanner": [0.0, 1.0, 1.0]}.get(name, mean)
    assert scores.collision[0].tolist() == approx(expected)
    driven_mean = [2 / 2, 2 / 4, 2 / 6]
    expected = {"uniad": [1.0, 0.0, 0.0], "bevplanner": [1.0, 1.0, 1.0]}.get(name, driven_mean)
    assert scores.driven_collision[0].tolist() == approx(expected)


@pytest.mark.parametrize("name", NAMES)
def test_a_log_that_ends_within_three_seconds(name: str) -> None:
    # The log ends after step 3; the plan errs by 1 m throughout and would collide at steps 2 and 5.
    driven = straight(5.0, valid_steps=3)
    plan = path([(2.5 * k, 1.0) for k in range(1, STEPS + 1)])
    things = [Thing((k,), 2.5 * k + 1.2, 1.7) for k in (2, 5)]
    scores = score(name, plan, driven, obstacles(*things, annotated_steps=3))
    assert not bool(scores.future_complete)
    if name == "uniad":  # masked steps add nothing and are counted: 1 m at 1 s, then 0
        assert bool(scores.counted)
        assert bool(scores.collision_counted)
        assert scores.l2_m[0].tolist() == [1.0, 0.0, 0.0]
        assert scores.collision[0].tolist() == [1.0, 0.0, 0.0]
    else:
        assert not bool(scores.counted)
        assert not bool(scores.collision_counted)


@pytest.mark.parametrize("name", NAMES)
def test_without_annotations_there_is_no_collision_number(name: str) -> None:
    scores = score(name, straight(5.0), straight(5.0), obstacles(annotated_steps=4))
    assert bool(scores.counted)
    assert not bool(scores.collision_counted)
    unseen = dataclasses.replace(obstacles(), annotated_now=torch.zeros(1, dtype=torch.bool))
    assert not bool(score(name, straight(5.0), straight(5.0), unseen).collision_counted)


@pytest.mark.parametrize("name", NAMES)
def test_a_broken_plan_is_not_scored(name: str) -> None:
    plan = straight(5.0)
    plan.xy[0, 0, 3, 0] = math.nan
    scores = score(name, plan, straight(5.0), obstacles())
    assert not bool(scores.plan_complete)
    assert not bool(scores.counted)
    assert scores.l2_m.tolist() == [[0.0, 0.0, 0.0]]
    short = path([(2.5 * k, 0.0) for k in range(1, STEPS + 1)], valid_steps=5)
    assert not bool(score(name, short, straight(5.0), obstacles()).plan_complete)


def test_centre_point_and_box_are_two_numbers() -> None:
    # At step 2 a box 3.1 m ahead of the rear axle: within every vehicle's box but ST-P3's (which ends 2.5 m
    # ahead), on nobody's point. At step 4 a box around rear axle and lidar alike.
    driven = straight(0.0)
    plan = straight(4.0)
    around = obstacles(Thing((2,), 4.0 + 3.1, 0.0), Thing((4,), 8.5, 0.0, size=3.0))
    for name in NAMES:
        scores = score(name, plan, driven, around)
        if name == "uniad":
            assert scores.collision[0].tolist() == [1.0, 1.0, 0.0]
            assert scores.collision_centre[0].tolist() == [0.0, 1.0, 0.0]
        elif name == "bevplanner":
            assert scores.collision[0].tolist() == [1.0, 1.0, 1.0]
            assert scores.collision_centre[0].tolist() == [0.0, 1.0, 1.0]
        else:
            box = [0.0, 1 / 4, 1 / 6] if name == "stp3" else [1 / 2, 2 / 4, 2 / 6]
            assert scores.collision[0].tolist() == approx(box), name
            assert scores.collision_centre[0].tolist() == approx([0.0, 1 / 4, 1 / 6]), name


def test_who_turns_the_vehicle_along_the_path() -> None:
    # The plan turns left onto the y axis and is heading there from step 2 on; at step 6 its rear axle is at
    # (4, 8). A box at (4, 11) is 3 m ahead of it: hit only by those who turn the vehicle. A box at (6, 8) is
    # 2 m to its right: hit only by those who leave the vehicle pointing along x.
    xy = [(3.0, 0.0), (4.0, 1.0), (4.0, 2.5), (4.0, 4.0), (4.0, 6.0), (4.0, 8.0)]
    plan = path(xy, yaw=0.5 * math.pi)
    driven = path([(-4.0, 0.0)] * STEPS)
    turns = {"stp3": False, "uniad": False, "vad": False, "sparsedrive": True, "bevplanner": True}
    for name, turning in turns.items():
        ahead = score(name, plan, driven, obstacles(Thing((6,), 4.0, 11.0)))
        aside = score(name, plan, driven, obstacles(Thing((6,), 6.0, 8.0 + (0.0 if turning else 1.0))))
        # At 3 s, "at" and "any" give 1, "mean" gives 1/6.
        assert (float(ahead.collision[0, 2]) > 0) == turning, name
        if name != "stp3":  # which follows the rear axle, so its vehicle is 1 m further to the right
            assert (float(aside.collision[0, 2]) > 0) != turning, name


def test_the_followed_point_swings_out_with_the_heading() -> None:
    # The vehicle stands, turned by 90°: UniAD's lidar has moved by (-0.986, +0.986) from where it was, and
    # its axis-aligned box with it, which now covers -1.5 … 2.5 m in x and 0.06 … 1.91 m in y.
    turned = path([(0.0, 0.0)] * STEPS, yaw=0.5 * math.pi)
    away = path([(-20.0, 0.0)] * STEPS)
    beside = obstacles(Thing(tuple(range(1, STEPS + 1)), 0.5, 1.5 + 0.2))
    assert score("uniad", turned, away, beside).collision[0].tolist() == [1.0, 1.0, 1.0]
    straight_on = path([(0.0, 0.0)] * STEPS)
    assert score("uniad", straight_on, away, beside).collision[0].tolist() == [0.0, 0.0, 0.0]
    assert LIDAR_FORWARD_M == 0.985793


def test_wrong_inputs_are_named() -> None:
    with pytest.raises(InputError, match=r"0\.5 s"):
        score("vad", dataclasses.replace(straight(5.0), dt_s=0.1), straight(5.0), obstacles())
    with pytest.raises(InputError, match="plan must be"):
        score("vad", path([(0.0, 0.0)] * 4), straight(5.0), obstacles())


metres = st.floats(-30, 30)
paths = st.lists(st.tuples(metres, metres), min_size=STEPS, max_size=STEPS)


@settings(deadline=None, max_examples=50)
@given(st.sampled_from(NAMES), paths, paths, st.floats(-math.pi, math.pi), metres, metres)
def test_distance_does_not_change_when_both_paths_move_alike(
    name: str,
    planned: list[tuple[float, float]],
    driven: list[tuple[float, float]],
    angle: float,
    dx: float,
    dy: float,
) -> None:
    def moved(xy: list[tuple[float, float]]) -> list[tuple[float, float]]:
        cos, sin = math.cos(angle), math.sin(angle)
        return [(cos * x - sin * y + dx, sin * x + cos * y + dy) for x, y in xy]

    here = score(name, path(planned), path(driven), obstacles())
    there = score(name, path(moved(planned)), path(moved(driven)), obstacles())
    torch.testing.assert_close(here.l2_m, there.l2_m, atol=1e-3, rtol=1e-4)


@settings(deadline=None, max_examples=20)
@given(paths, st.lists(st.tuples(st.integers(1, STEPS), metres, metres), max_size=5))
def test_any_is_at_least_mean_and_more_boxes_never_help(
    planned: list[tuple[float, float]], things: list[tuple[int, float, float]]
) -> None:
    away = path([(-45.0, -45.0)] * STEPS)
    boxes = [Thing((step,), x, y) for step, x, y in things if math.hypot(x + 45, y + 45) > 10]
    mean = dataclasses.replace(PROTOCOLS["bevplanner"], collision="mean")
    some = score("bevplanner", path(planned), away, obstacles(*boxes))
    assert bool((some.collision >= score_plan(path(planned), away, obstacles(*boxes), mean).collision).all())
    assert bool(
        (some.collision >= score("bevplanner", path(planned), away, obstacles(*boxes[:-1])).collision).all()
    )
