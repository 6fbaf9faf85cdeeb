"""The record of a recipe: plain values only, so that it can be read, written and compared."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Literal, TypeVar

from foredrive.data import ClipConfig
from foredrive.heads.joint import JointTasks
from foredrive.methods.planner.ego_mlp_fit import EgoMLPFit
from foredrive.methods.planner.path_fit import PathFit
from foredrive.methods.planner.planner import PlannerConfig

M = TypeVar("M")
S = TypeVar("S")
R = TypeVar("R", bound="Recipe[Any, Any]")


@dataclass(frozen=True)
class Recipe(Generic[M, S]):
    """All settings of a run, except where the logs are.

    M is the config of a world model and S that of its training stages: a row of `WORLD_MODELS`.
    """

    name: str
    clips: ClipConfig
    model: M
    planner: PlannerConfig
    pretrain: S | None
    """Stage of pre-training; None: fine-tuning starts from scratch or from given weights."""
    finetune: S
    """Stage of fine-tuning."""
    pretrained_model: M | None = None
    """World model of pre-training if it is another than `model`. Both have the same encoder."""
    transfer: Literal["world_model", "encoder", "perception", "frozen"] = "world_model"
    """Part of the pre-trained weights that fine-tuning starts from: the whole world model, or its backbone
    and encoder from images to a volume or plane. All other parts then start fresh, by the seed alone. With
    "perception", it starts from the last world model of another run and from the task heads that both have,
    and keeps backbone and encoder as they are (the second stage of UniAD). With "frozen", the last world
    model and the task heads of another run are kept as they are, and fine-tuning trains the planner alone."""
    tasks: JointTasks | None = None
    """Task heads that are part of the agent; fine-tuning trains them with the world model, unless that is
    frozen. Their truth is `clips.tasks`."""
    path: PathFit | None = None
    """Separate fit of the planner's `PathCorrection` after fine-tuning, which then does not train it; None
    trains it in fine-tuning."""
    ego_mlp: EgoMLPFit = field(default_factory=EgoMLPFit)
    """Fit of the ego MLP: the baseline in the evaluation and, with `planner.ego_mlp`, the planner's base."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    """Numbers in training: "32-true" for 32 bits, or "bf16-mixed" for bfloat16 autocast where it saves
    time."""
    about: str = field(default="", compare=False)
    """One line for lists of recipes."""

    @property
    def of_pretraining(self) -> "Recipe[M, S]":
        """Return the recipe with the world model of pre-training, without task heads."""
        return replace(
            self,
            model=self.pretrained_model or self.model,
            clips=replace(self.clips, tasks=None),
            planner=replace(self.planner, attends=()),
            tasks=None,
        )


def rescheduled(stage: S, **changes: Any) -> S:
    """Return the stage with changed entries of its schedule."""
    return replace(stage, schedule=replace(stage.schedule, **changes))  # type: ignore[attr-defined, type-var]


def named_after(full: R, rows: Mapping[str, tuple[R, str]]) -> dict[str, R]:
    """Return a recipe under its name, and its ablations under FULL_ROW.

    Args:
        rows: recipe and description of each ablation.
    """
    recipes = {full.name: full}
    for row, (recipe, about) in rows.items():
        name = f"{full.name}_{row}"
        recipes[name] = replace(recipe, name=name, about=f"{full.name}: {about}")
    return recipes


def with_occupancy_source(recipe: R, occupancy_source: Literal["lidar", "accumulated", "recorded"]) -> R:
    """Return the recipe with voxel labels of another source, which is added to its name."""
    if occupancy_source == recipe.clips.occupancy_source:
        return recipe
    clips = replace(recipe.clips, occupancy_source=occupancy_source)
    return replace(recipe, name=f"{recipe.name} ({occupancy_source} occupancy)", clips=clips)
