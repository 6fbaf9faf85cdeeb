"""A run of seconds: world models with every part but hardly any width, and a log of five seconds for them."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import synthetic_log
from flat_street import street

from foredrive.data import ClipConfig, LogPath, find_logs
from foredrive.data.logs import Log
from foredrive.data.maps import write_map
from foredrive.engine.loop import Schedule
from foredrive.engine.metrics_log import read_metrics
from foredrive.methods.blocks.backbone import BackboneConfig
from foredrive.methods.blocks.bev import BevConfig
from foredrive.methods.blocks.lift_splat import LiftSplatConfig
from foredrive.methods.blocks.lifting import LiftingConfig
from foredrive.methods.blocks.pooled_lifting import PooledLiftingConfig
from foredrive.methods.driveworld import DriveWorldConfig
from foredrive.methods.driveworld.objective import DriveWorldStage, DriveWorldWeights
from foredrive.methods.driveworld.planes import (
    PlanesToVolumeConfig,
    PlaneToVectorConfig,
    StaticSceneConfig,
    VectorToPlaneConfig,
)
from foredrive.methods.driveworld.recipes import DriveWorldRecipe
from foredrive.methods.driveworld.state_space import StateSpaceConfig
from foredrive.methods.nemo import MotionConfig, NemoConfig, RendererConfig
from foredrive.methods.nemo.objective import NemoStage, NemoWeights
from foredrive.methods.nemo.recipes import NemoRecipe
from foredrive.methods.planner.planner import PlannerConfig
from foredrive.methods.recipe import Recipe
from foredrive.scene import VoxelSpec

STEPS = 3
"""Of either stage."""


def miniature() -> NemoRecipe:
    """A step takes some hundredths of a second."""
    return Recipe(
        name="miniature",
        clips=ClipConfig(
            past_frames=1,
            future_frames=2,
            image_hw=(32, 64),
            voxels=VoxelSpec(lower_m=(-16.0, -16.0, -1.0), voxel_m=2.0, shape_zyx=(2, 16, 16)),
        ),
        model=NemoConfig(
            backbone=BackboneConfig(
                embedding_size=8,
                hidden_sizes=(8, 16, 16),
                depths=(1, 1, 1),
                layer_type="basic",
                stages=("stage2", "stage3"),
            ),
            encoder=LiftingConfig(heads=2, points=2, layers=1),
            motion=MotionConfig(hidden=4),
            renderer=RendererConfig(near_m=1.0, far_m=24.0, samples=8, hidden=16),
            channels=8,
            occupancy_hidden=8,
        ),
        planner=PlannerConfig(width=16, layers=1, heads=2, pool=(1, 4, 4)),
        pretrain=NemoStage(
            schedule=Schedule(batch_size=2, lr=2e-3, steps=STEPS, warmup_steps=1),
            weights=NemoWeights(wpts=0.0, recon=1.0, occ=1.0),
            ray_stride=4,
        ),
        finetune=NemoStage(
            schedule=Schedule(batch_size=2, lr=1e-3, steps=STEPS, warmup_steps=1),
            weights=NemoWeights(wpts=1.0, recon=0.5, occ=0.5),
            ray_stride=8,
        ),
    )


def miniature_driveworld() -> DriveWorldRecipe:
    """The same with a DriveWorld, but without task prompts, which need a text encoder."""
    nemo = miniature()
    return Recipe(
        name="miniature_driveworld",
        clips=nemo.clips,
        model=DriveWorldConfig(
            backbone=nemo.model.backbone,
            encoder=LiftSplatConfig(near_m=1.0, far_m=17.0, step_m=2.0),
            states=StateSpaceConfig(
                observation=8, state=6, history=8, memory=4, heads=2, objects=3, hidden=16
            ),
            channels=8,
            plane_channels=8,
            to_vector=PlaneToVectorConfig(hidden=4),
            from_vector=VectorToPlaneConfig(widths=(8, 4)),
            to_volume=PlanesToVolumeConfig(hidden=4),
            statics=StaticSceneConfig(channels=4),
            prompt=None,
        ),
        planner=nemo.planner,
        pretrain=DriveWorldStage(
            schedule=Schedule(batch_size=2, lr=2e-3, steps=STEPS, warmup_steps=1), weights=DriveWorldWeights()
        ),
        finetune=DriveWorldStage(
            schedule=Schedule(batch_size=2, lr=1e-3, steps=STEPS, warmup_steps=1),
            weights=DriveWorldWeights(occ=0.5, wpts=1.0),
        ),
    )


def with_steps(recipe: Recipe, pretrain: int, finetune: int) -> Recipe:
    """The recipe with other lengths of its stages."""
    stages = {
        name: dataclasses.replace(stage, schedule=dataclasses.replace(stage.schedule, steps=steps))
        for name, stage, steps in (
            ("pretrain", recipe.pretrain, pretrain),
            ("finetune", recipe.finetune, finetune),
        )
    }
    return dataclasses.replace(recipe, **stages)


def in_two_parts() -> Recipe[Any, Any]:
    """Return the miniature with two parts in each step, and a checkpoint after each."""
    recipe = miniature()
    stages = {
        name: dataclasses.replace(
            stage, schedule=dataclasses.replace(stage.schedule, accumulate=2, checkpoint_every=1)
        )
        for name, stage in (("pretrain", recipe.pretrain), ("finetune", recipe.finetune))
        if stage is not None
    }
    return dataclasses.replace(recipe, name="in two parts", **stages)


def losses(run: Path, stage: str) -> list[dict[str, float]]:
    """Return the losses of the steps of a stage."""
    timed = ("step_s", "cpu_s")
    lines = read_metrics(run / stage / "metrics.jsonl")
    return [{name: value for name, value in line.items() if name not in timed} for line in lines]


def assert_same_losses(run: Path, other: Path) -> None:
    """Compare the losses of two runs in both stages."""
    for stage in ("pretrain", "finetune"):
        found, expected = losses(run, stage), losses(other, stage)
        assert len(found) == len(expected) == STEPS
        for one, two in zip(found, expected, strict=True):
            assert one == pytest.approx(two, rel=1e-4)


def write_log(root: Path, name: str = "flat", frames: int = 51) -> LogPath:
    """Write a log at 10 Hz, 5 s long by default, with two cameras, lidar and boxes."""
    (log,) = find_logs(synthetic_log.write(root, frames=frames, name=name))
    return log


def with_map(log: LogPath, root: Path) -> LogPath:
    """The same log with the map of a street."""
    return LogPath(log.folder, write_map(street(), str(Log(log).metadata.location), root))


def shrunk(recipe: Recipe) -> Recipe:
    """Any recipe with all its parts and stages in the sizes of the miniature, and without named weights."""
    clips = dataclasses.replace(
        recipe.clips, image_hw=(32, 64), voxels=miniature().clips.voxels, cameras=None, part_s=None
    )
    first = recipe.pretrained_model
    stages = {
        name: dataclasses.replace(stage, perceptual=None, ray_stride=8) if stage.kind == "nemo" else stage
        for name in ("pretrain", "finetune")
        if (stage := getattr(recipe, name)) is not None
    }
    return dataclasses.replace(
        recipe,
        clips=clips,
        model=_shrunk_model(recipe.model),
        pretrained_model=None if first is None else _shrunk_model(first),
        planner=dataclasses.replace(recipe.planner, width=16, layers=2, heads=2, pool=(1, 4, 4)),
        **stages,
    )


def _shrunk_model(model: NemoConfig | DriveWorldConfig) -> NemoConfig | DriveWorldConfig:
    depth = len(model.backbone.depths)
    backbone = dataclasses.replace(
        miniature().model.backbone,
        hidden_sizes=(8, 16, 16, 16)[:depth],
        depths=(1,) * depth,
        stages=model.backbone.stages,
        checkpoint=model.backbone.checkpoint,
    )
    if isinstance(model, NemoConfig):
        return dataclasses.replace(
            miniature().model, backbone=backbone, encoder=_shrunk_encoder(model.encoder)
        )
    small = miniature_driveworld().model
    parts = {"memory_bank": model.states.memory_bank, "motion_norm": model.states.motion_norm}
    prompt = model.prompt and dataclasses.replace(model.prompt, expand=VectorToPlaneConfig(widths=(8, 4)))
    return dataclasses.replace(
        small,
        backbone=backbone,
        encoder=_shrunk_encoder(model.encoder),
        states=dataclasses.replace(small.states, **parts),
        statics=model.statics and small.statics,
        prompt=prompt,
        warp_statics=model.warp_statics,
    )


def _shrunk_encoder(encoder: Any) -> Any:
    if isinstance(encoder, PooledLiftingConfig):
        return dataclasses.replace(encoder, lifting=_shrunk_encoder(encoder.lifting))
    if isinstance(encoder, BevConfig):
        return dataclasses.replace(encoder, width=8, heads=2, points=2, pillars=2)
    if isinstance(encoder, LiftingConfig):
        return dataclasses.replace(encoder, heads=2, points=2)
    return encoder
