"""DriveWorld (Min et al. 2024): a world model whose state is remembered, and whose scene is handed on."""

from foredrive.models.driveworld.gaussian import DiagonalGaussian, balanced_kl, kl_divergence
from foredrive.models.driveworld.world_model import DriveWorld, Unrolled, actions_of, motion_of

__all__ = [
    "DiagonalGaussian",
    "DriveWorld",
    "Unrolled",
    "actions_of",
    "balanced_kl",
    "kl_divergence",
    "motion_of",
]
