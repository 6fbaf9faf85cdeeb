"""DriveWorld's recipes."""

from dataclasses import replace

from foredrive.data import ClipConfig
from foredrive.engine.loop import Schedule
from foredrive.methods.blocks.backbone import BackboneConfig
from foredrive.methods.blocks.lift_splat import LiftSplatConfig
from foredrive.methods.blocks.lifting import LiftingConfig
from foredrive.methods.blocks.pooled_lifting import PooledLiftingConfig
from foredrive.methods.blocks.text_encoder import PACKAGED_MODEL
from foredrive.methods.driveworld import DriveWorldConfig
from foredrive.methods.driveworld.objective import DriveWorldStage, DriveWorldWeights
from foredrive.methods.driveworld.planes import (
    PlanesToVolumeConfig,
    PlaneToVectorConfig,
    StaticSceneConfig,
    VectorToPlaneConfig,
)
from foredrive.methods.driveworld.state_space import StateSpaceConfig
from foredrive.methods.driveworld.task_prompt import PROMPTS, PromptConfig
from foredrive.methods.nemo.recipes import nemo_base, nemo_tiny, nemo_town
from foredrive.methods.recipe import Recipe, rescheduled

DriveWorldRecipe = Recipe[DriveWorldConfig, DriveWorldStage]

OBSERVED, IMAGINED = 4, 4
"""T and L of the paper."""


def driveworld_tiny() -> DriveWorldRecipe:
    """Return a small DriveWorld for two CPU cores. It has all parts, and T and L of the paper.

    Images, voxels, the planner and the occupancy loss are those of `nemo_tiny`. Eq. 3 has cross-entropy
    alone; these weights keep NeMo from learning an empty road in a few hundred steps.
    """
    nemo = nemo_tiny()
    few_steps = DriveWorldWeights(scal=1.0, bce=10.0, occupied=3.0)
    return Recipe(
        name="driveworld_tiny",
        about="DriveWorld small enough for two CPU cores",
        clips=_in_time(nemo.clips),
        model=DriveWorldConfig(
            backbone=BackboneConfig(
                embedding_size=24,
                hidden_sizes=(24, 48, 96),
                depths=(1, 1, 1),
                layer_type="basic",
                stages=("stage2", "stage3"),
            ),
            encoder=LiftSplatConfig(near_m=1.0, far_m=34.0, step_m=1.0),
            states=StateSpaceConfig(
                observation=128, state=64, history=128, memory=8, heads=4, objects=8, hidden=128
            ),
            channels=32,
            plane_channels=32,
            to_vector=PlaneToVectorConfig(hidden=16),
            from_vector=VectorToPlaneConfig(widths=(64, 32, 16, 8)),
            to_volume=PlanesToVolumeConfig(hidden=8),
            statics=StaticSceneConfig(channels=32),
            prompt=PromptConfig(
                prompts=tuple(PROMPTS),
                expand=VectorToPlaneConfig(widths=(32, 16, 8)),
                encoding=384,
                text_encoder=PACKAGED_MODEL,
            ),
        ),
        planner=nemo.planner,
        pretrain=DriveWorldStage(
            schedule=Schedule(batch_size=4, lr=2e-3, steps=400, warmup_steps=20, workers=1),
            weights=few_steps,
        ),
        finetune=DriveWorldStage(
            schedule=Schedule(batch_size=4, lr=1e-3, steps=160, warmup_steps=10, workers=1),
            weights=replace(few_steps, occ=0.5, wpts=1.0),
            statics_of="now",
        ),
    )


def driveworld_town() -> DriveWorldRecipe:
    """Return a DriveWorld for claims tested on two CPU cores, on towns.

    Grid, backbone, lifting, planner and precision are those of `nemo_town`. A step costs more, because every
    item has four observed and four imagined frames.
    """
    tiny, nemo = driveworld_tiny(), nemo_town()
    pretrain, finetune, lifting = tiny.pretrain, tiny.finetune, nemo.model.encoder
    assert pretrain is not None
    assert isinstance(lifting, LiftingConfig)
    return replace(
        tiny,
        name="driveworld_town",
        about="DriveWorld for claims tested on two CPU cores, on towns",
        clips=_in_time(nemo.clips),
        model=replace(tiny.model, backbone=nemo.model.backbone, encoder=PooledLiftingConfig(lifting)),
        planner=nemo.planner,
        path=nemo.path,
        pretrain=rescheduled(pretrain, steps=500, warmup_steps=50),
        finetune=rescheduled(finetune, steps=150, warmup_steps=20),
        precision=nemo.precision,
    )


def driveworld_base() -> DriveWorldRecipe:
    """Return the paper's size: ResNet-101, 200×200×16 voxels, 24 epochs at 2e-4, then 20.

    The paper's ResNet-101 has deformable convolutions (DCN), this one has none. The 20 epochs are UniAD's
    second stage. The occupancy loss is eq. 3's cross-entropy, summed over frames.

    Constants are from §4.1 and from MILE (state and history). Values not given there: D = 64, a plane of 256
    channels, a memory of 16, K = 32, images of 448×800, voxels of 0.5 m.
    """
    nemo = nemo_base()
    schedule = replace(nemo.finetune.schedule, epochs=24)
    as_published = DriveWorldWeights(over_frames="sum")
    return Recipe(
        name="driveworld_base",
        about="DriveWorld at the paper's size, for a GPU",
        clips=_in_time(nemo.clips),
        model=DriveWorldConfig(
            backbone=replace(
                nemo.model.backbone,
                depths=(3, 4, 23, 3),
                weights="microsoft/resnet-101",
                checkpoint=True,
            ),
            encoder=PooledLiftingConfig(LiftingConfig(heads=8, points=8, layers=3, checkpoint=True)),
            states=StateSpaceConfig(
                observation=512, state=512, history=1024, memory=16, heads=8, objects=32, hidden=1024
            ),
            channels=64,
            plane_channels=256,
            to_vector=PlaneToVectorConfig(hidden=128),
            from_vector=VectorToPlaneConfig(widths=(512, 256, 128, 64)),
            to_volume=PlanesToVolumeConfig(hidden=16),
            statics=StaticSceneConfig(channels=256),
            prompt=PromptConfig(
                prompts=tuple(PROMPTS),
                expand=VectorToPlaneConfig(widths=(256, 128, 64, 64)),
                encoding=384,
                text_encoder=PACKAGED_MODEL,
            ),
        ),
        planner=nemo.planner,
        pretrain=DriveWorldStage(schedule=schedule, weights=as_published),
        finetune=DriveWorldStage(
            schedule=replace(schedule, epochs=20),
            weights=replace(as_published, occ=0.5, wpts=1.0),
            statics_of="now",
        ),
        precision=nemo.precision,
    )


def _in_time(clips: ClipConfig) -> ClipConfig:
    """Return NeMo's images and voxels with the paper's number of key frames."""
    # Images of imagined frames are not read: DriveWorld reconstructs no images
    return replace(clips, past_frames=OBSERVED - 1, future_frames=IMAGINED, future_images=False)
