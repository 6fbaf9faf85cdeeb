"""Safety tests after NeuroNCAP in reconstructed logs, as a source of drives."""

import contextlib
import dataclasses
import functools
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from foredrive.data.boxes import read_track_ids
from foredrive.data.logs import Log
from foredrive.driving.drive import Drive
from foredrive.driving.ncap.drawing import draw_run
from foredrive.driving.ncap.hd import hd_score_of
from foredrive.driving.ncap.outcome import SafetyResult, judge
from foredrive.driving.ncap.placing import place_actors
from foredrive.driving.ncap.proposing import propose_kinds
from foredrive.driving.ncap.rules import RULES, Rules
from foredrive.driving.ncap.running import Place, SafetyRun, set_up_run
from foredrive.driving.ncap.scenario import Polyline, SafetyScenario
from foredrive.driving.ncap.scenario_file import load_scenarios, outside_protocol, save_scenarios
from foredrive.driving.ncap.self_test import SelfTest, run_reference, self_test
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.errors import InputError
from foredrive.files import digest_of
from foredrive.methods.reconstruction.renderer import ReconstructedRenderer
from foredrive.runs.drive.agent_inputs import check_seeing
from foredrive.runs.drive.agents import Sees, is_remote
from foredrive.runs.drive.drive_setup import DriveSetup
from foredrive.runs.drive.in_reconstruction import (
    agent_in,
    check_lidar_of,
    lanes_of,
    opened_reconstruction,
    opened_trust,
    past_frames_of,
    renders_for,
    shown_vehicle,
)
from foredrive.runs.drive.suite import ROUTES_SHA256, DriveJob, DriveSuite
from foredrive.runs.reconstruction.reconstruction_run import open_run_log
from foredrive.runs.shipped import run_files
from foredrive.towns.driving.drive_log import drive_log, log_frame

BEFORE_S = (2.0, 1.0)
"""Times before the impact at which the images of a proposed scenario have to be trusted, s. Nearer, a vehicle
in the way would fill them."""


@dataclass(frozen=True)
class SafetyTests:
    """A `DriveSource` of safety tests: a number of runs of each scenario that passes the self-test."""

    runs: tuple[str, ...]
    """Folders of the reconstructions; a scenario's scene is the name of a folder or of its log."""
    scenarios: str
    """File or folder of scenarios."""
    rules: str = "ours"
    count: int = 10
    """Number of runs of each scenario."""
    spread: bool = False
    """Whether several processes drive. Each of them opens the scenes."""
    sees: Sees | None = None
    """What the agent is shown of what it takes; None: all."""
    stay_trusted: bool = False
    """If True, a run ends, without a score, where the images are no longer trusted."""

    grows = ("count",)

    @property
    def in_turn(self) -> bool:
        """Return whether drives run one after another in this process."""
        return not self.spread

    def noted(self) -> Mapping[str, object]:
        """Return the fields, a hash of the scenarios, and their path as the routes."""
        scenarios = repr(load_scenarios(Path(self.scenarios)))
        shown: dict[str, object] = {} if self.sees is None else {"sees": self.sees}
        if self.stay_trusted:
            shown["stay_trusted"] = True
        return {
            **shown,
            "scenarios_sha256": hashlib.sha256(scenarios.encode()).hexdigest(),
            "runs": list(self.runs),
            "scenarios": self.scenarios,
            "rules": self.rules,
            "count": self.count,
            "routes": self.scenarios,
            ROUTES_SHA256: digest_of(file for run in self.runs for file in run_files(Path(run))),
        }

    def jobs(self, agent: str) -> Sequence[DriveJob]:
        """Return the runs of all scenarios that pass the self-test."""
        past_frames_of(agent)
        check_seeing(agent, self.sees)
        jobs = [
            DriveJob(f"{scenario.label}_rep{number}", scenario.label, number)
            for scenario in self.tested().passed
            for number in range(self.count)
        ]
        if not jobs:
            raise InputError(f"{self.scenarios}: no scenario passes the self-test: {self.tested().reasons}")
        return jobs

    def tested(self) -> SelfTest:
        """Return the result of the self-test. It is run once in a process."""
        return _tested(self)

    @contextlib.contextmanager
    def set_up(self, job: DriveJob, suite: DriveSuite, out: Path) -> Iterator[DriveSetup]:
        """Set up a run in the reconstructed scene."""
        rules = _rules(self.rules)
        scenario = next(entry for entry in load_scenarios(Path(self.scenarios)) if entry.label == job.route)
        folder = _folders(self.runs)[scenario.scene]
        sensors = renders_for(suite) or self.stay_trusted
        place = place_in(folder, trusted=sensors, required=self.stay_trusted, agent=suite.agent)
        check_lidar_of(suite.agent, self.sees, place.vehicle, folder)
        run = set_up_run(
            place,
            scenario,
            job.repetition,
            rules,
            sensors=sensors,
            past_frames=_past_frames(suite.agent, scenario),
            stay_trusted=self.stay_trusted,
        )
        simulator, start = run.simulator, run.scenario
        rig = simulator.renderer.rig if sensors else None
        route_xyz = simulator.drive.route_from(start.start_s)
        reference = run_reference(place, scenario, job.repetition, rules)
        with drive_log(out, job.name, route_xyz, rig) as log:
            yield DriveSetup(
                simulator,
                start,
                agent_in(suite.agent, simulator, self.sees),
                route_xyz,
                simulator.way_m(start),
                log,
                lambda: log_frame(simulator.state.frames[-1], simulator.state.ego, rig),
                lanes_known=lanes_of(Path(folder)) is not None,
                trusted_share=lambda: simulator.trusted_share,
                judge=lambda driven: _judged(driven, scenario, reference, rules, run, place),
                pilot=run.pilot,
            )


