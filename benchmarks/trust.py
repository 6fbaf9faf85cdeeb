"""Measure whether a reconstruction knows from where its images are good: `foredrive bench trust`.

Drives of six towns are reconstructed from a front camera and a lidar. Held-out moments are rendered from
random places and headings beside the logged way, and compared with the town's own sensors there. An arm
predicts the errors in one town with weights fitted to the others; `fit` fits to all of them, and prints the
weights that methods/reconstruction/trust.py holds. Towns are kept in runs/trust.

Arms TOWN_sight use weights that were fitted to the five other towns, on the reconstructions of `bench ncap`
(seven cameras, twenty seconds, another recipe), and show what a moment that is not trusted means to those who
look: how far off the beams of the lidar are, and whether the shipped driver finds road users in the same
places of its images as in the town's own ones.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from safetensors.torch import load_file, save_file
from scipy import stats
from torch import Tensor

from benchmarks.common.benchmark import Benchmark, study_identity
from benchmarks.common.reconstructed_towns import TownDrive, TownTruth
from benchmarks.common.safety_pairs import NotedTrust
from benchmarks.common.safety_suites import DRIVES as SAFETY_DRIVES
from benchmarks.common.safety_suites import RECONSTRUCTION, reconstructed_town
from benchmarks.common.town_replay import TownReplayRenderer
from foredrive.data.batches import stack_records
from foredrive.driver.agent import Driver
from foredrive.driving.observation import KeyFrame, make_clip
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw
from foredrive.methods.reconstruction.edits import ShiftEgo
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.renderer import ReconstructedRenderer
from foredrive.methods.reconstruction.tracks import boxes_at
from foredrive.methods.reconstruction.trust import (
    IMAGE_WEIGHTS,
    TRUSTED_LOSS_DB,
    ObservedViews,
    block_hw,
    expected_errors,
    fitted_offset,
    image_features,
    psnr_of,
)
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.runs.drive.seeing_agents import driver_of
from foredrive.runs.recipes.reconstruction import gaussians_tiny
from foredrive.runs.reconstruction.reconstruct import reconstruct
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
from foredrive.runs.reconstruction.trust import trained_views, trust_of
from foredrive.runs.shipped import run_folder
from foredrive.scene import Boxes, Clip, Command, Rendered
from foredrive.sensors.rigs import FRONT_TELE, camera_rig
from foredrive.towns.sensing.capture import SensorSuite

DRIVES = {
    town: TownDrive(town, seed)
    for town, seed in (
        ("Town01", 2),
        ("Town02", 1),
        ("Town03", 4),
        ("Town05", 5),
        ("Town07", 6),
        ("Town10HD", 3),
    )
}
FRAMES_APART = 8
"""Every eighth frame from the second on is judged; all of them are held out."""
POSES, ASIDE_M, TURNED_DEG = 24, 6.0, 25.0
"""Number of random poses at each moment beside the logged one, and their bounds."""
BEAMS_APART = 7
"""Every seventh beam is compared."""
SIGHT_FRAMES_APART, SIGHT_POSES = 16, 16
"""Distance of the frames that are judged in twenty seconds, an even number; random poses at each moment."""
SIGHT_DRIVES = {drive.town: drive for drive in SAFETY_DRIVES}
DRIVER = Path("embedded:driver")
USER_LOGIT = 0.0
"""Logit from which a place of an image counts as a road user."""
RECIPE = gaussians_tiny()
CONFIG = {
    "drives": [dataclasses.asdict(drive) for drive in DRIVES.values()],
    "recipe": dataclasses.asdict(RECIPE),
    "poses": [FRAMES_APART, POSES, ASIDE_M, TURNED_DEG, BEAMS_APART],
    "sight": [SIGHT_FRAMES_APART, SIGHT_POSES, RECONSTRUCTION],
}
DECIDED_BY = ("foredrive.methods.reconstruction.trust", "foredrive.methods.splatad")
WORK = Path("runs/trust") / study_identity(CONFIG, DECIDED_BY[1:])


class Judged(NamedTuple):
    """The features and the true errors of F frames of one town."""

    pose: Float[Tensor, "F 3"]
    """Index of the frame, m to the left, degrees to the left."""
    blocks: Float[Tensor, "F N D"]
    errors: Float[Tensor, "F N"]
    right_share: Float[Tensor, "F"]
    """Share of the beams that are right: lost as they should, or within 0.1 m and 2 % of the true range."""


@functools.cache
def judged(town: str) -> Judged:
    """Return the frames of a town; record, reconstruct and render what is missing."""
    file, drive = WORK / f"{town}.safetensors", DRIVES[town]
    if not file.is_file():
        folder = WORK / "rebuilt" / town
        recipe = dataclasses.replace(RECIPE, cameras=tuple(drive.rig.cameras))
        reconstruct(recipe, drive.recorded(WORK / "towns"), folder, WORK / "cache")
        frames = _judge(drive, folder)
        with atomic_path(file) as temporary:
            save_file(frames._asdict(), temporary)
    return Judged(**load_file(file))


def _judge(drive: TownDrive, folder: Path) -> Judged:
    truth, run = TownTruth(drive), open_reconstruction(folder)
    scene, rng = run.scene, np.random.default_rng(0)
    views = trained_views(run)
    rows = []
    for frame in range(1, drive.frames, FRAMES_APART):
        aside_m, turned_deg = rng.uniform(-1, 1, (2, POSES)) * np.array([[ASIDE_M], [TURNED_DEG]])
        for left_m, deg in zip((0.0, *aside_m), (0.0, *turned_deg), strict=True):
            seen = truth.seen(frame, (ShiftEgo((0.0, float(left_m), 0.0), math.radians(deg)),))
            blocks, errors = _blocks(scene, views, seen.cameras[0])
            pose = torch.tensor([frame, left_m, deg])
            rows.append((pose, blocks, errors, _right_share(scene, seen.sweep)))
        print(f"{drive.town}: frame {frame} of {drive.frames}", flush=True)
    return Judged(*(torch.stack(column).float() for column in zip(*rows, strict=True)))


@torch.no_grad()
def _blocks(
    scene: ReconstructedScene, views: ObservedViews, view: CameraView
) -> tuple[Float[Tensor, "N D"], Float[Tensor, "N"]]:
    """Return the features of the blocks of an image, and their squared errors."""
    graph, image = scene.graph, scene.camera(scene.graph, view)
    features = image_features(views, scene.track_id, graph, view, image)
    assert view.image is not None
    squared = (image.rgb.clamp(0, 1) - view.image / 255).square().mean(0)
    errors = torch.nn.functional.interpolate(squared[None, None], block_hw(view.size_hw), mode="area")
    return torch.stack([features[name] for name in IMAGE_WEIGHTS], -1), errors.flatten()


@torch.no_grad()
def _right_share(scene: ReconstructedScene, view: SweepView) -> Float[Tensor, ""]:
    """Return the share of some beams of a sweep that are right."""
    beams = view.beams[::BEAMS_APART]
    view = dataclasses.replace(view, beams=beams)
    sweep = scene.sweep(scene.graph, scene.prepare_sweep(view), view.t_s)
    close = (sweep.hit_range_m - beams.range_m).abs() < 0.1 + 0.02 * beams.range_m
    return ((sweep.returned == beams.returned) & (close | ~beams.returned)).float().mean()


def fitted(towns: Sequence[Judged]) -> Float[Tensor, "D"]:
    """Return weights for the logarithm of squared errors, by a gamma regression with a small ridge."""
    features = torch.cat([town.blocks.flatten(0, 1) for town in towns])
    errors = torch.cat([town.errors.flatten() for town in towns]) + 1e-5
    mean, std = features.mean(0), features.std(0).clamp_min(1e-6)
    # The first feature is 1, the constant
    mean[0], std[0] = 0.0, 1.0
    rows = (features - mean) / std
    weights = torch.zeros(rows.shape[1])
    weights[0] = errors.mean().log()
    weights.requires_grad_()
    search = torch.optim.LBFGS([weights], max_iter=200, line_search_fn="strong_wolfe")

    def objective() -> Tensor:
        search.zero_grad()
        log_mean = rows @ weights
        value = (errors * (-log_mean).exp() + log_mean).mean() + 1e-3 * weights[1:].square().sum()
        value.backward()
        return value

    search.step(objective)
    plain = weights.detach() / std
    # Undo the centring: the constant takes the means of all other columns
    plain[0] -= (plain[1:] * mean[1:]).sum()
    return plain


def weights_without(town: str) -> dict[str, float]:
    """Return weights that were fitted to the other towns."""
    others = [judged(other) for other in DRIVES if other != town]
    return dict(zip(IMAGE_WEIGHTS, fitted(others).tolist(), strict=True))


def of_town(town: str, _: int) -> dict[str, float]:
    """Return how well weights that were fitted to the other towns predict the errors in this one.

    The held-out frames calibrate the expectations to their log. What is nearly good loses 1 dB more.
    """
    own = judged(town)
    weights = weights_without(town)
    held = (own.pose[:, 1:] == 0).all(-1).numpy()
    true_db = np.array([psnr_of(error) for error in own.errors])
    features = [dict(zip(IMAGE_WEIGHTS, blocks.unbind(-1), strict=True)) for blocks in own.blocks]
    offset = fitted_offset(list(itertools.compress(features, held)), true_db[held].mean(), weights)
    expected_db = np.array([psnr_of(expected_errors(frame, offset, weights)) for frame in features])
    least_db = true_db[held].mean() - TRUSTED_LOSS_DB
    right, true, expected = own.right_share.numpy(), true_db[~held], expected_db[~held]
    good, trusted = true >= least_db, expected >= least_db
    # What is known without looking: the distance from the logged way, and the share of blocks that were seen
    distance = own.pose[:, 1].abs() / ASIDE_M + own.pose[:, 2].abs() / TURNED_DEG
    unseen = own.blocks[..., list(IMAGE_WEIGHTS).index("unseen")].mean(-1)
    figures = {
        "images": float((~held).sum()),
        "psnr_held_out_db": float(true_db[held].mean()),
        "psnr_db": float(true.mean()),
        "psnr_std_db": float(true.std()),
        "calibration_error_db": float(np.abs(expected - true).mean()),
        "bias_db": float((expected - true).mean()),
        "correlation": float(stats.pearsonr(expected, true).statistic),
        "correlation_of_distance": float(stats.pearsonr(-distance.numpy()[~held], true).statistic),
        "correlation_of_unseen": float(stats.pearsonr(-unseen.numpy()[~held], true).statistic),
        "good_share": float(good.mean()),
        "trusted_share": float(trusted.mean()),
        "right_beams_held_out": float(right[held].mean()),
        "right_beams": float(right[~held].mean()),
    }
    if good.any() and not good.all():
        figures["auc_good_frame"] = auc_of(expected, good)
    if trusted.any():
        figures["good_of_trusted"] = float(good[trusted].mean())
        figures["nearly_good_of_trusted"] = float((true >= least_db - 1.0)[trusted].mean())
    return figures


class SightMoment(NamedTuple):
    """One pose, seen by the town's own sensors and by those of the reconstruction."""

    logged: bool
    """On the logged way."""
    expected_db: float
    true_db: float
    trusted: bool
    range_error_m: float
    """Median absolute error of the ranges of the beams that return in both."""
    right_share: float
    """As `Judged.right_share`."""
    in_town: Bool[Tensor, "_"]
    """Places of the town's images in which the driver finds road users."""
    in_scene: Bool[Tensor, "_"]
    """The same of the rendered images."""


