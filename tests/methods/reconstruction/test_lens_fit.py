"""The lens that explains a camera's images: of panels whose edges a lidar sees, drawn by the true camera."""

import dataclasses

import pytest
import torch

from foredrive.geometry.projection import project
from foredrive.methods.reconstruction.calibration import CalibrationViews, calibration_views
from foredrive.methods.reconstruction.lens_fit import best_camera_lens
from foredrive.methods.reconstruction.sweep_edges import SweepEdges
from foredrive.methods.reconstruction.views import CameraView
from foredrive.runs.reconstruction.calibration_check import _camera_findings, best_camera_rotation

SIZE_HW, FOCAL_PX = (240, 320), 300.0
K = torch.tensor([[FOCAL_PX, 0, 160.0], [0, FOCAL_PX, 120.0], [0, 0, 1]])


def panels(seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """An image of square panels that face the camera, and points on their edges with their kind."""
    rng = torch.Generator().manual_seed(seed)
    image = torch.full((3, *SIZE_HW), 90, dtype=torch.uint8)
    points, horizontal = [], []
    for row in range(3):
        for column in range(4):
            depth_m = 6.0 + 6.0 * float(torch.rand((), generator=rng))
            shift = 0.08 * torch.rand(2, generator=rng) - 0.04
            x, y = (torch.tensor([(column - 1.5) * 0.24, (row - 1) * 0.24]) + shift).mul(depth_m).tolist()
            half_m = 0.05 * depth_m
            corners = torch.tensor([[x - half_m, y - half_m, depth_m], [x + half_m, y + half_m, depth_m]])
            uv, _, _ = project(corners, K, torch.zeros(5), SIZE_HW)
            (u0, v0), (u1, v1) = uv.round().int().clamp(0, 320).tolist()
            image[:, v0:v1, u0:u1] = 160 + int(90 * torch.rand((), generator=rng))
            along = torch.linspace(-half_m, half_m, 9)
            for side in (-half_m, half_m):
                for upright in (True, False):
                    edge = torch.full((9, 3), depth_m)
                    edge[:, 0] = x + (side if upright else along)
                    edge[:, 1] = y + (along if upright else side)
                    points.append(edge)
                    horizontal += [not upright] * 9
    return image, torch.cat(points), torch.tensor(horizontal)


def views(focal_scale: float, k1: float) -> CalibrationViews:
    """Six images and the edges in them, with a calibration that has another lens."""
    made = [panels(seed) for seed in range(6)]
    scaled = K * torch.tensor([[focal_scale], [focal_scale], [1.0]])
    scaled[:2, 2] = K[:2, 2]
    camera = CameraView(
        scaled, torch.tensor([k1, 0.0, 0, 0, 0]), torch.eye(4), torch.zeros(6), 0.0, 0.0, SIZE_HW, 0
    )
    cameras = [dataclasses.replace(camera, t_s=float(k), image=image) for k, (image, *_) in enumerate(made)]
    edges = [SweepEdges(float(k), torch.eye(4), points, kind) for k, (_, points, kind) in enumerate(made)]
    found = calibration_views(cameras, edges)
    assert found is not None
    return found


@pytest.mark.parametrize(("focal_scale", "k1"), [(1.25, -0.3), (0.85, 0.0)])
def test_another_lens_is_found_and_named(focal_scale: float, k1: float) -> None:
    """As of images that are undistorted a second time, and of a scale that the calibration lacks."""
    paired = views(focal_scale, k1)
    lens = best_camera_lens(paired)
    assert lens.focal_scale == pytest.approx(1 / focal_scale, abs=0.03)
    assert lens.undistorted == (k1 != 0)
    (finding,) = _camera_findings("front", paired, best_camera_rotation(paired))
    assert finding.large
    assert "of its focal length" in finding.text
    assert ("no distortion" in finding.text) == (k1 != 0)


def test_the_true_lens_has_no_finding() -> None:
    paired = views(1.0, 0.0)
    assert _camera_findings("front", paired, best_camera_rotation(paired)) == []
