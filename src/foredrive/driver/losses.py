"""Losses of a driver's sight."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.driver.road_user_targets import USERS, road_user_cells, road_user_pixels
from foredrive.driver.route_cells import LINE_CELL_M, LINE_CELLS, LINE_FROM_M
from foredrive.driver.sight import VELOCITY_SCALE_MPS, Sight, scaled_line
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.ops.masked import masked_mean
from foredrive.scene import CameraRig, Clip
from foredrive.scene.affordances import Affordances
from foredrive.scene.traffic_light import LightState


@dataclass(frozen=True)
class SightWeights:
    """Weights of the terms of `sight_losses`."""

    light: float = 1.0
    """Weight of the state of the next light on the route, cross-entropy."""
    lamps: float = 0.5
    """Weight of the places of that light's lamps in the images, focal loss."""
    light_m: float = 1.0
    """Weight of the distance of the stop line as read at each lamp, L1 of its logarithm."""
    line: float = 1.0
    """Weight of the cell of the route in which the stop line is, cross-entropy."""
    sign: float = 1.0
    """Weight of the cell of the route in which the line of the next stop sign is, cross-entropy."""
    occupied: float = 5.0
    """Weight of the occupancy of the path over time, cross-entropy."""
    occupied_cells: float = 2.5
    """Factor for occupied cells in `occupied` and `user_cells`: a missed road user is worse than a false
    one."""
    crossing: float = 2.0
    """Factor for cells in `occupied` that are free now and occupied later: who crosses or cuts in."""
    user_pixels: float = 4.0
    """Weight of the places of road users in the images, cross-entropy."""
    user_cells: float = 4.0
    """Weight of the cells along and beside the route where road users are, cross-entropy."""
    user_velocity: float = 2.0
    """Weight of the velocities of road users, squared error in units of `VELOCITY_SCALE_MPS`."""
    vulnerable: float = 4.0
    """Factor for the velocity of people and those on two wheels."""


def sight_losses(
    sight: Sight, truth: Affordances, clip: Clip, weights: SightWeights
) -> dict[str, Float[Tensor, ""]]:
    """Return the losses by name; "loss" is their sum. Entries that the truth does not know have no loss.

    Args:
        sight: of b items.
        truth: of b items.
        clip: its cameras, route and boxes at now are read.
        weights: weights of the terms.
    """
    rig = clip.rig[:, clip.now]
    lamps = lamp_places(truth, rig, (sight.lamp_logits.shape[-2], sight.lamp_logits.shape[-1]))
    visible = lamps.inside.any(-1).any(-1)
    is_none = truth.light == LightState.NONE
    # A light whose lamps are in no image cannot be named, and neither can "none" be learned from it.
    judged = truth.light_known & (is_none | visible)
    error = F.cross_entropy(sight.light_logits, truth.light.long(), reduction="none")
    losses = {
        "light": weights.light * masked_mean(error, judged),
        "lamps": weights.lamps * _lamp_loss(sight, truth, lamps),
        "light_m": weights.light_m * _lamp_line_loss(sight, truth, lamps),
        "line": weights.line
        * masked_mean(
            _line_error(sight.line_logits, truth.light != LightState.NONE, truth.light_m), truth.light_known
        ),
        "sign": weights.sign
        * masked_mean(_line_error(sight.sign_logits, truth.sign, truth.sign_m), truth.sign_known),
        "occupied": weights.occupied * _occupancy_loss(sight, truth, weights),
        **_user_losses(sight, clip, weights),
    }
    return losses | {"loss": torch.stack(list(losses.values())).sum()}


@dataclass(frozen=True)
class LampPlaces:
    """Places of L lamps in the feature maps of C cameras."""

    row: Int[Tensor, "b C L"]
    column: Int[Tensor, "b C L"]
    inside: Bool[Tensor, "b C L"]


def lamp_places(truth: Affordances, rig: CameraRig, size: tuple[int, int]) -> LampPlaces:
    """Return where the lamps of the light on the route are in feature maps of `size` rows and columns."""
    b, cameras = rig.K.shape[:2]
    # Lamps into the camera frame, then to cells of the feature map
    points = truth.lamp_xyz[:, None].expand(b, cameras, -1, -1)
    uv, _, inside = project(
        transform_points(inverse_se3(rig.T_ego_cam), points), rig.K, rig.dist, rig.size_hw
    )
    # Lamps are known for this light, and there is a light
    lamps = truth.lamp & (truth.lamps_known & (truth.light != LightState.NONE))[:, None]
    column = (uv[..., 0] * size[1] / rig.size_hw[1]).floor().long().clamp(0, size[1] - 1)
    row = (uv[..., 1] * size[0] / rig.size_hw[0]).floor().long().clamp(0, size[0] - 1)
    return LampPlaces(row, column, inside & lamps[:, None])


