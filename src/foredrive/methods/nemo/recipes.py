"""NeMo's recipes."""

import dataclasses

from foredrive.data import ClipConfig
from foredrive.data.augmentation import AugmentConfig
from foredrive.engine.loop import Schedule
from foredrive.methods.blocks.backbone import BackboneConfig
from foredrive.methods.blocks.bev import BevConfig
from foredrive.methods.blocks.lifting import LiftingConfig
from foredrive.methods.blocks.plane_context import PlaneContextConfig
from foredrive.methods.nemo import MotionConfig, NemoConfig, RendererConfig
from foredrive.methods.nemo.objective import NemoStage, NemoWeights
from foredrive.methods.nemo.sampling import ImaginationSampling
from foredrive.methods.planner.ego_mlp import EgoMLPConfig
from foredrive.methods.planner.path_correction import PathCorrectionConfig
from foredrive.methods.planner.path_fit import PathFit
from foredrive.methods.planner.planner import PlannerConfig
from foredrive.methods.recipe import Recipe, rescheduled
from foredrive.scene import VoxelSpec

NemoRecipe = Recipe[NemoConfig, NemoStage]


def nemo_tiny() -> NemoRecipe:
    """Return a small NeMo for two CPU cores, the demo. It has all parts.

    With the paper's λ (scal 10, BCE 1), a few hundred steps give an empty road: the affinity loss pushes
    uncertain voxels towards free, where its gradient vanishes. A stronger BCE with threefold weight on
    occupied voxels avoids this. Imagined frames have weight 1/4, because before motion is learned they only
    blur objects beside the road.

    To learn more in the same time, it lifts once, from stride 4, and relates the voxels by a U-Net in the
    plane in place of self-attention. In pre-training one item in four is imagined, past frames have no
    gradients, and half of the examples are mirrored. None of this is the paper's.
    """
    few_steps = NemoWeights(wpts=0.0, recon=0.0, occ=0.0, scal=1.0, bce=10.0, occupied=3.0, future=0.25)
    return Recipe(
        name="nemo_tiny",
        about="NeMo small enough for two CPU cores: the demo",
        clips=ClipConfig(
            past_frames=1,
            future_frames=2,
            now_stride_s=0.1,  # every frame of a 10 Hz log is the present of one clip
            image_hw=(96, 160),
            voxels=VoxelSpec(lower_m=(-24.0, -24.0, -1.5), voxel_m=1.0, shape_zyx=(6, 48, 48)),
        ),
        model=NemoConfig(
            backbone=BackboneConfig(
                embedding_size=24,
                hidden_sizes=(32, 64, 96),
                depths=(1, 1, 1),
                layer_type="basic",
                stages=("stage1", "stage2", "stage3"),
                levels=1,
            ),
            encoder=LiftingConfig(
                heads=4, points=2, layers=1, self_attention=False, context=PlaneContextConfig()
            ),
            motion=MotionConfig(hidden=16),
            renderer=RendererConfig(near_m=1.0, far_m=34.0, samples=32, hidden=64),
            channels=32,
            occupancy_hidden=32,
        ),
        planner=PlannerConfig(width=128, layers=3, heads=4, pool=(2, 4, 4)),
        pretrain=NemoStage(
            schedule=Schedule(batch_size=4, lr=3e-3, steps=500, warmup_steps=40, workers=1),
            weights=dataclasses.replace(few_steps, wpts=0.0, recon=2.0, occ=1.0),
            ray_stride=8,
            imagined=ImaginationSampling(items=1, past_gradient=False),
            augment=AugmentConfig(mirror=0.5),
        ),
        finetune=NemoStage(
            schedule=Schedule(batch_size=4, lr=1e-3, steps=160, warmup_steps=10, workers=1),
            weights=dataclasses.replace(few_steps, wpts=1.0, recon=1.0, occ=0.5),
            ray_stride=16,
            imagined=ImaginationSampling(past_gradient=False),
        ),
    )


def nemo_town() -> NemoRecipe:
    """Return a NeMo for claims tested on two CPU cores, on towns.

    Pre-training takes ten minutes of two cores. It is `nemo_tiny` with a longer view ahead, more steps, and
    bfloat16 where the processor computes it faster. Its planner also knows the last key frame and starts from
    the plan of the ego MLP, so any gain over the ego MLP comes from perception. It reads the volume along
    that plan by a head that is fitted last.
    """
    tiny = nemo_tiny()
    assert tiny.pretrain is not None
    along_m = (2.0, 5.0, 9.0, 13.0, 18.0, 24.0, 31.0, 39.0)
    return dataclasses.replace(
        tiny,
        name="nemo_town",
        about="NeMo for claims tested on two CPU cores, on towns",
        clips=dataclasses.replace(
            tiny.clips,
            now_stride_s=0.5,
            voxels=VoxelSpec(lower_m=(-16.0, -24.0, -1.5), voxel_m=1.0, shape_zyx=(6, 48, 56)),
        ),
        model=dataclasses.replace(
            tiny.model,
            motion=dataclasses.replace(tiny.model.motion, stride=2, ego="measured"),
            renderer=dataclasses.replace(tiny.model.renderer, far_m=48.0),
            step_features=True,
        ),
        planner=dataclasses.replace(
            tiny.planner,
            history=1,
            ego_mlp=EgoMLPConfig(rates=True),
            path=PathCorrectionConfig(distances_m=along_m, width=64, hidden=32),
        ),
        path=PathFit(),
        pretrain=rescheduled(
            dataclasses.replace(
                tiny.pretrain,
                weights=dataclasses.replace(tiny.pretrain.weights, future=0.5, ego=1.0),
                ray_stride=16,
                imagined=dataclasses.replace(tiny.pretrain.imagined, every=2),
            ),
            steps=2400,
            warmup_steps=190,
        ),
        finetune=rescheduled(tiny.finetune, steps=300, warmup_steps=20),
        precision="bf16-mixed",
    )


