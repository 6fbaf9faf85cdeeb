"""The world models that recipes can name: their configs, how each is built, and its training objective."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torch import nn

from foredrive.data import ClipConfig
from foredrive.engine.config import read_values, validated
from foredrive.errors import InputError
from foredrive.heads.joint import TaskTerms
from foredrive.methods.blocks.losses import ImageFeatures
from foredrive.methods.blocks.vgg import VggFeatures
from foredrive.methods.driveworld import DriveWorld, DriveWorldConfig
from foredrive.methods.driveworld.objective import DriveWorldObjective, DriveWorldStage
from foredrive.methods.lidarclip.image_tower import ImageTowerFeatures
from foredrive.methods.nemo import Nemo, NemoConfig
from foredrive.methods.nemo.objective import NemoObjective, NemoStage
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.recipe import Recipe
from foredrive.scene import WorldModel


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


def load_recipe(path: Path) -> Recipe[Any, Any]:
    """Read a recipe written by `save_recipe`.

    Raises:
        InputError: an entry is wrong, missing or unknown. The message names the file and the entry.
    """
    return recipe_from(read_values(path), str(path))


def recipe_from(written: Any, source: str) -> Recipe[Any, Any]:
    """Validate the plain values of a recipe.

    Args:
        written: the plain values.
        source: name of the source in errors.

    Raises:
        InputError: an entry is wrong, missing or unknown. The message names it.
    """
    model = written.get("model") if isinstance(written, Mapping) else None
    kind = model.get("kind") if isinstance(model, Mapping) else None
    if kind not in WORLD_MODELS:
        raise InputError(f"{source}: not a recipe: model.kind: {kind!r} is none of {', '.join(WORLD_MODELS)}")
    row = WORLD_MODELS[kind]
    recipe: Recipe[Any, Any] = validated(Recipe[row.config, row.stage], written, source)  # type: ignore[name-defined]
    return recipe
