"""A campaign is one list of drives: always the same, no name twice, commands evened out."""

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foredrive.errors import InputError
from foredrive.scene import Command
from foredrive.scene.conditions import CONDITIONS
from foredrive.towns.campaign import (
    ANY_CONDITIONS,
    Campaign,
    DrivePlan,
    driven_commands,
    plan_drives,
    select_balanced,
)
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.traffic.expert import ExpertDrive
from foredrive.towns.traffic.traffic import Traffic

RANGES = st.tuples(st.integers(0, 40), st.integers(0, 40)).map(lambda ends: (min(ends), max(ends)))


def spread(commands: Counter[Command]) -> int:
    counts = [commands[command] for command in (Command.LEFT, Command.RIGHT, Command.STRAIGHT)]
    return max(counts) - min(counts)


@settings(max_examples=50, deadline=None)
@given(
    seeds=st.lists(st.integers(0, 1000), min_size=1, max_size=6).map(tuple),
    conditions=st.one_of(
        st.just((ANY_CONDITIONS,)), st.lists(st.sampled_from(sorted(CONDITIONS)), max_size=4).map(tuple)
    ),
    vehicles=RANGES,
    people=RANGES,
)
def test_a_plan_is_always_the_same_and_no_name_comes_twice(
    seeds: tuple[int, ...], conditions: tuple[str, ...], vehicles: tuple[int, int], people: tuple[int, int]
) -> None:
    campaign = Campaign(("Town02",), seeds, conditions, vehicles, people)
    plans = plan_drives(campaign)
    assert plans == plan_drives(campaign)
    assert len({plan.log_name for plan in plans}) == len(plans)
    dealt = 1 if conditions == (ANY_CONDITIONS,) else max(1, len(set(conditions)))
    assert len(plans) == len(set(seeds)) * dealt
    for plan in plans:
        assert vehicles[0] <= plan.vehicles <= vehicles[1]
        assert people[0] <= plan.people <= people[1]


def test_names_tell_what_was_asked_for() -> None:
    plan = DrivePlan("Town01", 3, None, 30, 20, 20.0, 10.0)
    assert plan.log_name == "Town01_seed3"
    assert DrivePlan("Town01", 3, "night", 30, 20, 20.0, 10.0).log_name == "Town01_seed3_night"
    assert DrivePlan("Town01", 3, "night", 45, 10, 20.0, 10.0).log_name == "Town01_seed3_night_45v10p"


def test_every_town_is_driven_under_all_conditions_with_every_seed() -> None:
    plans = plan_drives(Campaign(("Town02", "Town01"), (4, 5), ("night", "rain")))
    assert [(plan.town, plan.conditions, plan.seed) for plan in plans] == [
        (town, conditions, seed)
        for town in ("Town02", "Town01")
        for conditions in ("night", "rain")
        for seed in (4, 5)
    ]


def test_any_conditions_are_dealt_evenly() -> None:
    plans = plan_drives(Campaign(("Town02",), tuple(range(2 * len(CONDITIONS) + 1)), (ANY_CONDITIONS,)))
    times = Counter(plan.conditions for plan in plans)
    assert set(times) == set(CONDITIONS)
    assert sorted(times.values()) == [2] * (len(CONDITIONS) - 1) + [3]


def test_chosen_seeds_turn_left_and_right_and_go_straight_alike() -> None:
    campaign = Campaign(
        ("Town02",), 1, ("clear", "night"), vehicles=(0, 0), people=(0, 0), seconds=10.0, rate_hz=5.0
    )
    plans = plan_drives(campaign)
    assert Counter(plan.conditions for plan in plans) == {"clear": 1, "night": 1}
    assert len({plan.seed for plan in plans}) == 2
    commands = sum((driven_commands(plan) for plan in plans), Counter())
    assert spread(commands) <= 1
    assert commands.total() >= 1


def test_traffic_is_the_same_under_all_conditions() -> None:
    plans = plan_drives(
        Campaign(("Town02",), (4, 5, 6), ("night", "rain"), vehicles=(0, 1000), people=(0, 1000))
    )
    crowds = {(plan.seed, plan.vehicles, plan.people) for plan in plans}
    assert len(crowds) == len({plan.vehicles for plan in plans}) == 3


def test_what_is_met_is_what_is_driven() -> None:
    met = Counter[Command]()
    for seed in (1, 7):
        plan = DrivePlan("Town02", seed, None, 0, 0, 15.0, 10.0)
        traffic = Traffic(load_town_map(plan.town), seed, 1, 0)
        drive, lanes = ExpertDrive(traffic, plan.seconds), traffic.lanes
        driven = Counter[Command]()
        for _ in range(plan.frames - 1):
            before = int(drive.state.vehicles.lane[0])
            drive.step(0.1)
            lane = int(drive.state.vehicles.lane[0])
            if lane != before and lanes.successor_count[before] > 1:
                driven[lanes.command(lane)] += 1
        assert driven_commands(plan) == driven
        met.update(driven)
    assert met.total() > 0


def test_the_rarest_command_decides() -> None:
    left, right = Counter([Command.LEFT]), Counter([Command.RIGHT])
    routes = [left, left, right, left + right]
    assert list(select_balanced(routes, 1, Counter(), routes.__getitem__)) == [3]
    assert list(select_balanced(routes, 2, Counter({Command.LEFT: 1}), routes.__getitem__)) == [3, 2]
    assert list(select_balanced(routes, 4, Counter(), routes.__getitem__)) == [3, 0, 2, 1]


def test_a_route_that_does_not_keep_its_promise_stands_back() -> None:
    left, right = Counter([Command.LEFT]), Counter([Command.RIGHT])
    promised = [left + right, left, right, right]
    met = [left, left, right, left]
    assert select_balanced(promised, 2, Counter(), met.__getitem__) == {0: left, 2: right}
    assert select_balanced(promised, 1, Counter({Command.LEFT: 1}), met.__getitem__) == {2: right}


@given(
    routes=st.lists(
        st.lists(st.sampled_from(list(Command)), max_size=6).map(Counter), min_size=4, max_size=30
    )
)
def test_no_route_is_chosen_twice(routes: list[Counter[Command]]) -> None:
    chosen = select_balanced(routes, 4, Counter(), routes[::-1].__getitem__)
    assert len(chosen) == 4
    assert chosen == select_balanced(routes, 4, Counter(), routes[::-1].__getitem__)
    assert set(chosen) <= set(range(len(routes)))


@pytest.mark.parametrize(
    ("ranges", "says"),
    [
        ({"towns": ("Town99",)}, "one of Town01"),
        ({"conditions": ("hail",)}, "unknown conditions hail"),
        ({"conditions": (ANY_CONDITIONS, "night")}, "unknown conditions any"),
        ({"seeds": ()}, "at least one town and one seed"),
        ({"seeds": 0}, "at least one town and one seed"),
        ({"seconds": 0.0}, "more than 0 s"),
        ({"rate_hz": 1000.0}, "frame rate"),
        ({"vehicles": (5, 3)}, "range of vehicles"),
    ],
)
def test_impossible_ranges_are_named(ranges: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        plan_drives(Campaign(**({"towns": ("Town02",), "seeds": (1,)} | ranges)))  # type: ignore[arg-type]
