"""Sensors that move while they look, and corrections of them, on scenes of a few Gaussians."""

import dataclasses
from typing import Literal

import pytest
import torch

from foredrive.geometry.se3 import exp_se3, transform_points
from foredrive.methods.reconstruction.decoders import CameraDecoder, CameraDecoderConfig, LidarDecoder
from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.content import GaussianContent
from foredrive.methods.splatad.scene import UNSEEN_RGB, GaussianScene
from foredrive.methods.splatad.scene_config import GaussianSceneConfig
from foredrive.scene import LidarSweep

FORWARD = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Camera (x right, y down, z forward) in a frame with x forward and z up."""


def scene_of(
    mean_m: torch.Tensor, tracks: ActorTracks, config: GaussianSceneConfig | None = None
) -> GaussianScene:
    """Small, hard, white Gaussians."""
    count = len(mean_m)
    gaussians = Gaussians(
        mean_m=mean_m,
        quaternion=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scale=torch.full((count, 3), 0.08).log(),
        opacity_logit=torch.full((count,), 8.0),
        feature=torch.tensor([[1.0, 1, 1, 0, 0]]).repeat(count, 1),
    )
    torch.manual_seed(0)
    graph = SceneGraph(tracks, GaussianContent(gaussians, torch.full((count,), STATIC)))
    return GaussianScene(graph, 1, config, frames=2)


@pytest.fixture
def nobody() -> ActorTracks:
    one = ActorTracks(
        torch.tensor([1]),
        torch.tensor([0]),
        torch.ones(1, 3),
        torch.tensor([0.0, 1.0]),
        torch.eye(4).repeat(1, 2, 1, 1),
        torch.ones(1, 2, dtype=torch.bool),
    )
    return one.only(torch.tensor([False]))


def view(twist_cam: list[float], readout_s: float) -> CameraView:
    return CameraView(
        K=torch.tensor([[60.0, 0, 48], [0, 60, 32], [0, 0, 1]]),
        dist=torch.zeros(5),
        T_scene_cam=FORWARD,
        twist_cam=torch.tensor(twist_cam),
        t_s=0.5,
        readout_s=readout_s,
        size_hw=(64, 96),
        sensor=0,
    )


@torch.no_grad()
def centre_px(scene: GaussianScene, camera: CameraView, rows: slice) -> float:
    """Where along u the light of some rows lies."""
    alpha = scene.camera(scene.graph, camera).alpha[rows]
    return float((alpha.sum(0) * (torch.arange(96) + 0.5)).sum() / alpha.sum())


def test_a_pole_leans_when_the_camera_passes_it(nobody: ActorTracks) -> None:
    """To the right at 10 m/s, 40 ms from the first row to the last: at 6 m a row is off by 10·dt·60/6 px."""
    pole = torch.tensor([[6.0, 0.0, z / 20] for z in range(-60, 61)])
    camera = view([10.0, 0, 0, 0, 0, 0], readout_s=0.04)
    top, bottom = (centre_px(scene_of(pole, nobody), camera, rows) for rows in (slice(4, 12), slice(52, 60)))
    assert top - bottom == pytest.approx(10 * 0.04 * 48 / 64 * 60 / 6, abs=0.05)
    still = scene_of(pole, nobody, GaussianSceneConfig(rolling=False))
    assert centre_px(still, camera, slice(4, 12)) == pytest.approx(48.0, abs=0.05)


def test_turning_shows_as_well(nobody: ActorTracks) -> None:
    """About the camera's y axis, to its right, 1 rad/s: what is straight ahead goes left by 60 px/rad."""
    pole = torch.tensor([[6.0, 0.0, z / 20] for z in range(-60, 61)])
    camera = view([0.0, 0, 0, 0, 1.0, 0], readout_s=0.04)
    scene = scene_of(pole, nobody)
    lean = centre_px(scene, camera, slice(4, 12)) - centre_px(scene, camera, slice(52, 60))
    assert lean == pytest.approx(60 * 0.04 * 48 / 64, abs=0.05)


@torch.no_grad()
def test_exposing_later_is_being_further(nobody: ActorTracks) -> None:
    scene = scene_of(torch.tensor([[6.0, 0.3, 0.2], [9.0, -1, 0]]), nobody)
    camera = view([1.0, 0.5, 8.0, 0.1, 0.3, 0], readout_s=0.02)
    scene.camera_late_s[0] = 0.05
    late = scene.camera(scene.graph, camera).alpha
    scene.camera_late_s[0] = 0.0
    further = dataclasses.replace(camera, T_scene_cam=FORWARD @ exp_se3(0.05 * camera.twist_cam), t_s=0.55)
    assert torch.allclose(late, scene.camera(scene.graph, further).alpha, atol=1e-4)
    assert float((late - scene.camera(scene.graph, camera).alpha).abs().max()) > 0.1


def test_corrections_of_cameras_are_learned(nobody: ActorTracks) -> None:
    scene = scene_of(torch.tensor([[6.0, 0.3, 0.2]]), nobody)
    camera = view([1.0, 0, 8.0, 0, 0, 0], readout_s=0.04)
    scene.camera(scene.graph, camera).rgb[:, :, :48].sum().backward()
    for parameter in (scene.camera_offset, scene.camera_twist, scene.camera_late_s):
        assert parameter.grad is not None
        assert float(parameter.grad.abs().max()) > 0


