"""The lane graph on a crossing built by hand, and on a real town."""

import numpy as np
import pytest

from foredrive.scene import Command
from foredrive.towns.map.town_map import Lane, MarkingKind, StopZone, StopZoneKind, TownMap
from foredrive.towns.traffic.lane_graph import LaneControl, LaneGraph, build_lane_graph, lanes_for
from foredrive.towns.traffic.leaders import find_leaders
from foredrive.towns.traffic.vehicles import BEHIND, WINDOW, Vehicles, empty_slots, path_starts, vehicle_poses


def lane(
    name: str, points: list[tuple[float, float]], to: str, after: str, junction: int | None = None
) -> Lane:
    xyz = np.array([(x, y, 0.1 * x) for x, y in points])
    return Lane(
        lane_id=name,
        group_id=name,
        junction_id=junction,
        centreline_xyz=xyz,
        left_boundary_xyz=xyz + np.array([0.0, 1.75, 0.0]),
        right_boundary_xyz=xyz - np.array([0.0, 1.75, 0.0]),
        speed_limit_mps=10.0,
        successor_ids=tuple(to.split()),
        predecessor_ids=tuple(after.split()),
        left_id=None,
        right_id=None,
        left_marking=MarkingKind.NONE,
        right_marking=MarkingKind.NONE,
    )


def crossing() -> TownMap:
    """West to east over a junction of 20 m, south to north across it, and a left turn from the west.

    Each way through the junction but the turn is in two pieces.
    """
    angle = np.linspace(-np.pi / 2, 0, 41)
    turn = [(10 * np.cos(a) - 10, 10 * np.sin(a) + 10) for a in angle]  # (-10, 0) to (0, 10)
    zone = np.array([[-10.0, -2, 0], [-10, 2, 0], [-9.5, 2, 0], [-10, -2, 0]])
    return TownMap(
        name="crossing",
        lanes=(
            lane("west", [(-60, 0), (-10, 0)], "we_1 turn", "east"),
            lane("we_1", [(-10, 0), (4, 0)], "we_2", "west", 7),
            lane("we_2", [(4, 0), (10, 0)], "east", "we_1", 7),
            lane("east", [(10, 0), (60, 0)], "west", "we_2"),
            lane("south", [(0, -60), (0, -10)], "sn_1", "north"),
            lane("sn_1", [(0, -10), (0, 5)], "sn_2", "south", 7),
            lane("sn_2", [(0, 5), (0, 10)], "north", "sn_1", 7),
            lane("north", [(0, 10), (0, 60)], "south", "sn_2 turn"),
            lane("turn", turn, "north", "west", 7),
        ),
        strips=(),
        crosswalks=(),
        stop_zones=(StopZone(1, StopZoneKind.STOP_SIGN, ("sn_1",), zone, np.zeros(3), 0.0),),
        junctions={},
    )


@pytest.fixture
def graph() -> LaneGraph:
    return build_lane_graph(crossing())


def test_pieces_of_a_way_through_a_junction_become_one_lane(graph: LaneGraph) -> None:
    assert graph.ids == ("west", "we_1", "east", "south", "sn_1", "north", "turn")
    we = graph.ids.index("we_1")
    # Up 0.1 per metre: 20 m seen from above are 20.1 m along the slope.
    assert graph.length_m[we] == pytest.approx(20 * np.hypot(1, 0.1))
    assert graph.successors[we, 0] == graph.ids.index("east")
    assert graph.predecessors[graph.ids.index("east"), 0] == we


def test_positions_by_arc_length_are_on_the_line(graph: LaneGraph) -> None:
    west = graph.ids.index("west")
    half = graph.length_m[west] / 2
    points = graph.position(np.array([west, west]), np.array([half, 1e9]))
    np.testing.assert_allclose(points, [[-35, 0, -3.5], [-10, 0, -1]], atol=1e-9)


def test_commands_and_guards(graph: LaneGraph) -> None:
    index = {name: i for i, name in enumerate(graph.ids)}
    assert graph.command(index["turn"]) is Command.LEFT
    assert graph.command(index["we_1"]) is Command.STRAIGHT
    assert graph.control[index["sn_1"]] == LaneControl.STOP
    assert (np.delete(graph.control, index["sn_1"]) == LaneControl.NONE).all()


def test_a_curve_is_driven_at_its_comfortable_speed(graph: LaneGraph) -> None:
    turn = graph.ids.index("turn")
    middle = graph.speed(np.array([turn]), np.array([graph.length_m[turn] / 2]))[0]
    assert middle == pytest.approx(np.sqrt(2.0 * 10.0), rel=0.05)  # v² = 2 m/s² · 10 m
    west = graph.ids.index("west")
    assert graph.speed(np.array([west]), np.array([10.0]))[0] == pytest.approx(10.0)


