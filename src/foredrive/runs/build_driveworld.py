"""From the sizes of a recipe to a DriveWorld."""

import torch

from foredrive.data import ClipConfig
from foredrive.errors import InputError
from foredrive.models.backbone import ImageBackbone
from foredrive.models.driveworld import DriveWorld
from foredrive.models.driveworld.planes import PlanesToVolume, PlaneToVector, StaticScene, VectorToPlane
from foredrive.models.driveworld.state_space import StateSpace
from foredrive.models.driveworld.task_prompt import PROMPTS, TaskPrompt
from foredrive.models.lift_splat import LiftSplatEncoder
from foredrive.models.lifting import LiftingEncoder
from foredrive.models.pooled_lifting import PooledLiftingEncoder
from foredrive.models.text_encoder import TextEncoder
from foredrive.recipes.config import DriveWorldSize, LiftSplatSize, PromptSize
from foredrive.scene import VoxelSpec


def build_driveworld(
    size: DriveWorldSize, clips: ClipConfig, backbone: ImageBackbone, *, fetch: bool
) -> DriveWorld:
    """A DriveWorld with fresh weights.

    Args:
        fetch: encode the task prompts; otherwise there are zeros for trained weights to replace.

    Raises:
        InputError: the text encoder cannot be had.
    """
    spec = clips.voxels
    height, size_yx = spec.shape_zyx[0], spec.shape_zyx[1:]
    prompted = 0 if size.prompt is None else size.prompt.widths[-1]
    return DriveWorld(
        backbone=backbone,
        encoder=_build_encoder(size, spec),
        states=StateSpace(
            observation=size.observation,
            state=size.state,
            history=size.history,
            objects=size.objects,
            heads=size.memory_heads,
            memory=size.memory,
            hidden=size.states_hidden,
            memory_bank=size.memory_bank,
            motion_norm=size.motion_norm,
        ),
        to_vector=PlaneToVector(size.plane, size.observation_hidden, size.observation),
        from_vector=VectorToPlane(size.history + size.state, size.expanded, size_yx),
        to_volume=PlanesToVolume(
            size.expanded[-1] + size.statics + prompted, size.volume_hidden, size.channels, height
        ),
        statics=StaticScene(size.plane, size.statics) if size.statics else None,
        carry_statics=size.carry_statics,
        prompt=None if size.prompt is None else _build_prompt(size.prompt, size_yx, fetch=fetch),
        past_frames=clips.past_frames,
        dt_s=clips.frame_dt_s,
        channels=size.channels,
    )


def _build_encoder(model: DriveWorldSize, spec: VoxelSpec) -> LiftSplatEncoder | PooledLiftingEncoder:
    size, channels = model.encoder, model.channels
    if isinstance(size, LiftSplatSize):
        depths = {"near_m": size.near_m, "far_m": size.far_m, "step_m": size.step_m}
        return LiftSplatEncoder(spec, channels=channels, width=model.plane, **depths)
    lifting = LiftingEncoder(
        spec,
        channels=channels,
        heads=size.heads,
        points=size.points,
        levels=len(model.backbone.stages),
        layers=size.layers,
        checkpoint="encoder" in model.checkpoint,
    )
    return PooledLiftingEncoder(lifting, channels=channels, width=model.plane)


def _build_prompt(size: PromptSize, size_yx: tuple[int, int], *, fetch: bool) -> TaskPrompt:
    if fetch:
        encoded = TextEncoder(size.text_encoder)(list(PROMPTS.values()))
        if encoded.shape[1] != size.encoding:
            raise InputError(
                f"the text encoder {size.text_encoder!r} makes {encoded.shape[1]} numbers of a sentence, the "
                f"recipe has {size.encoding}"
            )
    else:
        encoded = torch.zeros(len(PROMPTS), size.encoding)
    return TaskPrompt(dict(zip(PROMPTS, encoded, strict=True)), size.widths, size_yx)
