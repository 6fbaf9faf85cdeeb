"""What a driver remembers between plans, and the path that it is given."""

import dataclasses
from collections.abc import Callable

import pytest
import torch
from path_truth import SPEC, sight_of

from foredrive.driver.agent import (
    BEFORE_LINE_M,
    CREEPS,
    IMPATIENT,
    NEAR_CELLS,
    STAYS,
    WAITS,
    Driver,
    LightMemory,
    PartlyTrue,
    Perception,
    given_path,
    staying,
    stopped_by_sign,
)
from foredrive.driver.eyes import CameraEyes, CameraEyesConfig
from foredrive.driver.route_cells import LINE_CELLS
from foredrive.driver.sight import Sight
from foredrive.driver.speed_planner import SpeedPlanner, SpeedPlannerConfig
from foredrive.scene import Clip, Example
from foredrive.scene.affordances import CELLS, TIMES, PathEstimate
from foredrive.scene.clip import ROUTE_M
from foredrive.scene.traffic_light import LightState


def estimate(light: LightState, light_m: float = 0.0, p: float = 0.97) -> PathEstimate:
    states = torch.full((1, 4), (1 - p) / 3)
    states[0, light] = p
    return PathEstimate(states, torch.tensor([light_m]), torch.zeros(1, TIMES, CELLS))


def state(view: PathEstimate) -> LightState:
    return LightState(int(view.light[0].argmax()))


def test_a_red_light_is_remembered_at_its_line_and_forgotten_beyond_it() -> None:
    memory = LightMemory()
    assert state(memory.update(estimate(LightState.RED, 9.0), 0.0, line_seen=True)) is LightState.RED
    view = memory.update(estimate(LightState.NONE, 5.5), 4.0, line_seen=True)  # the lamps are out of view
    assert state(view) is LightState.RED
    assert float(view.light_m) == pytest.approx(5.0 - BEFORE_LINE_M)
    for _ in range(60):  # it waits for half a minute
        view = memory.update(estimate(LightState.NONE, 5.5), 0.0, line_seen=True)
    assert state(view) is LightState.RED
    assert state(memory.update(estimate(LightState.GREEN, 5.0), 0.0, line_seen=True)) is LightState.GREEN
    assert state(memory.update(estimate(LightState.NONE), 12.0)) is LightState.NONE  # beyond the line


def test_a_line_that_looks_farther_moves_less_than_one_that_looks_nearer() -> None:
    for read_m, line_m in ((15.0, 9.9), (5.0, 7.0)):
        memory = LightMemory()
        memory.update(estimate(LightState.RED, 10.0), 0.0)
        view = memory.update(estimate(LightState.RED, read_m), 1.0)
        assert float(view.light_m) == pytest.approx(line_m - BEFORE_LINE_M)


def test_a_line_jumps_nearer_at_once_and_farther_after_three_readings() -> None:
    memory = LightMemory()
    memory.update(estimate(LightState.RED, 8.0), 0.0)
    for _ in range(2):
        view = memory.update(estimate(LightState.RED, 25.0), 0.0)
        assert float(view.light_m) == pytest.approx(8.0 - BEFORE_LINE_M)
    view = memory.update(estimate(LightState.RED, 25.0), 0.0)
    assert float(view.light_m) == pytest.approx(25.0 - BEFORE_LINE_M)
    view = memory.update(estimate(LightState.RED, 8.0), 0.0)
    assert float(view.light_m) == pytest.approx(8.0 - BEFORE_LINE_M)


@pytest.mark.parametrize(("line_m", "stop_m"), [(8.0, 8.0 - BEFORE_LINE_M), (1.0, 0.0), (-2.0, -2.0)])
def test_a_vehicle_stops_before_the_line_but_is_told_truly_how_far_beyond_it_is(
    line_m: float, stop_m: float
) -> None:
    view = LightMemory().update(estimate(LightState.RED, line_m), 0.0)
    assert float(view.light_m) == pytest.approx(stop_m)


