"""Lane changes: MOBIL on cases worked out by hand, and the way over on a road of two lanes."""

import dataclasses

import numpy as np
import pytest

from foredrive.towns.map.town_map import Lane, MarkingKind, TownMap
from foredrive.towns.traffic.drivers import DrivingContext
from foredrive.towns.traffic.lane_changes import (
    COURTEOUS_MPS2,
    LEFT,
    MANDATORY_MPS2,
    POLITENESS,
    RIGHT,
    LaneGaps,
    begin_change,
    choose_change,
    courtesy_limits,
    find_change_ranges,
    find_gaps,
    incentive,
    lane_change_allowed,
)
from foredrive.towns.traffic.lane_graph import LaneGraph, build_lane_graph
from foredrive.towns.traffic.leaders import Leaders, find_leaders
from foredrive.towns.traffic.vehicles import BEHIND, WINDOW, Vehicles, empty_slots, path_starts, vehicle_poses

INNER_M, LANE_M = 200.0, 3.5


def ring(line: MarkingKind = MarkingKind.BROKEN) -> TownMap:
    """Two lanes round a circle, anticlockwise, each in two halves; the left lane is the inner one."""

    def lane(name: str, radius: float, half: int, beside: tuple[str | None, str | None]) -> Lane:
        angle = np.pi * half + np.linspace(0, np.pi, 700)
        round_it = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        other = f"{name[:-1]}{1 - half}"
        return Lane(
            lane_id=name,
            group_id=str(half),
            junction_id=None,
            centreline_xyz=radius * round_it,
            left_boundary_xyz=(radius - LANE_M / 2) * round_it,
            right_boundary_xyz=(radius + LANE_M / 2) * round_it,
            speed_limit_mps=13.0,
            successor_ids=(other,),
            predecessor_ids=(other,),
            left_id=beside[0],
            right_id=beside[1],
            left_marking=line if beside[0] else MarkingKind.SOLID,
            right_marking=line if beside[1] else MarkingKind.SOLID,
        )

    lanes = [lane(f"inner{half}", INNER_M, half, (None, f"outer{half}")) for half in (0, 1)]
    lanes += [lane(f"outer{half}", INNER_M + LANE_M, half, (f"inner{half}", None)) for half in (0, 1)]
    return TownMap("ring", tuple(lanes), (), (), (), {})


@pytest.fixture(scope="module")
def graph() -> LaneGraph:
    return build_lane_graph(ring())


def cars(graph: LaneGraph, where: list[tuple[str, float, float]]) -> Vehicles:
    """Cars of 4 m on lanes, at angles (degrees), with speeds."""
    count = len(where)
    path = np.full((count, WINDOW), -1)
    s = np.zeros(count)
    for row, (name, degrees, _) in enumerate(where):
        lane = graph.ids.index(name)
        for column in range(WINDOW):
            ahead = (column - BEHIND) % 2
            path[row, column] = lane if not ahead else graph.successors[lane, 0]
        s[row] = graph.length_m[lane] * (degrees % 180) / 180
    values = {
        "active": np.ones(count, dtype=bool),
        "path": path,
        "s_m": s,
        "speed_mps": np.array([speed for _, _, speed in where]),
        "size_lwh": np.tile([4.0, 1.8, 1.5], (count, 1)),
        "wheelbase_m": np.full(count, 2.4),
        "axle_to_centre_m": np.full(count, 1.2),
        "time_gap_s": np.full(count, 1.5),
        "decel_mps2": np.full(count, 2.0),
        "top_speed_mps": np.full(count, 40.0),
    }
    return Vehicles(**{**vars(empty_slots(count)), **values})


def seen(graph: LaneGraph, vehicles: Vehicles, free: list[float]) -> DrivingContext:
    ahead = find_leaders(graph, vehicles, path_starts(graph, vehicles.path))
    return DrivingContext(np.array(free), ahead, np.full(len(free), np.inf))


def following(leader: list[int], gap_m: list[float], free: list[float]) -> DrivingContext:
    ahead = Leaders(*2 * (np.array(leader), np.array(gap_m)))
    return DrivingContext(np.array(free), ahead, np.full(len(free), np.inf))


def gaps(
    vehicles: Vehicles, leader: list[int], ahead: list[float], behind: list[int], b: list[float]
) -> LaneGaps:
    return LaneGaps(np.array(leader), np.array(ahead), np.array(behind), np.array(b))


def test_the_incentive_is_mobils_formula(graph: LaneGraph) -> None:
    # 0 follows 1 at the desired gap 2 + 8 · 1.5 = 14 m: a = 0. On the empty left lane it would have a = 1.
    # 2 would follow there with z = 14 / 10: a (1 - z²) = -0.96 instead of 1.
    v = cars(graph, [("outer0", 40, 8.0), ("outer0", 60, 8.0), ("inner0", 30, 8.0)])
    now = following([1, -1, -1], [14.0, np.inf, np.inf], [1.0] * 3)
    found = incentive(
        v, now, gaps(v, [-1] * 3, [np.inf] * 3, [2, -1, -1], [10.0, np.inf, np.inf]), np.ones(3)
    )
    assert found[0] == pytest.approx(1.0 - 0.0 + POLITENESS * ((1 - 1.4**2) - 1.0))


