"""Reconstruct a drive of a town; evaluate it off the driven lane and after edits, where the truth is known.

`foredrive bench rebuild-town`. Training uses the front camera and the lidar of every second frame. The scene
is then rendered from the held-out poses, from poses beside them, and with an actor removed or moved. Each
view is compared with the town's own sensors at the same pose. Each arm is a run in runs/rebuild_town, which
continues where it stopped.
"""

import dataclasses
import functools
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxtyping import Bool
from torch import Tensor

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.reconstructed_towns import TownDrive, TownTruth, TrueViews
from benchmarks.common.study import RECONSTRUCTED_BY
from foredrive.engine.summary import numbers
from foredrive.methods.reconstruction.edits import Edit, Move, Remove, ShiftEgo, apply_edits
from foredrive.methods.reconstruction.evaluation import evaluate_cameras, evaluate_sweeps
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe, gaussians_tiny, rescheduled_recipe
from foredrive.runs.reconstruction.reconstruct import Reconstruction, reconstruct
from foredrive.scene import Category
from foredrive.view.reconstruction_sheet import write_reconstruction_sheet

DRIVE = TownDrive("Town10HD", seed=3)
ASIDE_M, AHEAD_M = (-5.0, -2.0), (2.0, 25.0)
"""Lateral position of the lane to the right, and the distance ahead in which a car in it is searched, m."""
NAMES = ("held_out", "left_2m", "left_3m", "right_2m", "right_3m", "removed", "moved")
JUDGED_EVERY = 8
"""Every eighth frame from the second on is evaluated: a quarter of the held-out frames."""
CHANGED, CHANGED_M = 4, 0.1
"""Thresholds of a change by an edit: pixels by more than 4 (of 255), and beams whose range differs by more
than 0.1 m.
"""
FEWEST = 20
"""Minimum number of changed pixels or beams of a view that counts."""
OF_IMAGES = ("psnr_db", "ssim", "nearest.psnr_db", "nearest.ssim")
OF_SWEEPS = ("depth_median_sq_m2", "intensity_rmse", "drop_accuracy", "chamfer_m2")
RECIPE = dataclasses.replace(gaussians_tiny(), cameras=tuple(DRIVE.rig.cameras), moves_m=0.0)
"""All tracks are actors, because the edited car may stand."""
ARMS: dict[str, ReconstructionRecipe[Any]] = {
    "gaussians": RECIPE,
    "static_only": dataclasses.replace(RECIPE, actors=False),
}
DECIDED_BY = ("benchmarks.common.reconstructed_towns", *RECONSTRUCTED_BY)
CONFIG = {
    "drive": dataclasses.asdict(DRIVE),
    "views": NAMES,
    "arms": {arm: dataclasses.asdict(recipe) for arm, recipe in ARMS.items()},
}
WORK = Path("runs/rebuild_town") / study_identity(CONFIG, DECIDED_BY)


@functools.cache
def truth() -> TownTruth:
    """Return the town of the drive."""
    return TownTruth(DRIVE)


@functools.cache
def passed() -> int:
    """Return the car in the lane to the right that is ahead in most evaluated frames; the ego passes it.

    The rounding of a machine's arithmetic decides which car drives there, so that its id is not fixed.
    """
    ahead: Counter[int] = Counter()
    for moment in truth().snapshots[1::JUDGED_EVERY]:
        R, ego_m = moment.T_world_ego[:3, :3], moment.T_world_ego[:3, 3]
        for actor in moment.actors:
            x_m, y_m, _ = R.T @ (actor.centre_m - ego_m)
            if actor.category is Category.CAR and inside(x_m, AHEAD_M) and inside(y_m, ASIDE_M):
                ahead[actor.track_id] += 1
    return ahead.most_common(1)[0][0]


def inside(value: float, bounds: tuple[float, float]) -> bool:
    return bounds[0] < value < bounds[1]


@functools.cache
def edits_of(name: str) -> tuple[Edit, ...]:
    """Return the edits of one of `NAMES`."""
    every: dict[str, tuple[Edit, ...]] = {
        "held_out": (),
        "left_2m": (ShiftEgo((0.0, 2.0, 0.0)),),
        "left_3m": (ShiftEgo((0.0, 3.0, 0.0)),),
        "right_2m": (ShiftEgo((0.0, -2.0, 0.0)),),
        "right_3m": (ShiftEgo((0.0, -3.0, 0.0)),),
        "removed": (Remove(passed()),),
        "moved": (Move(passed(), offset_m=(3.0, 2.0, 0.0)),),
    }
    return every[name]


