"""The records of recipes: plain values only, so that they can be read, written and compared."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError

from foredrive.data import ClipConfig
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.models.planner import PlannerConfig
from foredrive.plain_yaml import parse_yaml, read_yaml
from foredrive.recipes.old_formats import upgraded
from foredrive.recipes.world_models import WORLD_MODELS
from foredrive.training import EgoMLPFit, PathFit
from foredrive.training.joint_tasks import JointTasks

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
    """None: fine-tuning starts from scratch or from given weights."""
    finetune: S
    pretrained_model: M | None = None
    """World model of pre-training if it is another than `model`. Both have the same encoder."""
    transfer: Literal["world_model", "encoder", "frozen"] = "world_model"
    """Part of the pre-trained weights that fine-tuning starts from: the whole world model, or its backbone
    and encoder from images to a volume or plane. All other parts then start fresh, by the seed alone. With
    "frozen", the last world model and the task heads of another run are kept as they are, and fine-tuning
    trains the planner alone."""
    tasks: JointTasks | None = None
    """Task heads that are part of the agent; fine-tuning trains them with the world model, unless that is
    frozen. Their truth is `clips.tasks`."""
    path: PathFit | None = None
    """Separate fit of the planner's `PathCorrection` after fine-tuning, which then does not train it. None
    trains it in fine-tuning."""
    ego_mlp: EgoMLPFit = field(default_factory=EgoMLPFit)
    """Fit of the ego MLP: the baseline in the evaluation and, with `planner.ego_mlp`, the planner's base."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
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


def save_recipe(recipe: Any, path: Path) -> None:
    """Write a recipe of any kind, a dataclass of plain values, as YAML."""
    with atomic_path(path) as temporary:
        temporary.write_text(recipe_yaml(recipe))


def recipe_yaml(recipe: Any) -> str:
    """Return a recipe of any kind as YAML."""
    plain = _plain(asdict(recipe))
    return yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100)


def is_recipe_file(name: str) -> bool:
    """Return whether the name of a recipe is that of a YAML file."""
    return name.endswith((".yaml", ".yml"))


def load_recipe(path: Path) -> Recipe[Any, Any]:
    """Read a recipe written by `save_recipe`, in today's format or an earlier one.

    Raises:
        InputError: an entry is wrong, missing or unknown. The message names the file and the entry.
    """
    return recipe_from(upgraded(read_values(path)), str(path))


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


def read_values(path: Path) -> Any:
    """Read YAML.

    Raises:
        InputError: the file cannot be read or is not YAML.
    """
    return read_yaml(path, "a recipe")


def validated(kind: Any, written: Any, source: str) -> Any:
    """Return plain values as a dataclass, generic or not.

    Raises:
        InputError: an entry is wrong, missing or unknown. The message names it.
    """
    try:
        return TypeAdapter(kind).validate_python(written, extra="forbid")
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{source}: not a recipe: {f'{where}: ' if where else ''}{first['msg']}") from error


def overridden(written: Mapping[str, Any], settings: Sequence[str]) -> dict[str, Any]:
    """Return plain values with some of them replaced.

    Args:
        written: the complete values of a recipe of any kind.
        settings: entries KEY.KEY=VALUE; the value is read as YAML.

    Raises:
        InputError: a setting has another form or an unknown key. The message names the nearest known key.
    """
    values: dict[str, Any] = _plain(written)
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals:
            raise InputError(f"--set {setting}: write KEY=VALUE, such as finetune.schedule.lr=1e-3")
        *parents, last = name.split(".")
        place: Any = values
        for depth, key in enumerate([*parents, last]):
            if not isinstance(place, Mapping):
                raise InputError(f"--set {setting}: {'.'.join(parents[:depth])} has no entries")
            if key not in place:
                raise InputError(f"--set {setting}: no entry {key!r}{_nearest(key, name, place, values)}")
            if depth < len(parents):
                place = place[key]
        try:
            place[last] = parse_yaml(text)
        except InputError as error:
            raise InputError(f"--set {name}: {text[:100]!r} is no value: {error}") from error
    return values


def _nearest(key: str, name: str, siblings: Mapping[str, Any], values: Mapping[str, Any]) -> str:
    """Return a suggestion for an unknown key, as the end of a sentence."""
    near = difflib.get_close_matches(key, siblings, n=1)
    if near:
        return f"; {near[0]!r} is near"
    everywhere = list(_names(values))
    near = [known for known in everywhere if known.split(".")[-1] == key]
    near = near or difflib.get_close_matches(name, everywhere, n=1, cutoff=0.4)
    return f"; did you mean {near[0]}?" if near else f"; there are {', '.join(siblings)}"


def _names(values: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Return the dotted names of all entries."""
    found = []
    for key, value in values.items():
        found.append(prefix + key)
        if isinstance(value, Mapping):
            found += _names(value, f"{prefix}{key}.")
    return found


def _plain(value: object) -> Any:
    """Return tuples as lists, for YAML."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value
