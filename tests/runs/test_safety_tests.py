"""The verb for safety tests, in a small log that was reconstructed: scenarios, runs that are kept, report."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from foredrive.cli.main import main
from foredrive.driving.faults import CameraFault, Faults
from foredrive.driving.ncap.outcome import Outcome
from foredrive.driving.ncap.rules import RULES
from foredrive.driving.ncap.running import set_up_run
from foredrive.driving.ncap.scenario import Polyline, Rectilinear
from foredrive.driving.ncap.scenario_file import load_scenarios
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.methods.reconstruction.renderer import ReconstructedRenderer
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.trust import Trust
from foredrive.runs.drive.in_ncap import (
    SafetyTests,
    _folders,
    _untrusted_s,
    place_in,
    propose_scenarios,
)
from foredrive.runs.drive.in_reconstruction import ReconstructedRoutes
from foredrive.runs.drive.pseudo import pseudo_simulate
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.reconstruction.reconstruction_run import open_run_log
from foredrive.scene import Renderer
from foredrive.view.ncap_pictures import write_scenario_picture


def test_the_verb_tests_keeps_and_reports(
    reconstructed: Path, scenarios: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["ncap", str(reconstructed), "--scenarios", str(scenarios), "--out", str(tmp_path / "out")]
    command += ["--agent", "stop", "--rules", "paper", "--no-sensors", "--films", "1"]
    assert main([*command, "--runs", "1"]) == 0
    told = capsys.readouterr().out
    assert "stationary-on" in told
    assert "left out, stationary-beside: run 0 passes without any action" in " ".join(told.split())
    first = (tmp_path / "out" / "drives" / "stationary-on_rep0.json").stat().st_mtime_ns
    assert main([*command, "--runs", "2"]) == 0
    assert "1 of 2 drives had been driven before" in capsys.readouterr().out
    assert (tmp_path / "out" / "drives" / "stationary-on_rep0.json").stat().st_mtime_ns == first
    summary = read_summary(tmp_path / "out" / "summary.json")
    assert (summary["threats.all.runs"], summary["threats.all.failed"]) == (2, 0)
    assert summary["threats.stationary.score"] == 5.0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Safety tests" in page
    assert "5.0 of 5, stopped short" in page
    assert len(list((tmp_path / "out" / "videos").glob("*.webp"))) == 1
    other = [*command, "--runs", "1"]
    other[other.index("paper")] = "ours"
    assert main(other) == 2
    assert "another suite" in capsys.readouterr().err


def test_log_replay_crashes_and_wrong_input_is_one_line(
    reconstructed: Path, scenarios: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = SafetyTests((str(reconstructed),), str(scenarios), "ours", 1)
    (drive,) = drive_suite(DriveSuite("log", source, sensors=False), tmp_path / "log").drives.values()
    assert drive.threat is not None
    assert drive.threat.outcome is Outcome.COLLIDED
    assert drive.threat.score == pytest.approx(0.0, abs=0.3)
    out = ["--agent", "stop", "--out", str(tmp_path / "none")]
    assert main(["ncap", str(reconstructed), "--scenarios", str(tmp_path / "no.yaml"), *out]) == 2
    assert "no.yaml: cannot be read" in capsys.readouterr().err
    scenarios.with_name("late.yaml").write_text(
        scenarios.read_text().replace("length_s: 6.0", "length_s: 60.0")
    )
    assert main(["ncap", str(reconstructed), "--scenarios", str(scenarios.with_name("late.yaml")), *out]) == 2
    error = capsys.readouterr().err
    assert "no scenario passes the self-test" in error
    assert "the log ends at 6.6 s" in error
    assert main(["ncap", str(reconstructed), "--scenarios", str(scenarios), "--propose"]) == 2
    assert "scenarios.yaml: exists already" in capsys.readouterr().err
    assert main(["ncap", str(reconstructed), "--scenarios", str(scenarios)]) == 2
    assert "needs --agent and --out" in capsys.readouterr().err
    assert main(["ncap", "--scenarios", str(scenarios), *out]) == 2
    assert "name at least one reconstruction" in capsys.readouterr().err


def test_other_scenarios_in_the_same_file_are_another_suite(
    reconstructed: Path, scenarios: Path, tmp_path: Path
) -> None:
    changed = tmp_path / "changed.yaml"
    changed.write_text(scenarios.read_text())
    suite = DriveSuite("stop", SafetyTests((str(reconstructed),), str(changed), "ours", 1), sensors=False)
    drive_suite(suite, tmp_path / "out")
    changed.write_text(scenarios.read_text().replace("length_s: 6.0", "length_s: 5.5"))
    with pytest.raises(InputError, match="another suite"):
        drive_suite(suite, tmp_path / "out")


def test_reconstructions_of_one_name_are_an_error(reconstructed: Path, tmp_path: Path) -> None:
    """A second reconstruction of the log: its own name tells it apart, that of the log does not."""
    for folder in (tmp_path / "other", tmp_path / "same" / reconstructed.name):
        shutil.copytree(reconstructed, folder)
    with pytest.raises(InputError, match=f"two reconstructions have the name '{reconstructed.name}'"):
        propose_scenarios(
            (str(reconstructed), str(tmp_path / "same" / reconstructed.name)), tmp_path / "new", "ours", 1
        )
    (log,) = {open_run_log(reconstructed)[1].folder.name}
    assert log in _folders((str(reconstructed),))
    assert set(_folders((str(reconstructed), str(tmp_path / "other")))) == {reconstructed.name, "other"}


def test_an_agent_that_sees_more_of_the_past_than_the_log_has_is_told_so(
    reconstructed: Path, scenarios: Path
) -> None:
    place, (test, _) = place_in(str(reconstructed)), load_scenarios(scenarios)
    with pytest.raises(InputError, match=r"stationary-.*: run 0 begins to drive at .* sees 20 earlier"):
        set_up_run(place, test, 0, RULES["ours"], sensors=False, past_frames=20)


def test_the_expert_hits_nobody(reconstructed: Path, scenarios: Path, tmp_path: Path) -> None:
    source = SafetyTests((str(reconstructed),), str(scenarios), "ours", 2)
    drives = drive_suite(DriveSuite("expert", source, sensors=False), tmp_path).drives.values()
    outcomes = {drive.threat.outcome for drive in drives if drive.threat}
    assert outcomes <= {Outcome.PASSED, Outcome.STOPPED_SHORT}


@pytest.mark.slow
def test_workers_drive_as_one_process_does(reconstructed: Path, scenarios: Path, tmp_path: Path) -> None:
    threats = []
    for spread in (False, True):
        source = SafetyTests((str(reconstructed),), str(scenarios), "ours", 2, spread=spread)
        driven = drive_suite(DriveSuite("log", source, sensors=False), tmp_path / str(spread), workers=2)
        assert not driven.broken
        threats.append([drive.threat for drive in driven.drives.values()])
    assert threats[0] == threats[1]


def test_an_agent_is_shown_some_sensors_alone_or_told_that_it_cannot(
    reconstructed: Path, scenarios: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["ncap", str(reconstructed), "--scenarios", str(scenarios), "--runs", "1", "--films", "0"]
    lidar = [*command, "--agent", "lidar-corridor", "--out", str(tmp_path / "lidar")]
    assert main([*lidar, "--sees", "camera"]) == 2
    assert "lidar-corridor needs its lidar, which --sees camera hides" in capsys.readouterr().err
    assert main([*lidar, "--sees", "lidar"]) == 0
    assert read_summary(tmp_path / "lidar" / "summary.json")["threats.all.failed"] == 0
    assert main([*command, "--agent", "stop", "--out", str(tmp_path / "stop"), "--sees", "lidar"]) == 2
    assert "stop does not look at what --sees lidar shows" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["ncap", "--help"])
    assert "(default: )" not in capsys.readouterr().out


def test_a_picture_shows_a_scenario(reconstructed: Path, scenarios: Path, tmp_path: Path) -> None:
    test = load_scenarios(scenarios)[0]
    assert isinstance(test.actors[0].way, Polyline)
    crossing = Rectilinear(test.actors[0].way.xyz_m[0], 5.0, 1.57, 5.0)
    test = dataclasses.replace(test, actors=(dataclasses.replace(test.actors[0], way=crossing),))
    write_scenario_picture(tmp_path / "on.png", place_in(str(reconstructed)), test)
    with Image.open(tmp_path / "on.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    red = (np.abs(pixels - [255, 77, 79]).sum(axis=2) < 30).sum()
    assert pixels.shape[1] > 2 * 400
    assert red > 20  # the actor's way


@pytest.mark.parametrize("agent", ["idm", "disturbed"])
def test_an_agent_of_towns_cannot_be_pseudo_simulated_and_is_no_failed_start(
    agent: str, reconstructed: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="can drive only there"):
        pseudo_simulate([str(reconstructed)], agent, tmp_path, every_s=1.0)
    assert not list(tmp_path.iterdir())


def test_a_camera_that_the_reconstruction_does_not_have_cannot_fail(
    reconstructed: Path, tmp_path: Path
) -> None:
    faults = Faults((CameraFault("black", "ahed"),))
    suite = DriveSuite("stop", ReconstructedRoutes(str(reconstructed)), sensors=False, faults=faults)
    with pytest.raises(InputError, match="no camera ahed; there are ahead, left"):
        drive_suite(suite, tmp_path)


def test_a_safety_test_says_how_much_of_it_is_trusted(
    reconstructed: Path, scenarios: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["ncap", str(reconstructed), "--scenarios", str(scenarios), "--agent", "stop", "--runs", "1"]
    assert main([*command, "--films", "0", "--stay-trusted", "--out", str(tmp_path)]) == 0
    summary = read_summary(tmp_path / "summary.json")
    share, untrusted = summary["threats.all.trusted_share"], summary["threats.all.untrusted"]
    assert isinstance(share, float)
    assert 0.0 <= share <= 1.0
    assert (summary["threats.all.score"] is None) == (untrusted == 1)
    assert (share < 1.0) == (untrusted == 1)
    drive = json.loads((tmp_path / "drives" / "stationary-on_rep0.json").read_text())
    assert drive["trusted_share"] == pytest.approx(share)
    assert "trusted, %" in capsys.readouterr().out


def test_proposals_are_left_out_where_their_images_are_not_trusted(
    reconstructed: Path, scenarios: Path
) -> None:
    """The same images against expectations along the logged way that are worse, and far better."""
    place, (scenario, _) = place_in(str(reconstructed), trusted=True), load_scenarios(scenarios)
    renderer = place.renderer(place.graph)
    assert isinstance(renderer, ReconstructedRenderer)
    assert renderer.trust is not None
    for reference_db, untrusted_s in ((-50.0, None), (100.0, 2.0)):
        judge = dataclasses.replace(renderer.trust, reference_db=reference_db)

        def render(graph: SceneGraph, judge: Trust = judge) -> Renderer:
            return dataclasses.replace(renderer, graph=graph, trust=judge)

        assert _untrusted_s(dataclasses.replace(place, renderer=render), scenario) == untrusted_s
    assert _untrusted_s(place_in(str(reconstructed)), scenario) is None  # not known
