"""Files of scenarios, ours and neuro-ncap's, and the draws of their runs."""

import math
from pathlib import Path

import numpy as np
import pytest

from foredrive.driving.ncap.drawing import draw_run
from foredrive.driving.ncap.scenario import Jitter, Polyline, Rectilinear, SafetyScenario, ScenarioActor
from foredrive.driving.ncap.scenario_file import load_scenarios, outside_protocol, save_scenarios
from foredrive.driving.replay.threats import Threat
from foredrive.errors import InputError

THEIRS = """
general:
  start-pose: "original"
  start-frame: 20
  time-step: 0.5
  priming-steps: 2
  duration: 10.0
  smooth-actors: true
  start-jitter: 1

actors:
  - uuids:
      - 1234e5  # a number in YAML
      - 0017
    flip_uuids:
      - 0017
    mode: "override"
    is_target_actor: true
    times: [0.0, 20]
    initial-yaw: 2.5
    positions:
      - [550.0, 1542.5, 0.0]
      - [550.0, 1542.5, 0.0]
    jitter:
      times: [0.0, 1.0]
      longitudinal: 6.0
      lateral: 1.0
      long-lat-angle: 2.5
      yaw-jitter: 1.0
"""


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    file = tmp_path / "scenarios" / "stationary" / "0101.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(THEIRS)
    return file


def test_a_file_of_neuro_ncap_is_read_as_it_is(theirs: Path) -> None:
    (read,) = load_scenarios(theirs.parent.parent)
    assert (read.name, read.scene, read.kind, read.label) == (
        "0101",
        "0101",
        Threat.STATIONARY,
        "stationary-0101",
    )
    assert (read.start_frame, read.priming_frames, read.start_jitter_frames, read.length_s) == (
        20,
        2,
        1,
        10.0,
    )
    (actor,) = read.actors
    assert actor.names == ("1234e5", "0017")
    assert actor.flipped == ("0017",)
    assert actor.way == Polyline((0.0, 20.0), ((550.0, 1542.5, 0.0), (550.0, 1542.5, 0.0)))
    assert actor.yaw_rad == 2.5
    assert actor.jitter == Jitter(2.5, 6.0, 1.0, 1.0)


@pytest.mark.parametrize("number", [0, 1, 7])
def test_runs_are_those_of_neuro_ncap(theirs: Path, number: int) -> None:
    """The draws as its code makes them: the start by one generator, the actor by another of the same seed."""
    (scenario,) = load_scenarios(theirs)
    start = 20 + np.random.default_rng(number).integers(-1, 2)
    rng = np.random.default_rng(number)
    rng.permutation([{"an": "actor"}])
    name = rng.choice(["1234e5", "0017"])
    along, right, turned = rng.uniform(-6.0, 6.0), rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0)
    x = 550.0 + along * math.cos(2.5) + right * math.sin(2.5)
    y = 1542.5 + along * math.sin(2.5) - right * math.cos(2.5)
    run = draw_run(scenario, number)
    assert run.start_frame == start
    (actor,) = run.actors
    assert actor.name == name
    assert np.allclose(actor.way.xyz_m, [[x, y, 0.0]] * 2)
    assert actor.yaw_rad == pytest.approx(2.5 + turned + (math.pi if name == "0017" else 0.0))
    assert run.target is actor


def test_only_one_actor_of_a_group_is_in_a_run() -> None:
    way = Rectilinear((0.0, 0.0, 0.0), 0.0, 0.0, 3.0)
    grouped = [ScenarioActor((name,), way, group="lane") for name in "abc"]
    actors = (*grouped, ScenarioActor(("d",), way))
    scenario = SafetyScenario("x", Threat.SIDE, "scene", 2, 8.0, actors, target=3)
    runs = [draw_run(scenario, number) for number in range(12)]
    assert all(len(run.actors) == 2 and run.target.name == "d" for run in runs)
    assert len({actor.name for run in runs for actor in run.actors}) == 4