def test_those_behind_in_the_old_lane_gain(graph: LaneGraph) -> None:
    # 1 follows 0 at its desired gap and would have an open road: 1 m/s² more. 0 itself gains nothing.
    v = cars(graph, [("outer0", 60, 8.0), ("outer0", 40, 8.0)])
    now = following([-1, 0], [np.inf, 14.0], [1.0] * 2)
    nobody = gaps(v, [-1, -1], [np.inf] * 2, [-1, -1], [np.inf] * 2)
    assert incentive(v, now, nobody, np.ones(2))[0] == pytest.approx(POLITENESS * 1.0)


@pytest.mark.parametrize(
    ("gap_m", "closing_mps", "safe"), [(30.0, 0.0, True), (7.0, 0.0, True), (20.0, 6.0, False)]
)
def test_nobody_is_made_to_brake_hard(graph: LaneGraph, gap_m: float, closing_mps: float, safe: bool) -> None:
    # Equal speeds at 7 m: 1 - (14 / 7)² = -3, just allowed. Closing in with 6 m/s at 14 m/s over 20 m:
    # s* = 2 + 21 + 14 · 6 / (2 √2) = 52.7 m, a = 1 - 6.9.
    v = cars(graph, [("outer0", 40, 8.0), ("inner0", 30, 8.0 + closing_mps)])
    now = following([-1] * 2, [np.inf] * 2, [0.5] * 2)
    wanted = gaps(v, [-1, -1], [np.inf] * 2, [1, -1], [gap_m + 1e-6, np.inf])
    assert np.isfinite(incentive(v, now, wanted, np.full(2, 0.5))[0]) == safe


def test_nobody_squeezes_in(graph: LaneGraph) -> None:
    v = cars(graph, [("outer0", 40, 0.0), ("inner0", 42, 0.0)])
    now = following([-1] * 2, [np.inf] * 2, [1.0] * 2)
    target = np.array([graph.ids.index("inner0"), -1])
    found = find_gaps(graph, v, path_starts(graph, v.path), target, LEFT)
    assert found.leader[0] == 1
    assert found.leader_gap_m[0] == pytest.approx(
        INNER_M * np.deg2rad(2) - 4, abs=0.05
    )  # abreast, on a curve
    narrow = found._replace(leader_gap_m=np.array([1.9, np.inf]))
    assert incentive(v, now, narrow, np.ones(2))[0] == -np.inf


def test_who_is_ahead_and_behind_is_found_over_the_ends_of_lanes(graph: LaneGraph) -> None:
    v = cars(graph, [("outer0", 178, 8.0), ("inner1", 184, 8.0), ("inner0", 170, 8.0), ("inner0", 160, 8.0)])
    target = np.array([graph.ids.index("inner0"), -1, -1, -1])
    found = find_gaps(graph, v, path_starts(graph, v.path), target, LEFT)
    assert (found.leader[0], found.follower[0]) == (1, 2)
    assert found.leader_gap_m[0] == pytest.approx(INNER_M * np.deg2rad(6) - 4, abs=0.1)
    assert found.follower_gap_m[0] == pytest.approx(INNER_M * np.deg2rad(8) - 4, abs=0.1)


def test_nobody_abreast_is_overlooked_in_a_curve(graph: LaneGraph) -> None:
    """One that leaves a lane is on it still: wherever it is, it is ahead or behind, and too near."""
    target = np.array([-1, graph.ids.index("outer0")])
    for ahead_deg in np.linspace(-0.05, 0.05, 51):
        v = begin_change(graph, cars(graph, [("outer0", 90, 8.0), ("inner0", 90 + ahead_deg, 8.0)]), 0, LEFT)
        found = find_gaps(graph, v, path_starts(graph, v.path), target, RIGHT)
        assert min(found.leader_gap_m[1], found.follower_gap_m[1]) < 0, ahead_deg


def test_who_has_to_change_is_let_in(graph: LaneGraph) -> None:
    # 1 m more than behind somebody in its lane: s* = 2 + 8 · 1.5 = 14 m, z = 14 / (15 - 1).
    target = np.array([graph.ids.index("outer0"), -1, -1])
    for gap_m, limit_mps2 in ((15.0, 0.0), (4.0, -COURTEOUS_MPS2), (1.5, np.inf)):
        behind_deg = np.rad2deg((gap_m + 4.0) / (INNER_M + LANE_M))
        v = cars(graph, [("inner0", 90, 8.0), ("outer0", 90 - behind_deg, 8.0), ("outer0", 40, 8.0)])
        starts_m = path_starts(graph, v.path)
        limit = courtesy_limits(graph, v, starts_m, seen(graph, v, [1.0] * 3), target, RIGHT)
        assert limit[1] == pytest.approx(limit_mps2, abs=0.02)
        assert limit[0] == limit[2] == np.inf


