"""Studies: arms that differ in one thing, trained on the same towns and evaluated in a held-out town."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foredrive.data import LogPath, find_logs
from foredrive.data.formats.convert import convert
from foredrive.engine.metrics_log import read_metrics
from foredrive.engine.provenance import collect_provenance
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.methods.recipe import Recipe, rescheduled
from foredrive.runs.drive.recording import record_drives
from foredrive.runs.evaluate.run import SUMMARY, evaluate_run
from foredrive.runs.train.run import train_run
from foredrive.sensors.rigs import SURROUND
from foredrive.tasks.planning.protocols import PROTOCOLS
from foredrive.towns.campaign import Campaign, plan_drives

HEADLINE = "uniad"
"""The protocol of NeMo's own tables."""
JUDGED_EVERY_S = 1.0
"""Time between evaluated key frames, s; neighbouring key frames give nearly the same result."""
RECONSTRUCTED_BY = (
    "foredrive.geometry.boxes",
    "foredrive.geometry.projection",
    "foredrive.geometry.se3",
    *(
        f"foredrive.methods.neurad.{module}"
        for module in (
            *("config", "decoders", "losses", "network", "rays", "recipes"),
            *("render", "sampling", "scene", "training"),
        )
    ),
    *(
        f"foredrive.methods.splatad.{module}"
        for module in (
            *("beams", "camera", "content", "footprint", "initial", "lidar", "losses", "placing", "rates"),
            *("recipes", "relocation", "scene", "training", "unseen_ground"),
        )
    ),
    *(
        f"foredrive.methods.reconstruction.{module}"
        for module in (
            *("decoders", "evaluation", "gaussians", "reconstructed", "rendered"),
            *("scene_graph", "seed_points", "tracks", "training", "views"),
        )
    ),
    "foredrive.ops.hash_grid",
    "foredrive.ops.ray_boxes",
    "foredrive.ops.splatting",
    "foredrive.tasks.rendering",
)
"""The code that decides how well a log is reconstructed. Kernels are tested against the references here."""
PLANNERS = ("stand_still", "constant_velocity", "ego_mlp")
TASK_FIGURES = (
    "detection.car_ap_2m_30m", "detection.nuscenes.map", "detection.nuscenes.nds", "tracking.car_amota_30m",
    "motion.uniad.car.min_ade_m", "map.uniad_covered.iou_", "map.maptr.map", "occupancy.uniad.vpq_near_pct",
    "occupancy.occ3d_unmasked.miou_pct",
)  # fmt: skip
"""Beginnings of the figures of task heads that a study keeps."""


@dataclass(frozen=True)
class StudyTowns:
    """The drives of a study, in bright daylight, with key frames only."""

    train: tuple[str, ...] = ("Town01", "Town02", "Town03", "Town04", "Town06", "Town07", "Town10HD")
    test: tuple[str, ...] = ("Town05",)
    train_seeds: tuple[int, ...] = tuple(range(1, 9))
    test_seeds: tuple[int, ...] = tuple(range(1, 7))
    seconds: float = 60.0
    rate_hz: float = 2.0
    image_hw: tuple[int, int] = (144, 256)


@dataclass(frozen=True)
class StudyLogs:
    """The drives, ordered by seed and then by town, so that each first part contains all towns."""

    train: tuple[LogPath, ...]
    test: tuple[LogPath, ...]


def work_folder(root: Path) -> Path:
    """Return the folder of a study with the present commit, where it also continues after an interruption."""
    return root / str(collect_provenance()["commit"] or "no_commit")


def record_study(towns: StudyTowns, out: Path, workers: int) -> StudyLogs:
    """Record the drives that are not in `out` yet.

    Raises:
        InputError: a drive failed: all arms must have the same training data.
    """
    found = []
    for names, seeds in ((towns.train, towns.train_seeds), (towns.test, towns.test_seeds)):
        plans = plan_drives(Campaign(names, seeds, seconds=towns.seconds, rate_hz=towns.rate_hz))
        recorded = record_drives(plans, out, SURROUND.of_size(towns.image_hw), workers)
        if recorded.failed:
            plan, reason = next(iter(recorded.failed.items()))
            raise InputError(f"{len(recorded.failed)} drives failed, {plan.log_name}: {reason}")
        by_seed = sorted(recorded.logs, key=lambda plan: (plan.seed, names.index(plan.town)))
        found.append(tuple(recorded.logs[plan] for plan in by_seed))
    return StudyLogs(*found)


