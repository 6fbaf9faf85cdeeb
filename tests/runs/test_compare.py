"""Agents side by side: paired differences by hand, drives that are missing, names from outside."""

import json
from pathlib import Path

import numpy as np
import pytest
from html_pages import EVIL, assert_harmless

from foredrive.cli.main import main
from foredrive.driving.replay.threats import Threat
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.runs.drive.agents import absolute_name
from foredrive.runs.drive.baselines import same_drives
from foredrive.runs.drive.compare import compare, figures_of, read_agent, read_agents
from foredrive.runs.drive.in_reconstruction import ReconstructedRoutes
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.records import suite_title
from foredrive.runs.drive.suite import DriveSource, DriveSuite
from foredrive.view.compare_report import means_table, ranking_table, routes_table

Given = dict[tuple[str, int], tuple[float, list[str], str]]
"""By route and repetition: completion, kinds of infractions, ending."""


def suite(folder: Path, drives: Given, *, town: str | None = None, **settings: object) -> Path:
    (folder / "drives").mkdir(parents=True)
    (folder / "suite.json").write_text(json.dumps({"agent": folder.name, "routes": "r.xml", **settings}))
    factors = {"red_light": 0.7, "collision_vehicle": 0.6}
    for (route, repetition), (completion, kinds, ending) in drives.items():
        score = 100 * completion
        for kind in kinds:
            score *= factors[kind]
        record = {
            "town": town,
            "length_m": 10.0,
            "score": {
                "route": route,
                "repetition": repetition,
                "completion": completion,
                "outside_lanes": 0.0,
                "ending": ending,
                "infractions": [{"kind": kind, "t_s": 1.0, "xy_world": [0.0, 0.0]} for kind in kinds],
                "driven_m": 10.0 * completion,
                "duration_s": 2.0,
            },
            "driving_score_1_0": score,
            "driving_score_2_1": score,
            "error": "",
            "events": [],
            "comfort": None,
            "nearest_s": [],
            "act_s": [],
            "route_xy": [],
            "track": {"t_s": [], "xy": [], "yaw_rad": [], "speed_mps": []},
            "wall_s": 1.0,
            "log": "logs/one",
        }
        (folder / "drives" / f"{abs(hash(route))}_{repetition}.json").write_text(json.dumps(record))
    return folder


DONE = "completed"
BLIND: Given = {
    ("1", 0): (1.0, ["red_light"], DONE),
    ("2", 0): (1.0, [], DONE),
    ("10", 0): (0.5, ["collision_vehicle"], "blocked"),
    ("10", 1): (1.0, [], DONE),
}
SEEING: Given = {
    ("1", 0): (1.0, [], DONE),
    ("2", 0): (1.0, [], DONE),
    ("10", 0): (1.0, [], DONE),
    ("11", 0): (1.0, [], DONE),
}


def test_a_failed_drive_is_no_bad_drive(tmp_path: Path) -> None:
    """The agent broke on route 2 and would be ranked last by it; the drive is left out and counted."""
    breaks: Given = {**SEEING, ("2", 0): (0.0, [], "crashed"), ("12", 0): (0.1, [], "crashed")}
    agents = [read_agent(str(suite(tmp_path / name, of))) for name, of in (("b", BLIND), ("s", breaks))]
    compared = compare(agents, resamples=500)
    assert [route for route, *_ in compared.keys] == ["1", "10"]
    assert compared.differences["driving_score_1_0"]["s"].mean == pytest.approx((30 + 70) / 2)
    figures = figures_of(compared)
    assert (figures["b.failed"], figures["s.failed"]) == (0, 2)
    assert (figures["s.rank"], figures["b.rank"]) == (1.0, 2.0)
    assert compared.rated_routes == ("1", "2", "10", "11")
    with pytest.raises(InputError, match=r"in common \(failed drives: all 1\)"):
        compare([agents[0], read_agent(str(suite(tmp_path / "all", {("1", 0): (0.5, [], "crashed")})))])


