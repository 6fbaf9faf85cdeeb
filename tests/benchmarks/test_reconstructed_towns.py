"""What a town's sensors see after edits, and wrong calibrations that are noticed there."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from benchmarks.common.reconstructed_towns import TownDrive, TownTruth, TrueViews
from foredrive.errors import InputError
from foredrive.geometry.se3 import exp_se3, inverse_se3, transform_points
from foredrive.methods.reconstruction.calibration import with_images_from
from foredrive.methods.reconstruction.edits import Duplicate, Move, Remove, ShiftEgo
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.runs.reconstruction.calibration_check import calibration_findings
from foredrive.scene import Category
from foredrive.scene.actors import ActorState
from foredrive.sensors.rigs import SURROUND, RigPlan

CAMERAS = ("PCAM_F0", "PCAM_R0")
DRIVE = TownDrive(
    "Town02",
    seed=3,
    seconds=6.0,
    rate_hz=2.0,
    rig=RigPlan((120, 240), {name: SURROUND.cameras[name] for name in CAMERAS}),
)
AHEAD = 1_000
"""A car that is put ahead: whom traffic puts there depends on the last digits of the machine's arithmetic."""
NOBODY = ActorTracks(
    torch.zeros(0, dtype=torch.int64),
    torch.zeros(0, dtype=torch.int64),
    torch.zeros(0, 3),
    torch.tensor([0.0]),
    torch.zeros(0, 1, 4, 4),
    torch.zeros(0, 1, dtype=torch.bool),
)


@pytest.fixture(scope="module")
def truth() -> TownTruth:
    return TownTruth(DRIVE)


@pytest.fixture(scope="module")
def driven(truth: TownTruth) -> list[TrueViews]:
    return [truth.seen(frame) for frame in range(8)]


def points_m(view: SweepView) -> torch.Tensor:
    """In the scene's frame."""
    return transform_points(view.T_scene_ego, view.beams.points_ego[view.beams.returned])


@pytest.mark.slow
def test_from_beside_the_same_town_is_seen(truth: TownTruth) -> None:
    driven, beside = truth.seen(4), truth.seen(4, [ShiftEgo((0.0, 2.0, 0.0))])
    T = inverse_se3(driven.cameras[0].T_scene_cam) @ beside.cameras[0].T_scene_cam
    torch.testing.assert_close(T[:3, 3], torch.tensor([-2.0, 0.0, 0.0]), atol=1e-4, rtol=0)
    apart_m = cKDTree(points_m(driven.sweep)).query(points_m(beside.sweep))[0]
    near = (points_m(beside.sweep) - beside.sweep.T_scene_ego[:3, 3]).norm(dim=-1) < 12
    assert float(torch.from_numpy(apart_m)[near].median()) < 0.1
    assert not torch.equal(beside.cameras[0].image, driven.cameras[0].image)


def car_ahead(T_world_ego: np.ndarray) -> ActorState:
    """It drives 10 m ahead on a level road."""
    size_lwh = np.array([4.5, 1.8, 1.5])
    centre_m = (T_world_ego @ [10.0, 0.0, 0.5 * size_lwh[2], 1.0])[:3]
    yaw = float(np.arctan2(T_world_ego[1, 0], T_world_ego[0, 0]))
    velocity_mps = T_world_ego[:3, 0] * 3.0
    return ActorState(AHEAD, Category.CAR, centre_m, yaw, 0.0, size_lwh, velocity_mps, style=1, parked=False)


def test_who_is_removed_or_moved_is_not_where_it_was() -> None:
    truth = TownTruth(DRIVE)
    actor = car_ahead(truth.snapshots[4].T_world_ego)
    truth.snapshots[4] = dataclasses.replace(truth.snapshots[4], actors=[actor])
    driven = truth.seen(4).sweep
    T_scene_world = torch.from_numpy(truth.snapshots[0].T_world_ego).inverse()
    centre_m = transform_points(T_scene_world, torch.from_numpy(actor.centre_m)[None]).float()[0]
    forward = (T_scene_world[:3, :3] @ torch.from_numpy(actor.velocity_mps)).float()
    forward = forward / forward.norm()
    left = torch.tensor([-float(forward[1]), float(forward[0]), 0.0])
    length_m, width_m, height_m = actor.size_lwh

    def beams_at(view: SweepView, where_m: torch.Tensor) -> int:
        """That met something above the ground; the lidar looks ahead 0.05 s before the frame's time."""
        beside_m = points_m(view) - where_m
        inside = (beside_m @ forward).abs() < 0.5 * length_m + 0.7
        inside &= (beside_m @ left).abs() < 0.5 * width_m + 0.1
        return int((inside & (beside_m[:, 2] > 0.3 - 0.5 * height_m)).sum())

    removed, moved = truth.seen(4, [Remove(AHEAD)]), truth.seen(4, [Move(AHEAD, (0.0, 6.0, 0.0))])
    there_m = centre_m + 6 * left
    as_driven = beams_at(driven, centre_m)
    assert as_driven > 20
    assert beams_at(removed.sweep, centre_m) < 0.1 * as_driven
    assert beams_at(moved.sweep, centre_m) < 0.1 * as_driven
    assert beams_at(moved.sweep, there_m) > beams_at(driven, there_m) + 10
    with pytest.raises(InputError, match="not: duplicate"):
        truth.seen(4, [Duplicate(AHEAD, 1)])


