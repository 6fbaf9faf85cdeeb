"""What sensors see of a town."""

import dataclasses

import numpy as np
import pytest
import shapely
import torch
from scenes import ACTOR_ID, STILL, actor_at, ego_pose

from foredrive.errors import InputError
from foredrive.geometry.boxes import box_corners
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.scene import Category, VoxelSpec
from foredrive.scene.conditions import find_conditions
from foredrive.scene.traffic_light import LightState
from foredrive.sensors import SpinningLidar
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.place.materials import Surface
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.sensing.patterns import band, bands
from foredrive.towns.world import NO_ACTOR, World

SIZE = (48, 80)


@pytest.fixture(scope="module")
def sensors() -> SensorSuite:
    lidar = dataclasses.replace(roof_lidar(16, 180), range_noise_m=0.0)
    return SensorSuite(camera_rig(SIZE), lidar)


def test_a_beam_meets_a_box_where_it_should(world02: World, town02: TownMap) -> None:
    T = ego_pose(town02)
    T_ego_lidar = torch.eye(4)
    T_ego_lidar[:3, 3] = torch.tensor([1.0, 0.0, 0.8])
    level = SpinningLidar((0.0,), 3600, 10.0, 0.5, 60.0, 0.0, T_ego_lidar)
    frame = world02.render(
        [actor_at(T, (12.0, 0.0, 0.8))], SensorSuite(camera_rig((2, 2)), level), T, STILL, noise_seed=0
    )
    azimuth = torch.atan2(frame.sweep.dir_ego[:, 1], frame.sweep.dir_ego[:, 0])
    ahead = azimuth.abs() < 0.09  # within the rear face, 9 m ahead of the lidar
    assert (frame.beam_ids[ahead.numpy()] == ACTOR_ID).all()
    torch.testing.assert_close(frame.sweep.range_m[ahead], 9.0 / azimuth[ahead].cos(), atol=1e-3, rtol=0)
    beside = (azimuth.abs() > 0.12) & (azimuth.abs() < 0.5)
    assert not (frame.beam_ids[beside.numpy()] == ACTOR_ID).any()