def test_routes_of_one_number_in_other_sets_are_others(tmp_path: Path) -> None:
    """Town05 short and long both have routes 16 to 20; the ten short ones are of the 32."""
    ids: Given = {(route, 0): (0.1 * int(route) - 1, [], DONE) for route in ("16", "17")}
    long = suite(tmp_path / "long", ids, town="Town05", routes="town05-long")
    short = suite(tmp_path / "short", ids, town="Town05", routes="town05-short")
    ten = suite(tmp_path / "ten", ids, town="Town05", routes="town05-short-10")
    moved = suite(tmp_path / "moved", ids, town="Town05", routes="a/r.xml", routes_sha256="0" * 64)
    for other in (long, moved):
        with pytest.raises(InputError, match="no route and repetition in common"):
            compare(read_agents([str(short), str(other)]))
    assert [route for route, *_ in compare(read_agents([str(short), str(ten)])).keys] == ["16", "17"]
    both = compare([read_agent(f"a={short},{long}"), read_agent(f"b={ten},{long}")])
    assert [route for route, *_ in both.keys] == [
        "16 (Town05, town05-long)",
        "16 (Town05, town05-short)",
        "17 (Town05, town05-long)",
        "17 (Town05, town05-short)",
    ]
    assert len(both.rated_routes) == 4


def test_trainings_that_differ_are_part_of_the_interval(tmp_path: Path) -> None:
    """Two trainings of equal agents on twelve routes; then one training of the second is far better."""
    rng, widths = np.random.default_rng(0), []
    for offset in (0.0, 0.3):
        folders: dict[str, list[str]] = {}
        for name, shift in (("a0", 0.0), ("a1", 0.0), ("b0", 0.0), ("b1", offset)):
            driven = 0.4 + shift + 0.02 * rng.normal(size=12)
            drives: Given = {(str(k), 0): (float(value), [], DONE) for k, value in enumerate(driven)}
            path = suite(tmp_path / f"{offset}{name}", drives)
            folders.setdefault(name[0], []).append(str(path))
        agents = [read_agent(f"{name}={','.join(of)}") for name, of in folders.items()]
        found = compare(agents).differences["driving_score_1_0"]["b"]
        assert found.mean == pytest.approx(50 * offset, abs=1.0)
        assert found.low < found.mean < found.high
        widths.append(found.high - found.low)
    assert widths[0] < 10
    assert widths[1] > 60  # two trainings 30 points apart, with one degree of freedom


@pytest.mark.parametrize(
    "source",
    [
        TownRoutes("town05-short", 2, 7, "night", vehicles=3, people=1, only=("4", "9"), scenarios=False),
        ReconstructedRoutes("runs/a", (1.0, 2.5), (Threat.FRONTAL, Threat.SIDE), "edits.yaml", True),
        ReconstructedRoutes("runs/a"),
    ],
)
def test_baselines_have_the_same_drives(
    source: DriveSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "edits.yaml").write_text("[]")
    suite = DriveSuite("embedded", source, period_s=1.0, latency_s=0.2)
    (tmp_path / "suite.json").write_text(json.dumps(suite.noted()))
    baseline = same_drives(tmp_path, "stop")
    assert baseline.source == source
    assert (baseline.agent, baseline.sensors, baseline.period_s, baseline.latency_s) == (
        "stop",
        False,
        1.0,
        0.2,
    )
    (tmp_path / "suite.json").write_text(
        json.dumps(suite.noted() | {"server": "localhost:2000", "run": None})
    )
    if isinstance(source, TownRoutes):
        with pytest.raises(InputError, match="baselines drive in towns and reconstructed logs alone"):
            same_drives(tmp_path, "stop")


