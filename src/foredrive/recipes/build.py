"""From the values of a recipe to the objects they describe."""

import warnings

from foredrive.errors import InputError
from foredrive.models.averaging import AveragingEncoder
from foredrive.models.backbone import ImageBackbone
from foredrive.models.bev import BevEncoder
from foredrive.models.ego_mlp import EgoMLP
from foredrive.models.lifting import LiftingEncoder
from foredrive.models.nemo import MotionFlow, Nemo, NemoAgent, VolumeRenderer
from foredrive.models.planner import VolumePlanner
from foredrive.models.vgg import Vgg16Features
from foredrive.recipes.config import AveragingEncoderSize, BevEncoderSize, Recipe, Stage
from foredrive.training import NemoObjective


def build_agent(recipe: Recipe, *, load_backbone: bool = True) -> NemoAgent:
    """World model and planner with fresh weights.

    The backbone loads the weights the recipe names, unless `load_backbone` is False because trained ones
    will replace them.
    """
    size, clips = recipe.model, recipe.clips
    backbone = ImageBackbone(
        embedding_size=size.backbone.embedding_size,
        hidden_sizes=size.backbone.hidden_sizes,
        depths=size.backbone.depths,
        layer_type=size.backbone.layer_type,
        stages=size.backbone.stages,
        channels=size.channels,
        weights=size.backbone.weights if load_backbone else None,
        checkpoint="backbone" in size.checkpoint,
    )
    encoder = _build_encoder(recipe)
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
    world_model = Nemo(
        backbone=backbone,
        encoder=encoder,
        motion=motion,
        renderer=renderer,
        past_frames=clips.past_frames,
        channels=size.channels,
        hidden=size.occupancy_hidden,
    )
    planner = VolumePlanner(
        channels=size.channels,
        spec=clips.voxels,
        width=size.planner_width,
        layers=size.planner_layers,
        heads=size.planner_heads,
        future=size.planner_future,
        pool=size.attention_pool,
        history=size.planner_history,
        horizon_steps=clips.horizon_steps,
        dt_s=clips.horizon_dt_s,
        ego_mlp=_build_ego_mlp(recipe),
        look_m=size.planner_look_m,
    )
    return NemoAgent(world_model, planner)


def _build_ego_mlp(recipe: Recipe) -> EgoMLP | None:
    clips = recipe.clips
    if recipe.model.planner_base == "straight_on":
        return None
    return EgoMLP(
        past_frames=recipe.model.planner_history,
        horizon_steps=clips.horizon_steps,
        dt_s=clips.horizon_dt_s,
    )


def _build_encoder(recipe: Recipe) -> LiftingEncoder | BevEncoder | AveragingEncoder:
    model, spec = recipe.model, recipe.clips.voxels
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


def build_objective(recipe: Recipe, stage: Stage, agent: NemoAgent) -> NemoObjective:
    """What is trained in a stage. Without real VGG-16 weights the perceptual loss has weight 0."""
    features = None
    if stage.vgg16 is not None:
        try:
            features = Vgg16Features(stage.vgg16)
        except (OSError, InputError) as error:
            warnings.warn(f"the perceptual loss is OFF (weight 0): no VGG-16 weights ({error})", stacklevel=2)
    objective = NemoObjective(
        agent,
        stage.weights,
        steps=recipe.clips.future_frames if stage.imagine else 0,
        ray_stride=stage.ray_stride,
        image_features=features,
    )
    if recipe.path is not None and agent.planner.path is not None:
        agent.planner.path.requires_grad_(False)  # it has its turn after the last stage
    return objective
