"""How well a reconstruction knows where its images and sweeps are good: `foredrive bench trust`.

Drives of six towns are reconstructed from a front camera and a lidar. Held-out moments are rendered from
random places and headings beside the logged way, and compared with the town's own sensors there. An arm
predicts the errors in one town with weights fitted to the others; `fit` fits to all of them, and prints the
weights that methods/reconstruction/trust.py holds. Towns are kept in runs/trust.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from benchmarks.common.reconstructed_towns import TownDrive, TownTruth
from foredrive.engine.bench import Benchmark, study_identity
from foredrive.files import atomic_path
from foredrive.methods.reconstruction.edits import ShiftEgo
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.trust import (
    BEAMS_APART,
    IMAGE_WEIGHTS,
    SWEEP_WEIGHTS,
    TRUSTED_LOSS_DB,
    TRUSTED_LOSS_SHARE,
    ObservedPoints,
    ObservedViews,
    beam_is_right,
    block_hw,
    image_features,
    observe_points,
    observe_views,
    psnr_of,
    sweep_features,
)
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.runs.recipes.reconstruction import gaussians_tiny
from foredrive.runs.reconstruction.reconstruct import reconstruct
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction

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
    beams: Float[Tensor, "F P E"]
    right: Float[Tensor, "F P"]


@functools.cache
def judged(town: str) -> Judged:
    """Return the frames of a town; record, reconstruct and render what is missing."""
    file, drive = WORK / f"{town}.pt", DRIVES[town]
    if not file.is_file():
        folder = WORK / "rebuilt" / town
        recipe = dataclasses.replace(RECIPE, cameras=drive.cameras)
        reconstruct(recipe, drive.recorded(WORK / "towns"), folder, WORK / "cache")
        frames = _judge(drive, folder)
        with atomic_path(file) as temporary:
            torch.save(frames._asdict(), temporary)
    return Judged(**torch.load(file, weights_only=True))


def _judge(drive: TownDrive, folder: Path) -> Judged:
    truth, run = TownTruth(drive), open_reconstruction(folder)
    scene, vehicle, rng = run.scene, run.vehicle, np.random.default_rng(0)
    trained_s = vehicle.t_s[::2].tolist()
    views, points = observe_views(scene, vehicle, trained_s), observe_points(scene, vehicle, trained_s)
    assert views is not None
    assert points is not None
    rows = []
    for frame in range(1, drive.frames, FRAMES_APART):
        aside_m, turned_deg = rng.uniform(-1, 1, (2, POSES)) * np.array([[ASIDE_M], [TURNED_DEG]])
        for left_m, deg in zip((0.0, *aside_m), (0.0, *turned_deg), strict=True):
            seen = truth.seen(frame, (ShiftEgo((0.0, float(left_m), 0.0), math.radians(deg)),))
            blocks, errors = _blocks(scene, views, seen.cameras[0])
            beams, right = _beams(scene, points, seen.sweep)
            rows.append((torch.tensor([frame, left_m, deg]), blocks, errors, beams, right))
        print(f"{drive.town}: frame {frame} of {drive.frames}", flush=True)
    return Judged(*(torch.stack(column).float() for column in zip(*rows, strict=True)))


@torch.no_grad()
def _blocks(
    scene: ReconstructedScene, views: ObservedViews, view: CameraView
) -> tuple[Float[Tensor, "N D"], Float[Tensor, "N"]]:
    """Return the features of the blocks of an image, and their squared errors."""
    graph, image = scene.graph, scene.camera(scene.graph, view)
    features = image_features(views, scene.track_id, graph.tracks, view, image)
    assert view.image is not None
    squared = (image.rgb.clamp(0, 1) - view.image / 255).square().mean(0)
    errors = torch.nn.functional.interpolate(squared[None, None], block_hw(view.size_hw), mode="area")
    return torch.stack([features[name] for name in IMAGE_WEIGHTS], -1), errors.flatten()


@torch.no_grad()
def _beams(
    scene: ReconstructedScene, points: ObservedPoints, view: SweepView
) -> tuple[Float[Tensor, "P E"], Float[Tensor, "P"]]:
    """Return the features of some beams of a sweep, and which of them are right."""
    graph, view = scene.graph, dataclasses.replace(view, beams=view.beams[::BEAMS_APART])
    sweep = scene.sweep(graph, scene.prepare_sweep(view), view.t_s)
    features = sweep_features(points, scene.track_id, graph.tracks, view, sweep)
    right = beam_is_right(sweep.hit_range_m, sweep.returned, view.beams.range_m, view.beams.returned)
    return torch.stack([features[name] for name in SWEEP_WEIGHTS], -1), right


def fitted(
    features: Float[Tensor, "N D"],
    targets: Float[Tensor, "N"],
    loss: Callable[[Tensor, Tensor], Tensor],
    first: float,
) -> Float[Tensor, "D"]:
    """Return the weights of a regression with a small ridge.

    Args:
        features: the first column is 1.
        targets: what is predicted.
        loss: of the linear predictor and the target of each row.
        first: value of the predictor at the start.
    """
    mean, std = features.mean(0), features.std(0).clamp_min(1e-6)
    mean[0], std[0] = 0.0, 1.0
    rows = (features - mean) / std
    weights = torch.zeros(rows.shape[1])
    weights[0] = first
    weights.requires_grad_()
    search = torch.optim.LBFGS([weights], max_iter=200, line_search_fn="strong_wolfe")

    def objective() -> Tensor:
        search.zero_grad()
        value = loss(rows @ weights, targets).mean() + 1e-3 * weights[1:].square().sum()
        value.backward()
        return value

    search.step(objective)
    plain = weights.detach() / std
    # Undo the centring: the constant takes the means of all other columns
    plain[0] = weights.detach()[0] - (plain[1:] * mean[1:]).sum()
    return plain


def fit_images(towns: Sequence[Judged]) -> Float[Tensor, "D"]:
    """Return weights for the logarithm of squared errors, by a gamma regression."""
    features = torch.cat([town.blocks.flatten(0, 1) for town in towns])
    errors = torch.cat([town.errors.flatten() for town in towns]) + 1e-5
    return fitted(features, errors, lambda eta, error: error * (-eta).exp() + eta, float(errors.mean().log()))


def fit_sweeps(towns: Sequence[Judged]) -> Float[Tensor, "E"]:
    """Return weights for the log odds of right beams, by a logistic regression."""
    features = torch.cat([town.beams.flatten(0, 1) for town in towns])
    right = torch.cat([town.right.flatten() for town in towns])
    return fitted(features, right, torch.nn.functional.binary_cross_entropy_with_logits, 0.0)


def predicted(town: Judged, images: Float[Tensor, "D"], sweeps: Float[Tensor, "E"]) -> dict[str, np.ndarray]:
    """Return true and expected PSNR (dB) and share of right beams of each frame.

    The held-out frames calibrate the expectations to their log, as `Trust.offset` does.
    """
    held = (town.pose[:, 1:] == 0).all(-1).numpy()
    errors = (town.blocks @ images).clamp_max(0).exp()
    true_db = np.array([psnr_of(error) for error in town.errors])
    expected_db = np.array([psnr_of(error) for error in errors])
    true_share = town.right.mean(-1).numpy()
    expected_share = (town.beams @ sweeps).sigmoid().mean(-1).numpy()
    return {
        "held": held,
        "true_db": true_db,
        "expected_db": expected_db + (true_db - expected_db)[held].mean(),
        "true_share": true_share,
        "expected_share": expected_share + (true_share - expected_share)[held].mean(),
    }


def of_town(town: str, _: int) -> dict[str, float]:
    """Return how well weights that were fitted to the other towns predict the errors in this one."""
    others = [judged(other) for other in DRIVES if other != town]
    own = judged(town)
    frames = predicted(own, fit_images(others), fit_sweeps(others))
    beside = ~frames["held"]
    figures = {"frames": float(beside.sum())}
    for kind, unit, margin in (("db", "db", TRUSTED_LOSS_DB), ("share", "share", TRUSTED_LOSS_SHARE)):
        true, expected = frames[f"true_{kind}"], frames[f"expected_{kind}"]
        least = true[~beside].mean() - margin
        true, expected = true[beside], expected[beside]
        good, trusted = true >= least, expected >= least
        name = "image" if kind == "db" else "sweep"
        figures |= {
            f"{name}_mean_{unit}": float(true.mean()),
            f"{name}_std_{unit}": float(true.std()),
            f"{name}_calibration_error_{unit}": float(np.abs(expected - true).mean()),
            f"{name}_bias_{unit}": float((expected - true).mean()),
            f"{name}_correlation": float(stats.pearsonr(expected, true).statistic),
            f"{name}_good_share": float(good.mean()),
            f"{name}_trusted_share": float(trusted.mean()),
        }
        if good.any() and not good.all():
            figures[f"{name}_auc_good_frame"] = float(
                stats.mannwhitneyu(expected[good], expected[~good]).statistic / good.sum() / (~good).sum()
            )
        if trusted.any():
            figures[f"{name}_good_of_trusted"] = float(good[trusted].mean())
    # What is known without looking: the distance from the logged way, and the share of blocks that were seen
    distance = own.pose[:, 1].abs() / ASIDE_M + own.pose[:, 2].abs() / TURNED_DEG
    unseen = own.blocks[..., list(IMAGE_WEIGHTS).index("unseen")].mean(-1)
    for name, values in (("distance", distance), ("unseen", unseen)):
        correlation = stats.pearsonr(-values.numpy()[beside], frames["true_db"][beside]).statistic
        figures[f"image_correlation_of_{name}"] = float(correlation)
    return figures


def fit(_: int) -> dict[str, float]:
    """Fit to all towns; print the weights."""
    towns = [judged(town) for town in DRIVES]
    images, sweeps = fit_images(towns).tolist(), fit_sweeps(towns).tolist()
    weights = {
        "image": dict(zip(IMAGE_WEIGHTS, images, strict=True)),
        "sweep": dict(zip(SWEEP_WEIGHTS, sweeps, strict=True)),
    }
    for kind, values in weights.items():
        print(kind, {name: round(value, 4) for name, value in values.items()})
    return {f"{kind}.{name}": value for kind, values in weights.items() for name, value in values.items()}


BENCHMARK = Benchmark(
    question="Does a reconstruction know from where its images and sweeps are good?",
    arms={**{town: functools.partial(of_town, town) for town in DRIVES}, "fit": fit},
    seeds=(0,),
    config=CONFIG,
    decided_by=DECIDED_BY,
)
