"""Pedals and steering for CARLA, and where a vehicle is by satellites and compass."""

import math
from typing import Any

import numpy as np
import pytest
from carla_stand_in import lat_lon

from foredrive.driving.dynamics import EGO, STEP_S
from foredrive.errors import InputError
from foredrive.integrations.carla.control import CommandedSpeed, actuate, steer_of, steering_rad_of
from foredrive.integrations.carla.leaderboard import PoseEstimate, fit_geo_frame, locate
from foredrive.scene import Control


def test_pedals_are_never_pressed_together() -> None:
    for wanted in (-9.0, -2.0, -0.2, 0.0, 1.0, 9.0):
        pedals, _ = actuate(Control(wanted, 0.0), 10.0, CommandedSpeed())
        assert pedals.throttle * pedals.brake == 0
        assert 0 <= pedals.throttle <= 1
        assert 0 <= pedals.brake <= 1
    # 1 m/s² at 10 m/s: 1 + .3 + .08 of the 4 m/s² of full throttle.
    assert actuate(Control(1.0, 0.0), 10.0, CommandedSpeed())[0].throttle == pytest.approx(1.38 / 4)
    assert actuate(Control(-2.0, 0.0), 10.0, CommandedSpeed())[0].brake == pytest.approx(1.62 / 8)
    assert actuate(Control(-1.0, 0.0), 0.0, CommandedSpeed())[0].brake == pytest.approx(1.0 / 8)  # holds


@pytest.mark.parametrize(("strength", "drag_mps2"), [(1.0, 0.0), (0.6, 0.5), (1.4, 0.0)])
def test_the_speed_asked_for_comes_about_with_any_engine(strength: float, drag_mps2: float) -> None:
    speed, commanded = 0.0, CommandedSpeed()
    for _ in range(80):
        pedals, commanded = actuate(Control(1.5, 0.0), speed, commanded)
        force = strength * (4.0 * pedals.throttle - 8.0 * pedals.brake)
        speed = max(0.0, speed + (force - (drag_mps2 if speed > 0 else 0.0)) * STEP_S)
    assert speed == pytest.approx(6.0, abs=0.8)  # while it accelerates; then it catches up
    for _ in range(40):
        pedals, commanded = actuate(Control(0.0, 0.0), speed, commanded)
        speed += (strength * (4.0 * pedals.throttle - 8.0 * pedals.brake) - drag_mps2) * STEP_S
    assert speed == pytest.approx(6.0, abs=0.4)


def test_who_waits_with_the_brake_on_does_not_start_with_a_jerk() -> None:
    commanded = CommandedSpeed()
    for _ in range(100):
        _, commanded = actuate(Control(-1.0, 0.0), 0.0, commanded)
    assert actuate(Control(1.0, 0.0), 0.0, commanded)[0].throttle == pytest.approx(0.25)


def test_steering_is_mirrored_and_gives_the_curvature() -> None:
    left = 0.2
    steer = steer_of(left)
    assert steer == pytest.approx(-math.tan(0.2) / EGO.wheelbase_m / 0.278)
    assert steering_rad_of(steer) == pytest.approx(left)
    assert steer_of(-left) == -steer
    assert -1.0 <= steer_of(9.9) < 0.0


@pytest.mark.parametrize("origin", [(0.0, 0.0), (42.0, 2.0), (48.99, 8.0)])
def test_satellites_are_read_by_the_route_alone(origin: tuple[float, float]) -> None:
    route = np.array([[0.0, 0.0], [80.0, 0.0], [80.0, -150.0]])
    frame = fit_geo_frame(np.array([lat_lon(x, y, *origin) for x, y in route]), route)
    near = np.array([-245.0, 330.0])
    assert frame.xy(*lat_lon(-250.0, 321.0, *origin), near) == pytest.approx((-250.0, 321.0), abs=0.01)
    straight = route[:2]
    frame = fit_geo_frame(np.array([lat_lon(x, y, *origin) for x, y in straight]), straight)
    assert frame.xy(*lat_lon(-250.0, 321.0, *origin), near) == pytest.approx((-250.0, 321.0), abs=0.05)
    with pytest.raises(InputError, match="coincide"):
        fit_geo_frame(np.zeros((2, 2)), np.zeros((2, 2)))


def test_carlas_satellites_are_read_although_its_north_is_the_routes_south(carla: Any, town02: Any) -> None:
    """The route as the leaderboard writes it, the satellites as CARLA 0.9.16 projects."""
    route = np.array([[0.0, 0.0], [80.0, 0.0], [80.0, -150.0]])
    frame = fit_geo_frame(np.array([lat_lon(x, y, 0.0, 0.0) for x, y in route]), route)
    for x, y in ((-120.0, 90.0), (60.0, -150.0), (150.0, 3.0)):
        place = town02.transform_to_geolocation(carla.Location(x, -y, 0.0))
        found = frame.xy(place.latitude, place.longitude, np.array([x + 2.0, y - 2.0]))
        assert found == pytest.approx((x, y), abs=0.1)


@pytest.mark.parametrize(
    ("xy", "lat_deg", "lon_deg"),
    [
        ((0.0, 0.0), 41.09374957104911, -81.59374804575259),
        ((-4200.5, -3100.25), 41.121599878893356, -81.643858300507),
        ((5000.0, 2500.0), 41.071267347319086, -81.5341457691484),
    ],
)
def test_satellites_far_from_the_origin_of_town13(
    xy: tuple[float, float], lat_deg: float, lon_deg: float
) -> None:
    """Places and what `carla.Map.transform_to_geolocation` of 0.9.16 gives for them, y turned round."""
    origin = (41.09374957104912, -81.59374804575259)
    route = np.array([xy, [xy[0] + 80.0, xy[1]], [xy[0] + 80.0, xy[1] - 150.0]])
    frame = fit_geo_frame(np.array([lat_lon(x, y, *origin) for x, y in route]), route)
    assert frame.xy(lat_deg, lon_deg, np.array(xy) + 3.0) == pytest.approx(xy, abs=0.01)


def test_whereabouts_are_steadier_than_satellites() -> None:
    """Half a minute along a circle of 50 m at 8 m/s, with satellites half a metre off."""
    rng = np.random.default_rng(3)
    found: PoseEstimate | None = None
    errors, jumps = [], []
    for k in range(600):
        turned = 8.0 / 50.0 * k * STEP_S
        truth = 50.0 * np.array([math.sin(turned), 1 - math.cos(turned)])
        before = found
        compass = turned if k != 300 else math.nan  # as CARLA's is at times
        found = locate(found, truth + rng.normal(0.0, 0.56, 2), compass, 8.0, k * STEP_S)
        errors.append(float(np.hypot(found.x_m - truth[0], found.y_m - truth[1])))
        if before is not None and k > 100:
            way = math.hypot(found.x_m - before.x_m, found.y_m - before.y_m)
            jumps.append(abs(way - 8.0 * STEP_S))
    assert max(errors[100:]) < 0.35
    assert max(jumps) < 0.05
    assert found is not None
    assert found.T_world_ego[:2, 0] == pytest.approx([math.cos(turned), math.sin(turned)], abs=1e-6)
