"""DriveWorld's recipes."""

from foredrive.data import ClipConfig
from foredrive.models.text_encoder import IN_A_PACKAGE
from foredrive.recipes.config import (
    BackboneSize,
    DriveWorldSize,
    DriveWorldStage,
    LiftSplatSize,
    PromptSize,
    Recipe,
)
from foredrive.scene import VoxelSpec
from foredrive.training import DriveWorldWeights, Schedule

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
        ),
    )
