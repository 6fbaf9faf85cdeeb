"""`foredrive ncap`."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, check_number, check_out_folder, check_reconstruction
from foredrive.cli.drive import DrivesProgress, check_driven
from foredrive.errors import InputError
from foredrive.lazy import importing
from foredrive.runs.drive.agents import absolute_name


def ncap(
    reconstructed: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="RECONSTRUCTED [RECONSTRUCTED ...]", help_behavior_hint="(required)"),
    ],
    scenarios: Path,
    agent: Annotated[str | None, tyro.conf.arg(metavar="RUN|constant-velocity|stop|log|…")] = None,
    out: OptionalPath = None,
    runs: int = 10,
    rules: Literal["paper", "released", "ours"] = "ours",
    sensors: bool = True,
    films: int = 6,
    propose: bool = False,
    sees: Literal["camera", "lidar", "both"] | None = None,
    stay_trusted: bool = False,
    workers: int = 1,
    ray: bool = False,
) -> None:
    """Test an agent in safety-critical scenarios in reconstructed logs, after NeuroNCAP.

    Each run puts a vehicle in the way: it stands, comes head-on or crosses. Scenarios in which a vehicle that
    takes no action does not crash in every run are named and left out. Finished runs are kept and not driven
    again. docs/safety-tests.md compares the rules.

    Args:
        reconstructed: Folders of reconstructions. A scenario's scene is the name of a folder or of its log.
        scenarios: File or folder of scenarios, ours or neuro-ncap's. With --propose: file to write.
        agent: As for `foredrive drive --in`; lidar-corridor stops if lidar sees something in its corridor.
            Required without --propose.
        out: Folder of the suite: summary.json, report.html, drives, logs. Required without --propose.
        runs: Number of runs of each scenario; a later call may ask for more.
        rules: Rules of the paper, of its released code, or ours.
        sensors: Render cameras and lidar even if the agent does not need them.
        films: Number of films in the report: of the runs with the lowest scores.
        propose: Find feasible scenarios in the logs and write them to the file, and a picture of each beside
            it, instead of testing an agent.
        sees: Show the agent only its cameras, only its lidar, or both; by default all that it takes, and a
            planner at http://HOST:PORT its cameras.
        stay_trusted: End a run, without a score, where the reconstruction no longer expects good images.
        workers: Number of runs at a time. Each worker process opens the reconstructions.
        ray: Drive on Ray: on the cluster at RAY_ADDRESS, or on a cluster that is started here.
    """
    check_out_folder(out)
    check_number("--runs", runs, low=1)
    check_number("--films", films, low=0)
    check_number("--workers", workers, low=1)
    if not reconstructed:
        raise InputError("name at least one reconstruction (RECONSTRUCTED)")
    for folder in reconstructed:
        check_reconstruction(folder)
    folders = tuple(str(folder.absolute()) for folder in reconstructed)
    if propose:
        _propose(folders, scenarios, rules, runs)
        return
    if agent is None or out is None:
        raise InputError("a test needs --agent and --out; --propose needs neither")
    with importing():
        from rich.console import Console

        from foredrive.driving.ncap.rules import RULES
        from foredrive.runs.drive.in_ncap import SafetyTests
        from foredrive.runs.drive.records import tested_runs
        from foredrive.runs.drive.suite import DriveSuite, SuiteResult, drive_suite
        from foredrive.view.drive_report import REPORT, write_drive_report
        from foredrive.view.ncap_tables import safety_table
        from foredrive.view.table import Table, print_table

    name = absolute_name(agent)
    source = SafetyTests(
        folders,
        str(scenarios.absolute()),
        rules,
        runs,
        spread=ray or workers > 1,
        sees=sees,
        stay_trusted=stay_trusted,
    )
    suite = DriveSuite(name, source, sensors, latency_s=RULES[rules].latency_s)

    # One table for the report and the screen, with the scenarios that the self-test has left out
    def table(driven: SuiteResult) -> Table:
        return safety_table(tested_runs(list(driven.drives.values())), source.tested().left_out)

    with DrivesProgress(len(suite.jobs())) as progress:
        driven = drive_suite(
            suite,
            out,
            workers,
            on_ray=ray,
            tick=progress.tick,
            report=lambda driven: write_drive_report(out, films, table(driven)),
            tried=lambda text: print(f"{name} was {text}", flush=True),
        )
    check_driven(driven)
    print_table(table(driven), Console())
    print(f"report: {out / REPORT}")


def _propose(folders: tuple[str, ...], file: Path, rules: str, runs: int) -> None:
    """Write proposed scenarios and print their names."""
    with importing():
        from foredrive.runs.drive.in_ncap import place_in, propose_scenarios
        from foredrive.view.ncap_pictures import write_scenario_picture

    tested = propose_scenarios(folders, file, rules, runs)
    scenes, pictures = {Path(folder).name: folder for folder in folders}, file.with_suffix("")
    for scenario in tested.passed:
        write_scenario_picture(pictures / f"{scenario.label}.png", place_in(scenes[scenario.scene]), scenario)
        print(f"{scenario.label}: {scenario.length_s:g} s from key frame {scenario.start_frame}")
    for label, why in tested.left_out.items():
        print(f"left out, {label}: {why}")
    print(f"{len(tested.passed)} scenarios: {file}; a picture of each: {pictures}")
