"""Losses: pure functions of predictions and truth that training descends."""

from foredrive.losses.masked import masked_mean
from foredrive.losses.occupancy import occupancy_bce, occupancy_loss, scene_class_affinity
from foredrive.losses.planning import ego_motion_loss, l1_waypoint_loss, waypoint_loss
from foredrive.losses.reconstruction import l1_loss, perceptual_loss

__all__ = [
    "ego_motion_loss",
    "l1_loss",
    "l1_waypoint_loss",
    "masked_mean",
    "occupancy_bce",
    "occupancy_loss",
    "perceptual_loss",
    "scene_class_affinity",
    "waypoint_loss",
]
