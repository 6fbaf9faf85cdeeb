"""What a recipe holds: values only, so that it can be read, written and compared."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import yaml
from pydantic import Discriminator, Tag, TypeAdapter, ValidationError

from foredrive.data import ClipConfig
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.training import DriveWorldWeights, LossWeights, PathFit, Schedule

NEMO: Final = "nemo"
DRIVEWORLD: Final = "driveworld"


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
class PooledLiftingSize:
    """Deformable lifting into a volume, folded into a plane; see `models.pooled_lifting`."""

    heads: int
    points: int
    layers: int
    kind: Literal["pooled"] = "pooled"


@dataclass(frozen=True)
class LiftSplatSize:
    """Lift, splat; see `models.lift_splat.LiftSplatEncoder`."""

    near_m: float
    far_m: float
    step_m: float
    kind: Literal["lift_splat"] = "lift_splat"


@dataclass(frozen=True, kw_only=True)
class AgentSize:
    """Sizes of what all agents have: a backbone, a volume of D channels, the planner; see `VolumePlanner`."""

    backbone: BackboneSize
    channels: int
    planner_width: int
    planner_layers: int
    planner_heads: int
    attention_pool: tuple[int, int, int]
    planner_future: Literal["attention", "concatenation", "none"] = "attention"
    """How the planner looks at the predicted next volume."""
    planner_history: int = 0
    """Key frames before now whose pose and speed the planner is told; in the paper, now's speed alone."""
    planner_target: bool = False
    """Whether it knows where the route leads, beyond the command; agents on CARLA's leaderboards do."""
    planner_base: Literal["straight_on", "ego_mlp"] = "straight_on"
    """What the planner regresses changes from: the speed now, as it is; or what an MLP says that knows ego
    status alone (`planner_history` frames of it), fitted to the demonstrations before fine-tuning."""
    planner_look_m: tuple[float, ...] = ()
    """Distances along that plan at which the planner reads the volume as well; see `PathCorrection`."""
    checkpoint: tuple[Literal["backbone", "encoder"], ...] = ()
    """Trade time for memory: what these parts compute is not kept but computed again."""


@dataclass(frozen=True, kw_only=True)
class NemoSize(AgentSize):
    """Sizes of NeMo's parts; see the modules' own docstrings."""

    encoder: VolumeEncoderSize | BevEncoderSize | AveragingEncoderSize
    occupancy_hidden: int
    motion_hidden: int
    ray_near_m: float
    ray_far_m: float
    ray_samples: int
    recon_hidden: int


@dataclass(frozen=True, kw_only=True)
class PromptSize:
    """Task prompts; see `models.driveworld.task_prompt`."""

    widths: tuple[int, ...]
    """Channels of the steps from a sentence to a plane."""
    encoding: int
    """How many numbers the text encoder makes of a sentence."""
    text_encoder: str
    """By name or folder; needed once, by training from scratch."""


@dataclass(frozen=True, kw_only=True)
class DriveWorldSize(AgentSize):
    """Sizes of DriveWorld's parts; see the modules' own docstrings."""

    encoder: PooledLiftingSize | LiftSplatSize
    plane: int
    """C, channels of the plane that images are lifted to."""
    observation: int
    """Of x_t (512 in the paper)."""
    observation_hidden: int
    state: int
    history: int
    memory: int
    """How many histories the Dynamic Memory Bank holds."""
    memory_heads: int
    objects: int
    """K, moving objects whose velocities are estimated."""
    states_hidden: int
    expanded: tuple[int, ...]
    """Channels of the steps from a state to a plane (m_θ)."""
    volume_hidden: int
    statics: int
    """Channels of latent statics; 0 leaves Static Scene Propagation out."""
    prompt: PromptSize | None
    memory_bank: bool = True
    motion_norm: bool = True
    carry_statics: bool = False
    """Latent statics move along with the ego vehicle; in the paper they do not."""
    kind: Literal["driveworld"] = DRIVEWORLD


