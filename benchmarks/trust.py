"""Measure whether a reconstruction knows from where its images are good: `foredrive bench trust`.

Drives of six towns are reconstructed from a front camera and a lidar. Held-out moments are rendered from
random places and headings beside the logged way, and compared with the town's own sensors there. An arm
predicts the errors in one town with weights fitted to the others; `fit` fits to all of them, and prints the
weights that methods/reconstruction/trust.py holds. Towns are kept in runs/trust.
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
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from scipy import stats
from torch import Tensor

from benchmarks.common.reconstructed_towns import TownDrive, TownTruth
from foredrive.engine.bench import Benchmark, study_identity
from foredrive.files import atomic_path
from foredrive.methods.reconstruction.edits import ShiftEgo
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
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
from foredrive.runs.recipes.reconstruction import gaussians_tiny
from foredrive.runs.reconstruction.reconstruct import reconstruct
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
from foredrive.runs.reconstruction.trust import trained_views

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
RECIPE = gaussians_tiny()
CONFIG = {
    "drives": [dataclasses.asdict(drive) for drive in DRIVES.values()],
    "recipe": dataclasses.asdict(RECIPE),
    "poses": [FRAMES_APART, POSES, ASIDE_M, TURNED_DEG, BEAMS_APART],
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


def of_town(town: str, _: int) -> dict[str, float]:
    """Return how well weights that were fitted to the other towns predict the errors in this one.

    The held-out frames calibrate the expectations to their log. What is nearly good loses 1 dB more.
    """
    own = judged(town)
    fitted_to_others = fitted([judged(other) for other in DRIVES if other != town]).tolist()
    weights = dict(zip(IMAGE_WEIGHTS, fitted_to_others, strict=True))
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
        above = stats.mannwhitneyu(expected[good], expected[~good]).statistic
        figures["auc_good_frame"] = float(above / good.sum() / (~good).sum())
    if trusted.any():
        figures["good_of_trusted"] = float(good[trusted].mean())
        figures["nearly_good_of_trusted"] = float((true >= least_db - 1.0)[trusted].mean())
    return figures


def fit(_: int) -> dict[str, float]:
    """Fit to all towns; print the weights."""
    weights = dict(zip(IMAGE_WEIGHTS, fitted([judged(town) for town in DRIVES]).tolist(), strict=True))
    print({name: round(weight, 3) for name, weight in weights.items()})
    return weights


BENCHMARK = Benchmark(
    question="Does a reconstruction know from where its images are good?",
    arms={**{town: functools.partial(of_town, town) for town in DRIVES}, "fit": fit},
    seeds=(0,),
    config=CONFIG,
    decided_by=DECIDED_BY,
)
