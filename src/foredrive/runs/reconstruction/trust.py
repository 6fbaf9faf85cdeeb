"""Where the sensors of a reconstruction may be trusted: places and headings beside the logged way."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import torch

from foredrive.engine.folder import CONFIG, SUMMARY
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.methods.reconstruction.novel_views import novel_camera_view, novel_sweep_view
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.trust import Expected, Trust, observe_points, observe_views
from foredrive.methods.reconstruction.vehicle import EgoState, LoggedVehicle
from foredrive.runs.recipes.reconstruction import load_reconstruction_recipe
from foredrive.runs.reconstruction.reconstruction_run import OpenedReconstruction

OFFSETS_M = (0.0, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0, 4.5, -4.5, 6.0, -6.0)
HEADINGS_DEG = (0.0, 10.0, -10.0, 20.0, -20.0)
"""Places to the left and headings to the left that are judged, beside each moment of the log."""
REFERENCE_FRAMES = 12
"""Number of held-out frames, spread over the log, that the expectations are compared with."""


@dataclass(frozen=True)
class TrustedPlace:
    """The expected quality of the sensors at one place, heading and time."""

    t_s: float
    left_m: float
    """Distance to the left of the logged pose."""
    left_deg: float
    """Turn to the left of the logged heading."""
    xy: tuple[float, float]
    """Place in the frame of the scene, m."""
    psnr_db: float | None
    right_share: float | None
    trusted: bool


def trust_of(opened: OpenedReconstruction) -> Trust:
    """Return what a finished reconstruction expects of its frames. It takes some seconds for each camera.

    The expectations are shifted so that they agree with the held-out images of the log on average.

    Raises:
        InputError: the reconstruction is not finished.
    """
    scene, vehicle = opened.scene, opened.vehicle
    if not (opened.folder / SUMMARY).is_file():
        raise InputError(f"{opened.folder}: not finished; continue it with `foredrive reconstruct`")
    every = load_reconstruction_recipe(opened.folder / CONFIG).hold_out_every
    held = [bool(every) and frame % every == every - 1 for frame in range(len(vehicle.t_s))]
    trained_s = [t_s for t_s, out in zip(vehicle.t_s.tolist(), held, strict=True) if not out]
    held_s = [t_s for t_s, out in zip(vehicle.t_s.tolist(), held, strict=True) if out]
    views, points = observe_views(scene, vehicle, trained_s), observe_points(scene, vehicle, trained_s)
    plain = Trust(scene, views, points, 0.0, Expected(None, None))
    # Without held-out frames, the training frames are the reference, and their PSNR is not known
    compared = (held_s or trained_s)[:: max(1, len(held_s or trained_s) // REFERENCE_FRAMES)]
    frames = [expected_frame(plain, scene.graph, vehicle, vehicle.at(t_s)) for t_s in compared]
    expected_db = _mean([frame.psnr_db for frame in frames])
    actual_db = read_summary(opened.folder / SUMMARY).get("psnr_db")
    offset = 0.0
    if expected_db is not None and isinstance(actual_db, float | int) and math.isfinite(actual_db):
        offset = (expected_db - actual_db) * math.log(10) / 10
        expected_db = float(actual_db)
    return Trust(scene, views, points, offset, Expected(expected_db, _mean([f.right_share for f in frames])))


def _mean(values: Sequence[float | None]) -> float | None:
    return None if None in values or not values else fmean(value for value in values if value is not None)


@torch.no_grad()
def expected_frame(trust: Trust, graph: SceneGraph, vehicle: LoggedVehicle, ego: EgoState) -> Expected:
    """Return the expected quality of all sensors of the log at a pose of the vehicle."""
    scene: ReconstructedScene = trust.scene
    views = [novel_camera_view(vehicle.rig, camera, ego) for camera in range(len(vehicle.rig.names))]
    images = [(view, scene.camera(graph, view.to(scene.device))) for view in views]
    if vehicle.lidar is None:
        return trust.expected(graph, images, None)
    view = novel_sweep_view(vehicle.lidar, ego)
    return trust.expected(graph, images, (view, scene.sweep(graph, scene.prepare_sweep(view), ego.t_s)))


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
    expected = expected_frame(trust, trust.scene.graph, vehicle, ego)
    x_m, y_m = ego.T_scene_ego[:2, 3].tolist()
    return TrustedPlace(t_s, left_m, left_deg, (x_m, y_m), *expected, trust.trusts(expected))
