"""Test whether a reconstructed world predicts the real one: `foredrive bench ncap-transfer`, hours.

The same safety tests are driven in a town and in the reconstruction of a recorded drive there. Actors and
traffic replay in both, so that they differ in what the sensors show alone. Each agent that looks at its
sensors drives each test once in each world. `collision_agreement` is the share of the pairs in which both
or neither end in a collision, and `score_correlation` is that of the scores (Pearson). Arms are
AGENT_KIND@TOWN; without a kind or a town they are over all, and `all` is both agents. They tell where it
breaks.

Pairs are kept in runs/ncap_transfer, so that an interrupted arm goes on with the next pair.
"""

import dataclasses
import functools
from pathlib import Path

from benchmarks.common.reconstructed_towns import TownDrive
from benchmarks.common.safety_pairs import Pair, PairedTests, agreement
from benchmarks.common.safety_suites import (
    DRIVES,
    RECONSTRUCTION,
    SuiteSize,
    chosen_scenarios,
    reconstructed_town,
)
from foredrive.driving.ncap.scenario_file import load_scenarios
from foredrive.driving.replay.threats import Threat
from foredrive.engine.bench import Benchmark, study_identity

SIZE = SuiteSize(runs=3)
"""3 towns x 3 kinds x 4 starts x 3 runs: 108 pairs of each agent, if all kinds are feasible four times."""
AGENTS = {"nemo_cameras": "embedded:nemo_town", "corridor_lidar": "lidar-corridor"}
CONFIG = {
    "rebuilding": RECONSTRUCTION,
    "size": dataclasses.asdict(SIZE),
    "agents": AGENTS,
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
    "foredrive.towns.driving.town_replay",
    "foredrive.methods.splatad.training",
)
WORK = Path("runs/ncap_transfer") / study_identity(CONFIG, DECIDED_BY)


@functools.lru_cache(maxsize=1)
def tests_in(drive: TownDrive) -> PairedTests:
    """Return the paired tests of one town; the next town replaces it."""
    return PairedTests(drive, reconstructed_town(drive))


def pairs_of(agent: str, drive: TownDrive) -> list[Pair]:
    """Return the pairs of an agent in a town; drive those that are missing."""
    return [
        tests_in(drive).pair(
            AGENTS[agent], scenario, number, WORK / agent / drive.town / f"{scenario.label}_rep{number}.json"
        )
        for scenario in load_scenarios(chosen_scenarios(reconstructed_town(drive), SIZE, WORK))
        for number in range(SIZE.runs)
    ]


def transfer(
    agents: tuple[str, ...], drives: tuple[TownDrive, ...], kind: Threat | None, _: int
) -> dict[str, float]:
    """Return the agreement of the pairs of some agents in some towns, of one kind or of all."""
    pairs = [pair for drive in drives for agent in agents for pair in pairs_of(agent, drive)]
    return agreement([pair for pair in pairs if kind is None or pair.kind == kind.value])


EVERYONE = {"all": tuple(AGENTS), **{agent: (agent,) for agent in AGENTS}}
EVERYWHERE = {"": DRIVES, **{f"@{drive.town}": (drive,) for drive in DRIVES}}
BENCHMARK = Benchmark(
    question="Does a safety test in a reconstructed world predict the same test in the real one?",
    arms={
        f"{who}{of_kind}{where}": functools.partial(transfer, agents, drives, kind)
        for where, drives in EVERYWHERE.items()
        for who, agents in EVERYONE.items()
        for of_kind, kind in {"": None, **{f"_{kind}": kind for kind in Threat}}.items()
    },
    seeds=(0,),
    config=CONFIG,
    decided_by=DECIDED_BY,
)
