"""From the values of a recipe to the objects they describe."""

import warnings

from torch import nn

from foredrive.data import ClipConfig
from foredrive.errors import InputError
from foredrive.models.agent import PlanningAgent
from foredrive.models.averaging import AveragingEncoder
from foredrive.models.backbone import ImageBackbone
from foredrive.models.bev import BevEncoder
from foredrive.models.driveworld import DriveWorld
from foredrive.models.ego_mlp import EgoMLP
from foredrive.models.lifting import LiftingEncoder
from foredrive.models.nemo import MotionFlow, Nemo, VolumeRenderer
from foredrive.models.planner import VolumePlanner
from foredrive.models.vgg import Vgg16Features
from foredrive.runs.build_driveworld import build_driveworld
from foredrive.recipes.config import (
    AnyStage,
    AveragingEncoderSize,
    BevEncoderSize,
    DriveWorldSize,
    DriveWorldStage,
    NemoSize,
    Recipe,
    Stage,
)
from foredrive.scene import VoxelSpec
from foredrive.training import DriveWorldObjective, NemoObjective


def build_agent(recipe: Recipe, *, fetch: bool = True) -> PlanningAgent:
    """World model and planner with fresh weights.

    Args:
        fetch: whether to fetch what the recipe names, weights of a backbone and encodings of texts; not
            needed where trained weights will replace them.
    """
    size, clips = recipe.model, recipe.clips
    backbone = ImageBackbone(
        embedding_size=size.backbone.embedding_size,
        hidden_sizes=size.backbone.hidden_sizes,
        depths=size.backbone.depths,
        layer_type=size.backbone.layer_type,
        stages=size.backbone.stages,
        channels=size.channels,
        weights=size.backbone.weights if fetch else None,
        checkpoint="backbone" in size.checkpoint,
    )
    if isinstance(size, DriveWorldSize):
        world_model: Nemo | DriveWorld = build_driveworld(size, clips, backbone, fetch=fetch)
    else:
        world_model = _build_nemo(size, clips, backbone)
    planner = VolumePlanner(
        channels=size.channels,
        spec=clips.voxels,
        width=size.planner_width,
        layers=size.planner_layers,
        heads=size.planner_heads,
        future=size.planner_future,
        pool=size.attention_pool,
        history=size.planner_history,
        target=size.planner_target,
        horizon_steps=clips.horizon_steps,
        dt_s=clips.horizon_dt_s,
        ego_mlp=_build_ego_mlp(recipe),
        look_m=size.planner_look_m,
    )
    return PlanningAgent(world_model, planner)


def _build_nemo(size: NemoSize, clips: ClipConfig, backbone: ImageBackbone) -> Nemo:
    encoder = _build_encoder(size, clips.voxels)
    motion = MotionFlow(
        channels=size.channels,
        frames=clips.past_frames + 1,
        hidden=size.motion_hidden,
        steps=clips.future_frames,
    )
    renderer = VolumeRenderer(
        clips.voxels,
        channels=size.channels,
        near_m=size.ray_near_m,
        far_m=size.ray_far_m,
        samples=size.ray_samples,
        hidden=size.recon_hidden,
    )
    return Nemo(
        backbone=backbone,
        encoder=encoder,
        motion=motion,
        renderer=renderer,
        past_frames=clips.past_frames,
        channels=size.channels,
        hidden=size.occupancy_hidden,
    )


def _build_ego_mlp(recipe: Recipe) -> EgoMLP | None:
    clips = recipe.clips
    if recipe.model.planner_base == "straight_on":
        return None
    return EgoMLP(
        past_frames=recipe.model.planner_history,
        target=recipe.model.planner_target,
        horizon_steps=clips.horizon_steps,
        dt_s=clips.horizon_dt_s,
    )


def _build_encoder(model: NemoSize, spec: VoxelSpec) -> LiftingEncoder | BevEncoder | AveragingEncoder:
    size, levels = model.encoder, len(model.backbone.stages)
    if isinstance(size, AveragingEncoderSize):
        return AveragingEncoder(spec, channels=model.channels, hidden=size.hidden)
    if isinstance(size, BevEncoderSize):
        return BevEncoder(
            spec,
            channels=model.channels,
            width=size.width,
            heads=size.heads,
            points=size.points,
            pillars=size.pillars,
            levels=levels,
            layers=size.layers,
            checkpoint="encoder" in model.checkpoint,
        )
    return LiftingEncoder(
        spec,
        channels=model.channels,
        heads=size.heads,
        points=size.points,
        levels=levels,
        layers=size.layers,
        checkpoint="encoder" in model.checkpoint,
    )


def build_objective(recipe: Recipe, stage: AnyStage, agent: PlanningAgent) -> nn.Module:
    """What is trained in a stage. Without real VGG-16 weights the perceptual loss has weight 0."""
    if isinstance(stage, DriveWorldStage):
        objective: nn.Module = DriveWorldObjective(
            agent,
            stage.weights,
            steps=recipe.clips.future_frames,
            temporal=stage.temporal,
            statics_of=stage.statics_of,
        )
    else:
        objective = _build_nemo_objective(recipe, stage, agent)
    if recipe.path is not None and agent.planner.path is not None:
        agent.planner.path.requires_grad_(False)  # it has its turn after the last stage
    return objective


def _build_nemo_objective(recipe: Recipe, stage: Stage, agent: PlanningAgent) -> NemoObjective:
    features = None
    if stage.vgg16 is not None:
        try:
            features = Vgg16Features(stage.vgg16)
        except (OSError, InputError) as error:
            warnings.warn(f"the perceptual loss is OFF (weight 0): no VGG-16 weights ({error})", stacklevel=3)
    return NemoObjective(
        agent,
        stage.weights,
        steps=recipe.clips.future_frames if stage.imagine else 0,
        ray_stride=stage.ray_stride,
        image_features=features,
    )