def in_sight(town: str, _: int) -> dict[str, float]:
    """Return what trust says about ranges, and about what the driver finds, in one town."""
    drive = SIGHT_DRIVES[town]
    folder = reconstructed_town(drive)
    opened, truth = open_reconstruction(folder), TownTruth(drive)
    driver, rng = driver_of(run_folder(DRIVER, WORK / "models")), np.random.default_rng(0)
    rig, expected = camera_rig(None, 0.0, FRONT_TELE), trust_of(opened, weights_without(town))
    trust = NotedTrust.of(expected)
    graph, vehicle = opened.scene.graph, opened.vehicle
    rendered = ReconstructedRenderer(opened.scene, graph, vehicle.with_rig(rig), trust)
    sensors = SensorSuite(rig, drive.sensors.lidar)
    real = TownReplayRenderer(truth.world, sensors, truth.snapshots, graph.tracks, vehicle.T_world_scene, {})
    moments = list[SightMoment]()
    # Odd frames: all of them are held out
    for frame in range(1, drive.frames, SIGHT_FRAMES_APART):
        snapshot = truth.snapshots[frame]
        aside_m, turned_deg = rng.uniform(-1, 1, (2, SIGHT_POSES)) * np.array([[ASIDE_M], [TURNED_DEG]])
        for left_m, deg in zip((0.0, *aside_m), (0.0, *turned_deg), strict=True):
            T_ego_shifted = matrix_from_yaw(
                torch.tensor(math.radians(deg)).double(), torch.tensor([0.0, float(left_m), 0.0]).double()
            )
            T_world_ego = torch.from_numpy(snapshot.T_world_ego) @ T_ego_shifted
            T_scene_ego = (inverse_se3(vehicle.T_world_scene) @ T_world_ego).float()
            boxes = boxes_at(graph.all_tracks, T_scene_ego, snapshot.t_s)
            pose = T_world_ego, torch.zeros(6), snapshot.t_s
            both = real.render(*pose), rendered.render(*pose)
            places = [road_user_places(driver, seen, boxes, T_world_ego) for seen in both]
            moments.append(
                SightMoment(
                    left_m == 0 and deg == 0,
                    trust.noted_db[-1],
                    psnr_of((both[0].images.float() - both[1].images.float()).square() / 255**2),
                    bool(both[1].trusted),
                    *_of_beams(*both),
                    *places,
                )
            )
        print(f"{town}: frame {frame} of {drive.frames}", flush=True)
    return _sight_figures(moments, trust.reference_db)


