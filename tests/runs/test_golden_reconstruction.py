"""A log reconstructed by Gaussians gives the losses, the images and the sweeps that it gave before.

After a change that is meant to change them, write them anew and look at the difference:

    FOREDRIVE_WRITE_GOLDEN=1 .venv/bin/python -m pytest tests/runs/test_golden_reconstruction.py
    git diff tests

The log has a standing and a moving actor, two cameras and a lidar. Steps relocate and add Gaussians. The
rates are low, so that Adam does not multiply the rounding of sums, which differs between processors.
"""

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import pytest
import synthetic_log as world
import torch
from torch.nn.functional import adaptive_avg_pool1d, adaptive_avg_pool2d

from foredrive.data import LogPath, find_logs
from foredrive.engine.learning_rates import Rate
from foredrive.engine.metrics_log import read_metrics
from foredrive.methods.reconstruction.decoders import CameraDecoderConfig
from foredrive.methods.reconstruction.edits import DriveStraight, Duplicate, Edit, Move, Remove
from foredrive.methods.splatad.initial import InitialGaussians
from foredrive.methods.splatad.rates import LearningRates
from foredrive.methods.splatad.recipes import GaussianRecipe, published_gaussians
from foredrive.methods.splatad.scene_config import GaussianSceneConfig
from foredrive.methods.splatad.training import GaussianSchedule
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe
from foredrive.runs.reconstruction.reconstruct import reconstruct
from foredrive.runs.reconstruction.reconstruction_run import edited_scene, open_reconstruction

GOLDEN = Path(__file__).with_name("golden_reconstruction.json")
RTOL, ATOL = 2e-3, 2e-4
TIMES = ("step", "step_s", "cpu_s", "computing_s")
LOW = LearningRates(
    mean_m=Rate(1e-4),
    quaternion=Rate(1e-4),
    log_scale=Rate(1e-4),
    opacity_logit=Rate(1e-4),
    albedo=Rate(1e-4),
    feature=Rate(1e-4),
    decoders=Rate(1e-4),
    actor_offset=Rate(1e-5),
)
EDITS: list[Edit] = [
    Duplicate(7, copy=20, offset_m=(3.0, -2.5, 0.0), yaw_rad=0.4),
    Move(11, offset_m=(2.0, 1.0, 0.0), yaw_rad=-0.2),
    DriveStraight(11, copy=21, at_m=(12.0, 0.5, 1.0), at_s=0.3, velocity_mps=(-2.0, 1.0, 0.0), yaw_rad=2.5),
    Remove(7),
]


def small() -> GaussianRecipe:
    return GaussianRecipe(
        initial=InitialGaussians(
            lidar_points=700,
            unseen_points=300,
            pixel_points=200,
            near_points=60,
            actor_points=60,
            max_actor_points=100,
            features=3,
            scale=0.7,
        ),
        schedule=GaussianSchedule(
            steps=18,
            max_gaussians=1500,
            rates=LOW,
            images_per_sweep=2,
            beam_stride=2,
            shrink_steps=(4,),
            grow_from=5,
            grow_until=15,
            grow_every=5,
        ),
        scene=GaussianSceneConfig(CameraDecoderConfig(width=8)),
    )


def published() -> GaussianRecipe:
    like = small()
    return dataclasses.replace(
        like,
        initial=dataclasses.replace(
            like.initial, random_far_points=60, random_near_points=40, random_features=True
        ),
        schedule=dataclasses.replace(
            like.schedule,
            lidar_losses="published",
            rates=dataclasses.replace(LOW, frame_velocity=Rate(1e-4), frame_turn=Rate(1e-4)),
        ),
        scene=dataclasses.replace(published_gaussians().scene, decoder=CameraDecoderConfig(8, "residual")),
    )


GAUSSIANS = {"tiny": small, "published": published}


def recipe(name: str) -> ReconstructionRecipe[GaussianRecipe]:
    return ReconstructionRecipe("golden", image_hw=(24, 48), representation=GAUSSIANS[name](), moves_m=0.0)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    (log,) = find_logs(world.write(tmp_path_factory.mktemp("golden"), frames=7))
    return log


@torch.no_grad()
def figures(folder: Path, held_out: Any) -> dict[str, Any]:
    """Losses of every step, and means over pixels and beams of the edited scene, opened again."""
    lines = read_metrics(folder / "metrics.jsonl")
    losses = [{key: value for key, value in line.items() if key not in TIMES} for line in lines]
    scene = open_reconstruction(folder).scene
    graph = edited_scene(scene, EDITS).graph
    images, sweeps = [], []
    for view in held_out.cameras[::2]:
        picture = scene.camera(graph, view)
        layers = torch.cat([picture.rgb, picture.range_m.log1p()[None], picture.alpha[None]])
        images.append(adaptive_avg_pool2d(layers, (3, 4)).flatten().tolist())
    for sweep in held_out.sweeps[::2]:
        seen = scene.sweep(graph, scene.prepare_sweep(sweep), sweep.t_s)
        rows = torch.stack([seen.weighted_range_m.log1p(), seen.intensity, seen.drop_logit, seen.alpha])
        sweeps.append(adaptive_avg_pool1d(rows, 16).flatten().tolist())
    return {"losses": losses, "images": images, "sweeps": sweeps, "actors": graph.tracks.track_id.tolist()}


@pytest.mark.parametrize("name", ["tiny", pytest.param("published", marks=pytest.mark.slow)])
def test_a_reconstructed_log_is_what_it_was(name: str, log: LogPath, tmp_path: Path) -> None:
    run = reconstruct(recipe(name), log, tmp_path / "run")
    found = figures(run.folder, run.held_out)
    if os.environ.get("FOREDRIVE_WRITE_GOLDEN"):
        written = json.loads(GOLDEN.read_text()) if GOLDEN.is_file() else {}
        GOLDEN.write_text(json.dumps(written | {name: found}) + "\n")
    golden = json.loads(GOLDEN.read_text())[name]
    assert found["actors"] == golden["actors"] == [11, 20, 21]
    for step, (now, then) in enumerate(zip(found["losses"], golden["losses"], strict=True), start=1):
        assert now == pytest.approx(then, rel=RTOL, abs=ATOL), f"step {step}"
    for kind in ("images", "sweeps"):
        for now, then in zip(found[kind], golden[kind], strict=True):
            assert now == pytest.approx(then, rel=RTOL, abs=ATOL), kind