def test_a_moving_vehicle_measures_points_where_they_are(world02: World, town02: TownMap) -> None:
    T = ego_pose(town02)
    sensors = SensorSuite(camera_rig((2, 2)), dataclasses.replace(roof_lidar(16, 360), range_noise_m=0.0))
    box = actor_at(T, (12.0, 0.0, 0.8))
    twist = np.array([15.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    frame = world02.render([box], sensors, T, twist, noise_seed=0)
    on_box = torch.from_numpy(frame.beam_ids == ACTOR_ID) & frame.sweep.returned
    points = frame.sweep.points_ego[on_box]
    assert len(points) > 20
    low, high = torch.tensor([10.0, -1.0, 0.0]), torch.tensor([14.0, 1.0, 1.6])
    assert ((points > low - 1e-2) & (points < high + 1e-2)).all()
    assert frame.sweep.origin_ego[:, 0].min() < 0.94 - 1.4  # 1.5 m further back when the sweep began


def test_pixels_of_an_actor_lie_where_its_box_projects(
    world02: World, town02: TownMap, sensors: SensorSuite
) -> None:
    T = ego_pose(town02)
    frame = world02.render([actor_at(T, (9.0, -1.5, 0.8))], sensors, T, STILL, noise_seed=0)
    rig = sensors.rig
    corners = box_corners(torch.tensor([9.0, -1.5, 0.8]), torch.tensor([4.0, 2.0, 1.6]), torch.tensor(0.0))
    uv, _, _ = project(transform_points(inverse_se3(rig.T_ego_cam[0]), corners), rig.K[0], rig.dist[0], SIZE)
    hull = shapely.MultiPoint(uv.numpy()).convex_hull
    rows, columns = np.nonzero(frame.pixel_ids["PCAM_F0"] == ACTOR_ID)
    inside = shapely.contains_xy(hull.buffer(1e-3), columns + 0.5, rows + 0.5)
    assert inside.all()
    visible = hull.intersection(shapely.box(0, 0, SIZE[1], SIZE[0])).area
    assert len(rows) == pytest.approx(visible, rel=0.1)
    assert not (frame.pixel_ids["PCAM_B0"] == ACTOR_ID).any()


def test_misses_are_kept_with_the_range_that_is_free(
    world02: World, town02: TownMap, sensors: SensorSuite
) -> None:
    sweep = world02.render([], sensors, ego_pose(town02), STILL, noise_seed=0).sweep
    assert len(sweep.range_m) == 16 * 180
    up = (sweep.dir_ego[:, 2] > 0.15) & ~sweep.returned
    assert up.any()
    assert sweep.range_m[up].max() == pytest.approx(100.0)
    assert (sweep.intensity[~sweep.returned] == 0).all()
    assert ((sweep.intensity[sweep.returned] > 0) & (sweep.intensity[sweep.returned] <= 1)).all()
    down = sweep.dir_ego[:, 2] < -0.3
    height = sweep.points_ego[down & sweep.returned][:, 2]
    assert height.min() > -0.2  # nothing below the road


def test_the_same_input_gives_the_same_bytes(world02: World, town02: TownMap, sensors: SensorSuite) -> None:
    T = ego_pose(town02)
    noisy = dataclasses.replace(sensors, lidar=roof_lidar(16, 180))
    a, b, c = (world02.render([actor_at(T, (9, 0, 0.8))], noisy, T, STILL, noise_seed=s) for s in (1, 1, 2))
    for name, image in a.images.items():
        assert image.tobytes() == b.images[name].tobytes() == c.images[name].tobytes()
    assert torch.equal(a.sweep.range_m, b.sweep.range_m)
    assert not torch.equal(a.sweep.range_m, c.sweep.range_m)


def test_actors_cast_shadows(world02: World, town02: TownMap, sensors: SensorSuite) -> None:
    T = ego_pose(town02)
    roof = actor_at(T, (0.0, 0.0, 60.0), size_lwh=np.array([150.0, 150.0, 0.5]))
    bright = world02.render([], sensors, T, STILL, noise_seed=0).images["PCAM_F0"]
    dark = world02.render([roof], sensors, T, STILL, noise_seed=0).images["PCAM_F0"]
    assert dark[-10:].mean() < 0.75 * bright[-10:].mean()


def test_lights_show_their_colour(world02: World, town02: TownMap) -> None:
    head = world02.static.heads[0]
    zone = town02.stop_zones[head.zone]
    T = np.eye(4)
    T[:2, :2] = [
        [np.cos(zone.post_yaw), -np.sin(zone.post_yaw)],
        [np.sin(zone.post_yaw), np.cos(zone.post_yaw)],
    ]
    T[:3, 3] = zone.post_xyz - T[:3, 0] * 5.5
    sensors = SensorSuite(camera_rig((120, 200)), roof_lidar(2, 4))
    seen = {}
    for light in (LightState.RED, LightState.GREEN):
        lights = np.full(len(town02.stop_zones), int(light))
        seen[light] = world02.render([], sensors, T, STILL, 0, lights).images["PCAM_F0"].astype(int)
    change = seen[LightState.RED] - seen[LightState.GREEN]
    assert change[..., 0].max() > 100  # the red lamp
    assert change[..., 1].min() < -100  # the green one


def test_more_samples_smooth_outlines_only(world02: World, town02: TownMap, sensors: SensorSuite) -> None:
    T = ego_pose(town02)
    images = []
    for samples in (1, 4):
        suite = dataclasses.replace(sensors, samples_per_outline_pixel=samples)
        images.append(world02.render([], suite, T, STILL, 0).images["PCAM_F0"].astype(float))
    change = np.abs(images[0] - images[1]).max(-1)
    assert 0.02 < (change > 0).mean() < 0.5
    assert change.max() > 30


def test_occupancy_holds_a_known_box(world02: World, town02: TownMap) -> None:
    T = ego_pose(town02)
    spec = VoxelSpec((-12.8, -12.8, -1.3), 0.4, (12, 64, 64))
    velocity = T[:3, :3] @ [3.0, 1.0, 0.0]
    box = actor_at(T, (7.0, 2.0, 0.8), velocity_mps=velocity)
    full = world02.occupancy([box], T, spec)
    centres = np.array(spec.lower_m) + (full.index_zyx[:, ::-1] + 0.5) * spec.voxel_m
    mine = full.category == Category.BARRIER
    outside = np.abs(centres[mine] - [7.0, 2.0, 0.8]) - 0.5 * box.size_lwh
    assert outside.max() < 0.5 * spec.voxel_m + 1e-6  # each of its voxels touches the box
    inside = (np.abs(spec.centres_m().numpy() - [7.0, 2.0, 0.8]) < 0.5 * box.size_lwh - 0.05).all(-1)
    filled = np.zeros(spec.shape_zyx, dtype=bool)
    filled[tuple(full.index_zyx[mine].T)] = True
    assert filled[inside].all()
    np.testing.assert_allclose(full.velocity_mps[mine], np.tile([3.0, 1.0, 0.0], (mine.sum(), 1)), atol=1e-5)
    assert not full.velocity_mps[~mine].any()


def test_occupancy_has_the_road_as_one_layer(world02: World, town02: TownMap) -> None:
    T = ego_pose(town02)
    spec = VoxelSpec((-4.0, -1.2, -1.3), 0.4, (12, 6, 20))  # within the lane
    full = world02.occupancy([], T, spec)
    assert set(full.category.tolist()) == {-1 - Surface.ROAD}
    assert set(full.index_zyx[:, 0].tolist()) == {3}  # z from -0.1 to 0.3
    assert len(full.index_zyx) == 6 * 20


def test_lidar_returns_lie_in_occupied_voxels(world02: World, town02: TownMap) -> None:
    T = ego_pose(town02)
    spec = VoxelSpec((-38.4, -38.4, -2.2), 0.4, (24, 192, 192))
    sensors = SensorSuite(camera_rig((2, 2)), dataclasses.replace(roof_lidar(32, 180), range_noise_m=0.0))
    sweep = world02.render([], sensors, T, STILL, 0).sweep
    filled = np.zeros(spec.shape_zyx, dtype=bool)
    filled[tuple(world02.occupancy([], T, spec).index_zyx.T)] = True
    points = sweep.points_ego[sweep.returned].numpy()
    index = np.floor((points - spec.lower_m) / spec.voxel_m).astype(int)
    within = ((index >= 0) & (index < spec.shape_zyx[::-1])).all(1)
    assert within.sum() > 1000
    assert filled[tuple(index[within, ::-1].T)].mean() > 0.97


def test_a_part_of_the_grid_holds_what_the_whole_holds_there(world02: World, town02: TownMap) -> None:
    """However the vehicle stands: what is out of the part's reach is left out, and nothing else."""
    T, turn, nose = ego_pose(town02), 0.6, 0.08
    T[:3, :3] = T[:3, :3] @ [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    T[:3, :3] = T[:3, :3] @ [[np.cos(nose), 0, np.sin(nose)], [0, 1, 0], [-np.sin(nose), 0, np.cos(nose)]]
    whole = VoxelSpec((-48.0, -48.0, -3.0), 0.5, (16, 192, 192))
    part = VoxelSpec((20.0, 4.0, -1.0), 0.5, (10, 30, 50))
    car = actor_at(T, (30.0, 10.0, 0.8))
    filled = []
    for spec in (whole, part):
        grid = np.full(spec.shape_zyx, np.inf)
        full = world02.occupancy([car], T, spec)
        grid[tuple(full.index_zyx.T)] = full.category
        filled.append(grid)
    np.testing.assert_array_equal(filled[1], filled[0][4:14, 104:134, 136:186])
    assert np.isfinite(filled[1]).sum() > 500
    assert (filled[1] == Category.BARRIER).any()


def test_voxels_too_fine_for_the_town_are_refused(world02: World, town02: TownMap) -> None:
    with pytest.raises(InputError, match=r"at least 0\.35 m, got 0\.2"):
        world02.occupancy([], ego_pose(town02), VoxelSpec((0.0, 0.0, 0.0), 0.2, (2, 2, 2)))


def test_parked_cars_are_told_apart(world02: World, town02: TownMap, sensors: SensorSuite) -> None:
    car = world02.parked[0]
    T = np.eye(4)
    T[:3, 3] = car.centre_m - [12.0, 0.0, 0.7]
    frame = world02.render([car], sensors, T, STILL, noise_seed=0)
    seen = set(np.unique(frame.pixel_ids["PCAM_F0"]).tolist())
    assert car.track_id in seen
    assert NO_ACTOR in seen


def test_filtered_bands_keep_their_share() -> None:
    assert band(0.5, 0.0, 1.0, 1e-6) == pytest.approx(1.0)
    assert band(0.0, 0.0, 1.0, 0.5) == pytest.approx(0.5, abs=1e-3)
    assert bands(3.2, 1.0, 0.25, 1e-6) == pytest.approx(1.0)
    assert bands(3.5, 1.0, 0.25, 1e-6) == pytest.approx(0.0)
    assert bands(7.77, 1.0, 0.25, 40.0) == pytest.approx(0.25, abs=0.01)


def test_brake_lights_shine_by_day_and_by_night(world02: World, town02: TownMap) -> None:
    T = ego_pose(town02)
    sensors = SensorSuite(camera_rig((108, 192)), roof_lidar(channels=4, azimuth_steps=60))
    for town in (world02, world02.under(find_conditions("night"))):
        car = actor_at(T, (11.0, 0.0, 0.8), category=Category.CAR, size_lwh=np.array([4.5, 1.9, 1.5]))
        rolls, brakes = (
            town.render([dataclasses.replace(car, braking=b)], sensors, T, STILL, noise_seed=0)
            for b in (False, True)
        )
        change = brakes.images["PCAM_F0"].astype(int) - rolls.images["PCAM_F0"]
        changed = np.argwhere(change[..., 0] > 30)
        assert len(changed) >= 4
        assert np.ptp(changed[:, 1]) > 5 * np.ptp(changed[:, 0])  # one to the left, one to the right
        assert (change[..., 0] >= change[..., 1]).mean() > 0.99
        assert (rolls.pixel_ids["PCAM_F0"] == brakes.pixel_ids["PCAM_F0"]).all()