@torch.no_grad()
def road_user_places(
    driver: Driver, frame: Rendered, boxes: Boxes, T_world_ego: Float64[Tensor, "4 4"]
) -> Bool[Tensor, "_"]:
    """Return in which places of its images the driver finds road users."""
    # Road users are found in single images: the frames before may be the same
    key = KeyFrame(0.0, T_world_ego.numpy(), 0.0, frame.images, None, boxes)
    past = dataclasses.replace(key, t_s=-0.5)
    clip = make_clip([past, key], camera_rig(None, 0.0, FRONT_TELE), Command.STRAIGHT)
    batch: Clip = stack_records([clip])
    return driver.see(batch).user_pixels.flatten() > USER_LOGIT


def _of_beams(real: Rendered, rendered: Rendered) -> tuple[float, float]:
    """Return the median error of the ranges of a sweep, m, and the share of its beams that are right."""
    assert real.sweep is not None
    assert rendered.sweep is not None
    true, seen = real.sweep, rendered.sweep
    error_m = (seen.range_m - true.range_m).abs()
    returned = true.returned & seen.returned
    close = error_m < 0.1 + 0.02 * true.range_m
    right = (true.returned == seen.returned) & (close | ~true.returned)
    return float(error_m[returned].median()), float(right.float().mean())


