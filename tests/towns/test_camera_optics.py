"""Rolling shutter, motion blur and sensor noise of the towns' cameras."""

import dataclasses
import math

import numpy as np
import pytest
from scenes import ACTOR_ID, STILL, actor_at, ego_pose

from foredrive.scene.actors import ActorState
from foredrive.sensors import CameraOptics
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.world import World

SIZE = (48, 80)
FOCAL_PX = 40.0 / math.tan(math.radians(35.0))
DEPTH_M = 8.0
"""Of the post's front from the front camera."""


def post(T_world_ego: np.ndarray, left_mps: float = 0.0, width_m: float = 0.4) -> ActorState:
    """A post straight ahead of the front camera, higher than its image."""
    return actor_at(
        T_world_ego,
        (1.7 + DEPTH_M + 0.1, 0.0, 1.6),
        size_lwh=np.array([0.2, width_m, 12.0]),
        velocity_mps=T_world_ego[:3, :3] @ [0.0, left_mps, 0.0],
    )


def suite(readout_s: float = 0.0, samples: int = 4, **optics: float) -> SensorSuite:
    return SensorSuite(camera_rig(SIZE, readout_s), roof_lidar(2, 4), samples, CameraOptics(**optics))


READOUT_S = 0.1


@pytest.mark.parametrize(
    ("left_mps", "twist", "shift_px_per_s"),
    [
        (20.0, (0, 0, 0, 0, 0, 0), -FOCAL_PX * 20.0 / DEPTH_M),
        (0.0, (0, 20.0, 0, 0, 0, 0), FOCAL_PX * 20.0 / DEPTH_M),
        (0.0, (0, 0, 0, 0, 0, 1.2), FOCAL_PX * 1.2 * (1.0 + 1.7 / DEPTH_M)),
    ],
)
def test_a_post_slants_as_far_as_it_moves_while_rows_are_read(
    world02: World, town02: TownMap, left_mps: float, twist: tuple[float, ...], shift_px_per_s: float
) -> None:
    """Moving left it shifts left in rows that are read later; so it does when the vehicle turns right."""
    T = ego_pose(town02)
    frame = world02.render([post(T, left_mps)], suite(READOUT_S), T, np.array(twist, float), noise_seed=0)
    rows, columns = np.nonzero(frame.pixel_ids["PCAM_F0"] == ACTOR_ID)
    above_ground = np.arange(34)
    middle = np.array([columns[rows == v].mean() + 0.5 for v in above_ground])
    dt_s = ((above_ground + 0.5) / SIZE[0] - 0.5) * READOUT_S
    np.testing.assert_allclose(middle, SIZE[1] / 2 + shift_px_per_s * dt_s, atol=0.75)
    assert abs(middle[-1] - middle[0]) > 5.0


def test_nothing_that_stands_still_is_changed(world02: World, town02: TownMap) -> None:
    """At the defaults motion is not seen at all; with a rolling shutter rest is as with a global one."""
    T = ego_pose(town02)
    clean = world02.render([post(T)], suite(), T, STILL, noise_seed=0)
    fast = np.array([15.0, 0, 0, 0, 0, 0.3])
    moving = world02.render([post(T, 8.0)], suite(), T, fast, noise_seed=1)
    rolling = world02.render([post(T)], suite(READOUT_S), T, STILL, noise_seed=2)
    for name, image in clean.images.items():
        assert image.tobytes() == moving.images[name].tobytes() == rolling.images[name].tobytes()
        assert clean.pixel_ids[name].tobytes() == moving.pixel_ids[name].tobytes()


def test_a_shutter_smears_what_moves(world02: World, town02: TownMap) -> None:
    T = ego_pose(town02)
    speed_mps, shutter_s = 12.0, 0.1
    sensors = suite(samples=1, shutter_s=shutter_s, sub_exposures=32)
    with_post, without, at_rest = (
        world02.render(actors, sensors, T, STILL, noise_seed=0).images["PCAM_F0"].astype(int)
        for actors in ([post(T, speed_mps)], [], [post(T)])
    )
    width_px, smear_px = FOCAL_PX * 0.4 / DEPTH_M, FOCAL_PX * speed_mps * shutter_s / DEPTH_M
    change = np.abs(with_post - without).max(-1)[:16]  # against the sky
    touched = (change > 2).sum(1).mean()
    assert touched == pytest.approx(smear_px + width_px, abs=1.5)
    still = np.abs(at_rest - without).max(-1)[:16]
    assert (still > 2).sum(1).mean() == pytest.approx(width_px, abs=1.0)
    assert change.max() < 0.7 * still.max()  # each spot is covered for a part of the time alone


def test_noise_is_that_of_its_seed(world02: World, town02: TownMap) -> None:
    T = ego_pose(town02)
    noisy = suite(white_electrons=2000.0, read_noise_electrons=4.0)
    clean, a, b, c = (
        world02.render([], s, T, STILL, noise_seed=seed).images["PCAM_F0"]
        for s, seed in ((suite(), 0), (noisy, 3), (noisy, 3), (noisy, 4))
    )
    assert a.tobytes() == b.tobytes() != c.tobytes()
    assert 1.0 < (a.astype(float) - c).std() / math.sqrt(2) < 12.0
    assert abs(a.mean() - clean.mean()) < 1.0


def test_a_stop_more_is_brighter(world02: World, town02: TownMap) -> None:
    T = ego_pose(town02)
    means = [
        world02.render([], suite(exposure_ev=ev), T, STILL, 0).images["PCAM_F0"].mean()
        for ev in (-1.0, 0.0, 1.0)
    ]
    assert means[0] < means[1] - 15 < means[2] - 30


def test_a_road_user_moves_during_a_sweep(world02: World, town02: TownMap) -> None:
    """Straight ahead is seen half a period before the sweep ends."""
    T = ego_pose(town02)
    lidar = dataclasses.replace(roof_lidar(1, 720), elevation_rad=(0.0,), range_noise_m=0.0)
    ahead = dataclasses.replace(
        post(T, width_m=3.0), velocity_mps=T[:3, :3] @ [15.0, 0.0, 0.0], size_lwh=np.array([0.2, 3.0, 3.0])
    )
    frame = world02.render([ahead], SensorSuite(camera_rig((2, 2)), lidar), T, STILL, noise_seed=0)
    beam = 360
    assert frame.beam_ids[beam] == ACTOR_ID
    expected = 1.7 + DEPTH_M - 0.94 + 15.0 * float(frame.sweep.dt_s[beam])
    assert float(frame.sweep.dt_s[beam]) == pytest.approx(-0.05, abs=2e-4)
    assert float(frame.sweep.range_m[beam]) == pytest.approx(expected, abs=0.01)
