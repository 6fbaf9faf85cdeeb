"""DriveWorld (Min et al. 2024): a world model with a memory of past states and a static scene branch."""

from foredrive.methods.driveworld.actions import actions_of, motion_of
from foredrive.methods.driveworld.gaussian import DiagonalGaussian, balanced_kl, kl_divergence
from foredrive.methods.driveworld.world_model import DriveWorld, DriveWorldConfig, LiftedFrames, Unrolled

__all__ = [
    "DiagonalGaussian",
    "DriveWorld",
    "DriveWorldConfig",
    "LiftedFrames",
    "Unrolled",
    "actions_of",
    "balanced_kl",
    "kl_divergence",
    "motion_of",
]