def test_a_start_never_lies_before_the_log() -> None:
    actor = ScenarioActor(("a",), Rectilinear((0.0, 0.0, 0.0), 0.0, 0.0))
    scenario = SafetyScenario("x", Threat.SIDE, "scene", 0, 8.0, (actor,), start_jitter_frames=3)
    starts = {draw_run(scenario, number).start_frame for number in range(30)}
    assert starts == {0, 1, 2, 3}


def test_our_files_are_read_as_they_were_written(theirs: Path, tmp_path: Path) -> None:
    crossing = ScenarioActor(
        ("12", "0101"),
        Rectilinear((1.0, 2.0, 0.5), 4.0, 1.5, 5.0),
        flipped=("12",),
        jitter=Jitter(longitudinal_m=2.0, uniform=False),
        group="x",
    )
    ours = SafetyScenario("010", Threat.SIDE, "1e3", 4, 8.0, (crossing,), 2)
    scenarios = (*load_scenarios(theirs), ours)
    save_scenarios(scenarios, tmp_path / "ours.yaml")
    assert load_scenarios(tmp_path / "ours.yaml") == scenarios


def test_a_straight_way_moves_at_its_speed() -> None:
    way = Rectilinear((1.0, 2.0, 3.0), 4.0, 0.5 * math.pi, 5.0).polyline()
    assert way.t_s == (4.0, 5.0)
    assert np.allclose(way.xyz_m, [[1.0, 2.0, 3.0], [1.0, 7.0, 3.0]])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("duration: 10.0", "duration: long", "duration"),
        ("duration: 10.0", "durations: 10.0", "durations"),
        ("duration: 10.0", "duration: 1.0", "too short"),
        ("time-step: 0.5", "time-step: 0.1", "time-step"),
        ('mode: "override"', 'mode: "optimized"', "mode override"),
        ("times: [0.0, 20]", "times: [0.0]", "two points"),
        ("times: [0.0, 20]", "times: [20.0, 0]", "must ascend"),
        ("times: [0.0, 20]", "times: [0.0, inf]", "finite"),
        ("initial-yaw: 2.5", "initial-yaw: nan", "finite"),
        ("lateral: 1.0", "lateral: -1.0", "must not be negative"),
        ("general:", "special:", "not a file of scenarios"),
        ("general:", "general: [", "not YAML"),
    ],
)
def test_a_wrong_entry_is_named_with_its_file(theirs: Path, old: str, new: str, message: str) -> None:
    theirs.write_text(THEIRS.replace(old, new))
    with pytest.raises(InputError, match=message) as raised:
        load_scenarios(theirs)
    assert str(theirs) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_file_outside_of_the_protocol_is_read_by_its_name_alone(theirs: Path) -> None:
    """neuro-ncap's folder has 21 files, one of them for nuScenes' mini set and "not for eval"."""
    mini = theirs.with_name("0061.yaml")
    mini.write_text(THEIRS)
    for folder in (theirs.parent.parent, theirs.parent):
        assert [scenario.label for scenario in load_scenarios(folder)] == ["stationary-0101"]
        assert outside_protocol(folder) == {mini: "stationary-0061"}
    assert [scenario.label for scenario in load_scenarios(mini)] == ["stationary-0061"]
    assert outside_protocol(mini) == {}


def test_a_folder_tells_the_kind_and_names_are_unique(theirs: Path, tmp_path: Path) -> None:
    strange = tmp_path / "0102.yaml"
    strange.write_text(THEIRS)
    with pytest.raises(InputError, match="name of its folder"):
        load_scenarios(strange)
    with pytest.raises(InputError, match="cannot be read"):
        load_scenarios(tmp_path / "none.yaml")
    twice = theirs.parent.parent / "more" / "stationary" / "0101.yaml"
    twice.parent.mkdir(parents=True)
    twice.write_text(THEIRS)
    with pytest.raises(InputError, match="stationary-0101"):
        load_scenarios(theirs.parent.parent)
