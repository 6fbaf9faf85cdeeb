"""Suites of drives: kept as they end, never driven twice, never mixed up."""

import dataclasses
import json
import shutil
from collections import Counter
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
import torch

from foredrive.cli.main import main
from foredrive.data import ClipConfig, ClipDataset
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.log_paths import LogPath, find_logs
from foredrive.data.logs import Log
from foredrive.driving.route_sets import RouteWaypoints
from foredrive.driving.scores import Ending, RouteScore
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.runs.drive.agent_inputs import inputs_of
from foredrive.runs.drive.agents import AGENTS
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.records import read_drive, summarise
from foredrive.runs.drive.route_source import job_of
from foredrive.runs.drive.suite import (
    DriveJob,
    DriveSuite,
    SuiteResult,
    agent_digest,
    drive_one,
    drive_suite,
    folder_of,
)
from foredrive.runs.train.run import Run
from foredrive.scene import VoxelSpec
from foredrive.scene.conditions import CONDITIONS, carla_weather, conditions_of_weather
from foredrive.sensors.rigs import SURROUND
from foredrive.towns.driving.routes import snap_route
from foredrive.towns.driving.town import grow
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.scenarios.places import scenarios_on
from foredrive.towns.traffic.lane_graph import build_lane_graph
from foredrive.view.drive_report import write_drive_report

VOXELS = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=2.0, shape_zyx=(2, 8, 8))


HOSTILE = 'x"><svg onload=alert(1)>'