def test_where_lanes_cross_merge_and_part(graph: LaneGraph) -> None:
    index = {name: i for i, name in enumerate(graph.ids)}

    def rows(meetings: object, of: str) -> dict[str, tuple[float, float, float]]:
        first, other = meetings.first, meetings.other  # type: ignore[attr-defined]
        of_lane = range(first[index[of]], first[index[of] + 1])
        columns = meetings.enter_m, meetings.other_enter_m, meetings.other_clear_m  # type: ignore[attr-defined]
        return {graph.ids[other[m]]: tuple(float(c[m]) for c in columns) for m in of_lane}

    crossed = rows(graph.conflicts, "we_1")
    assert set(crossed) == {"sn_1"}
    # In the way from 3.4 m before the middle to 3.4 m behind it, up to the sample spacing.
    np.testing.assert_allclose(crossed["sn_1"], [10 - 3.4, 10 - 3.4, 10 + 3.4], atol=0.8)
    merging = rows(graph.conflicts, "turn")
    assert set(merging) == {"sn_1"}
    assert merging["sn_1"][2] == np.inf  # to the end of the lane
    parting = rows(graph.siblings, "we_1")
    assert set(parting) == {"turn"}
    assert 5 < parting["turn"][2] < 10
    contested = {graph.ids[i] for i in np.flatnonzero(graph.contested)}
    assert contested == {"we_1", "sn_1", "turn"}


def test_lanes_for_long_vehicles_never_lead_into_a_tight_curve(graph: LaneGraph) -> None:
    roomy = {graph.ids[i] for i in np.flatnonzero(lanes_for(graph, 12.0))}
    assert roomy == {"west", "we_1", "east", "south", "sn_1", "north"}


def on_lanes(graph: LaneGraph, where: list[tuple[list[str], float]]) -> Vehicles:
    """Cars of 4 m on given paths (behind, current, ahead …) at an arc length of their second lane."""
    slots = empty_slots(len(where))
    path = np.full((len(where), WINDOW), -1)
    for row, (names, _) in enumerate(where):
        columns = slice(BEHIND - 1, BEHIND - 1 + len(names))
        path[row, columns] = [graph.ids.index(name) for name in names]
    changed = {
        "active": np.ones(len(where), dtype=bool),
        "path": path,
        "s_m": np.array([s for _, s in where]),
        "size_lwh": np.tile([4.0, 1.8, 1.5], (len(where), 1)),
        "wheelbase_m": np.full(len(where), 2.4),
        "axle_to_centre_m": np.full(len(where), 1.2),
    }
    return Vehicles(**{**vars(slots), **changed})


def test_the_leader_is_found_over_the_end_of_a_lane(graph: LaneGraph) -> None:
    length = graph.length_m[graph.ids.index("west")]
    cars = on_lanes(graph, [(["east", "west", "we_1", "east"], length - 6), (["west", "we_1", "east"], 8.0)])
    leader, gap, *_ = find_leaders(graph, cars, path_starts(graph, cars.path))
    assert leader.tolist() == [1, -1]
    assert gap[0] == pytest.approx(6 + 8 - 4)
    assert gap[1] == np.inf


@pytest.mark.parametrize(("s_m", "leads"), [(1.0, True), (6.0, True), (12.0, False)])
def test_a_car_that_turns_off_leads_until_it_is_clear(graph: LaneGraph, s_m: float, leads: bool) -> None:
    length = graph.length_m[graph.ids.index("west")]
    cars = on_lanes(
        graph, [(["east", "west", "we_1", "east"], length - 10), (["west", "turn", "north"], s_m)]
    )
    leader, *_ = find_leaders(graph, cars, path_starts(graph, cars.path))
    assert (leader[0] == 1) == leads


def test_both_axles_are_on_the_path(graph: LaneGraph) -> None:
    cars = on_lanes(graph, [(["west", "we_1", "east"], 0.5)])
    poses = vehicle_poses(graph, cars)
    slope = np.array([1, 0, 0.1]) / np.hypot(1, 0.1)
    np.testing.assert_allclose(poses.forward[0], slope, atol=1e-9)
    start = np.array([-10, 0, -1.0])
    np.testing.assert_allclose(poses.axle_xyz[0], start + (0.5 - 1.2) * slope, atol=1e-9)
    up = np.array([-slope[2], 0, slope[0]])
    np.testing.assert_allclose(poses.centre_m[0], start + 0.5 * slope + 0.75 * up, atol=1e-9)
    assert poses.pitch[0] == pytest.approx(-np.arctan(0.1))  # uphill is nose up


def test_a_real_town_has_no_dead_ends_and_joins_smoothly(town02: TownMap) -> None:
    graph = build_lane_graph(town02)
    assert (graph.successor_count > 0).all()
    for lane_index in range(len(graph.ids)):
        end = graph.samples(lane_index)[-1]
        for following in graph.successors[lane_index, : graph.successor_count[lane_index]].tolist():
            assert np.linalg.norm(graph.samples(following)[0] - end) < 0.1
    # Eight junctions with three arms: each offers two ways from each arm.
    assert graph.contested.sum() == 8 * 6
    commands = [graph.command(i) for i in np.flatnonzero(graph.junction >= 0).tolist()]
    assert [commands.count(c) for c in Command] == [16, 16, 16]