def test_lamps_do_not_move_a_line_that_was_seen_itself() -> None:
    memory = LightMemory()
    memory.update(estimate(LightState.RED, 20.0), 0.0)
    view = memory.update(estimate(LightState.RED, 9.0), 1.0, line_seen=True)
    assert float(view.light_m) == pytest.approx(9.0 - BEFORE_LINE_M)
    for moved_m in (1.0, 1.0, 1.0):
        view = memory.update(estimate(LightState.RED, 25.0), moved_m)
    assert float(view.light_m) == pytest.approx(6.0 - BEFORE_LINE_M)
    view = memory.update(estimate(LightState.RED, 8.0), 0.0, line_seen=True)
    assert float(view.light_m) == pytest.approx(7.0 - BEFORE_LINE_M)
    for count in range(3):  # the line of the next light, beyond this one
        assert float(view.light_m) == pytest.approx(7.0 - BEFORE_LINE_M), count
        view = memory.update(estimate(LightState.RED, 30.0), 0.0, line_seen=True)
    assert float(view.light_m) == pytest.approx(30.0 - BEFORE_LINE_M)


def test_a_line_that_was_told_by_lamps_alone_is_not_waited_for() -> None:
    memory = LightMemory()
    for _ in range(4):
        assert state(memory.update(estimate(LightState.RED, 5.8), 0.0)) is LightState.RED
    for _ in range(8):
        view = memory.update(estimate(LightState.NONE), 0.0)
    assert state(view) is LightState.NONE  # at 5.8 m the line would be in view
    memory = LightMemory()
    memory.update(estimate(LightState.RED, 9.0), 0.0, line_seen=True)
    for moved_m in (3.0, *[0.0] * 8):
        view = memory.update(estimate(LightState.NONE, 12.0), moved_m, line_seen=True)
    assert state(view) is LightState.NONE  # no line is where one was remembered
    memory.update(estimate(LightState.RED, 9.0), 0.0, line_seen=True)
    for moved_m in (6.0, *[0.0] * 60):
        view = memory.update(estimate(LightState.NONE, 12.0), moved_m)
    assert state(view) is LightState.RED  # it is below the image


@pytest.mark.parametrize(
    ("line_m", "p", "waits"), [(3.0, 0.97, True), (3.0, 0.6, False), (-1.5, 0.97, False)]
)
def test_a_light_hardly_seen_or_far_beyond_its_line_is_waited_for_a_while(
    line_m: float, p: float, waits: bool
) -> None:
    memory = LightMemory()
    memory.update(estimate(LightState.RED, 8.0, p), 0.0, line_seen=True)
    view = memory.update(estimate(LightState.NONE, 12.0), 8.0 - line_m)
    assert state(view) is LightState.RED
    for _ in range(30):
        view = memory.update(estimate(LightState.NONE, 12.0), 0.0)
    assert (state(view) is LightState.RED) == waits


def test_a_light_that_was_seen_far_away_and_vanishes_fades() -> None:
    memory = LightMemory()
    memory.update(estimate(LightState.RED, 30.0, p=0.7), 0.0)
    views = [memory.update(estimate(LightState.NONE), 0.0) for _ in range(6)]
    stops = [float(view.light[0, LightState.RED]) for view in views]
    assert stops[0] > stops[1] > stops[2] > 0.5
    assert state(views[-1]) is LightState.NONE  # who stands would else wait for it


def test_a_line_behind_is_no_new_one_unless_the_drive_begins_there() -> None:
    assert state(LightMemory().update(estimate(LightState.RED, 0.5), 0.0)) is LightState.RED
    memory = LightMemory()
    for line_m in (3.0, 1.0, -1.0, -3.0, -5.0):
        memory.update(estimate(LightState.GREEN, line_m), 2.0)
    for _ in range(3):
        assert state(memory.update(estimate(LightState.RED, -2.5), 0.1)) is LightState.NONE
    assert state(memory.update(estimate(LightState.RED, 12.0), 0.1)) is LightState.RED