def test_what_a_route_file_asks_for_and_is_not_here_is_told(
    routes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scenario = '<scenarios><scenario type="ParkingCutIn"/><scenario type="Accident"/></scenarios>'
    first, second = routes.read_text().split("</route>", 1)
    file = tmp_path / "bench.xml"
    file.write_text(
        f"{first}{scenario}</route>{second}".replace('id="b" town="Town02"', 'id="b" town="Town99"')
    )
    with pytest.raises(InputError, match=r"not here: Town99 \(1 of 2\); the towns are Town01, .*--only"):
        TownRoutes(str(file)).jobs("stop")
    source = TownRoutes(str(file), only=("a",))
    assert [job.route for job in (*source.jobs("stop"), *source.jobs("stop"))] == ["a", "a"]
    (said,) = caplog.messages
    assert "scenarios left out: 1 Accident, 1 ParkingCutIn" in said


def changed(suite: DriveSuite, **fields: Any) -> DriveSuite:
    """The suite over other routes, or under other circumstances."""
    return dataclasses.replace(suite, source=dataclasses.replace(suite.source, **fields))


@pytest.fixture(scope="module")
def suite(routes: Path) -> DriveSuite:
    return DriveSuite(
        "constant-velocity", TownRoutes(str(routes), rig=SURROUND.of_size((18, 32)), vehicles=4, people=2)
    )


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("suite")


@pytest.fixture(scope="module")
def driven(suite: DriveSuite, out: Path) -> SuiteResult:
    return drive_suite(suite, out, workers=1)


@pytest.mark.slow
def test_a_demonstration_has_the_plans_of_the_expert(routes: Path, tmp_path: Path) -> None:
    source = TownRoutes(str(routes), seed=5, conditions="any", vehicles=4, people=2)
    suite = DriveSuite("disturbed", source, sensors=False)
    driven = drive_suite(suite, tmp_path, workers=1)
    logs = find_logs(tmp_path)
    planned, was_driven = (
        ClipDataset(logs, ClipConfig(1, 0, (18, 32), VOXELS, future_source=source), None)
        for source in ("expert", "driven")
    )
    assert driven.broken == {}
    for index in range(len(planned)):
        plan, done = planned.clip(index).future, was_driven.clip(index).future
        assert plan.valid.all()  # three seconds, whenever the drive is over
        assert plan.dt_s == done.dt_s == 0.5
        assert torch.diff(plan.xy[0, :, 0]).ge(-0.01).all()
        assert float(plan.xy[0, -1].norm()) < 40
        apart_m = (plan.xy - done.xy)[done.valid].norm(dim=-1)  # followed, but for disturbances
        assert apart_m.numel() == 0 or 0 < float(apart_m.max()) < 6


@pytest.mark.parametrize("name", ["../../../x", "..", "/x", "a/b", HOSTILE, "", "a" * 101])
def test_a_route_whose_id_cannot_name_a_file_is_refused(name: str, routes: Path, tmp_path: Path) -> None:
    file, out = tmp_path / "deep" / "routes.xml", tmp_path / "deep" / "er" / "out"
    file.parent.mkdir()
    file.write_text(routes.read_text().replace('id="b"', f"id={quoteattr(name)}"))
    with pytest.raises(InputError, match=r"route number 2 of .*routes\.xml: a route's id is letters, digits"):
        drive_suite(
            DriveSuite("stop", TownRoutes(str(file), vehicles=0, people=0), sensors=False), out, workers=1
        )
    assert [path.name for path in tmp_path.rglob("*")] == ["deep", "routes.xml"]


@pytest.mark.slow
def test_a_log_has_the_sensors_that_were_asked_for(suite: DriveSuite, tmp_path: Path) -> None:
    """Images do not depend on whether a lidar turns beside them."""
    images = {}
    for lidar in (True, False):
        some = dataclasses.replace(changed(suite, only=("b",)), lidar=lidar)
        drive_one(some.jobs()[0], some, tmp_path / str(lidar))
        log = Log(find_logs(tmp_path / str(lidar))[0])
        assert (read_sweep(log, 0) is not None) is lidar
        camera = pinhole_cameras(log)["PCAM_F0"]
        images[lidar] = read_camera(log, 1, camera, (18, 32), with_image=True).image
    assert torch.equal(images[True], images[False])


def test_foggy_nights_are_drawn_seldom(suite: DriveSuite) -> None:
    source = changed(suite, conditions="any").source
    drawn = Counter(source.conditions_of("a", seed) for seed in range(2000))
    assert set(drawn) == set(CONDITIONS.values())
    others = [drawn[kind] for name, kind in CONDITIONS.items() if name != "night_fog"]
    assert min(others) > 2 * drawn[CONDITIONS["night_fog"]]


def test_only_some_routes_of_a_set_are_driven(suite: DriveSuite) -> None:
    assert [job.route for job in changed(suite, only=("b",), repetitions=2).jobs()] == ["b", "b"]
    assert changed(suite, only=("b",)).noted()["only"] == ["b"]
    assert "only" not in suite.noted()  # folders of suites from before there was the field are continued
    with pytest.raises(InputError, match="has no route c; it has a, b"):
        changed(suite, only=("c",)).jobs()


def test_every_drive_is_kept_scored_and_logged(driven: SuiteResult, out: Path) -> None:
    assert list(driven.drives) == [job_of("a", 0), job_of("b", 0)]
    assert (driven.skipped, driven.broken) == (0, {})
    for job, kept in driven.drives.items():
        assert read_drive(out / "drives" / f"{job.name}.json") == kept
        score = kept.score
        assert (score.route, score.ending) == (job.route, Ending.COMPLETED)
        assert kept.length_m == pytest.approx(14.0, abs=0.5)
        dataset = ClipDataset(
            [LogPath(out / kept.log, out / "maps")], ClipConfig(1, 1, (18, 32), VOXELS), None
        )
        example = dataset[len(dataset) - 1]
        assert len(dataset.camera_names) == 6
        assert example.clip.images.float().std() > 5
        assert dataset.command_source["route"] == len(dataset)
    assert len(find_logs(out)) == 2
    summary = read_summary(out / "summary.json")
    assert (summary["routes"], summary["drives"], summary["failed"]) == (2, 2, 0)
    assert summary["scenarios.cut_in"] == 0  # routes are too short for any
    mean = np.mean([kept.score.driving_score_1_0 for kept in driven.drives.values()])
    assert summary["driving_score_1_0"] == pytest.approx(mean)
    met = dataclasses.replace(driven.drives[job_of("a", 0)], nearest_s=(0.5, None, 2.0, None))
    assert summarise([met])["near_collision_share"] == 1 / 4


def test_scenarios_are_those_of_the_drives_seed(suite: DriveSuite) -> None:
    graph = build_lane_graph(load_town_map("Town02"))
    lane = int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))
    ends = graph.position(np.full(2, lane), np.array([5.0, graph.length_m[lane] - 5.0]))
    route = snap_route(RouteWaypoints("straight", "Town02", ends))
    first, second = (suite.source.scenario_of(route, repetition, suite) for repetition in (0, 1))
    expected = scenarios_on(route, grow("Town02", 1), 1)
    assert [(s.kind, s.at_m) for s in second.scenarios] == [(s.kind, s.at_m) for s in expected]
    assert len(first.scenarios) >= 1
    without = changed(suite, scenarios=False)
    assert without.source.scenario_of(route, 0, without).scenarios == ()


