"""Recipes of drivers."""

from dataclasses import dataclass, field, replace
from typing import Literal

from foredrive.data import ClipConfig
from foredrive.data.clip_config import TaskTruthConfig
from foredrive.driver.eyes import CameraEyesConfig
from foredrive.driver.losses import SightWeights
from foredrive.driver.planner_fit import PlanFit
from foredrive.driver.speed_planner import SpeedPlannerConfig
from foredrive.driver.volume_eyes import VolumeEyesConfig
from foredrive.engine.loop import Schedule
from foredrive.methods.nemo.recipes import nemo_town
from foredrive.scene import VoxelSpec
from foredrive.sensors.rigs import FRONT_TELE


@dataclass(frozen=True)
class DriverRecipe:
    """All settings of a driver's training, except where the logs are."""

    name: str
    clips: ClipConfig
    eyes: CameraEyesConfig | VolumeEyesConfig
    planner: SpeedPlannerConfig
    see: Schedule
    """Training of the eyes."""
    weights: SightWeights = field(default_factory=SightWeights)
    plan: PlanFit = field(default_factory=PlanFit)
    emphasis: float = 3.0
    """How often clips are drawn in which the driver that the training starts from is wrong; others: 1."""
    precision: Literal["32-true", "bf16-mixed"] = "bf16-mixed"
    """Numbers in training: "32-true" for 32 bits, or "bf16-mixed" for bfloat16 autocast where it saves
    time."""
    kind: Literal["driver"] = "driver"
    about: str = field(default="", compare=False)
    """One line for lists of recipes."""


AFFORDANCES = TaskTruthConfig(
    elements_lw_m=None, raster=None, semantics=None, instances=None, affordances=True
)
NO_VOXELS = VoxelSpec(lower_m=(-4.0, -4.0, -1.0), voxel_m=4.0, shape_zyx=(1, 2, 2))


def driver_small() -> DriverRecipe:
    """Return a driver of 0.7 M weights that sees two cameras and two key frames."""
    eyes = CameraEyesConfig(signs=True)
    return DriverRecipe(
        name="driver_small",
        about="drives along a given route by two cameras: lights, and who is on the path over time",
        clips=ClipConfig(
            past_frames=eyes.frames - 1,
            future_frames=0,
            image_hw=FRONT_TELE.image_hw,
            voxels=NO_VOXELS,
            cameras=tuple(name.lower() for name in FRONT_TELE.cameras),
            tasks=AFFORDANCES,
        ),
        eyes=eyes,
        planner=SpeedPlannerConfig(),
        see=Schedule(
            batch_size=16,
            lr=3e-3,
            epochs=8,
            weight_decay=1e-2,
            clip_grad_norm=5.0,
            checkpoint_every=200,
            warmup_steps=200,
        ),
    )


def driver_nemo() -> DriverRecipe:
    """Return a driver that reads NeMo's volume and features along the route, both trained on.

    `foredrive train driver_nemo --start RUN` starts from the pre-trained encoder of a run with the same world
    model, such as the one that comes with the package.
    """
    small, town = driver_small(), nemo_town()
    return replace(
        small,
        name="driver_nemo",
        about="driver_small with NeMo's backbone and volume as its eyes",
        eyes=VolumeEyesConfig(
            world=town.model, voxels=town.clips.voxels, frames=small.eyes.frames, signs=True
        ),
        see=replace(small.see, lr=1e-3, epochs=2),
    )


DRIVER_RECIPES: dict[str, DriverRecipe] = {recipe.name: recipe for recipe in (driver_small(), driver_nemo())}
