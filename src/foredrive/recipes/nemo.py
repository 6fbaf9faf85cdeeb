"""NeMo's recipes."""

import dataclasses

from foredrive.data import ClipConfig
from foredrive.recipes.config import BackboneSize, BevEncoderSize, NemoSize, Recipe, Stage, VolumeEncoderSize
from foredrive.scene import VoxelSpec
from foredrive.training import LossWeights, PathFit, Schedule


def nemo_tiny() -> Recipe:
    """NeMo small enough for two CPU cores: the demo. Every part is there, only smaller.

    With the paper's λ (scal 10, BCE 1) a few hundred steps end in a road and nothing on it: the affinity loss
    pushes every voxel it is unsure of towards free, where its own gradient vanishes. A stronger BCE that
    counts occupied voxels threefold gets there. Imagined frames weigh a quarter: until motion is learned
    they only blur what stands beside the road.
    """
    few_steps = LossWeights(wpts=0.0, recon=0.0, occ=0.0, scal=1.0, bce=10.0, occupied=3.0, future=0.25)
    return Recipe(
        name="nemo_tiny",
        clips=ClipConfig(
            past_frames=1,
            future_frames=2,
            now_stride_s=0.1,  # every frame of a 10 Hz log is a now once
            image_hw=(96, 160),
            voxels=VoxelSpec(lower_m=(-24.0, -24.0, -1.5), voxel_m=1.0, shape_zyx=(6, 48, 48)),
        ),
        model=NemoSize(
            backbone=BackboneSize(
                embedding_size=24,
                hidden_sizes=(24, 48, 96),
                depths=(1, 1, 1),
                layer_type="basic",
                stages=("stage2", "stage3"),
            ),
            encoder=VolumeEncoderSize(heads=4, points=4, layers=2),
            channels=32,
            occupancy_hidden=32,
            motion_hidden=16,
            ray_near_m=1.0,
            ray_far_m=34.0,
            ray_samples=32,
            recon_hidden=64,
            planner_width=128,
            planner_layers=3,
            planner_heads=4,
            attention_pool=(2, 4, 4),
        ),
        pretrain=Stage(
            schedule=Schedule(batch_size=4, lr=2e-3, steps=200, warmup_steps=20, workers=1),
            weights=dataclasses.replace(few_steps, wpts=0.0, recon=2.0, occ=1.0),
            ray_stride=8,
        ),
        finetune=Stage(
            schedule=Schedule(batch_size=4, lr=1e-3, steps=160, warmup_steps=10, workers=1),
            weights=dataclasses.replace(few_steps, wpts=1.0, recon=1.0, occ=0.5),
            ray_stride=16,
        ),
    )


def nemo_town() -> Recipe:
    """NeMo for claims tested on two CPU cores: 500 steps of pre-training, 150 of fine-tuning on towns.

    As `nemo_tiny`, but it sees further ahead and is trained for longer. Its planner knows the last key frame
    too and starts from what ego status alone says, so that what it scores beyond the ego-only MLP is what
    looking brings; it reads the volume along that plan by a head that is fitted last.
    """
    tiny = nemo_tiny()
    pretrain, finetune = tiny.pretrain, tiny.finetune
    assert pretrain is not None
    assert isinstance(tiny.model, NemoSize)
    return dataclasses.replace(
        tiny,
        name="nemo_town",
        clips=dataclasses.replace(
            tiny.clips,
            now_stride_s=0.5,
            voxels=VoxelSpec(lower_m=(-16.0, -24.0, -1.5), voxel_m=1.0, shape_zyx=(6, 48, 56)),
        ),
        model=dataclasses.replace(
            tiny.model,
            ray_far_m=48.0,
            planner_history=1,
            planner_base="ego_mlp",
            planner_look_m=(2.0, 5.0, 9.0, 13.0, 18.0, 24.0, 31.0, 39.0),
        ),
        path=PathFit(),
        pretrain=dataclasses.replace(
            pretrain, schedule=dataclasses.replace(pretrain.schedule, steps=500, warmup_steps=50)
        ),
        finetune=dataclasses.replace(
            finetune, schedule=dataclasses.replace(finetune.schedule, steps=150, warmup_steps=20)
        ),
    )


def nemo_drive() -> Recipe:
    """`nemo_town` to drive in closed loop, trained on lessons (`foredrive drive --agent disturbed`).

    Two things differ in what the planner is told. It does not know where it was half a second ago: who
    learns from that learns to go on as before, and stands for ever once he stands. And it knows where the
    route leads, as agents on CARLA's leaderboards do: the command alone leaves open when a turn begins.
    """
    town = nemo_town()
    return dataclasses.replace(
        town,
        name="nemo_drive",
        clips=dataclasses.replace(town.clips, future_source="taught"),
        model=dataclasses.replace(town.model, planner_history=0, planner_target=True),
    )


def nemo_base() -> Recipe:
    """The paper's size: ResNet-50, 200×200×16 voxels of 0.5 m, six cameras, two stages of 10 epochs.

    Constants of §4.1; what it leaves open: D = 64, three rounds of lifting with 8 heads and 8 points, four
    pyramid levels, T_f = 3 at 0.5 s, images of 450×800, λ_perc = 0.1 (Video Autoencoder).
    """
    schedule = Schedule(
        batch_size=1,
        lr=2e-4,
        epochs=10,
        weight_decay=1e-2,
        warmup_steps=500,
        checkpoint_every=1000,
        workers=4,
    )
    return Recipe(
        name="nemo_base",
        clips=ClipConfig(
            past_frames=1,
            future_frames=3,
            image_hw=(448, 800),
            voxels=VoxelSpec(lower_m=(-50.0, -50.0, -3.0), voxel_m=0.5, shape_zyx=(16, 200, 200)),
        ),
        model=NemoSize(
            backbone=BackboneSize(
                embedding_size=64,
                hidden_sizes=(256, 512, 1024, 2048),
                depths=(3, 4, 6, 3),
                layer_type="bottleneck",
                stages=("stage1", "stage2", "stage3", "stage4"),
                weights="microsoft/resnet-50",
            ),
            encoder=VolumeEncoderSize(heads=8, points=8, layers=3),
            channels=64,
            occupancy_hidden=64,
            motion_hidden=64,
            ray_near_m=1.0,
            ray_far_m=72.0,
            ray_samples=96,
            recon_hidden=128,
            planner_width=256,
            planner_layers=3,
            planner_heads=8,
            attention_pool=(4, 8, 8),
            checkpoint=("encoder",),  # 16 of the 23 GiB that would be kept
        ),
        pretrain=Stage(
            schedule=schedule,
            weights=LossWeights(wpts=0.0, recon=1.0, occ=1.0),
            ray_stride=8,
            vgg16="download",
        ),
        finetune=Stage(
            schedule=schedule,
            weights=LossWeights(wpts=1.0, recon=0.5, occ=0.5),
            ray_stride=8,
            vgg16="download",
        ),
        precision="bf16-mixed",
    )


BASE_BEV = BevEncoderSize(width=256, heads=8, points=2, pillars=4, layers=3)
"""BEVFormer's width and heights; as many rounds as NeMo's own encoder."""
TOWN_BEV = BevEncoderSize(width=96, heads=4, points=2, pillars=4, layers=2)