@torch.no_grad()
def test_a_moving_lidar_measures_from_where_each_beam_left(nobody: ActorTracks) -> None:
    """At 8 m/s in a curve; the beams' origins and directions are those that the vehicle's motion gives."""
    targets = torch.tensor([[12.0, 0, 1], [0.0, 9, 2], [-15.0, 1, 0], [3.0, -8, 1.5]])
    dt_s = torch.tensor([0.0, -0.025, -0.05, -0.075])
    twist = torch.tensor([8.0, 0, 0, 0, 0, 0.4])
    T_scene_ego = exp_se3(torch.tensor([3.0, -1, 0.1, 0, 0, 0.7]))
    mounted = torch.tensor([[1.0, 0.2, 1.8]])
    origin = transform_points(exp_se3(dt_s[:, None] * twist), mounted[:, None].expand(4, 1, 3))[:, 0]
    along = targets - origin
    beams = LidarSweep(
        origin_ego=origin,
        dir_ego=along / along.norm(dim=-1, keepdim=True),
        range_m=along.norm(dim=-1),
        returned=torch.ones(4, dtype=torch.bool),
        intensity=torch.zeros(4),
        dt_s=dt_s,
        beam=torch.zeros(4, dtype=torch.int64),
        valid=torch.ones(4, dtype=torch.bool),
    )
    sweep = SweepView(beams, False, T_scene_ego, twist, t_s=0.5)
    scene = scene_of(transform_points(T_scene_ego, targets), nobody)
    points = scene.prepare_sweep(sweep)
    seen = scene.sweep(scene.graph, points, 0.5, hit_range_m=along.norm(dim=-1) - 0.5)
    assert float(seen.alpha.min()) > 0.5
    # splats move in straight lines: what they miss of the motion is of second order
    assert torch.allclose(seen.range_m, along.norm(dim=-1), atol=0.05)
    assert seen.alpha_before_hit is not None
    assert float(seen.alpha_before_hit.max()) < 1e-3
    one_moment = scene_of(transform_points(T_scene_ego, targets), nobody, GaussianSceneConfig(rolling=False))
    missed = one_moment.sweep(one_moment.graph, one_moment.prepare_sweep(sweep), 0.5)
    assert float(missed.alpha[[1, 3]].max()) < 0.2  # those abeam


def test_the_velocity_of_a_frame_is_used_for_that_frame_alone(nobody: ActorTracks) -> None:
    pole = torch.stack([torch.full((81,), 10.0), torch.zeros(81), torch.linspace(-4, 4, 81)], -1)
    scene = scene_of(pole, nobody, GaussianSceneConfig(frame_velocities=True))
    assert scene.frame_velocity is not None
    assert scene.frame_turn is not None
    with torch.no_grad():
        scene.frame_turn.zero_()
        scene.frame_velocity.copy_(torch.tensor([[0.0, 0, 0], [6.0, 0, 0]]))
        still, passing = view([0.0] * 6, 0.05), view([6.0, 0, 0, 0, 0, 0], 0.05)
        expected = scene.camera(scene.graph, passing).rgb
        torch.testing.assert_close(scene.camera(scene.graph, still, frame=1).rgb, expected)
        assert torch.equal(
            scene.camera(scene.graph, still, frame=0).rgb, scene.camera(scene.graph, still).rgb
        )
        assert not torch.equal(scene.camera(scene.graph, still).rgb, expected)


def test_a_background_after_the_decoder_fills_what_nothing_covers(nobody: ActorTracks) -> None:
    scene = scene_of(torch.tensor([[2.0, 0, 0]]), nobody, GaussianSceneConfig(background="after_decoder"))
    camera, red = view([0.0] * 6, 0.0), torch.tensor([1.0, 0.25, 0.0])
    with torch.no_grad():
        black, coloured = (
            scene.camera(scene.graph, camera, background_rgb=rgb) for rgb in (torch.zeros(3), red)
        )
        unseen = scene.camera(scene.graph, camera)
    assert float(black.alpha.max()) > 0.9
    torch.testing.assert_close(coloured.rgb - black.rgb, (1 - black.alpha) * red[:, None, None])
    torch.testing.assert_close(
        unseen.rgb - black.rgb, (1 - black.alpha) * torch.tensor(UNSEEN_RGB)[:, None, None]
    )


def test_what_is_nearer_than_the_near_plane_is_not_seen(nobody: ActorTracks) -> None:
    near, camera = torch.tensor([[0.4, 0.0, 0.0]]), view([0.0] * 6, 0.0)
    with torch.no_grad():
        for config, seen in ((GaussianSceneConfig(), True), (GaussianSceneConfig(camera_near_m=0.5), False)):
            scene = scene_of(near, nobody, config)
            assert bool(scene.camera(scene.graph, camera).alpha.max() > 0.5) is seen


def test_the_network_alone_may_decide_which_beams_return(nobody: ActorTracks) -> None:
    """Half of the light is stopped: half as many beams return, or as many."""
    feature, direction = torch.rand(4, 5), torch.tensor([[1.0, 0, 0]]).expand(4, 3)
    for from_alpha in (True, False):
        torch.manual_seed(0)
        decoder = LidarDecoder(2, from_alpha)
        full, half = (decoder(feature, torch.full((4,), alpha), direction)[1] for alpha in (1.0, 0.5))
        returns = (-half).sigmoid() / (-full).sigmoid()
        torch.testing.assert_close(returns, torch.full((4,), 0.5 if from_alpha else 1.0))


@pytest.mark.parametrize(("blocks", "count"), [("plain", 16_390), ("residual", 35_686)])
def test_parameters_of_a_camera_decoder(blocks: Literal["plain", "residual"], count: int) -> None:
    """3x3 of 24 to 32 channels: 6,944; of 32 to 32: 9,248; 1x1 to 6: 198; 1x1 shortcut of 24 to 32: 800."""
    decoder = CameraDecoder(13, 2, CameraDecoderConfig(32, blocks))
    assert sum(parameter.numel() for parameter in decoder.net.parameters()) == count
    assert decoder(torch.rand(6, 8, 16), torch.rand(6, 8, 3), 1).shape == (3, 6, 8)
