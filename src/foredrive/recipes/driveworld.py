"""DriveWorld's recipes."""

from dataclasses import replace

from foredrive.data import ClipConfig
from foredrive.models.text_encoder import IN_A_PACKAGE
from foredrive.recipes.config import (
    BackboneSize,
    DriveWorldSize,
    DriveWorldStage,
    LiftSplatSize,
    PooledLiftingSize,
    PromptSize,
    Recipe,
    rescheduled,
)
from foredrive.scene import VoxelSpec
from foredrive.training import DriveWorldWeights, PathFit, Schedule

OBSERVED, IMAGINED = 4, 4
"""T and L of the paper."""


def driveworld_tiny() -> Recipe:
    """DriveWorld small enough for two CPU cores. Every part is there, only smaller; T and L are the paper's.

    Images, voxels and the planner are those of `nemo_tiny`.
    """
    return Recipe(
        name="driveworld_tiny",
        clips=ClipConfig(
            past_frames=OBSERVED - 1,
            future_frames=IMAGINED,
            future_images=False,
            image_hw=(96, 160),
            voxels=VoxelSpec(lower_m=(-24.0, -24.0, -1.5), voxel_m=1.0, shape_zyx=(6, 48, 48)),
        ),
        model=DriveWorldSize(
            backbone=BackboneSize(
                embedding_size=24,
                hidden_sizes=(24, 48, 96),
                depths=(1, 1, 1),
                layer_type="basic",
                stages=("stage2", "stage3"),
            ),
            encoder=LiftSplatSize(near_m=1.0, far_m=34.0, step_m=1.0),
            channels=32,
            plane=32,
            observation=128,
            observation_hidden=16,
            state=64,
            history=128,
            memory=8,
            memory_heads=4,
            objects=8,
            states_hidden=128,
            expanded=(64, 32, 16, 8),
            volume_hidden=8,
            statics=32,
            prompt=PromptSize(widths=(32, 16, 8), encoding=384, text_encoder=IN_A_PACKAGE),
            planner_width=128,
            planner_layers=3,
            planner_heads=4,
            attention_pool=(2, 4, 4),
        ),
        pretrain=DriveWorldStage(
            schedule=Schedule(batch_size=4, lr=2e-3, steps=400, warmup_steps=20, workers=1),
            weights=DriveWorldWeights(),
        ),
        finetune=DriveWorldStage(
            schedule=Schedule(batch_size=4, lr=1e-3, steps=160, warmup_steps=10, workers=1),
            weights=DriveWorldWeights(occ=0.5, wpts=1.0),
            statics_of="now",
        ),
    )


def driveworld_town() -> Recipe:
    """DriveWorld for claims tested on two CPU cores: grid, planner and steps are those of `nemo_town`."""
    tiny = driveworld_tiny()
    pretrain, finetune = tiny.pretrain, tiny.finetune
    assert pretrain is not None
    assert isinstance(tiny.model, DriveWorldSize)
    return replace(
        tiny,
        name="driveworld_town",
        clips=replace(
            tiny.clips,
            now_stride_s=0.5,
            voxels=VoxelSpec(lower_m=(-16.0, -24.0, -1.5), voxel_m=1.0, shape_zyx=(6, 48, 56)),
        ),
        model=replace(
            tiny.model,
            encoder=LiftSplatSize(near_m=1.0, far_m=48.0, step_m=1.0),
            planner_history=1,
            planner_base="ego_mlp",
            planner_look_m=(2.0, 5.0, 9.0, 13.0, 18.0, 24.0, 31.0, 39.0),
        ),
        path=PathFit(),
        pretrain=rescheduled(pretrain, steps=500, warmup_steps=50),
        finetune=rescheduled(finetune, steps=150, warmup_steps=20),
    )


def driveworld_base() -> Recipe:
    """The paper's size: ResNet-101, 200×200×16 voxels, 24 epochs at 2e-4, then 20 (UniAD's second stage).

    Constants of §4.1 and of MILE (state and history); what they leave open: D = 64, a plane of 256 channels,
    a memory of 16, K = 32, images of 448×800, voxels of 0.5 m.
    """
    schedule = Schedule(
        batch_size=1,
        lr=2e-4,
        epochs=24,
        weight_decay=1e-2,
        warmup_steps=500,
        checkpoint_every=1000,
        workers=4,
    )
    return Recipe(
        name="driveworld_base",
        clips=ClipConfig(
            past_frames=OBSERVED - 1,
            future_frames=IMAGINED,
            future_images=False,
            image_hw=(448, 800),
            voxels=VoxelSpec(lower_m=(-50.0, -50.0, -3.0), voxel_m=0.5, shape_zyx=(16, 200, 200)),
        ),
        model=DriveWorldSize(
            backbone=BackboneSize(
                embedding_size=64,
                hidden_sizes=(256, 512, 1024, 2048),
                depths=(3, 4, 23, 3),
                layer_type="bottleneck",
                stages=("stage1", "stage2", "stage3", "stage4"),
                weights="microsoft/resnet-101",
            ),
            encoder=PooledLiftingSize(heads=8, points=8, layers=3),
            channels=64,
            plane=256,
            observation=512,
            observation_hidden=128,
            state=512,
            history=1024,
            memory=16,
            memory_heads=8,
            objects=32,
            states_hidden=1024,
            expanded=(512, 256, 128, 64),
            volume_hidden=16,
            statics=256,
            prompt=PromptSize(widths=(256, 128, 64, 64), encoding=384, text_encoder=IN_A_PACKAGE),
            planner_width=256,
            planner_layers=3,
            planner_heads=8,
            attention_pool=(4, 8, 8),
            checkpoint=("backbone", "encoder"),
        ),
        pretrain=DriveWorldStage(schedule=schedule, weights=DriveWorldWeights()),
        finetune=DriveWorldStage(
            schedule=replace(schedule, epochs=20),
            weights=DriveWorldWeights(occ=0.5, wpts=1.0),
            statics_of="now",
        ),
        precision="bf16-mixed",
    )