def _sight_figures(moments: Sequence[SightMoment], reference_db: float) -> dict[str, float]:
    """Return the figures of the moments beside the logged way; those on it have names of their own."""
    least_db = reference_db - TRUSTED_LOSS_DB
    groups = {
        "logged": [moment for moment in moments if moment.logged],
        "trusted": [moment for moment in moments if not moment.logged and moment.trusted],
        "untrusted": [moment for moment in moments if not moment.logged and not moment.trusted],
    }
    figures = {"reference_db": reference_db}
    for name, of in groups.items():
        figures[f"images_{name}"] = float(len(of))
        if not of:
            continue
        figures |= {
            f"psnr_{name}_db": float(np.mean([moment.true_db for moment in of])),
            f"range_error_{name}_m": float(np.mean([moment.range_error_m for moment in of])),
            f"right_beams_{name}": float(np.mean([moment.right_share for moment in of])),
            f"detection_f1_{name}": f1_of([(moment.in_town, moment.in_scene) for moment in of]),
        }
    beside = groups["trusted"] + groups["untrusted"]
    expected, true = (
        np.array([getattr(moment, key) for moment in beside]) for key in ("expected_db", "true_db")
    )
    good = true >= least_db
    # By chance: the town's own images against those at another pose 1.6 s later
    later = [*moments[SIGHT_POSES + 1 :], *moments[: SIGHT_POSES + 1]]
    pairs = [(now.in_town, other.in_town) for now, other in zip(moments, later, strict=True)]
    figures |= {
        "detection_f1_by_chance": f1_of(pairs),
        "calibration_error_db": float(np.abs(expected - true).mean()),
        "bias_db": float((expected - true).mean()),
        "correlation": float(stats.pearsonr(expected, true).statistic),
        "good_share": float(good.mean()),
        "trusted_share": len(groups["trusted"]) / len(beside),
    }
    if good.any() and not good.all():
        figures["auc_good_frame"] = auc_of(expected, good)
    if groups["trusted"]:
        trusted_db = np.array([moment.true_db for moment in groups["trusted"]])
        figures["good_of_trusted"] = float((trusted_db >= least_db).mean())
    return figures


def f1_of(pairs: Sequence[tuple[Bool[Tensor, "_"], Bool[Tensor, "_"]]]) -> float:
    """Return F1 of places in one image against those in another, over all pairs together.

    Raises:
        InputError: there are no such places, so that nothing is compared.
    """
    both = sum(int((one & other).sum()) for one, other in pairs)
    either = sum(int(one.sum() + other.sum()) for one, other in pairs)
    if not either:
        raise InputError("the driver finds nobody in any image")
    return 2 * both / either


def auc_of(expected: Float[np.ndarray, "N"], good: Bool[np.ndarray, "N"]) -> float:
    """Return how often more is expected of a good frame than of another one."""
    above = stats.mannwhitneyu(expected[good], expected[~good]).statistic
    return float(above / good.sum() / (~good).sum())


def fit(_: int) -> dict[str, float]:
    """Fit to all towns; print the weights."""
    weights = dict(zip(IMAGE_WEIGHTS, fitted([judged(town) for town in DRIVES]).tolist(), strict=True))
    print({name: round(weight, 3) for name, weight in weights.items()})
    return weights


BENCHMARK = Benchmark(
    question="Does a reconstruction know from where its images are good?",
    arms={
        **{town: functools.partial(of_town, town) for town in DRIVES},
        "fit": fit,
        **{f"{town}_sight": functools.partial(in_sight, town) for town in SIGHT_DRIVES},
    },
    seeds=(0,),
    config=CONFIG,
    decided_by=DECIDED_BY,
)