def test_differences_by_hand(tmp_path: Path) -> None:
    """Three drives are common: 70, 100 and 30 against 100 each."""
    agents = [read_agent(str(suite(tmp_path / name, given))) for name, given in (("b", BLIND), ("s", SEEING))]
    found = compare(agents, resamples=500)
    assert [route for route, *_ in found.keys] == ["1", "2", "10"]
    assert found.left_out == 2
    score = found.differences["driving_score_1_0"]["s"]
    assert score.mean == pytest.approx((30 + 0 + 70) / 3)
    assert np.isnan([score.low, score.high]).all()  # of three routes
    assert found.differences["red_lights"]["s"].mean == pytest.approx(-1 / 3)
    assert found.differences["collisions"]["s"].mean == pytest.approx(-1 / 3)
    assert found.differences["speed_mps"]["s"].mean == pytest.approx((5 - 2.5) / 3)
    assert [row.route for row in found.routes] == ["10", "1", "2"]
    assert found.routes[0].happened == ("collision vehicle, blocked", "")
    assert figures_of(found)["b.completion"] == pytest.approx(250 / 3)
    assert found.unlike == ()
    assert "s" in str(means_table(found).columns)
    assert len(routes_table(found, 2).sections[0].rows) == 2


@pytest.mark.parametrize("routes", [9, 10])
def test_fewer_than_ten_routes_have_no_intervals(routes: int, tmp_path: Path) -> None:
    """One agent drives the whole of every route, the other half of every second one."""
    whole: Given = {(str(k), 0): (1.0, [], DONE) for k in range(routes)}
    half: Given = {(str(k), 0): (0.5 + 0.5 * (k % 2), [], "blocked") for k in range(routes)}
    compared = compare([read_agent(str(suite(tmp_path / n, d))) for n, d in (("h", half), ("w", whole))])
    figures, score = figures_of(compared), compared.differences["completion"]["w"]
    means, ranking = means_table(compared), ranking_table(compared)
    cells = [str(cell) for table in (means, ranking) for row in table.sections[0].rows for cell in row.cells]
    notes = [" ".join(table.notes) for table in (means, ranking)]
    if routes < 10:
        assert np.isnan([score.low, score.high]).all()
        assert figures["w.completion.difference.low"] is None
        assert figures["w.ability.low"] is figures["w.rank.high"] is None
        assert not any("[" in cell for cell in cells)
        assert all("fewer than 10 routes there are no intervals" in note for note in notes)
    else:
        assert 0 < score.low < score.mean < score.high <= 50
        assert figures["w.ability.low"] < figures["w.ability"]
        assert any("[" in cell for cell in cells)
        assert all("Intervals of 95 %" in note for note in notes)


def test_repetitions_of_a_route_are_drawn_together(tmp_path: Path) -> None:
    """With one route there is nothing to draw from, however many repetitions there are."""
    one = {("1", k): (1.0, [], DONE) for k in range(5)}
    other = {("1", k): (0.5, [], DONE) for k in range(5)}
    found = compare([read_agent(str(suite(tmp_path / n, d))) for n, d in (("a", one), ("b", other))])
    assert found.differences["completion"]["b"].mean == -50
    assert found.differences["completion"]["b"].low != found.differences["completion"]["b"].low