def test_what_lies_there_is_not_driven_again(driven: SuiteResult, suite: DriveSuite, out: Path) -> None:
    (out / "drives" / "routeb_rep0.json").unlink()
    told: list[DriveJob] = []
    again = drive_suite(suite, out, workers=1, tick=lambda job, drive: told.append(job))
    assert again.skipped == 1
    assert told == [job_of("a", 0), job_of("b", 0)]
    for job, kept in driven.drives.items():
        taken = {"wall_s": kept.wall_s, "act_s": kept.act_s}  # by the computer
        assert dataclasses.replace(again.drives[job], **taken) == kept


def test_while_a_drive_is_broken_there_is_no_summary(
    driven: SuiteResult, suite: DriveSuite, out: Path, tmp_path: Path
) -> None:
    """The log of the drive is being written by somebody else."""
    folder = tmp_path / "suite"
    shutil.copytree(out, folder)
    for name in ("drives/routeb_rep0.json", "summary.json"):
        (folder / name).unlink()
    log = folder / "logs" / "town_train" / "routeb_rep0"
    with atomic_path(log, alone=True) as somebody_elses:
        again = drive_suite(suite, folder, workers=1)
        somebody_elses.mkdir()
    assert list(again.drives) == [job_of("a", 0)]
    assert "routeb_rep0" in again.broken[job_of("b", 0)]
    assert not (folder / "summary.json").exists()


def test_files_of_suites_and_drives_stay_what_they_were(driven: SuiteResult, out: Path) -> None:
    """They are read by who knows their keys."""
    suite = json.loads((out / "suite.json").read_text())
    fields = "agent routes repetitions seed conditions sensors image_hw vehicles people scenarios"
    assert set(suite) == {*fields.split(), "period_s", "latency_s", "routes_sha256"}
    assert suite["image_hw"] == [18, 32]
    drive = json.loads((out / "drives" / "routea_rep0.json").read_text())
    fields = "town length_m score driving_score_1_0 driving_score_2_1 error events comfort nearest_s act_s"
    fields += " route_xy track wall_s log lanes_known plans efficiency_pct smoothness_pct"
    assert set(drive) == set(fields.split())
    assert set(drive["score"]) == {field.name for field in dataclasses.fields(RouteScore)}
    assert drive["score"]["ending"] == "completed"
    for later in ("lanes_known", "efficiency_pct", "smoothness_pct"):
        del drive[later]  # not in older files
    (out / "old.json").write_text(json.dumps(drive))
    older = dataclasses.replace(driven.drives[job_of("a", 0)], efficiency_pct=None, smoothness_pct=None)
    assert read_drive(out / "old.json") == older


