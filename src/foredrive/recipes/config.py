"""What a recipe holds: values only, so that it can be read, written and compared."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import yaml
from pydantic import TypeAdapter, ValidationError

from foredrive.data import ClipConfig
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.training import LossWeights, PathFit, Schedule


@dataclass(frozen=True)
class BackboneSize:
    """A ResNet and its pyramid; see `models.backbone.ImageBackbone`."""

    embedding_size: int
    hidden_sizes: tuple[int, ...]
    depths: tuple[int, ...]
    layer_type: Literal["basic", "bottleneck"]
    stages: tuple[str, ...]
    weights: str | None = None


@dataclass(frozen=True)
class VolumeEncoderSize:
    """NeMo's own way from images to a volume; see `models.lifting.LiftingEncoder`."""

    heads: int
    points: int
    layers: int
    kind: Literal["volume"] = "volume"


@dataclass(frozen=True)
class BevEncoderSize:
    """A plane first, which is then unfolded; see `models.bev.BevEncoder`."""

    width: int
    heads: int
    points: int
    pillars: int
    layers: int
    kind: Literal["bev"] = "bev"


@dataclass(frozen=True)
class AveragingEncoderSize:
    """No attention at all; see `models.averaging.AveragingEncoder`."""

    hidden: int
    kind: Literal["averaging"] = "averaging"


@dataclass(frozen=True)
class NemoSize:
    """Sizes of NeMo's parts; see the modules' own docstrings."""

    backbone: BackboneSize
    encoder: VolumeEncoderSize | BevEncoderSize | AveragingEncoderSize
    channels: int
    occupancy_hidden: int
    motion_hidden: int
    ray_near_m: float
    ray_far_m: float
    ray_samples: int
    recon_hidden: int
    planner_width: int
    planner_layers: int
    planner_heads: int
    attention_pool: tuple[int, int, int]
    planner_future: Literal["attention", "concatenation", "none"] = "attention"
    """How the planner looks at the predicted next volume."""
    planner_history: int = 0
    """Key frames before now whose pose and speed the planner is told; in the paper, now's speed alone."""
    planner_base: Literal["straight_on", "ego_mlp"] = "straight_on"
    """What the planner regresses changes from: the speed now, as it is; or what an MLP says that knows ego
    status alone (`planner_history` frames of it), fitted to the demonstrations before fine-tuning."""
    planner_look_m: tuple[float, ...] = ()
    """Distances along that plan at which the planner reads the volume as well; see `PathCorrection`."""
    checkpoint: tuple[Literal["backbone", "encoder"], ...] = ()
    """Trade time for memory: what these parts compute is not kept but computed again."""


@dataclass(frozen=True)
class Stage:
    """One stage of training."""

    schedule: Schedule
    weights: LossWeights
    ray_stride: int
    vgg16: str | None = None
    """File of VGG-16 weights for the perceptual loss, or "download"; None leaves that loss out (weight 0)."""
    imagine: bool = True
    """Imagine the future key frames and supervise them too, by what happened; otherwise the present alone."""


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a run, but for where the logs are."""

    name: str
    clips: ClipConfig
    model: NemoSize
    pretrain: Stage | None
    """None: fine-tuning starts from scratch, or from weights that are given."""
    finetune: Stage
    path: PathFit | None = None
    """How the planner's `PathCorrection` is fitted to what the fine-tuned world model sees, which joint
    fine-tuning then leaves alone; None leaves it to joint fine-tuning."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"


def labelled_by(recipe: Recipe, occupancy_source: Literal["lidar", "recorded"]) -> Recipe:
    """The recipe with voxel labels of another source; its name tells."""
    if occupancy_source == recipe.clips.occupancy_source:
        return recipe
    clips = replace(recipe.clips, occupancy_source=occupancy_source)
    return replace(recipe, name=f"{recipe.name} ({occupancy_source} occupancy)", clips=clips)


def save_recipe(recipe: Recipe, path: Path) -> None:
    """Write a recipe as YAML."""
    with atomic_path(path) as temporary:
        temporary.write_text(yaml.safe_dump(_plain(asdict(recipe)), sort_keys=False))


def load_recipe(path: Path) -> Recipe:
    """Read a recipe that `save_recipe` wrote.

    Raises:
        InputError: naming the file, and the entry that is wrong, missing or unknown.
    """
    try:
        return TypeAdapter(Recipe).validate_python(yaml.safe_load(path.read_text()), extra="forbid")
    except OSError as error:
        raise InputError(f"{path.parent}: not a run folder, {path.name} cannot be read") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"{path}: not a recipe: {f'{where}: ' if where else ''}{first['msg']}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a recipe: {str(error).splitlines()[0]}") from error


def _plain(value: object) -> object:
    """Tuples as lists, as YAML has them."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value
