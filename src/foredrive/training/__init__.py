"""The training loop, checkpoints, resuming, logging."""

from foredrive.training.checkpoints import load_weights, save_weights
from foredrive.training.loop import Schedule, read_metrics, train
from foredrive.training.objective import LossWeights, NemoObjective
from foredrive.training.rays import ImageRays, thinned_rays

__all__ = [
    "ImageRays",
    "LossWeights",
    "NemoObjective",
    "Schedule",
    "load_weights",
    "read_metrics",
    "save_weights",
    "thinned_rays",
    "train",
]