def nemo_wide() -> NemoRecipe:
    """Return `nemo_town` on a grid that holds what detectors and maps are judged on, 32 m behind and beside.

    It is pre-trained on the exact occupancy of virtual egos (`--occupancy recorded`), in which voxels that
    move, and those next to them, weigh five times as much, and on their exact flow: without that loss the
    flow grew until all futures were empty. Its planner has no head along the path.
    """
    town = nemo_town()
    assert town.pretrain is not None
    return dataclasses.replace(
        town,
        name="nemo_wide",
        about="nemo_town on a grid that reaches 32 m behind and beside, for virtual egos",
        clips=dataclasses.replace(
            town.clips,
            voxels=VoxelSpec(lower_m=(-32.0, -32.0, -1.5), voxel_m=1.0, shape_zyx=(6, 64, 72)),
            occupancy_source="recorded",
        ),
        planner=dataclasses.replace(town.planner, path=None),
        path=None,
        pretrain=dataclasses.replace(
            rescheduled(town.pretrain, steps=4600, warmup_steps=432),
            weights=dataclasses.replace(town.pretrain.weights, moving=5.0, flow=0.3),
        ),
    )


def nemo_drive() -> NemoRecipe:
    """Return `nemo_town` for closed-loop driving, trained on DAgger demonstrations.

    `foredrive drive --agent disturbed` records the demonstrations.

    The inputs of the planner differ in two ways. It does not know its pose half a second ago: with that input
    it learns to continue its motion, and once stopped it never starts. And it knows the target point of the
    route, as agents on CARLA's leaderboards do, because the command alone does not tell where a turn begins.
    """
    town = nemo_town()
    return dataclasses.replace(
        town,
        name="nemo_drive",
        about="nemo_town to drive in closed loop, trained on DAgger demonstrations",
        clips=dataclasses.replace(town.clips, future_source="expert"),
        planner=dataclasses.replace(town.planner, history=0, target=True),
    )


def nemo_base() -> NemoRecipe:
    """Return the paper's size: ResNet-50, 200×200×16 voxels of 0.5 m, six cameras, two stages of 10 epochs.

    Constants are from §4.1. Values not given there: D = 64, three rounds of lifting with 8 heads and 8
    points, four pyramid levels, T_f = 3 at 0.5 s, images of 448×800, λ_perc = 0.1 (Video Autoencoder).
    The images are half of nuScenes' 900×1600, with the height rounded to whole strides (32) of the backbone.

    The planner departs from the paper: its decoder is normalised first, and its output is the difference from
    driving on at constant velocity.
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
        about="NeMo at the paper's size, for a GPU",
        clips=ClipConfig(
            past_frames=1,
            future_frames=3,
            image_hw=(448, 800),
            voxels=VoxelSpec(lower_m=(-50.0, -50.0, -3.0), voxel_m=0.5, shape_zyx=(16, 200, 200)),
        ),
        model=NemoConfig(
            backbone=BackboneConfig(
                embedding_size=64,
                hidden_sizes=(256, 512, 1024, 2048),
                depths=(3, 4, 6, 3),
                layer_type="bottleneck",
                stages=("stage1", "stage2", "stage3", "stage4"),
                weights="microsoft/resnet-50",
            ),
            encoder=LiftingConfig(heads=8, points=8, layers=3, checkpoint=True),  # saves 16 of 23 GiB
            motion=MotionConfig(hidden=64),
            renderer=RendererConfig(near_m=1.0, far_m=72.0, samples=96, hidden=128),
            channels=64,
            occupancy_hidden=64,
        ),
        planner=PlannerConfig(width=256, layers=3, heads=8, pool=(4, 8, 8)),
        pretrain=NemoStage(
            schedule=schedule,
            weights=NemoWeights(wpts=0.0, recon=1.0, occ=1.0, over_frames="sum"),
            ray_stride=8,
            pixels="averaged",
            perceptual="vgg16",
        ),
        finetune=NemoStage(
            schedule=schedule,
            weights=NemoWeights(wpts=1.0, recon=0.5, occ=0.5, over_frames="sum"),
            ray_stride=8,
            pixels="averaged",
            perceptual="vgg16",
        ),
        precision="bf16-mixed",
    )


BASE_BEV = BevConfig(width=256, heads=8, points=2, pillars=4, layers=3, checkpoint=True)
"""BEVFormer's width and heights, with as many rounds as NeMo's own encoder."""
TOWN_BEV = BevConfig(width=96, heads=4, points=2, pillars=4, layers=2)
