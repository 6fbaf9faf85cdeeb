"""Safety tests in rebuilt towns: the recorded drives, their rebuilds, and scenarios chosen from proposals."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.rebuilt_towns import TownDrive
from foredrive.errors import InputError
from foredrive.recipes.rebuilding import RebuildRecipe
from foredrive.runs.drive.in_ncap import SafetyTests, propose_scenarios
from foredrive.runs.drive.records import tested_runs
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.rebuild.reconstruct import reconstruct
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.simulation.drive_record import DriveRecord
from foredrive.simulation.ncap.aggregation import SafetyFigures, aggregate
from foredrive.simulation.ncap.scenario import SafetyScenario
from foredrive.simulation.ncap.scenario_file import load_scenarios, save_scenarios
from foredrive.simulation.threats import Threat

CAMERAS = ("PCAM_F0", "PCAM_L0", "PCAM_R0", "PCAM_L1", "PCAM_R1", "PCAM_B0")


@dataclass(frozen=True)
class SuiteSize:
    """Sizes of a benchmark of safety tests in one rebuilt town."""

    recipe: RebuildRecipe[Any]
    starts: int = 4
    """Largest number of scenarios of each kind."""
    runs: int = 10
    """Number of runs of each scenario."""


def safety_drive(town: str, seed: int, seconds: float = 20.0) -> TownDrive:
    """Return a drive to rebuild: six cameras of 160 by 96 px and a lidar of 32 channels, at 10 Hz."""
    traffic = BackgroundTraffic(vehicles=40, pedestrians=20)
    return TownDrive(
        town, seed, seconds, background_traffic=traffic, cameras=CAMERAS, image_hw=(96, 160), lidar="hdl32e"
    )


def rebuilt_town(drive: TownDrive, size: SuiteSize, work: Path) -> Path:
    """Return the folder of the rebuild of a drive; record and rebuild what is missing."""
    folder = work / "rebuilt" / drive.town
    recipe = dataclasses.replace(size.recipe, cameras=drive.cameras, image_hw=drive.image_hw)
    reconstruct(recipe, drive.recorded(work / "towns"), folder, work / "cache")
    return folder


def chosen_scenarios(rebuilt: Path, size: SuiteSize) -> Path:
    """Return the file of scenarios of a rebuild: of each kind some proposals, spread over the log.

    Raises:
        InputError: no scenario is feasible.
    """
    file = rebuilt.with_name(f"{rebuilt.name}_scenarios.yaml")
    if not file.is_file():
        proposed = file.with_name(f"{rebuilt.name}_proposed.yaml")
        if not proposed.is_file():
            propose_scenarios((str(rebuilt),), proposed, "ours", size.runs)
        found = load_scenarios(proposed)
        kept = [each for kind in Threat for each in spread([s for s in found if s.kind is kind], size.starts)]
        save_scenarios(kept, file)
    return file


def spread(scenarios: Sequence[SafetyScenario], count: int) -> list[SafetyScenario]:
    """Return at most `count` scenarios at equal distances in the list, the first and the last among them."""
    if len(scenarios) <= count:
        return list(scenarios)
    return [scenarios[index] for index in np.linspace(0, len(scenarios) - 1, count).round().astype(int)]


def driven_suite(
    agent: str, rules: str, rebuilt: Path, size: SuiteSize, out: Path, workers: int
) -> dict[str, float]:
    """Drive the suite of a rebuild that is missing; return its figures.

    Raises:
        InputError: no scenario is feasible, or a drive broke off.
    """
    source = SafetyTests((str(rebuilt),), str(chosen_scenarios(rebuilt, size)), rules, size.runs, workers > 1)
    driven = drive_suite(DriveSuite(agent, source), out, workers)
    if driven.broken:
        job, why = next(iter(driven.broken.items()))
        raise InputError(f"{len(driven.broken)} drives broke off, {job.name}: {why}")
    return suite_figures(list(driven.drives.values()), workers)


def suite_figures(drives: Sequence[DriveRecord], workers: int) -> dict[str, float]:
    """Return the figures of a suite: of all kinds, and of each with its name at the end.

    `suite_minutes` is the time of all drives, sensors and planning included, by the number that were driven
    at the same time.
    """
    scenarios, kinds, overall = aggregate(tested_runs(drives))
    figures = {
        "suite_minutes": sum(drive.wall_s for drive in drives) / workers / 60,
        "scenarios": float(len(scenarios)),
        **_of(overall, ""),
    }
    for kind, of in kinds.items():
        figures |= _of(of, f"_{kind}")
    return figures


def _of(figures: SafetyFigures, end: str) -> dict[str, float]:
    values: Mapping[str, float | None] = {
        "runs": figures.runs,
        "failed": figures.failed,
        "left_way": figures.left_way,
        "stopped_short": figures.stopped_short,
        "score": None if figures.score is None else figures.score.mean,
        "score_low": None if figures.score is None else figures.score.low,
        "score_high": None if figures.score is None else figures.score.high,
        "collision_rate": None if figures.collision_rate is None else figures.collision_rate.mean,
        "progress": figures.progress,
        "score_progress": figures.score_progress,
        "relative_impact_speed": figures.relative_impact_speed,
    }
    return {f"{key}{end}": float(value) for key, value in values.items() if value is not None}
