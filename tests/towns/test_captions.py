"""Captions say what hand-built scenes hold, and nothing that cannot be seen."""

import dataclasses
import re

import numpy as np
import pytest
import torch

from foredrive.data.setting import Doing, LightColour, Place, Setting, TimeOfDay, Weather
from foredrive.data.setting import ObjectKind as Kind
from foredrive.scene import CameraRig, Category
from foredrive.scene.actors import ActorState
from foredrive.scene.conditions import CONDITIONS, Conditions
from foredrive.towns.labels.captions import CaptionActor, FrameFacts, caption
from foredrive.towns.labels.frame_facts import object_kind
from foredrive.towns.labels.visibility import is_point_visible

SEEDS = range(24)


def thing(kind: Kind, x: float, y: float, **changes: object) -> CaptionActor:
    standing = CaptionActor(kind, np.array([x, y], dtype=np.float64), np.zeros(2), 0.0, visibility=1.0)
    return dataclasses.replace(standing, **changes)


def situation(
    *things: CaptionActor, conditions: Conditions = CONDITIONS["clear"], **changes: object
) -> FrameFacts:
    plain = Setting(
        time_of_day=TimeOfDay.at_hour(conditions.hour),
        weather=Weather.under(conditions),
        place=Place.STREET,
        doing=Doing.DRIVES,
        speed_mps=10.0,
        leader=None,
        light=None,
        **dataclasses.asdict(conditions),
    )
    return FrameFacts(dataclasses.replace(plain, **changes), things)


WALKER = thing(Kind.PEDESTRIAN, 12.0, -4.0, velocity_mps=np.array([0.0, 1.4]), on_road=True)
RAINY_NIGHT = situation(
    thing(Kind.CAR, 20.0, 0.0),
    thing(Kind.CAR, 30.0, 3.0),
    WALKER,
    conditions=Conditions(hour=23.0, clouds=1.0, rain_mmph=30.0),
    light=LightColour.RED,
    doing=Doing.SLOWS,
)


def test_a_scene_in_words() -> None:
    for seed in SEEDS:
        text = caption(RAINY_NIGHT, seed).lower()
        assert re.match(r"(at |a drive by )?night, heavy rain, ", text), text
        assert re.search(r"two cars (ahead|in front)\.", text), text
        assert re.search(r"a pedestrian (crosses|crosses the road|walks across) from the right\.", text), text
        assert re.search(r"light is red|light shows red|a red traffic light", text), text


def test_language_varies_with_the_seed_alone() -> None:
    texts = [caption(RAINY_NIGHT, seed) for seed in SEEDS]
    assert len(set(texts)) > 10
    assert texts == [caption(RAINY_NIGHT, seed) for seed in SEEDS]
    assert all(text.endswith(".") and text[0].isupper() and "  " not in text for text in texts)


