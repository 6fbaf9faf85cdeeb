"""Training: the loop, checkpoints, resuming, logging."""

from typing import TYPE_CHECKING

from foredrive.lazy import on_demand

if TYPE_CHECKING:
    from foredrive.training.augmentation import AugmentConfig
    from foredrive.training.checkpoints import load_weights, save_weights
    from foredrive.training.driveworld_objective import (
        DriveWorldObjective,
        DriveWorldStage,
        DriveWorldWeights,
    )
    from foredrive.training.ego_mlp_fit import EgoMLPFit, StatusDemonstrations, fit_ego_mlp, read_status
    from foredrive.training.fabric import make_fabric
    from foredrive.training.loop import CONDITIONS, Schedule, train
    from foredrive.training.metrics_log import read_metrics
    from foredrive.training.objective import NemoObjective, NemoStage, NemoWeights
    from foredrive.training.path_fit import PathDemonstrations, PathFit, fit_path
    from foredrive.training.rays import ImageRays, thinned_rays

__all__ = [
    "CONDITIONS",
    "AugmentConfig",
    "DriveWorldObjective",
    "DriveWorldStage",
    "DriveWorldWeights",
    "EgoMLPFit",
    "ImageRays",
    "NemoObjective",
    "NemoStage",
    "NemoWeights",
    "PathDemonstrations",
    "PathFit",
    "Schedule",
    "StatusDemonstrations",
    "fit_ego_mlp",
    "fit_path",
    "load_weights",
    "make_fabric",
    "read_metrics",
    "read_status",
    "save_weights",
    "thinned_rays",
    "train",
]

__getattr__ = on_demand(
    __name__,
    {
        "augmentation": ("AugmentConfig",),
        "checkpoints": ("load_weights", "save_weights"),
        "driveworld_objective": ("DriveWorldObjective", "DriveWorldStage", "DriveWorldWeights"),
        "ego_mlp_fit": ("EgoMLPFit", "StatusDemonstrations", "fit_ego_mlp", "read_status"),
        "fabric": ("make_fabric",),
        "loop": ("CONDITIONS", "Schedule", "train"),
        "metrics_log": ("read_metrics",),
        "objective": ("NemoObjective", "NemoStage", "NemoWeights"),
        "path_fit": ("PathDemonstrations", "PathFit", "fit_path"),
        "rays": ("ImageRays", "thinned_rays"),
    },
)