@functools.cache
def true_views(name: str) -> list[TrueViews]:
    """Return the true views after the edits of a name."""
    return [truth().seen(frame, edits_of(name)) for frame in range(1, DRIVE.frames, JUDGED_EVERY)]


def reconstructed(arm: str, seed: int) -> dict[str, float]:
    """Return the metrics of one run, see `judged_town`, and its minutes."""
    recipe = rescheduled_recipe(ARMS[arm], seed=seed)
    run = reconstruct(recipe, DRIVE.recorded(WORK / "town"), WORK / f"{arm}_seed{seed}", WORK / "cache")
    summary = numbers(run.summary)
    return {name: summary[name] for name in ("minutes", "gaussians")} | judged_town(run)


def judged_town(run: Reconstruction) -> dict[str, float]:
    """Return the metrics of a run of `DRIVE`.

    They are "VIEWS.METRIC", and "VIEWS.changed.METRIC" where an edit changes the views.
    """
    figures: dict[str, float] = {}
    for name in NAMES:
        edits = edits_of(name)
        edited = any(isinstance(edit, Move | Remove) for edit in edits)
        if edited and not run.recipe.actors:
            continue
        graph = apply_edits(run.scene.graph, edits).graph
        views, title = true_views(name), f"{name}, beside what the town's camera sees there"
        figures |= named(f"{name}.", judge(run, views, graph))
        if edited:
            figures |= judge_changed(run, name, graph)
        cameras = [camera for view in views for camera in view.cameras]
        write_reconstruction_sheet(run.folder / f"{name}.png", run.scene, cameras, title, graph)
    return figures


def judge(run: Reconstruction, views: Sequence[TrueViews], graph: SceneGraph) -> dict[str, float]:
    """Return all metrics of views, over all their pixels and beams."""
    cameras = [camera for view in views for camera in view.cameras]
    found = evaluate_cameras(run.scene, cameras, run.train.cameras, graph)
    found |= evaluate_sweeps(run.scene, [view.sweep for view in views], graph=graph)
    return {name: found[name] for name in OF_IMAGES + OF_SWEEPS}


def judge_changed(run: Reconstruction, name: str, graph: SceneGraph) -> dict[str, float]:
    """Return the same metrics over changed pixels and beams only, for the scene with and without the edit."""
    pixels, beams = list[tuple[CameraView, Tensor]](), list[tuple[SweepView, Tensor]]()
    for before, after in zip(true_views("held_out"), true_views(name), strict=True):
        pixels += zip(after.cameras, map(changed_pixels, before.cameras, after.cameras), strict=True)
        beams.append((after.sweep, changed_beams(before.sweep, after.sweep)))
    cameras, where = zip(*(view for view in pixels if int(view[1].sum()) >= FEWEST), strict=True)
    sweeps, which = zip(*(view for view in beams if int(view[1].sum()) >= FEWEST), strict=True)
    changed: dict[str, float] = {}
    for prefix, shown in (("changed.", graph), ("unedited.changed.", run.scene.graph)):
        figures = evaluate_cameras(run.scene, cameras, run.train.cameras, shown, where)
        figures |= evaluate_sweeps(run.scene, sweeps, graph=shown, where=which)
        changed |= named(f"{name}.{prefix}", {key: figures[key] for key in OF_IMAGES + OF_SWEEPS})
    return changed


def changed_pixels(before: CameraView, after: CameraView) -> Bool[Tensor, "H W"]:
    assert before.image is not None
    assert after.image is not None
    return (before.image.int() - after.image.int()).abs().amax(0) > CHANGED


def changed_beams(before: SweepView, after: SweepView) -> Bool[Tensor, "P"]:
    one, other = before.beams, after.beams
    return (one.returned != other.returned) | ((one.range_m - other.range_m).abs() > CHANGED_M)


def named(prefix: str, figures: Mapping[str, float]) -> dict[str, float]:
    return {prefix + name: value for name, value in figures.items()}


BENCHMARK = Benchmark(
    question="How true is a reconstructed town off the driven lane, and with a road user removed or moved?",
    arms={arm: functools.partial(reconstructed, arm) for arm in ARMS},
    config=CONFIG,
    decided_by=DECIDED_BY,
)
