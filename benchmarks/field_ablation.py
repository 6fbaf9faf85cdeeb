"""Measure what the parts of a neural field are worth, as NeuRAD's ablation: `foredrive bench field-ablation`.

PandaSet 002 (raw, in FOREDRIVE_REAL_DATA/pandaset), front camera and lidar, every second frame held out. All
arms train `field_tiny` for 1500 of its 12,000 steps, with the whole decay of the rates; each changes one
thing. `no_appearance` has appearance codes of no length, so that one camera and the lidar differ by their
decoders alone. `sdf` has a signed distance in place of a density. `perceptual` has a perceptual loss of the
shipped image tower's features. Runs are kept in runs/field_ablation.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.study import RECONSTRUCTED_BY, pandaset_log
from benchmarks.rebuild_pandaset import FIGURES
from foredrive.methods.reconstruction.perceptual import PerceptualMetrics, PerceptualWeights
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe, field_tiny, rescheduled_recipe
from foredrive.runs.reconstruction.reconstruct import reconstruct, shipped_tower

ROOT = Path("runs/field_ablation")
STEPS = 1500
SHORT = rescheduled_recipe(dataclasses.replace(field_tiny(), cameras=("pcam_f0",)), steps=STEPS)


def with_scene(**changes: Any) -> ReconstructionRecipe[Any]:
    """Return the short recipe with changed entries of its scene."""
    scene = dataclasses.replace(SHORT.representation.scene, **changes)
    return dataclasses.replace(SHORT, representation=dataclasses.replace(SHORT.representation, scene=scene))


def with_network(**changes: Any) -> ReconstructionRecipe[Any]:
    """Return the short recipe with changed entries of its network."""
    return with_scene(network=dataclasses.replace(SHORT.representation.scene.network, **changes))


ARMS: dict[str, ReconstructionRecipe[Any]] = {
    "short": SHORT,
    "no_rolling_shutter": with_scene(rolling=False),
    "no_drop": dataclasses.replace(
        rescheduled_recipe(
            SHORT, weights=dataclasses.replace(SHORT.representation.schedule.weights, drop=0.0)
        ),
        drop=False,
    ),
    "no_appearance": with_network(appearance=0),
    "sdf": with_network(surface="sdf"),
    "static_only": dataclasses.replace(SHORT, actors=False),
    "perceptual": rescheduled_recipe(SHORT, perceptual="tower"),
}
DECIDED_BY = (*RECONSTRUCTED_BY, "foredrive.methods.reconstruction.perceptual")
CONFIG = {"arms": {arm: dataclasses.asdict(recipe) for arm, recipe in ARMS.items()}}
WORK = ROOT / study_identity(CONFIG, DECIDED_BY)


def reconstructed(arm: str) -> Callable[[int], dict[str, float]]:
    """Return the measurement of one arm."""

    def measure(seed: int) -> dict[str, float]:
        recipe, log = rescheduled_recipe(ARMS[arm], seed=seed), pandaset_log(ROOT / "pandaset")
        metrics = PerceptualMetrics(PerceptualWeights(), shipped_tower())
        summary = reconstruct(recipe, log, WORK / f"{arm}_seed{seed}", ROOT / "cache", metrics).summary
        names = (*FIGURES, "tower_lpips", "tower_fid")
        return {name: float(value) for name in names if isinstance(value := summary.get(name), float | int)}

    return measure


BENCHMARK = Benchmark(
    question="What are rolling shutter, ray drop, appearance, density, actors and a perceptual loss worth?",
    arms={arm: reconstructed(arm) for arm in ARMS},
    config=CONFIG,
    decided_by=DECIDED_BY,
)