def test_a_green_light_that_was_crossed_does_not_turn_red() -> None:
    for before, after in ((LightState.GREEN, LightState.RED), (LightState.RED, LightState.RED)):
        memory = LightMemory()
        memory.update(estimate(before, 2.0), 0.0, line_seen=True)
        for moved_m in (3.0, 0.5, 0.5):
            view = memory.update(estimate(after, -1.0), moved_m)
        assert state(view) is before
    view = memory.update(estimate(LightState.GREEN, -1.0), 0.0)  # who has gone too far waits for green
    assert state(memory.update(estimate(LightState.GREEN, -1.0), 0.0)) is LightState.GREEN


def test_doubt_that_there_is_a_light_does_not_turn_it_green() -> None:
    memory = LightMemory()
    unsure = PathEstimate(
        torch.tensor([[0.45, 0.40, 0.05, 0.10]]), torch.tensor([8.0]), torch.zeros(1, TIMES, CELLS)
    )
    for _ in range(20):
        view = memory.update(unsure, 0.0)
    assert state(view) is LightState.RED  # .45 to .10


def test_readings_without_a_clear_state_keep_no_light_alive() -> None:
    memory = LightMemory()
    memory.update(estimate(LightState.RED, 9.0), 0.0, line_seen=True)
    unclear = PathEstimate(
        torch.tensor([[0.05, 0.36, 0.31, 0.28]]), torch.tensor([30.0]), torch.zeros(1, TIMES, CELLS)
    )
    for moved_m in (4.0, *[0.0] * 10):  # at 5 m the line would be in view
        view = memory.update(unclear, moved_m)
    assert state(view) is LightState.NONE
    for _ in range(5):
        view = memory.update(unclear, 0.0)
    assert state(view) is LightState.NONE


def test_one_wrong_frame_does_not_turn_a_light() -> None:
    memory = LightMemory()
    for _ in range(4):
        memory.update(estimate(LightState.RED, 12.0), 0.0)
    assert state(memory.update(estimate(LightState.GREEN, 12.0, p=0.6), 0.0)) is LightState.RED
    for _ in range(4):
        view = memory.update(estimate(LightState.GREEN, 12.0), 0.0)
    assert state(view) is LightState.GREEN


def test_who_is_close_ahead_is_taken_to_stay_for_a_while() -> None:
    occupied = torch.zeros(2, TIMES, CELLS)
    occupied[1, 0, 1], occupied[1, 1:, 1] = 0.9, 0.2  # expected to leave at once
    occupied[1, 0, NEAR_CELLS] = 0.9  # farther away
    occupied[1, 2, 0] = 0.7  # somebody comes
    expected = occupied.clone()
    expected[1, 1 : 1 + STAYS, 1] = 0.9
    torch.testing.assert_close(staying(occupied), expected)


class Fixed(Driver):
    """A driver that always sees the same."""

    def __init__(self, sight: Sight) -> None:
        super().__init__(CameraEyes(CameraEyesConfig()), SpeedPlanner(SpeedPlannerConfig(hidden=4)))
        self.sight = sight

    def see(self, clip: Clip) -> Sight:
        return self.sight


def sight(light: LightState, p_there: float) -> Sight:
    logits = torch.zeros(1, TIMES, CELLS)
    logits[...] = torch.logit(torch.tensor(p_there))
    light_logits = torch.full((1, 4), -5.0)
    light_logits[0, light] = 5.0
    nothing = sight_of(1, light_logits)
    return dataclasses.replace(
        nothing, lamp_line=torch.full_like(nothing.lamp_line, -1.0), occupied_logits=logits
    )


@pytest.fixture
def standing(make_example: Callable[..., Example]) -> Clip:
    clip = make_example(spec=SPEC, batch=1, past=1, future=0, cameras=2).clip
    still = clip.T_world_ego[:, :1].expand_as(clip.T_world_ego)
    return dataclasses.replace(clip, ego_speed_mps=torch.zeros_like(clip.ego_speed_mps), T_world_ego=still)


