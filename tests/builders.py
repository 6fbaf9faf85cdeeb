"""Build what tests of several folders use: logs that are reconstructed in seconds, and short routes."""

import dataclasses
from pathlib import Path

import numpy as np
import synthetic_log

from foredrive.data import find_logs
from foredrive.methods.reconstruction.decoders import CameraDecoderConfig
from foredrive.methods.splatad.initial import InitialGaussians
from foredrive.methods.splatad.recipes import GaussianRecipe
from foredrive.methods.splatad.scene_config import GaussianSceneConfig
from foredrive.methods.splatad.training import GaussianSchedule
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe
from foredrive.runs.reconstruction.reconstruct import Reconstruction, reconstruct
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.traffic.lane_graph import build_lane_graph

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


def routes_along(path: Path, town: str) -> Path:
    """Write two routes of 14 m in CARLA's form, along one lane; CARLA's y points to the right."""
    graph = build_lane_graph(load_town_map(town))
    lane = int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))
    text = ""
    for name, first_m in (("a", 20.0), ("b", 60.0)):
        ends = graph.position(np.full(2, lane), np.array([first_m, first_m + 14.0]))
        points = "".join(f'<waypoint x="{x}" y="{-y}" z="{z}"/>' for x, y, z in ends)
        text += f'<route id="{name}" town="{town}">{points}</route>'
    path.write_text(f"<routes>{text}</routes>")
    return path
