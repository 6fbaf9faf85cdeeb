"""Training of a field: what a step learns is what is rendered."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch

from foredrive.data.log_writer import CameraSpec
from foredrive.engine.learning_rates import Rate
from foredrive.engine.metrics_log import read_metrics
from foredrive.methods.neurad.config import FieldConfig, GridConfig, GridsConfig
from foredrive.methods.neurad.decoders import PatchDecoderConfig
from foredrive.methods.neurad.recipes import FieldRecipe
from foredrive.methods.neurad.scene import FieldSceneConfig
from foredrive.methods.neurad.training import FieldRates, FieldSchedule
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.training import SensorViews, train_representation
from foredrive.methods.reconstruction.views import CameraView

STEPS = 150
DIRECTIONS = ((0.0, 60.0), (0.0, -40.0), (0.0, 0.0))
"""Yaw and pitch of the cameras, degrees."""


def looking(yaw_deg: float, pitch_deg: float) -> CameraView:
    """A view of the flat street at t = 0, 36 × 24 pixels and 90° wide."""
    yaw, pitch = np.deg2rad([yaw_deg, pitch_deg])
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    tilt = np.array([[np.cos(pitch), 0, -np.sin(pitch)], [0, 1, 0], [np.sin(pitch), 0, np.cos(pitch)]])
    T_ego_cam = np.eye(4)
    T_ego_cam[:3, :3] = turn @ tilt @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    T_ego_cam[:3, 3] = 0.0, 0.0, 1.5
    K = np.array([[18.0, 0, 18], [0, 18, 12], [0, 0, 1]])
    image = world.image(CameraSpec("c", K, T_ego_cam, (24, 36)), 0.0)
    return CameraView(
        K=torch.from_numpy(K).float(),
        dist=torch.zeros(5),
        T_scene_cam=torch.from_numpy(T_ego_cam).float(),
        twist_cam=torch.zeros(6),
        t_s=0.0,
        readout_s=0.0,
        size_hw=(24, 36),
        sensor=0,
        image=torch.from_numpy(image).permute(2, 0, 1),
    )


def no_tracks() -> ActorTracks:
    return ActorTracks(
        track_id=torch.zeros(0, dtype=torch.int64),
        category=torch.zeros(0, dtype=torch.int64),
        size_lwh=torch.zeros(0, 3),
        t_s=torch.tensor([0.0, 1.0]),
        T_scene_actor=torch.zeros(0, 2, 4, 4),
        present=torch.zeros(0, 2, dtype=torch.bool),
    )


@pytest.mark.slow
def test_what_was_trained_on_several_cameras_is_rendered(tmp_path: Path) -> None:
    """One camera sees the sky, one the ground, one both and two boxes: their features have other means.

    A patch is as large as an image, so that training and rendering decode the same rays.
    """
    views = [dataclasses.replace(looking(*angles), sensor=n) for n, angles in enumerate(DIRECTIONS)]
    small = GridsConfig(
        GridConfig(levels=4, features=2, coarsest=8, finest=128, log2_rows=12),
        GridConfig(levels=1, features=1, coarsest=8, finest=8, log2_rows=4),
    )
    quick = Rate(1e-2)
    representation = FieldRecipe(
        schedule=FieldSchedule(
            steps=STEPS, patches=6, beams=0, rates=FieldRates(grids=quick, layers=quick, decoder=quick)
        ),
        scene=FieldSceneConfig(
            FieldConfig(small, (small,), proposal_samples=(12,), samples=8, width=8, appearance=4),
            PatchDecoderConfig(8, 8, 3, 1, 1, batch_norm=True),
        ),
    )
    scene = representation.begin(SensorViews(views, []), no_tracks(), cameras=3, reach_m=40.0)
    train_representation(representation.training(scene, SensorViews(views, [])), tmp_path)
    lines = read_metrics(tmp_path / "metrics.jsonl")[-STEPS // 5 :]
    trained_db = np.mean([float(line["psnr_db"]) for line in lines])
    squares = []
    for view in views:
        assert view.image is not None
        with torch.no_grad():
            squares.append(((scene.camera(scene.graph, view).rgb - view.image / 255) ** 2).mean())
    rendered_db = float(-10 * torch.stack(squares).mean().log10())
    assert trained_db > 20
    assert rendered_db == pytest.approx(trained_db, abs=1.0)
