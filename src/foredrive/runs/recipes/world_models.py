"""The world models that recipes can name: their configs, how each is built, and its training objective."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

from torch import nn

from foredrive.data import ClipConfig
from foredrive.losses.reconstruction import ImageFeatures
from foredrive.models.agent import PlanningAgent
from foredrive.models.driveworld import DriveWorld, DriveWorldConfig
from foredrive.models.image_tower import ImageTowerFeatures
from foredrive.models.nemo import Nemo, NemoConfig
from foredrive.models.vgg import VggFeatures
from foredrive.scene import WorldModel
from foredrive.training import DriveWorldObjective, DriveWorldStage, NemoObjective, NemoStage
from foredrive.training.joint_tasks import TaskTerms


class WorldModelEntry(NamedTuple):
    """One kind of world model."""

    config: type
    """Frozen dataclass of its sizes. Its `kind` is the key of `WORLD_MODELS`."""
    stage: type
    """Frozen dataclass of a training stage with the same `kind` and a `schedule`."""
    build: Callable[[Any, ClipConfig, bool], WorldModel]
    """Builds the model from its config and that of its clips. If the last argument is true, fetches named
    weights."""
    objective: Callable[[Any, PlanningAgent[Any], ClipConfig, TaskTerms | None], nn.Module]
    """Builds the module that maps an example to its losses, from a stage, the agent and, if its heads are
    trained, their losses."""


def build_nemo(config: NemoConfig, clips: ClipConfig, fetch: bool) -> Nemo:
    """Build a NeMo with fresh weights."""
    return Nemo(
        config,
        clips.voxels,
        past_frames=clips.past_frames,
        max_steps=clips.future_frames,
        dt_s=clips.frame_dt_s,
        fetch=fetch,
    )


def nemo_objective(
    stage: NemoStage, agent: PlanningAgent[Nemo], clips: ClipConfig, tasks: TaskTerms | None = None
) -> NemoObjective:
    """Build NeMo's objective. Where VGG-16 cannot be downloaded, the perceptual loss has weight 0."""
    features: ImageFeatures | None = None
    if stage.perceptual == "tower":
        from foredrive.search.embedded import SHIPPED, load_image_tower  # few stages need it

        features = ImageTowerFeatures(load_image_tower(SHIPPED))
    elif stage.perceptual == "vgg16":
        try:
            features = VggFeatures("download")
        except OSError as error:
            warnings.warn(f"the perceptual loss is OFF (weight 0): no VGG-16 weights ({error})", stacklevel=3)
    elif stage.perceptual is not None:
        features = VggFeatures(stage.perceptual)
    return NemoObjective(agent, stage, steps=clips.future_frames, image_features=features, tasks=tasks)


def build_driveworld(config: DriveWorldConfig, clips: ClipConfig, fetch: bool) -> DriveWorld:
    """Build a DriveWorld with fresh weights."""
    return DriveWorld(config, clips.voxels, past_frames=clips.past_frames, dt_s=clips.frame_dt_s, fetch=fetch)


def driveworld_objective(
    stage: DriveWorldStage,
    agent: PlanningAgent[DriveWorld],
    clips: ClipConfig,
    tasks: TaskTerms | None = None,
) -> DriveWorldObjective:
    """Build DriveWorld's objective."""
    return DriveWorldObjective(agent, stage, steps=clips.future_frames, tasks=tasks)


WORLD_MODELS: dict[str, WorldModelEntry] = {
    "nemo": WorldModelEntry(NemoConfig, NemoStage, build_nemo, nemo_objective),
    "driveworld": WorldModelEntry(DriveWorldConfig, DriveWorldStage, build_driveworld, driveworld_objective),
}