def _lamp_loss(sight: Sight, truth: Affordances, lamps: LampPlaces) -> Float[Tensor, ""]:
    """Return the focal loss (Lin et al. 2017, γ = 2) of the lamps in place, per lamp."""
    target = torch.zeros_like(sight.lamp_logits)
    item, camera, lamp = lamps.inside.nonzero(as_tuple=True)
    # Colour channels begin at red: `LightState` minus 1
    colour = truth.light[item].long() - 1
    target[item, camera, colour, lamps.row[item, camera, lamp], lamps.column[item, camera, lamp]] = 1.0
    error = F.binary_cross_entropy_with_logits(sight.lamp_logits, target, reduction="none")
    p = sight.lamp_logits.sigmoid()
    # Focal weight: the square of the wrongness of the prediction
    wrong = torch.where(target > 0, 1 - p, p)
    of_item = truth.lamps_known[:, None, None, None, None]
    return (wrong.square() * error * of_item).sum() / target.sum().clamp_min(1)


def _line_error(
    logits: Float[Tensor, "b N"], present: Bool[Tensor, "b"], line_m: Float[Tensor, "b"]
) -> Float[Tensor, "b"]:
    """Return the cross-entropy of the cell in which a stop line is."""
    cell = (line_m / LINE_CELL_M).floor().long()
    # The last class is no line in any cell
    seen = present & (line_m >= LINE_FROM_M) & (cell < LINE_CELLS)
    target = torch.where(seen, cell, LINE_CELLS)
    return F.cross_entropy(logits, target, reduction="none")


def _lamp_line_loss(sight: Sight, truth: Affordances, lamps: LampPlaces) -> Float[Tensor, ""]:
    """Return the error of the stop line's distance, read at each lamp, in `Sight.lamp_line`'s scale."""
    item, camera, lamp = lamps.inside.nonzero(as_tuple=True)
    read = sight.lamp_line[item, camera, lamps.row[item, camera, lamp], lamps.column[item, camera, lamp]]
    error = (read - scaled_line(truth.light_m[item])).abs()
    return error.sum() / max(len(item), 1)


def _occupancy_loss(sight: Sight, truth: Affordances, weights: SightWeights) -> Float[Tensor, ""]:
    """Return the weighted cross-entropy of the cells that are known."""
    occupied = truth.occupied
    # Cells that become occupied later are rare and count more
    later = occupied & ~occupied[:, :1]
    weight = torch.where(occupied, weights.occupied_cells, 1.0) * torch.where(later, weights.crossing, 1.0)
    error = F.binary_cross_entropy_with_logits(sight.occupied_logits, occupied.float(), reduction="none")
    return masked_mean(weight * error, truth.occupied_known)


def _user_losses(sight: Sight, clip: Clip, weights: SightWeights) -> dict[str, Float[Tensor, ""]]:
    """Return the losses of where road users are in images and cells, and of how they move."""
    size = (sight.user_pixels.shape[-2], sight.user_pixels.shape[-1])
    annotated = clip.boxes_valid[:, clip.now]
    pixels, pixels_known = road_user_pixels(clip, size)
    cells = road_user_cells(clip)
    is_pixel = F.binary_cross_entropy_with_logits(sight.user_pixels, pixels.float(), reduction="none")
    logits, velocity = sight.user_cells.split([len(USERS), 2], dim=1)
    is_cell = F.binary_cross_entropy_with_logits(logits, cells.present.float(), reduction="none")
    is_cell = torch.where(cells.present, weights.occupied_cells, 1.0) * is_cell
    # Most vehicles stand or drive along: people and those on two wheels count more.
    vulnerable = torch.where(cells.present[:, 1], weights.vulnerable, 1.0)
    error = F.mse_loss(velocity, cells.velocity / VELOCITY_SCALE_MPS, reduction="none").sum(1)
    error = vulnerable * error
    return {
        "user_pixels": weights.user_pixels
        * masked_mean(is_pixel, pixels_known & annotated[:, None, None, None, None]),
        "user_cells": weights.user_cells * masked_mean(is_cell, cells.known & annotated[:, None, None, None]),
        "user_velocity": weights.user_velocity
        * masked_mean(error, cells.velocity_known & annotated[:, None, None]),
    }
