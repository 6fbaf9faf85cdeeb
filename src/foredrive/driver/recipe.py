"""Recipes of drivers."""

from dataclasses import dataclass, field
from typing import Literal

from foredrive.data import ClipConfig
from foredrive.data.task_truth import TaskTruthConfig
from foredrive.driver.eyes import CameraEyesConfig
from foredrive.driver.losses import SightWeights
from foredrive.driver.speed_planner import SpeedPlannerConfig
from foredrive.scene import VoxelSpec
from foredrive.sensors.rigs import FRONT_TELE
from foredrive.training import Schedule
from foredrive.training.in_memory_fit import FitSchedule


@dataclass(frozen=True)
class PlanFit(FitSchedule):
    """Fit of the planner to the rule, on the truth of the training clips and on what the eyes see of them."""

    steps: int = 6000
    batch_size: int = 256
    lr: float = 2e-3
    weight_decay: float = 1e-3
    speeds: int = 3
    """Speeds at which each clip is driven: its own and random ones."""
    clips: int = 6000
    """Most clips that are used."""
    seen_share: float = 0.5
    """Share of the rows in which the planner reads what the eyes see, in place of the truth."""


@dataclass(frozen=True)
class DriverRecipe:
    """All settings of a driver's training, except where the logs are."""

    name: str
    clips: ClipConfig
    eyes: CameraEyesConfig
    planner: SpeedPlannerConfig
    see: Schedule
    """Training of the eyes."""
    weights: SightWeights = field(default_factory=SightWeights)
    plan: PlanFit = field(default_factory=PlanFit)
    precision: Literal["32-true", "bf16-mixed"] = "bf16-mixed"
    kind: Literal["driver"] = "driver"
    about: str = field(default="", compare=False)
    """One line for lists of recipes."""


AFFORDANCES = TaskTruthConfig(
    elements_lw_m=None, raster=None, semantics=None, instances=None, affordances=True
)
NO_VOXELS = VoxelSpec(lower_m=(-4.0, -4.0, -1.0), voxel_m=4.0, shape_zyx=(1, 2, 2))


def driver_small() -> DriverRecipe:
    """Return a driver of 0.9 M weights that sees two cameras and two key frames."""
    eyes = CameraEyesConfig()
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
            epochs=3,
            weight_decay=1e-2,
            clip_grad_norm=5.0,
            checkpoint_every=200,
            warmup_steps=200,
        ),
    )


DRIVER_RECIPES: dict[str, DriverRecipe] = {recipe.name: recipe for recipe in (driver_small(),)}
