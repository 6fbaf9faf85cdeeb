"""Where the images of a reconstruction may be trusted: places and headings beside the logged way."""

import itertools
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.engine.folder import CONFIG, SUMMARY
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.methods.reconstruction.novel_views import novel_camera_view
from foredrive.methods.reconstruction.trust import (
    IMAGE_WEIGHTS,
    ObservedViews,
    Trust,
    expected_errors,
    fitted_offset,
    image_features,
    observe_views,
    psnr_of,
)
from foredrive.methods.reconstruction.vehicle import EgoState, LoggedVehicle
from foredrive.runs.recipes.reconstruction import load_reconstruction_recipe
from foredrive.runs.reconstruction.reconstruction_run import OpenedReconstruction

OFFSETS_M = (0.0, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0, 4.5, -4.5, 6.0, -6.0)
HEADINGS_DEG = (0.0, 10.0, -10.0, 20.0, -20.0)
"""Places to the left and headings to the left that are judged, beside each moment of the log."""
_log = logging.getLogger(__name__)
CALIBRATED_DB = 1.0
"""Largest difference of expected and actual PSNR of the held-out images, dB, without a warning."""
REFERENCE_FRAMES = 12
"""Number of held-out frames, spread over the log, that the expectations are compared with."""


@dataclass(frozen=True)
class TrustedPlace:
    """The expected quality of the images at one place, heading and time."""

    t_s: float
    left_m: float
    """Distance to the left of the logged pose."""
    left_deg: float
    """Turn to the left of the logged heading."""
    xy: tuple[float, float]
    """Place in the frame of the scene, m."""
    psnr_db: float
    trusted: bool


def trust_of(opened: OpenedReconstruction, weights: Mapping[str, float] = IMAGE_WEIGHTS) -> Trust:
    """Return what a finished reconstruction expects of its images. It takes some seconds for each camera.

    The expectations are shifted so that they agree with the held-out images of the log on average.

    Args:
        opened: the reconstruction.
        weights: of `expected_errors`.

    Raises:
        InputError: the reconstruction is not finished, or has no cameras.
    """
    scene, vehicle = opened.scene, opened.vehicle
    if not (opened.folder / SUMMARY).is_file():
        raise InputError(f"{opened.folder}: not finished; continue it with `foredrive reconstruct`")
    trained_s, held_s = _frame_times(opened)
    plain = Trust(scene, observe_views(scene, vehicle, trained_s), 0.0, 0.0, weights)
    # Without held-out frames, the training frames are the reference, and their PSNR is not known
    compared_s = held_s or trained_s
    compared_s = compared_s[:: max(1, len(compared_s) // REFERENCE_FRAMES)]
    frames = [_features(plain, vehicle, vehicle.at(t_s)) for t_s in compared_s]
    actual_db = read_summary(opened.folder / SUMMARY).get("psnr_db")
    if isinstance(actual_db, float) and math.isfinite(actual_db):
        # The summary has the mean over single images, of each camera
        images = [image for frame in frames for image in frame]
        offset = fitted_offset(images, actual_db, weights)
        expected_db = fmean(psnr_of(expected_errors(image, offset, weights)) for image in images)
        if abs(expected_db - actual_db) > CALIBRATED_DB:
            _log.warning(
                "%s: trust says little here: %.1f dB are expected of the held-out images, which have %.1f dB",
                opened.folder,
                expected_db,
                actual_db,
            )
    else:
        _log.warning("%s: no held-out images: what is expected is that of other logs", opened.folder)
        offset = 0.0
    trust = replace(plain, offset=offset)
    return replace(trust, reference_db=fmean(_psnr_db(trust, frame) for frame in frames))


def trained_views(opened: OpenedReconstruction) -> ObservedViews:
    """Return the training views of a reconstruction.

    Raises:
        InputError: the reconstruction has no cameras.
    """
    return observe_views(opened.scene, opened.vehicle, _frame_times(opened)[0])


def _frame_times(opened: OpenedReconstruction) -> tuple[list[float], list[float]]:
    """Return the times of the training frames and of the held-out frames, s."""
    every = load_reconstruction_recipe(opened.folder / CONFIG).hold_out_every
    t_s = opened.vehicle.t_s.tolist()
    held_s = t_s[every - 1 :: every] if every else []
    return [time_s for time_s in t_s if time_s not in held_s], held_s


@torch.no_grad()
def _features(trust: Trust, vehicle: LoggedVehicle, ego: EgoState) -> list[dict[str, Float[Tensor, "N"]]]:
    """Return the features of the blocks of each camera's image at a pose of the vehicle, without edits."""
    scene, graph = trust.scene, trust.scene.graph
    of_cameras = []
    for camera in range(len(vehicle.rig.names)):
        view = novel_camera_view(vehicle.rig, camera, ego)
        image = scene.camera(graph, view.to(scene.device))
        of_cameras.append(image_features(trust.views, scene.track_id, graph, view, image))
    return of_cameras


def _psnr_db(trust: Trust, images: Sequence[Mapping[str, Float[Tensor, "N"]]]) -> float:
    """Return the expected PSNR of the images of all cameras at one time together, dB."""
    return psnr_of(torch.cat([expected_errors(features, trust.offset, trust.weights) for features in images]))


def expected_psnr_db(trust: Trust, vehicle: LoggedVehicle, ego: EgoState) -> float:
    """Return the expected PSNR of all cameras of the log together at a pose of the vehicle, without edits."""
    return _psnr_db(trust, _features(trust, vehicle, ego))


def place_grid(vehicle: LoggedVehicle, step_s: float) -> list[tuple[float, float, float]]:
    """Return the judged times of the log, s, with metres and degrees to the left of the logged pose."""
    first_s, last_s = float(vehicle.t_s[0]), float(vehicle.t_s[-1])
    times_s = [first_s + k * step_s for k in range(int((last_s - first_s) / step_s + 1e-6) + 1)]
    return list(itertools.product(times_s, OFFSETS_M, HEADINGS_DEG))


def trusted_place(
    trust: Trust, vehicle: LoggedVehicle, t_s: float, left_m: float, left_deg: float
) -> TrustedPlace:
    """Judge one place, heading and time of a reconstruction without edits."""
    moved = matrix_from_yaw(torch.tensor(math.radians(left_deg)), torch.tensor([0.0, left_m, 0.0]))
    ego = vehicle.at(t_s).shifted(moved)
    psnr_db = expected_psnr_db(trust, vehicle, ego)
    x_m, y_m = ego.T_scene_ego[:2, 3].tolist()
    return TrustedPlace(t_s, left_m, left_deg, (x_m, y_m), psnr_db, trust.trusts(psnr_db))
