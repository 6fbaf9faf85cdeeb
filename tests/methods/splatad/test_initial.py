"""A scene before learning, from a log whose geometry is known."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
from scipy.spatial.transform import Rotation

from foredrive.data import find_logs
from foredrive.data.drives import read_drive
from foredrive.errors import InputError
from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.seed_points import UNSEEN_RAD, SeedPoints, colour_from_neighbours
from foredrive.methods.reconstruction.tracks import read_tracks, states_at
from foredrive.methods.reconstruction.views import camera_views, sweep_views
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.initial import InitialGaussians, initial_scene
from foredrive.scene import Clip

SIZE = InitialGaussians(
    lidar_points=4000, unseen_points=20_000, pixel_points=200, near_points=100, actor_points=60, features=2
)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    (log,) = find_logs(world.write(tmp_path_factory.mktemp("initial"), frames=11))
    return read_drive(log, (48, 96))


@pytest.fixture(scope="module")
def graph(drive: Clip) -> SceneGraph:
    origin = drive.T_world_ego[0]
    return initial_scene(
        [view for views in camera_views(drive, origin) for view in views],
        sweep_views(drive, origin),
        read_tracks(drive, origin),
        SIZE,
        torch.Generator().manual_seed(0),
    )


def test_a_drive_has_every_frame(drive: Clip) -> None:
    assert len(drive.t_s) == 11
    assert drive.now == 0
    assert bool(drive.misses_known.all())
    assert drive.images.shape == (11, 2, 3, 48, 96)
    assert drive.rig.exposed_dt_s is not None
    assert float(drive.rig.exposed_dt_s.abs().max()) < 1e-5


def test_a_view_is_at_the_time_of_its_exposure(drive: Clip) -> None:
    late_s = torch.tensor([[0.02, -0.03]]).expand(11, 2)
    rig = dataclasses.replace(drive.rig, exposed_dt_s=late_s)
    views = camera_views(dataclasses.replace(drive, rig=rig), drive.T_world_ego[0])
    for camera, shift_s in enumerate((0.02, -0.03)):
        times = torch.tensor([view.t_s for view in views[camera]])
        torch.testing.assert_close(times, drive.t_s + shift_s)


def test_a_camera_the_log_lacks_is_told(drive: Clip, tmp_path: Path) -> None:
    (log,) = find_logs(world.write(tmp_path, frames=2))
    with pytest.raises(
        InputError, match=r"no camera 'behind'; there are: ahead \(pcam_f0\), left \(pcam_l\d\)"
    ):
        read_drive(log, (48, 96), ("behind",))


def test_cameras_are_found_by_both_names_in_any_case(tmp_path: Path) -> None:
    (log,) = find_logs(world.write(tmp_path, frames=2))
    right = read_drive(log, (48, 96), ("ahead",), frames=[0]).rig.T_ego_cam
    for name in ("AHEAD", "PCAM_F0", "pcam_f0"):
        torch.testing.assert_close(read_drive(log, (48, 96), (name,), frames=[0]).rig.T_ego_cam, right)


def test_chosen_frames_are_read_with_the_first_of_them_as_now(drive: Clip, tmp_path: Path) -> None:
    (log,) = find_logs(world.write(tmp_path, frames=11))
    part = read_drive(log, (48, 96), frames=[3, 7], derived=False)
    assert part.now == 0
    torch.testing.assert_close(part.t_s, drive.t_s[[3, 7]] - drive.t_s[3])
    torch.testing.assert_close(part.T_world_ego, drive.T_world_ego[[3, 7]])


def test_tracks_are_where_the_boxes_are(drive: Clip) -> None:
    tracks = read_tracks(drive.frames([0, 2, 4, 6, 8, 10]), drive.T_world_ego[0])
    states = states_at(tracks, 0.5)  # between frames that were read
    moving = tracks.index_of(11)
    expected = torch.tensor(world.MOVING["centre"]).float() + torch.tensor([1.5, 0, 0])
    assert torch.allclose(states.T_scene_actor[moving, :3, 3], expected, atol=1e-4)
    assert states.velocity_mps[moving].tolist() == pytest.approx([3, 0, 0], abs=1e-3)


def test_the_static_part_has_no_actors_in_it(graph: SceneGraph) -> None:
    own = graph.content.preview(STATIC)
    lidar = own.mean_m[: SIZE.lidar_points]
    assert float(lidar[:, 2].abs().max()) < 0.02  # all of it is ground
    seen = own.feature[: SIZE.lidar_points, :3]
    grey = torch.tensor(world.GROUND_RGB) / 255
    # at the rims of boxes a pixel shows another thing than the beam met; what no camera saw is like the rest
    assert float(((seen - grey).abs().amax(-1) < 0.02).float().mean()) > 0.95


def unseen(own: Gaussians) -> torch.Tensor:
    """Those where no camera looks."""
    return own.log_scale[:, 0] != own.log_scale[:, 2]  # the others are round


def test_what_no_camera_saw_lies_flat_and_evenly(graph: SceneGraph, drive: Clip) -> None:
    own = graph.content.preview(STATIC)
    patches = own[unseen(own)]
    assert 1000 < len(patches.opacity_logit) < SIZE.unseen_points
    way_m = float(torch.linalg.inv(drive.T_world_ego[0])[0] @ drive.T_world_ego[-1, :, 3])  # straight on
    x_m, y_m = patches.mean_m[:, 0], patches.mean_m[:, 1]
    range_m = (x_m - x_m.clamp(0, way_m)).hypot(y_m)  # from which it was met at closest
    for near_m, far_m, side_m in ((0, 8, 0.125), (9, 16, 0.25), (18, 32, 0.5)):
        there = patches.mean_m[(range_m > near_m) & (range_m < far_m)]
        cubes = (there / side_m).floor()
        assert len(there) > 50
        assert len(cubes.unique(dim=0)) == len(cubes)
    # all of it is ground: thin along the vertical, as wide as they are apart across it
    thinnest = patches.log_scale.argmin(-1)
    R = Rotation.from_quat(patches.quaternion.numpy(), scalar_first=True).as_matrix()
    assert np.median(np.abs(R[np.arange(len(R)), 2, thinnest])) > 0.99
    widths_m = patches.log_scale.exp().sort(-1).values
    assert float(widths_m[:, 0].median()) < 0.05
    assert 0.02 < float((widths_m[:, 2] / range_m).median()) < 2 * UNSEEN_RAD


def test_what_no_camera_saw_is_coloured_like_what_is_near() -> None:
    points = SeedPoints(
        xyz_m=torch.tensor([[0.0, 0, 0], [10.0, 0, 0], [10.0, 1, 0], [1.0, 0, 0], [10.0, 0.5, 0]]),
        rgb=torch.tensor([[0.2], [0.6], [0.8], [0.5], [0.5]]).expand(5, 3),
        seen=torch.tensor([True, True, True, False, False]),
        scale_m=torch.ones(5),
    )
    # three points have colours, so that each is a neighbour of all
    assert colour_from_neighbours(points).rgb[:, 0].tolist() == pytest.approx([0.2, 0.6, 0.8, 0.6, 0.6])
    assert colour_from_neighbours(points[2:]).rgb[:, 0].tolist() == pytest.approx([0.8, 0.8, 0.8])
    assert torch.equal(colour_from_neighbours(points[3:]).rgb, points[3:].rgb)


@pytest.mark.parametrize(
    ("track_id", "box", "rgb"), [(7, world.PARKED, world.PARKED_RGB), (11, world.MOVING, world.MOVING_RGB)]
)
def test_actors_have_their_own_points(graph: SceneGraph, track_id: int, box: dict, rgb: tuple) -> None:
    own = graph.content.preview(graph.tracks.index_of(track_id))
    assert len(own.opacity_logit) >= SIZE.actor_points
    half_m = torch.tensor(box["size"]).float() / 2
    assert bool((own.mean_m.abs() <= half_m + 0.15).all())
    # lidar meets surfaces: most points lie on one of the sides
    on_side = ((own.mean_m.abs() - half_m).abs().amin(-1) < 0.05).float().mean()
    assert float(on_side) > 0.7
    coloured = (own.feature[:, :3] - 0.5).abs().amax(-1) > 0.05
    near = (own.feature[coloured, :3] - torch.tensor(rgb) / 255).abs().amax(-1) < 0.1
    assert float(near.float().mean()) > 0.6


def test_pixels_are_as_far_as_the_beams_beside_them(graph: SceneGraph) -> None:
    """Those of the ground lie on the ground, those of the sky far away; those of actors are left out."""
    own = graph.content.preview(STATIC)
    along = own[~unseen(own)][slice(SIZE.lidar_points, -SIZE.near_points)]
    assert 0.5 * SIZE.pixel_points < len(along.opacity_logit) < SIZE.pixel_points
    rgb = along.feature[:, :3] * 255
    sky = (rgb - torch.tensor(world.SKY_RGB)).abs().amax(-1) < 4
    ground = (rgb - torch.tensor(world.GROUND_RGB)).abs().amax(-1) < 4
    assert bool((along.mean_m[sky, 2] > 0).all())
    assert float((along.mean_m[sky].norm(dim=-1) > 50).float().mean()) > 0.9
    assert float((along.mean_m[ground, 2].abs() < 0.3).float().mean()) > 0.8
    assert int(sky.sum()) > 20
    assert int(ground.sum()) > 20


def test_the_same_seed_gives_the_same_scene(drive: Clip, graph: SceneGraph) -> None:
    origin = drive.T_world_ego[0]
    again = initial_scene(
        [view for views in camera_views(drive, origin) for view in views],
        sweep_views(drive, origin),
        read_tracks(drive, origin),
        SIZE,
        torch.Generator().manual_seed(0),
    )
    assert torch.equal(again.content.preview(STATIC).mean_m, graph.content.preview(STATIC).mean_m)