def _judged(
    driven: Drive, scenario: SafetyScenario, reference_mps: float, rules: Rules, run: SafetyRun, place: Place
) -> SafetyResult:
    """Return the result of a drive, with its HD-Score if the lanes are known."""
    result = judge(scenario.kind, driven, reference_mps, rules.left_way_score)
    if place.lanes is None or result.score is None:
        return result
    judged = hd_score_of(
        driven,
        run.simulator.tracks,
        place.vehicle.T_world_scene,
        run.scenario.start_s,
        place.lanes.area,
    )
    return dataclasses.replace(result, hd_score=None if judged is None else judged.hd_score)


def propose_scenarios(
    runs: Sequence[str], file: Path, rules: str, count: int, *, trusted: bool = True
) -> SelfTest:
    """Find the feasible scenarios of reconstructions; write those that pass the self-test to a file.

    Args:
        runs: folders of the reconstructions.
        file: file to write.
        rules: name of the rules.
        count: number of runs of each scenario that have to pass.
        trusted: leave a scenario out where the images of a vehicle that takes no action are not trusted
            shortly before the impact. Of a reconstruction without cameras, this is not known.

    Returns:
        The result of the self-test, and what is left out for want of trust.

    Raises:
        InputError: the file exists, two folders have one name, or no scenario is feasible.
    """
    if file.exists():
        raise InputError(f"{file}: exists already; proposed scenarios are written to a new file")
    places = _by_name(runs)
    proposals = [
        proposal for scene, run in places.items() for proposal in propose_kinds(place_in(run), scene)
    ]
    if not proposals:
        raise InputError("no scenario is feasible in these logs: they are too short, too slow or too full")
    tested = self_test(proposals, lambda scenario: place_in(places[scenario.scene]), count, _rules(rules))
    if not tested.passed:
        raise InputError(f"no scenario passes the self-test: {tested.reasons}")
    passed, left_out = list[SafetyScenario](), dict(tested.left_out)
    for scenario in tested.passed:
        place = place_in(places[scenario.scene], trusted=trusted)
        untrusted_s = _untrusted_s(place, scenario) if trusted else None
        if untrusted_s is None:
            passed.append(scenario)
        else:
            left_out[scenario.label] = f"its images {untrusted_s:g} s before the impact are not trusted"
    tested = SelfTest(tuple(passed), left_out)
    if not passed:
        raise InputError(f"no scenario is where images are trusted: {tested.reasons}")
    save_scenarios(passed, file)
    return tested


