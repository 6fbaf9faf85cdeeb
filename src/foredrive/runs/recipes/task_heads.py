"""Configurations of task heads that are trained on a frozen world model."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar, get_args

from foredrive.data.clip_config import TaskTruthConfig
from foredrive.engine.config import overridden, read_values, validated
from foredrive.engine.loop import Schedule
from foredrive.errors import InputError
from foredrive.heads.agents_head import AgentHeadConfig, CarriedConfig
from foredrive.heads.decoder import DecoderConfig
from foredrive.heads.heads import TaskHeadsConfig
from foredrive.heads.instances_head import InstanceHeadConfig
from foredrive.heads.joint import JointTasks
from foredrive.heads.losses import TaskWeights
from foredrive.heads.map_head import MapHeadConfig
from foredrive.heads.motion_head import MotionConfig
from foredrive.methods.recipe import Recipe
from foredrive.scene import Task

R = TypeVar("R", bound="Recipe[Any, Any]")

LARGE_CELLS = 100
"""Grids with more cells along a side get heads of the published sizes."""
HEADED: tuple[Task, ...] = ("detection", "tracking", "map", "motion", "occupancy")
"""Tasks that have a head."""
INSTANCES = "instances"
"""Name of the head of instance occupancy, beside the tasks."""


@dataclass(frozen=True)
class TaskHeadsRecipe:
    """All settings of the heads and of their training."""

    heads: TaskHeadsConfig
    truth: TaskTruthConfig
    schedule: Schedule
    weights: TaskWeights = field(default_factory=TaskWeights)
    now_stride_s: float = 1.0
    """Time between the nows of successive training clips, s."""
    mirror: float = 0.5
    """Probability that left and right of a training item are exchanged."""


def town_heads(tasks: Sequence[str]) -> TaskHeadsRecipe:
    """Return heads of the given tasks for towns on two cores. Motion and tracking add detection.

    Raises:
        InputError: a task is unknown or has no head.
    """
    sizes = TaskHeadsConfig(agents=AgentHeadConfig(carried=CarriedConfig()))
    schedule = Schedule(batch_size=8, lr=3e-3, steps=1500, warmup_steps=60, clip_grad_norm=10.0)
    return _heads_of(tasks, sizes, schedule)


def base_heads(tasks: Sequence[str]) -> TaskHeadsRecipe:
    """Return heads of the given tasks in the size of published models, for a GPU.

    Raises:
        InputError: a task is unknown or has no head.
    """
    deep = DecoderConfig(layers=6, heads=8, feed_forward=4)
    sizes = TaskHeadsConfig(
        width=256,
        max_cells=100,
        agents=AgentHeadConfig(
            queries=300, decoder=deep, motion=MotionConfig(), carried=CarriedConfig(agents=100)
        ),
        elements=MapHeadConfig(elements=50, points=20, decoder=deep),
    )
    return _heads_of(tasks, sizes, Schedule(batch_size=8, lr=2e-4, epochs=24, warmup_steps=500))


def heads_for(recipe: Recipe[Any, Any], tasks: Sequence[str]) -> TaskHeadsRecipe:
    """Return heads in a size that fits a recipe: those of published models on grids of more than 100 cells.

    Raises:
        InputError: a task is unknown or has no head.
    """
    large = max(recipe.clips.voxels.shape_zyx[1:]) > LARGE_CELLS
    return base_heads(tasks) if large else town_heads(tasks)


def with_joint_heads(recipe: R, heads: TaskHeadsRecipe, settings: Sequence[str] = ()) -> R:
    """Return a recipe that trains heads together with world model and planner, in fine-tuning.

    Args:
        recipe: without heads.
        heads: heads and their truth. Their schedule is not used.
        settings: entries of `Recipe.tasks` to replace, such as "weights.raster=2".

    Raises:
        InputError: the recipe keeps the heads of another run, a setting does not fit, or instances need key
            frames of another time step.
    """
    if recipe.transfer == "frozen":
        raise InputError(f"{recipe.name}: transfer is frozen, which keeps the heads of --start: no --tasks")
    check_instances(recipe, heads)
    joint = JointTasks(replace(heads.heads, volume_of=None), heads.weights)
    if settings:
        joint = validated(JointTasks, overridden(asdict(joint), settings), "--set")
    names = "+".join((*joint.heads.tasks, *([INSTANCES] if joint.heads.instances else [])))
    return replace(
        recipe,
        name=f"{recipe.name} ({names})",
        clips=replace(recipe.clips, tasks=heads.truth),
        tasks=joint,
    )


def check_instances(recipe: Recipe[Any, Any], heads: TaskHeadsRecipe) -> None:
    """Refuse heads that read imagined key frames of another time step than the recipe's.

    Raises:
        InputError: the time steps differ.
    """
    instances, dt_s = heads.heads.instances, recipe.clips.frame_dt_s
    if instances is not None and instances.dt_s != dt_s:
        raise InputError(
            f"{recipe.name}: key frames are {dt_s:g} s apart, {INSTANCES} need {instances.dt_s:g} s"
        )


def with_settings(recipe: TaskHeadsRecipe, settings: Sequence[str]) -> TaskHeadsRecipe:
    """Return the recipe with some entries replaced, such as "schedule.steps=100".

    Raises:
        InputError: a setting has another form, an unknown key or an impossible value.
    """
    changed: TaskHeadsRecipe = validated(TaskHeadsRecipe, overridden(asdict(recipe), settings), "--set")
    return changed


def load_task_heads(path: Path) -> TaskHeadsRecipe:
    """Read the YAML that `save_recipe` wrote.

    Raises:
        InputError: an entry is wrong, missing or unknown. The message names the file and the entry.
    """
    recipe: TaskHeadsRecipe = validated(TaskHeadsRecipe, read_values(path), str(path))
    return recipe


def _heads_of(tasks: Sequence[str], sizes: TaskHeadsConfig, schedule: Schedule) -> TaskHeadsRecipe:
    """Leave out the heads of other tasks, and the truth that nobody needs. All heads read one volume."""
    if not tasks:
        raise InputError("name at least one task")
    for task in tasks:
        if task not in (*HEADED, INSTANCES):
            fault = "has no head" if task in get_args(Task) else "is unknown"
            headed = ", ".join((*HEADED, INSTANCES))
            raise InputError(f"the task {task!r} {fault}; heads can be trained for {headed}")
    agents = sizes.agents if {"detection", "motion", "tracking", INSTANCES} & set(tasks) else None
    if agents is not None and "motion" not in tasks:
        agents = replace(agents, motion=None)
    if agents is not None and "tracking" not in tasks:
        agents = replace(agents, carried=None)
    kept = replace(
        sizes,
        agents=agents,
        elements=sizes.elements if "map" in tasks else None,
        raster=sizes.raster if "map" in tasks else None,
        voxels=sizes.voxels if "occupancy" in tasks else None,
        instances=InstanceHeadConfig() if INSTANCES in tasks else None,
        volume_of="occupancy",
    )
    truth = TaskTruthConfig()
    if INSTANCES not in tasks:
        truth = replace(truth, instances=None)
    if "map" not in tasks:
        truth = replace(truth, elements_lw_m=None, raster=None)
    if "occupancy" not in tasks:
        truth = replace(truth, semantics=None)
    recipe = TaskHeadsRecipe(kept, truth, schedule)
    if agents is None or agents.carried is None:
        return recipe
    return replace(recipe, now_stride_s=agents.carried.dt_s)
