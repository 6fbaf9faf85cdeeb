"""Safety tests in reconstructed towns: recorded drives, reconstructions, scenarios chosen from proposals."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.benchmark import study_identity
from benchmarks.common.reconstructed_towns import TownDrive
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.ncap.aggregation import SafetyFigures, aggregate
from foredrive.driving.ncap.scenario import SafetyScenario
from foredrive.driving.ncap.scenario_file import load_scenarios, save_scenarios
from foredrive.driving.replay.threats import Threat
from foredrive.errors import InputError
from foredrive.runs.drive.in_ncap import SafetyTests, propose_scenarios
from foredrive.runs.drive.records import tested_runs
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe, field_tiny, gaussians_small
from foredrive.runs.reconstruction.reconstruct import reconstruct
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.sensors.rigs import FRONT_TELE, SURROUND, TELE, RigPlan

RIG = RigPlan(SURROUND.image_hw, {**SURROUND.cameras, TELE: FRONT_TELE.cameras[TELE]})
"""NeMo's six cameras, and the narrow one of the driver."""


@dataclass(frozen=True)
class SuiteSize:
    """Sizes of a benchmark of safety tests in one reconstructed town."""

    starts: int = 4
    """Largest number of scenarios of each kind."""
    runs: int = 10
    """Number of runs of each scenario."""


def safety_drive(town: str, seed: int, seconds: float = 20.0) -> TownDrive:
    """Return a drive to reconstruct: seven cameras of 256 by 144 px and a lidar of 32 channels, at 10 Hz."""
    traffic = BackgroundTraffic(vehicles=40, pedestrians=20)
    return TownDrive(town, seed, seconds, background_traffic=traffic, rig=RIG, lidar="hdl32e")


DRIVES = tuple(safety_drive(town, seed) for town, seed in (("Town10HD", 3), ("Town03", 4), ("Town05", 5)))
"""The drives that benchmarks of safety tests reconstruct."""
RECIPE = dataclasses.replace(gaussians_small(), cameras=tuple(RIG.cameras), image_hw=RIG.image_hw)
FIELD = dataclasses.replace(field_tiny(), cameras=RECIPE.cameras, image_hw=RECIPE.image_hw)
RECONSTRUCTION = {
    "drives": [dataclasses.asdict(drive) for drive in DRIVES],
    "recipe": dataclasses.asdict(RECIPE),
    "field": dataclasses.asdict(FIELD),
}
WORK = Path("runs/safety_rebuilds") / study_identity(
    RECONSTRUCTION,
    (
        "foredrive.methods.reconstruction",
        "foredrive.methods.splatad",
        "foredrive.methods.neurad",
    ),
)


def reconstructed_town(drive: TownDrive, recipe: ReconstructionRecipe[Any] = RECIPE) -> Path:
    """Return the folder of the reconstruction of a drive; record and reconstruct what is missing."""
    folder = WORK / ("rebuilt" if recipe is RECIPE else recipe.name) / drive.town
    reconstruct(recipe, drive.recorded(WORK / "towns"), folder, WORK / "cache")
    return folder


def chosen_scenarios(reconstructed: Path, size: SuiteSize, work: Path) -> Path:
    """Return the file of scenarios of a reconstruction: of each kind some proposals, spread over the log.

    Raises:
        InputError: no scenario is feasible.
    """
    file = work / "scenarios" / f"{reconstructed.name}.yaml"
    if not file.is_file():
        proposed = file.with_name(f"{reconstructed.name}_proposed.yaml")
        if not proposed.is_file():
            file.parent.mkdir(parents=True, exist_ok=True)
            # All kinds: the fronts of copied cars were often never seen, so their images are not trusted
            propose_scenarios((str(reconstructed),), proposed, "ours", size.runs, trusted=False)
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
    agent: str, rules: str, reconstructed: Path, size: SuiteSize, work: Path, arm: str, workers: int
) -> dict[str, float]:
    """Drive what is missing of the suite of a reconstruction; return its figures.

    Args:
        work: folder of the study.
        arm: name of its folder of drives.

    Raises:
        InputError: no scenario is feasible, or a drive broke off.
    """
    scenarios = chosen_scenarios(reconstructed, size, work)
    source = SafetyTests((str(reconstructed),), str(scenarios), rules, size.runs, workers > 1)
    driven = drive_suite(DriveSuite(agent, source, sensors=False), work / arm / reconstructed.name, workers)
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
