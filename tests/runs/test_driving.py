"""Suites of drives: kept as they end, never driven twice, never mixed up."""

import dataclasses
import json
import shutil
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
import torch

from foredrive.cli.main import main
from foredrive.data.clips import ClipConfig, ClipDataset
from foredrive.data.log_paths import LogPath, find_logs
from foredrive.errors import InputError
from foredrive.evaluation import read_summary
from foredrive.runs.drive.agents import needs_of
from foredrive.runs.drive.records import read_drive, score_of
from foredrive.runs.drive.suite import (
    DriveJob,
    Driven,
    DriveSuite,
    claim,
    drive_suite,
    scenario_of,
)
from foredrive.scene import VoxelSpec
from foredrive.simulation.route_sets import RouteWaypoints
from foredrive.simulation.routes import snap_route
from foredrive.simulation.scenarios.places import scenarios_on
from foredrive.simulation.scores import Ending
from foredrive.simulation.town import grow
from foredrive.towns.map.town_map import load_town_map
from foredrive.towns.traffic.lane_graph import build_lane_graph
from foredrive.view.drive_report import write_drive_report

VOXELS = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=2.0, shape_zyx=(2, 8, 8))


HOSTILE = 'x"><svg onload=alert(1)>'


@pytest.fixture(scope="module")
def routes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short routes of Town02 in CARLA's form, along one lane; CARLA's y points to the right."""
    graph = build_lane_graph(load_town_map("Town02"))
    lane = int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))
    text = ""
    for name, first_m in (("a", 20.0), ("b", 60.0)):
        ends = graph.position(np.full(2, lane), np.array([first_m, first_m + 14.0]))
        points = "".join(f'<waypoint x="{x}" y="{-y}" z="{z}"/>' for x, y, z in ends)
        text += f'<route id="{name}" town="Town02">{points}</route>'
    path = tmp_path_factory.mktemp("routes") / "two.xml"
    path.write_text(f"<routes>{text}</routes>")
    return path


@pytest.fixture(scope="module")
def suite(routes: Path) -> DriveSuite:
    return DriveSuite("constant-velocity", str(routes), image_hw=(18, 32), vehicles=4, people=2)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("suite")


@pytest.fixture(scope="module")
def driven(suite: DriveSuite, out: Path) -> Driven:
    return drive_suite(suite, out, workers=1)


def test_a_lesson_tells_what_the_expert_would_do(routes: Path, tmp_path: Path) -> None:
    suite = DriveSuite(
        "disturbed", str(routes), seed=5, conditions="any", sensors=False, vehicles=4, people=2
    )
    driven = drive_suite(suite, tmp_path, workers=1)
    logs = find_logs(tmp_path)
    taught, was_driven = (
        ClipDataset(logs, ClipConfig(1, 0, (18, 32), VOXELS, future_source=source), None)
        for source in ("taught", "driven")
    )
    assert driven.broken == {}
    for index in range(len(taught)):
        said, done = taught.clip(index).future, was_driven.clip(index).future
        assert said.valid.all()  # three seconds, whenever the drive is over
        assert said.dt_s == done.dt_s == 0.5
        assert torch.diff(said.xy[0, :, 0]).ge(-0.01).all()
        assert float(said.xy[0, -1].norm()) < 40
        apart_m = (said.xy - done.xy)[done.valid].norm(dim=-1)  # he does what he says, more or less
        assert apart_m.numel() == 0 or 0 < float(apart_m.max()) < 6


@pytest.mark.parametrize("name", ["../../../x", "..", "/x", "a/b", HOSTILE, "", "a" * 101])
def test_a_route_whose_id_cannot_name_a_file_is_refused(name: str, routes: Path, tmp_path: Path) -> None:
    file, out = tmp_path / "deep" / "routes.xml", tmp_path / "deep" / "er" / "out"
    file.parent.mkdir()
    file.write_text(routes.read_text().replace('id="b"', f"id={quoteattr(name)}"))
    with pytest.raises(InputError, match=r"route number 2 of .*routes\.xml: a route's id is letters, digits"):
        drive_suite(DriveSuite("stop", str(file), sensors=False, vehicles=0, people=0), out, workers=1)
    assert [path.name for path in tmp_path.rglob("*")] == ["deep", "routes.xml"]


def test_every_drive_is_kept_scored_and_logged(driven: Driven, out: Path) -> None:
    assert list(driven.drives) == [DriveJob("a", 0), DriveJob("b", 0)]
    assert (driven.skipped, driven.broken) == (0, {})
    for job, kept in driven.drives.items():
        assert read_drive(out / "drives" / f"{job.name}.json") == kept
        score = score_of(kept)
        assert (score.route, score.ending) == (job.route, Ending.COMPLETED)
        assert kept["length_m"] == pytest.approx(14.0, abs=0.5)
        dataset = ClipDataset(
            [LogPath(out / kept["log"], out / "maps")], ClipConfig(1, 1, (18, 32), VOXELS), None
        )
        example = dataset[len(dataset) - 1]
        assert len(dataset.camera_names) == 6
        assert example.clip.images.float().std() > 5
        assert dataset.command_source["route"] == len(dataset)
    assert len(find_logs(out)) == 2
    summary = read_summary(out / "summary.json")
    assert (summary["routes"], summary["drives"], summary["failed"]) == (2, 2, 0)
    assert summary["scenarios.cut_in"] == 0  # routes are too short for any
    mean = np.mean([score_of(kept).driving_score_1_0 for kept in driven.drives.values()])
    assert summary["driving_score_1_0"] == pytest.approx(mean)


def test_scenarios_are_those_of_the_drives_seed(suite: DriveSuite) -> None:
    graph = build_lane_graph(load_town_map("Town02"))
    lane = int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))
    ends = graph.position(np.full(2, lane), np.array([5.0, graph.length_m[lane] - 5.0]))
    route = snap_route(RouteWaypoints("straight", "Town02", ends))
    first, second = (scenario_of(suite, route, repetition) for repetition in (0, 1))
    expected = scenarios_on(route, grow("Town02", 1), 1)
    assert [(s.kind, s.at_m) for s in second.scenarios] == [(s.kind, s.at_m) for s in expected]
    assert len(first.scenarios) >= 1
    without = scenario_of(dataclasses.replace(suite, scenarios=False), route, 0)
    assert without.scenarios == ()


def test_what_lies_there_is_not_driven_again(driven: Driven, suite: DriveSuite, out: Path) -> None:
    (out / "drives" / "routeb_rep0.json").unlink()
    told: list[DriveJob] = []
    again = drive_suite(suite, out, workers=1, tick=lambda job, drive: told.append(job))
    assert again.skipped == 1
    assert told == [DriveJob("a", 0), DriveJob("b", 0)]
    for job, kept in driven.drives.items():
        changed = {"wall_s", "act_s"}  # what the computer took
        assert all(again.drives[job][key] == kept[key] for key in kept.keys() - changed)


def test_a_folder_holds_one_suite(driven: Driven, suite: DriveSuite, out: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="another suite"):
        drive_suite(dataclasses.replace(suite, seed=1), out, workers=1)
    (tmp_path / "drives").mkdir()
    (tmp_path / "drives" / "routea_rep0.json").write_text("{}")
    with pytest.raises(InputError, match="nobody knows"):
        drive_suite(suite, tmp_path, workers=1)
    (out / "drives" / "routea_rep0.json").write_text("{}")
    with pytest.raises(InputError, match="not what is kept of a drive"):
        drive_suite(suite, out, workers=1)


def test_a_folder_is_claimed_by_what_can_be_driven(suite: DriveSuite, tmp_path: Path) -> None:
    for wrong in ({"routes": "nothing.xml"}, {"driver": "nobody"}):
        with pytest.raises(InputError, match=wrong.get("routes", "no such driver")):
            claim(dataclasses.replace(suite, **wrong), tmp_path / "new")
    assert not (tmp_path / "new").exists()
    claim(suite, tmp_path)
    other = dataclasses.replace(suite, seed=1, repetitions=2)
    claim(other, tmp_path)  # nothing has been driven yet
    (tmp_path / "drives").mkdir()
    (tmp_path / "drives" / "routea_rep0.json").write_text("{}")
    with pytest.raises(InputError, match="another suite"):
        claim(suite, tmp_path)
    claim(dataclasses.replace(other, repetitions=1), tmp_path)
    assert json.loads((tmp_path / "suite.json").read_text())["repetitions"] == 2


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="folders can be made everywhere here")
def test_a_folder_that_cannot_be_made_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["drive", "--agent", "stop", "--out", "/proc/no/folder"]) == 2
    assert capsys.readouterr().err == "foredrive: /proc/no/folder: no folder can be made there\n"


@pytest.mark.parametrize("driver", ["nobody", "ego-mlp:nowhere"])
def test_an_unknown_driver_is_named(driver: str) -> None:
    with pytest.raises(InputError, match=f"{driver}: no such driver; there are expert"):
        needs_of(driver)


def test_the_report_has_a_film_of_every_drive(suite: DriveSuite, tmp_path: Path) -> None:
    blind = dataclasses.replace(suite, driver="stop", sensors=False)
    drive_suite(blind, tmp_path, workers=1)
    page = write_drive_report(tmp_path).read_text()
    for job in ("routea_rep0", "routeb_rep0"):
        assert f'<h3 id="{job}">{job}: 0.0, timeout</h3>' in page
        assert (tmp_path / "videos" / f"{job}.webp").stat().st_size > 1000
    with pytest.raises(InputError, match="not a suite"):
        write_drive_report(tmp_path / "videos")
    drive = json.loads((tmp_path / "drives" / "routea_rep0.json").read_text())
    drive["events"].append({"kind": "scenario", "what": HOSTILE, "t_s": 0.0, "xy_world": [0.0, 0.0]})
    (tmp_path / "drives" / f"{HOSTILE}.json").write_text(json.dumps(drive))
    shutil.copy(tmp_path / "videos" / "routea_rep0.webp", tmp_path / "videos" / f"{HOSTILE}.webp")
    assert "<svg onload" not in write_drive_report(tmp_path).read_text()