def test_a_carla_server_is_reached_by_the_verb(
    routes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No server runs here: the drives go as far as to ask for one."""
    command = ["drive", "--agent", "stop", "--routes", str(routes), "--no-sensors", "--out", str(tmp_path)]
    assert main([*command, "--carla", "localhost:1"]) == 2
    assert "CARLA" in capsys.readouterr().err
    suite = json.loads((tmp_path / "suite.json").read_text())
    assert (suite["carla"], suite["routes"], suite["scenarios"]) == ("localhost:1", str(routes), False)
    for server in ("localhost:x", ":2000"):
        assert main([*command, "--carla", server]) == 2
        assert "a CARLA server is named HOST:PORT" in capsys.readouterr().err


def test_a_folder_holds_one_suite(driven: SuiteResult, suite: DriveSuite, out: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="another suite"):
        drive_suite(changed(suite, seed=1), out, workers=1)
    (tmp_path / "drives").mkdir()
    (tmp_path / "drives" / "routea_rep0.json").write_text("{}")
    with pytest.raises(InputError, match=r"not the description of a suite .* drives beside it"):
        drive_suite(suite, tmp_path, workers=1)
    (out / "drives" / "routea_rep0.json").write_text("{}")
    with pytest.raises(InputError, match="not the record of a drive"):
        drive_suite(suite, out, workers=1)


def test_another_file_of_the_same_name_is_another_suite(
    suite: DriveSuite, routes: Path, tmp_path: Path
) -> None:
    """A route is moved in its file, or the weights of a run change; the names stay."""
    file, run = tmp_path / "own.xml", tmp_path / "run"
    file.write_text(routes.read_text())
    source = dataclasses.replace(suite.source, routes=str(file))
    before = folder_of(dataclasses.replace(suite, source=source), tmp_path).wanted
    file.write_text(routes.read_text().replace('z="', 'z="1'))
    after = folder_of(dataclasses.replace(suite, source=source), tmp_path).wanted
    assert [what for what in before if before[what] != after[what]] == [
        f"the drives of another version of {file}"
    ]
    (run / "finetune").mkdir(parents=True)
    (run / "config.yaml").write_text("")
    digests = []
    for text in ("a", "b", "a"):
        (run / "finetune" / "model.safetensors").write_text(text)
        digests.append([agent_digest(f"{kind}{run}") for kind in ("", "student:", "true-lights:")])
    assert digests[0] == digests[2]
    assert all(one != other for one, other in zip(*digests[:2], strict=True))
    assert agent_digest("expert") is agent_digest("http://localhost:1") is None


WEATHER = (
    '<weathers><weather route_percentage="{}" cloudiness="90" precipitation="80" precipitation_deposits="90"'
    ' wetness="90" sun_altitude_angle="{}" fog_density="40"/></weathers>'
)


def test_the_weather_of_a_route_file_is_played(
    routes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In the forms of leaderboard 1.0 and 2.x; other conditions that are asked for come first."""
    first, second, _ = routes.read_text().split("</route>")
    night = WEATHER.format(0, -60).removesuffix("</weathers>") + WEATHER.format(100, 45).removeprefix(
        "<weathers>"
    )
    plain = '<weather id="a" cloudiness="0" precipitation="0" wetness="0" sun_altitude_angle="75"/>'
    file = tmp_path / "weather.xml"
    file.write_text(f"{first}{night}</route>{second}{plain}</route></routes>")
    source = TownRoutes(str(file))
    seen, noon = source.conditions_of("a", 0), source.conditions_of("b", 0)
    assert seen is not None
    assert noon is not None
    assert (seen.hour, seen.clouds, seen.rain_mmph) == (24.0, 0.9, pytest.approx(32.0))
    assert (seen.wetness, seen.visibility_m) == (0.9, pytest.approx(398.1, abs=0.1))
    assert (noon.hour, noon.rain_mmph, noon.visibility_m) == (12.0, 0.0, CONDITIONS["clear"].visibility_m)
    source.jobs("stop")
    assert "the weather of 1 routes changes on the way; it stays as it begins" in caplog.messages[-1]
    assert TownRoutes(str(file), conditions="fog").conditions_of("a", 0) == CONDITIONS["fog"]
    assert TownRoutes(str(routes)).conditions_of("a", 0) is None
    file.write_text(file.read_text().replace('"90"', '"much"'))
    with pytest.raises(InputError, match="weather that is no number"):
        TownRoutes(str(file)).jobs("stop")


@pytest.mark.parametrize("name", CONDITIONS)
def test_conditions_return_from_carlas_weather(name: str) -> None:
    """A morning returns as the evening that is as bright; thin haze as clear air."""
    before = CONDITIONS[name]
    after = conditions_of_weather(carla_weather(before))
    assert abs(after.hour - 12) == pytest.approx(abs(before.hour - 12))
    assert after.clouds == pytest.approx(before.clouds)
    assert after.rain_mmph == pytest.approx(before.rain_mmph)
    assert after.wetness == pytest.approx(before.wetness)
    if before.visibility_m < 500:
        assert after.visibility_m == pytest.approx(before.visibility_m)
    else:
        assert after.visibility_m > 1000


def claim(suite: DriveSuite, out: Path) -> None:
    with folder_of(suite, out).claimed():
        pass


def test_a_folder_is_claimed_by_what_can_be_driven(suite: DriveSuite, tmp_path: Path) -> None:
    unknown = changed(suite, routes="nothing.xml"), dataclasses.replace(suite, agent="nobody")
    for wrong, named in zip(unknown, (r"nothing\.xml", "unknown agent"), strict=True):
        with pytest.raises(InputError, match=named):
            drive_suite(wrong, tmp_path / "new")
    assert not (tmp_path / "new").exists()
    claim(suite, tmp_path)
    other = changed(suite, seed=1, repetitions=2)
    claim(other, tmp_path)  # nothing has been driven yet
    (tmp_path / "drives").mkdir()
    (tmp_path / "drives" / "routea_rep0.json").write_text("{}")
    with pytest.raises(InputError, match="another suite"):
        claim(suite, tmp_path)
    claim(changed(other, repetitions=1), tmp_path)
    assert json.loads((tmp_path / "suite.json").read_text())["repetitions"] == 2


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="folders can be made everywhere here")
def test_a_folder_that_cannot_be_made_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["drive", "--agent", "stop", "--out", "/proc/no/folder"]) == 2
    assert capsys.readouterr().err == "foredrive: /proc/no/folder: no folder can be made there\n"


@pytest.mark.parametrize("agent", ["nobody", "ego-mlp:nowhere"])
def test_an_unknown_agent_is_named(agent: str) -> None:
    with pytest.raises(InputError, match=f"unknown agent '{agent}'; the agents are expert"):
        inputs_of(agent)


def test_the_report_has_a_film_of_every_drive(suite: DriveSuite, tmp_path: Path) -> None:
    blind = dataclasses.replace(suite, agent="stop", sensors=False)
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


def test_the_page_names_all_agents() -> None:
    page = (Path(__file__).parents[2] / "docs" / "driving.md").read_text()
    missing = [kind.name for kind in AGENTS if f"`{kind.name}{kind.argument}`" not in page]
    assert missing == [""]  # a run folder stands first, in words


def test_an_agent_that_cannot_drive_there_is_refused_before_the_first_drive(trained: Run) -> None:
    for agent in ("log", "lidar-corridor"):
        with pytest.raises(InputError, match="only in a reconstruction"):
            TownRoutes("town05-short").jobs(agent)
    for kind in ("idm:", "true:", "true-lights:", "true-users:"):
        with pytest.raises(InputError, match=f"{kind}RUN needs the run of a driver"):
            TownRoutes("town05-short").jobs(f"{kind}{trained.folder}")
