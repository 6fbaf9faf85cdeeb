"""DriveWorld's recipes."""

from dataclasses import replace

from foredrive.data import ClipConfig
from foredrive.models.text_encoder import IN_A_PACKAGE
from foredrive.recipes.config import (
    DriveWorldSize,
    DriveWorldStage,
    LiftSplatSize,
    NemoSize,
    PooledLiftingSize,
    PromptSize,
    Recipe,
    rescheduled,
)
from foredrive.recipes.nemo import nemo_base, nemo_tiny, nemo_town
from foredrive.training import DriveWorldWeights, Schedule

OBSERVED, IMAGINED = 4, 4
"""T and L of the paper."""


def driveworld_tiny() -> Recipe:
    """DriveWorld small enough for two CPU cores. Every part is there, only smaller; T and L are the paper's.

    Images, voxels and the planner are those of `nemo_tiny`.
    """
    nemo = nemo_tiny()
    assert isinstance(nemo.model, NemoSize)
    return Recipe(
        name="driveworld_tiny",
        clips=_in_time(nemo.clips),
        model=DriveWorldSize(
            backbone=nemo.model.backbone,
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
            planner_width=nemo.model.planner_width,
            planner_layers=nemo.model.planner_layers,
            planner_heads=nemo.model.planner_heads,
            attention_pool=nemo.model.attention_pool,
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
    """DriveWorld for claims tested on two CPU cores: grid, planner and steps are those of `nemo_town`.

    One round of deformable lifting: after 300 steps, statics carried along, above-ground IoU on 32 clips of
    Town05 was 0.127; by lift, splat, shoot, whose steps take two thirds of the time, 0.108.
    """
    tiny, nemo = driveworld_tiny(), nemo_town()
    pretrain, finetune = tiny.pretrain, tiny.finetune
    assert pretrain is not None
    assert isinstance(tiny.model, DriveWorldSize)
    assert isinstance(nemo.model, NemoSize)
    return replace(
        tiny,
        name="driveworld_town",
        clips=_in_time(nemo.clips),
        model=replace(
            tiny.model,
            encoder=PooledLiftingSize(heads=4, points=4, layers=1),
            planner_history=nemo.model.planner_history,
            planner_base=nemo.model.planner_base,
            planner_look_m=nemo.model.planner_look_m,
        ),
        path=nemo.path,
        pretrain=rescheduled(pretrain, steps=500, warmup_steps=50),
        finetune=rescheduled(finetune, steps=150, warmup_steps=20),
    )


def driveworld_base() -> Recipe:
    """The paper's size: ResNet-101, 200×200×16 voxels, 24 epochs at 2e-4, then 20 (UniAD's second stage).

    Constants of §4.1 and of MILE (state and history); what they leave open: D = 64, a plane of 256 channels,
    a memory of 16, K = 32, images of 448×800, voxels of 0.5 m.
    """
    nemo = nemo_base()
    assert isinstance(nemo.model, NemoSize)
    schedule = replace(nemo.finetune.schedule, epochs=24)
    return Recipe(
        name="driveworld_base",
        clips=_in_time(nemo.clips),
        model=DriveWorldSize(
            backbone=replace(nemo.model.backbone, depths=(3, 4, 23, 3), weights="microsoft/resnet-101"),
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
            planner_width=nemo.model.planner_width,
            planner_layers=nemo.model.planner_layers,
            planner_heads=nemo.model.planner_heads,
            attention_pool=nemo.model.attention_pool,
            checkpoint=("backbone", "encoder"),
        ),
        pretrain=DriveWorldStage(schedule=schedule, weights=DriveWorldWeights()),
        finetune=DriveWorldStage(
            schedule=replace(schedule, epochs=20),
            weights=DriveWorldWeights(occ=0.5, wpts=1.0),
            statics_of="now",
        ),
        precision=nemo.precision,
    )


def _in_time(clips: ClipConfig) -> ClipConfig:
    """NeMo's images and voxels, of as many key frames as the paper looks at."""
    return replace(clips, past_frames=OBSERVED - 1, future_frames=IMAGINED, future_images=False)