@pytest.mark.parametrize(
    ("light", "p_there", "frees"), [("NONE", 0.8, True), ("NONE", 0.97, False), ("RED", 0.8, False)]
)
def test_who_stands_for_long_creeps_unless_it_is_sure(
    light: str, p_there: float, frees: bool, standing: Clip
) -> None:
    perception = Perception(Fixed(sight(LightState[light], p_there)))
    free = [not bool((perception(standing).occupied > 0.5).any()) for _ in range(WAITS + CREEPS)]
    assert not any(free[:WAITS])
    assert all(free[WAITS:]) is frees


def test_a_light_that_never_changes_stops_nobody_for_ever(standing: Clip) -> None:
    perception = Perception(Fixed(sight(LightState.RED, 0.8)))
    lights = [state(perception(standing)) for _ in range(IMPATIENT + 2)]
    assert lights[:IMPATIENT].count(LightState.RED) == IMPATIENT
    assert lights[IMPATIENT:] == [LightState.NONE] * 2


def test_it_waits_at_a_stop_sign_and_goes_on(standing: Clip) -> None:
    logits = torch.full((1, LINE_CELLS + 1), -20.0)
    logits[0, 5] = 5.0  # the line is 5.5 m ahead
    at_sign = dataclasses.replace(sight(LightState.NONE, 0.01), sign_logits=logits)
    driving = dataclasses.replace(standing, ego_speed_mps=torch.full_like(standing.ego_speed_mps, 4.0))
    perception = Perception(Fixed(at_sign))
    assert state(perception(driving)) is LightState.NONE  # one reading may be wrong
    view = perception(driving)
    assert (state(view), float(view.light_m)) == (LightState.RED, pytest.approx(5.5 - BEFORE_LINE_M))
    assert state(perception(standing)) is LightState.NONE
    # A red light before the line of the sign counts first
    nearer = stopped_by_sign(estimate(LightState.RED, 3.0), 9.0)
    assert float(nearer.light_m) == 3.0
    assert float(stopped_by_sign(estimate(LightState.GREEN, 3.0), 9.0).light_m) == 9.0 - BEFORE_LINE_M


def test_parts_of_the_truth_take_the_place_of_what_is_seen(standing: Clip) -> None:
    seen, true = estimate(LightState.RED, 9.0), estimate(LightState.GREEN, 7.0)
    true = dataclasses.replace(true, occupied=torch.ones(1, TIMES, CELLS))
    clip = standing
    for lights, users in ((True, True), (True, False), (False, True)):
        view = PartlyTrue(lambda _: seen, lambda _: true, lights=lights, users=users)(clip)
        assert (state(view) is LightState.GREEN) is lights
        assert float(view.light_m) == (7.0 if lights else 9.0)
        assert bool(view.occupied.any()) is users


def test_the_path_goes_through_the_points_of_the_route(standing: Clip) -> None:
    """The vehicle is a metre beside a route that turns right; it ends after 20 m."""
    clip = standing
    angle = torch.tensor(ROUTE_M) / 30.0
    xy = torch.stack([30 * angle.sin(), 30 * (angle.cos() - 1) - 1.0], -1)
    valid = torch.tensor([True] * 5 + [False] * 2)
    path = given_path(dataclasses.replace(clip, route_xy=xy[None], route_valid=valid[None]))
    assert int(path.valid.sum()) == 21
    for k, along in enumerate(ROUTE_M[:5]):
        torch.testing.assert_close(path.xy[int(along)], xy[k], atol=1e-4, rtol=0)
    assert float(path.xy[0, 1]) == pytest.approx(-1.0, abs=0.2)
    without = given_path(dataclasses.replace(clip, route_valid=torch.zeros(1, 7, dtype=torch.bool)))
    assert not without.xy[:, 1].any()
    assert int(without.valid.sum()) == 41