@dataclass(frozen=True)
class Stage:
    """One stage of NeMo's training."""

    schedule: Schedule
    weights: LossWeights
    ray_stride: int
    vgg16: str | None = None
    """File of VGG-16 weights for the perceptual loss, or "download"; None leaves that loss out (weight 0)."""
    imagine: bool = True
    """Imagine the future key frames and supervise them too, by what happened; otherwise the present alone."""


@dataclass(frozen=True)
class DriveWorldStage:
    """One stage of DriveWorld's training."""

    schedule: Schedule
    weights: DriveWorldWeights
    temporal: bool = True
    """Otherwise each frame's occupancy is learned from that frame alone."""
    statics_of: Literal["random", "now"] = "random"
    """The frame that all frames take what stands from: a random one, as the paper pre-trains, or the present,
    as it is when the model is used."""
    kind: Literal["driveworld"] = DRIVEWORLD


def _kind_of(written: object) -> str:
    """Whose size or stage was written: only DriveWorld's say so."""
    return DRIVEWORLD if isinstance(written, dict) and written.get("kind") == DRIVEWORLD else NEMO


AnyModel = Annotated[
    Annotated[NemoSize, Tag(NEMO)] | Annotated[DriveWorldSize, Tag(DRIVEWORLD)], Discriminator(_kind_of)
]
AnyStage = Annotated[
    Annotated[Stage, Tag(NEMO)] | Annotated[DriveWorldStage, Tag(DRIVEWORLD)], Discriminator(_kind_of)
]


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a run, but for where the logs are. The stages are of the model's kind."""

    name: str
    clips: ClipConfig
    model: AnyModel
    pretrain: AnyStage | None
    """None: fine-tuning starts from scratch, or from weights that are given."""
    finetune: AnyStage
    path: PathFit | None = None
    """How the planner's `PathCorrection` is fitted to what the fine-tuned world model sees, which joint
    fine-tuning then leaves alone; None leaves it to joint fine-tuning."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"


S = TypeVar("S", bound=Stage | DriveWorldStage)


def rescheduled(stage: S, **changes: Any) -> S:
    """The stage with other entries of its schedule."""
    return replace(stage, schedule=replace(stage.schedule, **changes))


def labelled_by(recipe: Recipe, occupancy_source: Literal["lidar", "recorded"]) -> Recipe:
    """The recipe with voxel labels of another source; its name tells."""
    if occupancy_source == recipe.clips.occupancy_source:
        return recipe
    clips = replace(recipe.clips, occupancy_source=occupancy_source)
    return replace(recipe, name=f"{recipe.name} ({occupancy_source} occupancy)", clips=clips)


V = TypeVar("V")


def save_recipe(recipe: Any, path: Path) -> None:
    """Write a recipe of any kind, a dataclass of plain values, as YAML."""
    with atomic_path(path) as temporary:
        temporary.write_text(yaml.safe_dump(_plain(asdict(recipe)), sort_keys=False))


def load_recipe(path: Path) -> Recipe:
    """Read a recipe that `save_recipe` wrote.

    Raises:
        InputError: naming the file, and the entry that is wrong, missing or unknown.
    """
    return load_values(Recipe, path)


def load_values(kind: type[V], path: Path) -> V:
    """`load_recipe` for any kind of recipe."""
    try:
        return TypeAdapter(kind).validate_python(yaml.safe_load(path.read_text()), extra="forbid")
    except OSError as error:
        raise InputError(f"{path.parent}: not a run folder, {path.name} cannot be read") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"] if part not in (NEMO, DRIVEWORLD))
        raise InputError(f"{path}: not a recipe: {f'{where}: ' if where else ''}{first['msg']}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a recipe: {str(error).splitlines()[0]}") from error


def _plain(value: object) -> object:
    """Tuples as lists, as YAML has them."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value