@pytest.mark.parametrize(
    ("folders", "names"),
    [
        (["runs/blind/short", "runs/seeing/short"], ["blind", "seeing"]),
        (["runs/blind", "runs/seeing"], ["blind", "seeing"]),
        (["a/x/short", "b/x/short", "b/x/long"], ["a/x/short", "b/x/short", "long"]),
        (["a/short", "b/short", "other"], ["a/short", "b/short", "other"]),
        (["a/short", "mine=b/short", "b/long"], ["short", "mine", "long"]),
        (["a/short", "a/short/more"], ["short", "more"]),
        (["a/short,b/short", "c/short,d/short"], ["a", "c"]),
    ],
)
def test_agents_are_named_by_what_tells_their_folders_apart(
    folders: list[str], names: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in {part for given in folders for part in given.rpartition("=")[2].split(",")}:
        suite(Path(folder), SEEING)
    agents = read_agents(folders)
    assert [agent.name for agent in agents] == names
    assert [agent.name for agent in compare(agents, resamples=10).agents] == names


def test_titles_have_the_agent_as_it_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for given, title in (
        (absolute_name("expert"), "expert"),
        ("idm:runs/driver", "idm:runs/driver"),
        (str(tmp_path / "runs" / "driver"), "runs/driver"),
        (f"python:{tmp_path}/own.py:Planner", "python:own.py:Planner"),
        ("/elsewhere/runs/driver", "driver"),
    ):
        (tmp_path / "suite.json").write_text(json.dumps({"agent": given, "routes": "/x/short.xml"}))
        assert suite_title(tmp_path) == f"{title} on short"


def test_suites_of_several_seeds_are_one_agent(tmp_path: Path) -> None:
    folders = [suite(tmp_path / f"{n}{k}", d) for n, d in (("b", BLIND), ("s", SEEING)) for k in (0, 1)]
    blind = read_agent(f"blind={folders[0]},{folders[1]}")
    found = compare([blind, read_agent(f"seeing={folders[2]},{folders[3]}")], resamples=100)
    assert len(found.keys) == 6
    assert len(found.routes) == 3
    assert found.differences["driving_score_1_0"]["seeing"].mean == pytest.approx(100 / 3)


def test_the_report_says_what_its_intervals_are_over(tmp_path: Path) -> None:
    """Intervals are over routes; a second training of one agent counts in its ability alone."""
    ten: Given = {(str(k), 0): (0.1 * k, [], DONE) for k in range(10)}
    one, two, other = (str(suite(tmp_path / name, ten)) for name in ("one", "two", "other"))
    single = compare([read_agent(one), read_agent(other)], resamples=10)
    mixed = compare([read_agent(f"a={one},{two}"), read_agent(other)], resamples=10)
    both = compare([read_agent(f"a={one},{two}"), read_agent(f"b={other},{two}")], resamples=10)
    for found, differences, ratings in (
        (single, "routes,", "routes."),
        (mixed, "routes,", "routes and trainings."),
        (both, "routes and trainings,", "routes and trainings."),
    ):
        assert f"Intervals of 95 % over {differences}" in " ".join(means_table(found).notes)
        assert f"Intervals of 95 % over {ratings}" in " ".join(ranking_table(found).notes)


def test_the_file_of_a_suite_is_read_once(tmp_path: Path) -> None:
    folders = [suite(tmp_path / name, SEEING, seed=seed) for seed, name in enumerate(("a", "b"))]
    agents = [read_agent(str(folder)) for folder in folders]
    for folder in folders:
        (folder / "suite.json").unlink()
    assert compare(agents, resamples=10).unlike == ("seed (0 or 1)",)


def test_other_traffic_is_told(tmp_path: Path) -> None:
    one = suite(tmp_path / "day", SEEING, seed=0, conditions=None)
    other = suite(tmp_path / "night", SEEING, seed=1, conditions="night")
    found = compare([read_agent(str(one)), read_agent(str(other))], resamples=10)
    assert found.unlike == ("seed (0 or 1)", "conditions (None or night)")
    assert "did not meet the same traffic" in " ".join(means_table(found).notes)


def test_the_verb_writes_a_page_of_harmless_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evil = {(EVIL, 0): (1.0, ["red_light"], DONE), ("2", 0): (1.0, [], DONE)}
    fine = {(EVIL, 0): (1.0, [], DONE), ("2", 0): (1.0, [], DONE)}
    given = [str(suite(tmp_path / "a", evil)), f"other={suite(tmp_path / 'b', fine)}"]
    assert main(["compare", *given, "--out", str(tmp_path / "out")]) == 0
    assert "+15.0" in capsys.readouterr().out
    assert read_summary(tmp_path / "out" / "summary.json")["other.red_lights.difference.mean"] == -0.5
    assert_harmless((tmp_path / "out" / "report.html").read_text(), times=3)


def test_what_cannot_be_compared_is_one_line(tmp_path: Path) -> None:
    one = read_agent(str(suite(tmp_path / "one", BLIND)))
    with pytest.raises(InputError, match="at least two folders"):
        compare([one])
    for same in ([one, one], read_agents([str(tmp_path / "one")] * 2)):
        with pytest.raises(InputError, match="the same name"):
            compare(same)
    with pytest.raises(InputError, match="no drives to compare"):
        read_agent(str(tmp_path))
    other = read_agent(str(suite(tmp_path / "far", {("99", 0): (1.0, [], DONE)})))
    with pytest.raises(InputError, match="no route and repetition in common"):
        compare([one, other])