def _untrusted_s(place: Place, scenario: SafetyScenario) -> float | None:
    """Return the time before the impact at which the images of a proposal are not trusted; None if all are.

    They are those of its first run, along the logged path.
    """
    drawn, drive = draw_run(scenario, 0), LoggedDrive(place.vehicle, torch.eye(4))
    renderer = place.renderer(
        place_actors(place.graph, drawn, place.vehicle.T_world_scene, place.track_ids, moving_stay=True)
    )
    way = scenario.actors[0].way
    # Proposed ways end, or pass the path, at the impact
    impact_s = way.t_s[-1] if isinstance(way, Polyline) else way.at_s
    for before_s in BEFORE_S:
        at_s = impact_s - before_s
        seen = renderer.render(torch.from_numpy(drive.pose_at(at_s)), torch.zeros(6), at_s)
        if seen.trusted is False:
            return before_s
    return None


def _past_frames(agent: str, scenario: SafetyScenario) -> int:
    """Return the number of earlier key frames that an agent observes; a remote one observes the priming."""
    return scenario.priming_frames if is_remote(agent) else past_frames_of(agent)


def _rules(name: str) -> Rules:
    if name not in RULES:
        raise InputError(f"there are no rules {name!r}; there are: {', '.join(RULES)}")
    return RULES[name]


def _by_name(runs: Sequence[str]) -> dict[str, str]:
    """Return the folder of each run by its name.

    Raises:
        InputError: two folders have one name.
    """
    folders: dict[str, str] = {}
    for run in runs:
        if folders.setdefault(Path(run).name, run) != run:
            raise InputError(f"two reconstructions have the name {Path(run).name!r}, so a scene is ambiguous")
    return folders


def _folders(runs: Sequence[str]) -> dict[str, str]:
    """Return the folder of each run by its own name, and by the name of its log if no other run has it.

    Raises:
        InputError: two folders have one name.
    """
    by_log: dict[str, list[str]] = {}
    for run in runs:
        with contextlib.suppress(InputError):
            by_log.setdefault(open_run_log(Path(run))[1].folder.name, []).append(run)
    return {log: of_log[0] for log, of_log in by_log.items() if len(of_log) == 1} | _by_name(runs)


@functools.lru_cache(maxsize=2)
def _tested(source: SafetyTests) -> SelfTest:
    rules, folders = _rules(source.rules), _folders(source.runs)

    def place_of(scenario: SafetyScenario) -> Place:
        if scenario.scene not in folders:
            raise InputError(
                f"its scene {scenario.scene!r} names no reconstruction, or several ({', '.join(folders)})"
            )
        return place_in(folders[scenario.scene])

    file = Path(source.scenarios)
    tested = self_test(load_scenarios(file), place_of, source.count, rules)
    outside = {
        label: f"not one of the scenarios of neuro-ncap's protocol; to drive it, name its file {path}"
        for path, label in outside_protocol(file).items()
    }
    return dataclasses.replace(tested, left_out={**tested.left_out, **outside})


@functools.lru_cache(maxsize=2)  # consecutive runs share one scene
def place_in(folder: str, trusted: bool = False, required: bool = False, agent: str | None = None) -> Place:
    """Return a reconstruction as a place of tests.

    Args:
        folder: of the reconstruction.
        trusted: whether its renderers say which frames they trust; without cameras they do not.
        required: raise an error where they cannot say it.
        agent: its cameras are rendered, see `shown_vehicle`; None: those of the log.
    """
    shown = opened_reconstruction(folder).vehicle if agent is None else shown_vehicle(folder, agent)
    opened = opened_reconstruction(folder)
    trust = opened_trust(folder, required) if trusted else None
    ids = {str(track_id): track_id for track_id in opened.scene.graph.all_tracks.track_id.tolist()}
    with contextlib.suppress(InputError):  # without its log, actors are known by their numbers alone
        of_log = read_track_ids(Log(open_run_log(Path(folder))[1]))
        ids |= {token: track_id for token, track_id in of_log.items() if track_id in set(ids.values())}
    return Place(
        opened.scene.graph,
        opened.vehicle,
        lambda graph: ReconstructedRenderer(opened.scene, graph, shown, trust),
        ids,
        lanes_of(Path(folder)),
    )