@pytest.mark.parametrize(
    ("scene", "says", "never"),
    [
        (situation(thing(Kind.CAR, 20, 0, visibility=0.3)), "nearby", "car ahead|car in front"),
        (situation(thing(Kind.BUS, 60, 0)), "nearby", "bus"),
        (
            situation(thing(Kind.BUS, 40, 0), conditions=Conditions(visibility_m=50.0)),
            "dense fog",
            "bus",
        ),
        (situation(thing(Kind.CAR, 0, 9)), "a car (on|to) the left", "ahead|right"),
        (situation(thing(Kind.TRUCK, -12, 0)), "a truck behind", "ahead"),
        (
            situation(thing(Kind.CAR, 25, 3, yaw=np.pi, velocity_mps=np.array([-9.0, 0.0]))),
            "an oncoming car",
            "ahead",
        ),
        (
            situation(thing(Kind.VAN, 25, 3, yaw=1.5, velocity_mps=np.array([0.0, 6.0]))),
            "a van (crossing|passing across the road) ahead",
            "in front|oncoming|left",
        ),
        (
            situation(
                thing(Kind.VAN, 25, 3, yaw=1.5, velocity_mps=np.array([0.0, 6.0])),
                doing=Doing.TURNS_LEFT,
            ),
            "a van (ahead|in front)",
            "across|crossing",
        ),
        (situation(thing(Kind.CAR, 15, -4, parked=True)), "a parked car on the right", "nearby|ahead"),
        (
            situation(thing(Kind.CAR, 15, -4, parked=True), thing(Kind.CAR, 15, 4, parked=True)),
            "two parked cars on both sides",
            "ahead",
        ),
        (situation(thing(Kind.PEDESTRIAN, 12, -6)), "a pedestrian .*on the right", "cross"),
        (
            situation(dataclasses.replace(WALKER, velocity_mps=np.array([0.0, -1.4]))),
            "from the left",
            "from the right",
        ),
        (
            situation(thing(Kind.PEDESTRIAN, 12, -6), thing(Kind.PEDESTRIAN, 12, 6)),
            r"two pedestrians (on the walkways )?on both sides\.",
            "walkway",
        ),
        (
            situation(doing=Doing.TURNS_LEFT, place=Place.JUNCTION, light=LightColour.RED),
            "a red traffic light ahead",
            "light is|light shows",
        ),
        (situation(dataclasses.replace(WALKER, on_road=False)), "a pedestrian", "cross|across"),
        (
            situation(doing=Doing.WAITS, light=LightColour.RED, speed_mps=0.0),
            "waits at (the|a) red light",
            "light is|light shows|km/h",
        ),
        (
            situation(doing=Doing.FOLLOWS, leader=Kind.BUS, speed_mps=8.4),
            "follows a bus at (about|some) 30 km/h",
            "nearby",
        ),
        (situation(doing=Doing.TURNS_LEFT, place=Place.JUNCTION), "turns left", "right"),
        (situation(place=Place.ROUNDABOUT), "roundabout", "junction"),
        (situation(conditions=CONDITIONS["dusk"]), "dusk", "night|noon"),
        (situation(conditions=Conditions(wetness=0.8)), "road is wet|wet road", "rain"),
    ],
)
def test_facts(scene: FrameFacts, says: str, never: str) -> None:
    for seed in SEEDS:
        text = caption(scene, seed).lower()
        assert re.search(says, text), text
        assert not re.search(rf"\b({never})\b", text), text


def test_many_are_counted_by_kind() -> None:
    crowd = [thing(Kind.CAR, 10.0 + 2 * i, 0.0) for i in range(3)] + [thing(Kind.CYCLIST, 9.0, 1.0)]
    assert re.search("three cars and a cyclist (ahead|in front)", caption(situation(*crowd), 0).lower())


def test_vans_and_riders_go_by_their_own_names() -> None:
    def named(category: Category, *size_lwh: float) -> Kind:
        still = np.zeros(3)
        return object_kind(
            ActorState(1, category, still, 0.0, 0.0, np.array(size_lwh), still, 0, parked=False)
        )

    assert named(Category.CAR, 4.5, 1.8, 1.5) is Kind.CAR
    assert named(Category.CAR, 5.5, 2.0, 2.3) is Kind.VAN
    assert named(Category.CAR, 5.2, 1.9, 1.5) is Kind.CAR  # long, but low
    assert named(Category.BICYCLE, 1.7, 0.6, 1.7) is Kind.CYCLIST
    assert named(Category.MOTORCYCLE, 2.1, 0.8, 1.5) is Kind.MOTORCYCLE
    assert all(named(category, 5.5, 2.0, 2.3) for category in Category)


@pytest.mark.parametrize(
    ("name", "facts"),
    [
        ("clear", ("midday", "clear")),
        ("morning", ("morning", "clear")),
        ("overcast", ("midday", "overcast")),
        ("dusk", ("dusk", "clear")),
        ("night_rain", ("night", "rain")),
        ("fog", ("morning", "fog")),
    ],
)
def test_conditions_in_words(name: str, facts: tuple[str, str]) -> None:
    assert (TimeOfDay.at_hour(CONDITIONS[name].hour), Weather.under(CONDITIONS[name])) == facts


def test_a_small_object_is_seen_beside_a_post_but_not_behind_a_wall() -> None:
    """It is 10 m ahead; the pixel that it falls on shows a surface 3 m ahead."""
    T_ego_cam = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    K = torch.tensor([[20.0, 0, 8], [0, 20, 5], [0, 0, 1]])
    rig = CameraRig(K[None], T_ego_cam[None], torch.zeros(1, 5), torch.zeros(1), ("ahead",), (10, 16))
    point, post = np.array([10.0, 0.0, 1.5]), np.full((1, 10, 16), 50.0, np.float32)
    post[0, :, 8] = 3.0
    assert is_point_visible(point, rig, post)
    assert not is_point_visible(point, rig, np.full_like(post, 3.0))
    assert is_point_visible(point, rig, np.full_like(post, 9.6))  # its own surface
    assert not is_point_visible(-point, rig, post)