def chosen(graph: LaneGraph, v: Vehicles, bonus: np.ndarray | None = None) -> tuple[int, int] | None:
    change_ranges, count = find_change_ranges(graph), len(v.active)
    bonus = np.zeros((2, count)) if bonus is None else bonus
    may = lane_change_allowed(graph, change_ranges, v, np.ones((count, 4), dtype=bool), bonus > 0)
    return choose_change(graph, change_ranges, v, seen(graph, v, [1.0] * count), may, bonus)


def test_a_slow_leader_is_passed_and_a_fast_one_is_not(graph: LaneGraph) -> None:
    assert chosen(graph, cars(graph, [("outer0", 40, 8.0), ("outer0", 52, 3.0)])) == (0, LEFT)
    assert chosen(graph, cars(graph, [("outer0", 40, 8.0), ("outer0", 100, 12.0)])) is None


def test_who_has_to_changes_without_a_gain_unless_it_is_unsafe(graph: LaneGraph) -> None:
    bonus = np.array([[0.0, 0.0], [MANDATORY_MPS2, 0.0]])
    assert chosen(graph, cars(graph, [("inner0", 40, 8.0), ("outer0", 120, 8.0)]), bonus) == (0, RIGHT)
    assert chosen(graph, cars(graph, [("inner0", 40, 8.0), ("outer0", 40, 8.0)]), bonus) is None


def test_solid_lines_are_not_crossed() -> None:
    graph = build_lane_graph(ring(MarkingKind.SOLID))
    assert chosen(graph, cars(graph, [("outer0", 40, 8.0), ("outer0", 52, 3.0)])) is None
    one_way = build_lane_graph(ring(MarkingKind.BROKEN_SOLID))  # broken on the own side, whichever that is
    assert one_way.may_cross.any()


def test_the_way_over_is_smooth_and_keeps_to_the_road(graph: LaneGraph) -> None:
    v = cars(graph, [("outer0", 60, 10.0)])
    states = [v, begin_change(graph, v, 0, LEFT)]
    for _ in range(450):
        states.append(states[-1].moved(np.array([0.1])))
    poses = [vehicle_poses(graph, state) for state in states]
    axle = np.array([p.axle_xyz[0] for p in poses])
    radius = np.hypot(axle[:, 0], axle[:, 1])
    assert np.linalg.norm(axle[1] - axle[0]) < 0.02  # taking the other path moves nothing
    assert np.abs(poses[1].forward[0] - poses[0].forward[0]).max() < 2e-3
    assert radius[0] == pytest.approx(INNER_M + LANE_M, abs=0.02)
    assert radius[-1] == pytest.approx(INNER_M, abs=0.02)
    assert np.diff(radius).max() < 2e-3  # straight over, without swinging out
    yaw = np.unwrap([p.yaw[0] for p in poses])
    along = np.degrees(yaw - np.unwrap(np.arctan2(axle[:, 1], axle[:, 0])) - np.pi / 2)
    assert 8.0 < along.max() < 12.0  # 1.875 · 3.5 m / 35 m = 10.6° at the steepest
    assert np.abs(np.diff(yaw[2:], 2)).max() < 1e-3
    step = np.diff(axle[2:], axis=0)
    slip = step[:, 0] * np.sin(yaw[2:-1]) - step[:, 1] * np.cos(yaw[2:-1])
    assert np.abs(slip).max() < 0.1 * 0.09  # the rear axle follows its wheels, but for some degrees


def test_both_lanes_are_taken_during_a_change(graph: LaneGraph) -> None:
    before = cars(graph, [("outer0", 60, 10.0), ("outer0", 50, 10.0), ("inner0", 50, 10.0)])

    def leaders(v: Vehicles) -> list[int]:
        return find_leaders(graph, v, path_starts(graph, v.path))[0].tolist()

    assert leaders(before) == [-1, 0, -1]
    v = begin_change(graph, before, 0, LEFT)
    assert leaders(v) == [-1, 0, 0]
    gap = find_leaders(graph, v, path_starts(graph, v.path))[1]
    assert gap[1] == pytest.approx((INNER_M + LANE_M) * np.deg2rad(10) - 4, abs=0.05)
    assert gap[2] == pytest.approx(INNER_M * np.deg2rad(10) - 4, abs=0.05)
    halfway = dataclasses.replace(v, changed_m=0.5 * v.change_length_m)
    assert leaders(halfway) == [-1, 0, 0]
    over = dataclasses.replace(v, changed_m=0.7 * v.change_length_m)
    assert leaders(over) == [-1, -1, 0]


def test_a_change_that_stands_still_stays_where_it_is(graph: LaneGraph) -> None:
    v = begin_change(graph, cars(graph, [("outer0", 60, 10.0)]), 0, LEFT).moved(np.array([15.0]))
    still = v.moved(np.array([0.0]))
    np.testing.assert_array_equal(vehicle_poses(graph, v).centre_m, vehicle_poses(graph, still).centre_m)