def pandaset_log(root: Path) -> LogPath:
    """Return the first log of the raw PandaSet in FOREDRIVE_REAL_DATA; convert it into `root` if necessary.

    Raises:
        InputError: there is no raw PandaSet here.
    """
    return _converted_log("pandaset", "pandaset", root)


def kitti_drive(root: Path) -> LogPath:
    """Return the first drive in FOREDRIVE_REAL_DATA/kitti_raw; convert it into `root` if necessary.

    Raises:
        InputError: there is no KITTI raw here.
    """
    return _converted_log("kitti_raw", "kitti-raw", root)


def _converted_log(name: str, dataset: str, root: Path) -> LogPath:
    source = Path(os.environ.get("FOREDRIVE_REAL_DATA", "../shared/data")) / name
    if not root.is_dir():
        if not source.is_dir():
            raise InputError(
                f"{source}: no raw {dataset} logs here; name their parent in FOREDRIVE_REAL_DATA"
            )
        with atomic_path(root) as temporary:
            convert(source, dataset, temporary)
    return find_logs(root)[0]


def share_of(logs: Sequence[LogPath], share: float) -> tuple[LogPath, ...]:
    """Return the first part of the logs: whole logs, at least one."""
    return tuple(logs[: max(1, round(share * len(logs)))])


def seeded(recipe: Recipe, seed: int) -> Recipe:
    """Return the recipe with another seed for weights, order of data and rays."""

    return dataclasses.replace(
        recipe,
        pretrain=None if recipe.pretrain is None else rescheduled(recipe.pretrain, seed=seed),
        finetune=rescheduled(recipe.finetune, seed=seed),
    )


def run_arm(
    recipe: Recipe, logs: StudyLogs, folder: Path, cache_dir: Path, start: Path | None = None
) -> dict[str, float]:
    """Train one arm, evaluate it on the test drives, and return its metrics; continue where it stopped.

    An evaluated arm is not evaluated again: `folder` belongs to one commit and one set of test drives.

    `occupancy_iou` is the present IoU of voxels above the ground. `l2_m` and `collision_pct` follow UniAD's
    protocol, as NeMo's tables do. Metrics of other protocols, later frames, baselines and task heads have
    longer names. `train_s` is the time of the training steps of this run.
    """
    run = train_run(recipe, logs.train, folder, cache_dir, start)
    if not (folder / SUMMARY).is_file():
        evaluate_run(run, logs.test, folder, batch_size=8, views=False, stride_s=JUDGED_EVERY_S)
    summary: Mapping[str, Any] = read_summary(folder / SUMMARY)
    lines = [
        line for name in ("pretrain", "finetune") for line in read_metrics(folder / name / "metrics.jsonl")
    ]
    return study_figures(summary) | {
        "failed": float(summary["failed"]),
        "train_s": sum(float(line["step_s"]) for line in lines),
    }


def study_figures(summary: Mapping[str, Any]) -> dict[str, float]:
    """Return the metrics that a study keeps; planning metrics mean nothing for a recipe without planning."""
    headline = f"planning.{HEADLINE}"
    kept = {
        "occupancy_iou": "occupancy.above_ground.iou_now",
        "l2_m": f"{headline}.l2_avg_m",
        "collision_pct": f"{headline}.collision_avg_pct",
    }
    for scope in ("", "above_ground.", "moving.", "standing."):
        prefixes = (f"occupancy.{scope}iou_", f"occupancy.{scope}spread_")
        kept |= {key.removeprefix("occupancy."): key for key in summary if key.startswith(prefixes)}
    kept |= {key: key for key in summary if key.startswith(("flow.", *TASK_FIGURES))}
    for planner in ("", *(f"{name}." for name in PLANNERS)):
        for protocol in PROTOCOLS:
            for kind in ("l2_avg_m", "collision_avg_pct"):
                kept[f"{planner}{protocol}.{kind}"] = f"planning.{planner}{protocol}.{kind}"
    return {
        name: float(summary[key])
        for name, key in kept.items()
        if "threshold" not in key and summary[key] is not None
    }