def findings(cameras: list[CameraView], sweeps: list[SweepView]) -> list[str]:
    return [finding.text for finding in calibration_findings(CAMERAS, cameras, sweeps, NOBODY)]


def test_a_right_calibration_gives_no_finding(driven: list[TrueViews]) -> None:
    cameras, sweeps = [c for seen in driven for c in seen.cameras], [seen.sweep for seen in driven]
    assert findings(cameras, sweeps) == []
    assert findings(cameras, []) == []


def moved(driven: list[TrueViews], sensor: int, offset: list[float]) -> list[CameraView]:
    """All views, those of one camera with a pose that is wrong by a translation (m) and a rotation (rad)."""
    T_cam_moved = exp_se3(torch.tensor(offset))
    cameras = [camera for seen in driven for camera in seen.cameras]
    return [
        dataclasses.replace(camera, T_scene_cam=camera.T_scene_cam @ T_cam_moved)
        if camera.sensor == sensor
        else camera
        for camera in cameras
    ]


@pytest.mark.parametrize("sensor", [0, 1])
@pytest.mark.parametrize(("degrees", "side"), [(0.5, "left"), (-0.5, "right"), (2.0, "left")])
def test_a_camera_that_is_turned_is_told(
    sensor: int, degrees: float, side: str, driven: list[TrueViews]
) -> None:
    cameras = moved(driven, sensor, [0.0, 0.0, 0.0, 0.0, math.radians(degrees), 0.0])
    (said,) = findings(cameras, [seen.sweep for seen in driven])
    assert said.startswith(f"camera {CAMERAS[sensor]} fits the lidar better if it is turned")
    around = [abs(degrees) + step for step in (-0.25, 0.0, 0.25)]
    assert any(f"{degrees:.2f}° to the {side}" in said for degrees in around)


@pytest.mark.parametrize("left_m", [0.2, -0.2])
def test_a_lidar_that_is_moved_is_told(left_m: float, driven: list[TrueViews]) -> None:
    T_ego_moved = exp_se3(torch.tensor([0.0, left_m, 0.0, 0.0, 0.0, 0.0]))
    sweeps = [
        dataclasses.replace(seen.sweep, T_scene_ego=seen.sweep.T_scene_ego @ T_ego_moved) for seen in driven
    ]
    (said,) = findings([camera for seen in driven for camera in seen.cameras], sweeps)
    assert said.startswith("the lidar fits the images better if it is moved 0.00 m forward")
    assert f"0.20 m to the {'right' if left_m > 0 else 'left'}" in said


@pytest.mark.parametrize("sensor", [0, 1])
def test_a_camera_whose_clock_is_wrong_is_told(sensor: int, driven: list[TrueViews]) -> None:
    cameras = [
        dataclasses.replace(camera, T_scene_cam=camera.T_scene_cam @ exp_se3(0.05 * camera.twist_cam))
        if camera.sensor == sensor
        else camera
        for seen in driven
        for camera in seen.cameras
    ]
    (said,) = findings(cameras, [seen.sweep for seen in driven])
    assert said.startswith(f"camera {CAMERAS[sensor]} fits the lidar better if its images are from")
    assert any(f"{delay_s:.2f} s earlier" in said for delay_s in (0.04, 0.05, 0.06))


def test_cameras_that_are_exchanged_are_told(driven: list[TrueViews]) -> None:
    front, right = ([seen.cameras[i] for seen in driven] for i in (0, 1))
    cameras = with_images_from(front, right) + with_images_from(right, front)
    said = findings(cameras, [seen.sweep for seen in driven])
    assert "the images of camera PCAM_F0 fit the pose of PCAM_R0" in said
    assert "the images of camera PCAM_R0 fit the pose of PCAM_F0" in said
