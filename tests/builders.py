"""What tests of several folders build: logs that are reconstructed in seconds."""

import dataclasses
from pathlib import Path

import synthetic_log

from foredrive.data import find_logs
from foredrive.methods.reconstruction.decoders import CameraDecoderConfig
from foredrive.methods.splatad.initial import InitialGaussians
from foredrive.methods.splatad.recipes import GaussianRecipe
from foredrive.methods.splatad.scene_config import GaussianSceneConfig
from foredrive.methods.splatad.training import GaussianSchedule
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe
from foredrive.runs.reconstruction.reconstruct import Reconstruction, reconstruct

SMALLEST = ReconstructionRecipe(
    name="smallest",
    image_hw=(24, 48),
    moves_m=0.0,
    representation=GaussianRecipe(
        initial=InitialGaussians(
            lidar_points=1100,
            unseen_points=400,
            pixel_points=1000,
            near_points=0,
            actor_points=80,
            features=2,
        ),
        schedule=GaussianSchedule(steps=2, max_gaussians=3000, beam_stride=4),
        scene=GaussianSceneConfig(CameraDecoderConfig(width=8)),
    ),
)
"""Hardly any Gaussians, hardly trained. What stands is an actor too."""
ONE_CAMERA = dataclasses.replace(SMALLEST, cameras=("ahead",))


def reconstructed_log(
    folder: Path, frames: int, recipe: ReconstructionRecipe[GaussianRecipe] = SMALLEST
) -> Reconstruction:
    """A made-up log that is reconstructed, in `run` beside the log."""
    (log,) = find_logs(synthetic_log.write(folder, frames=frames))
    return reconstruct(recipe, log, folder / "run")
