"""Test whether a reconstructed world predicts the real one: `foredrive bench ncap-transfer`, hours.

The same safety tests are driven in a town and in the reconstruction of a recorded drive there. Actors and
traffic replay in both, so that they differ in what the sensors show alone. Each agent drives each test once
in each world, and sees its own cameras or the lidar. Each agent has a twin with bad sensors, equally bad in
both worlds, so that outcomes are mixed.
A test is a kind, a place, and the time and speed at which the actor comes (`APPROACHES`).

Arms are of single towns (their drives are made there), of all towns, of single kinds, of single agents, and
of the same tests in Gaussians and in a field.
Drives are kept in runs/ncap_transfer, so that an interrupted arm goes on with the next drive.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.reconstructed_towns import TownDrive
from benchmarks.common.safety_agreement import agreement
from benchmarks.common.safety_pairs import Pair, PairedAgent, PairedTests, SensorNoise
from benchmarks.common.safety_suites import DRIVES, FIELD, RECIPE, RECONSTRUCTION, reconstructed_town, spread
from foredrive.driving.ncap.proposing import Approach, propose
from foredrive.driving.ncap.rules import OURS
from foredrive.driving.ncap.scenario import SafetyScenario
from foredrive.driving.ncap.scenario_file import load_scenarios, save_scenarios
from foredrive.driving.ncap.self_test import self_test
from foredrive.driving.replay.threats import Threat
from foredrive.runs.drive.in_ncap import place_in
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe
from foredrive.sensors.rigs import FRONT_TELE, SURROUND, RigPlan

APPROACHES = {
    Threat.STATIONARY: (Approach(2.0), Approach(3.0), Approach(4.0)),
    Threat.FRONTAL: (Approach(2.0, 2.0), Approach(3.0, 2.0), Approach(4.0, 2.0)),
    Threat.SIDE: (Approach(2.0, 3.0), Approach(3.0, 3.0), Approach(4.0, 3.0)),
}
PLACES = 3
"""Largest number of places for each kind and approach in a town."""
ONE = RigPlan(SURROUND.image_hw, {"PCAM_F0": SURROUND.cameras["PCAM_F0"]})
DARK_IMAGES, SPARSE_SWEEPS = SensorNoise(gain=0.2, pixel_std=5.0), SensorNoise(lost_beams=0.99)
AGENTS = {
    "nemo": PairedAgent("embedded:nemo_town", SURROUND),
    "nemo_dark": PairedAgent("embedded:nemo_town", SURROUND, noise=DARK_IMAGES),
    "driver": PairedAgent("embedded", FRONT_TELE),
    "driver_dark": PairedAgent("embedded", FRONT_TELE, noise=DARK_IMAGES),
    "idm": PairedAgent("idm:embedded", FRONT_TELE),
    "idm_dark": PairedAgent("idm:embedded", FRONT_TELE, noise=DARK_IMAGES),
    "corridor": PairedAgent("lidar-corridor", ONE, lidar=True),
    "corridor_sparse": PairedAgent("lidar-corridor", ONE, lidar=True, noise=SPARSE_SWEEPS),
}
WORLDS: dict[str, ReconstructionRecipe[Any]] = {"gaussians": RECIPE, "field": FIELD}
IN_FIELD = tuple(name for name in AGENTS if not name.startswith("nemo"))
"""Agents that drive in a field too. Six cameras of a field take a minute for each drive."""
CONFIG = {
    "rebuilding": RECONSTRUCTION,
    "approaches": {kind.value: [dataclasses.asdict(a) for a in of] for kind, of in APPROACHES.items()},
    "places": PLACES,
    "agents": {name: dataclasses.asdict(agent) for name, agent in AGENTS.items()},
}
DECIDED_BY = (
    "benchmarks.common.safety_pairs",
    "benchmarks.common.safety_suites",
    "foredrive.methods.reconstruction",
    "foredrive.driving.collisions",
    "foredrive.driving.controller",
    "foredrive.driving.dynamics",
    "foredrive.driving.ncap",
    "foredrive.driving.replay.reconstructed",
    "benchmarks.common.town_replay",
    "foredrive.methods.splatad",
    "foredrive.methods.neurad",
)
WORK = Path("runs/ncap_transfer") / study_identity(CONFIG, DECIDED_BY)


@functools.lru_cache(maxsize=1)
def tests_in(town: str, world: str) -> PairedTests:
    """Return the paired tests of one town and one of `WORLDS`; the next ones replace them."""
    drive = next(drive for drive in DRIVES if drive.town == town)
    return PairedTests(drive, reconstructed_town(drive, WORLDS[world]))


def scenarios_of(drive: TownDrive) -> list[SafetyScenario]:
    """Return the tests in a town, those that pass the self-test; find them if their file is missing."""
    file = WORK / "scenarios" / f"{drive.town}.yaml"
    if not file.is_file():
        place, chosen = place_in(str(reconstructed_town(drive))), list[SafetyScenario]()
        for kind, approaches in APPROACHES.items():
            for approach in approaches:
                proposals = [one for one in propose(place, drive.town, approach) if one.kind is kind]
                passed = self_test(proposals, lambda _: place, 1, OURS).passed
                suffix = f"_{approach.impact_s:g}s_{approach.actor_mps:g}mps"
                chosen += [dataclasses.replace(one, name=one.name + suffix) for one in spread(passed, PLACES)]
        file.parent.mkdir(parents=True, exist_ok=True)
        save_scenarios(chosen, file)
    return list(load_scenarios(file))


def pairs_in(drive: TownDrive, world: str = "gaussians", agents: Sequence[str] = tuple(AGENTS)) -> list[Pair]:
    """Return the pairs of some agents in a town; drive those that are missing."""
    pairs, scenarios = [], scenarios_of(drive)
    for number, scenario in enumerate(scenarios):
        for name in agents:
            agent, file = AGENTS[name], Path(name) / drive.town / f"{scenario.label}.json"
            if not all((WORK / of / file).is_file() for of in ("town", world)):
                print(f"{drive.town}: test {number + 1} of {len(scenarios)}, {name}", flush=True)
            tests = tests_in(drive.town, world)
            town = tests.in_town(agent, scenario, WORK / "town" / file)
            reconstructed = tests.reconstructed(agent, scenario, WORK / world / file)
            test = f"{drive.town}/{scenario.label}"
            pairs.append(Pair(scenario.kind.value, name, test, town, reconstructed))
    return pairs


def transfer(
    drives: tuple[TownDrive, ...], kind: Threat | None, agent: str | None, _: int
) -> dict[str, float]:
    """Return the agreement of the pairs in some towns, of one kind and one agent or of all."""
    pairs = [pair for drive in drives for pair in pairs_in(drive)]
    return agreement(
        [
            pair
            for pair in pairs
            if (kind is None or pair.kind == kind.value) and (agent is None or pair.agent == agent)
        ]
    )


def by_world(world: str, _: int) -> dict[str, float]:
    """Return the agreement of the pairs in the first town, of the agents that drive in a field too."""
    return agreement(pairs_in(DRIVES[0], world, IN_FIELD))


BENCHMARK = Benchmark(
    question="Does a safety test in a reconstructed world predict the same test in the real one?",
    arms={
        **{drive.town: functools.partial(transfer, (drive,), None, None) for drive in DRIVES},
        "all": functools.partial(transfer, DRIVES, None, None),
        **{kind.value: functools.partial(transfer, DRIVES, kind, None) for kind in Threat},
        **{agent: functools.partial(transfer, DRIVES, None, agent) for agent in AGENTS},
        **{f"in_{world}": functools.partial(by_world, world) for world in WORLDS},
    },
    seeds=(0,),
    config=CONFIG,
    decided_by=DECIDED_BY,
)
