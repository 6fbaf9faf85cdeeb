"""A drive through the interface of CARLA's leaderboards in a town."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.leaderboard_door import LeaderboardDoor, control_of, lat_lon_of, sparse_plans
from foredrive.driving.route_sets import load_route_set
from foredrive.integrations.carla.control import CommandedSpeed, actuate
from foredrive.integrations.carla.leaderboard import GlobalPlan, fit_geo_frame
from foredrive.runs.drive.agents import IDM
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.scene import Control
from foredrive.towns.driving.routes import snap_route


@pytest.mark.slow
def test_who_knows_the_road_completes_a_route_by_satellites_and_pedals(tmp_path: Path) -> None:
    source = LeaderboardDoor("town05-short", only=("13",), vehicles=0, people=0, scenarios=False)
    (drive,) = drive_suite(DriveSuite(IDM, source, sensors=False), tmp_path).drives.values()
    assert drive.score.completion == 1.0
    assert drive.driving_score_1_0 == pytest.approx(100.0)


@pytest.mark.parametrize("speed_mps", [0.0, 6.0])
def test_pedals_give_the_acceleration_that_they_stand_for(speed_mps: float) -> None:
    for acceleration in (1.0, -2.0) if speed_mps else (1.0,):
        wanted = Control(acceleration, 0.1)
        got = control_of(actuate(wanted, speed_mps, CommandedSpeed())[0], speed_mps)
        assert got.acceleration_mps2 == pytest.approx(acceleration)
        assert got.steering_rad == pytest.approx(0.1)


@pytest.mark.parametrize(("number", "away_m"), [(2, 1.0), (3, 1.0), (28, 0.7)])
def test_the_sparse_route_stays_in_its_lanes(number: int, away_m: float) -> None:
    """Straight lines between its points would leave them by 5.9 to 6.6 m."""
    route = snap_route(load_route_set("town05-short")[number])
    by_satellite, in_world = sparse_plans(route)
    plan = GlobalPlan(in_world)
    line = plan._xy
    assert np.hypot(*(line[:, None] - route.xyz[None, :, :2]).transpose(2, 0, 1)).min(axis=1).max() < away_m
    frame = fit_geo_frame(np.array([(point["lat"], point["lon"]) for point, _ in by_satellite]), plan.xy)
    place = route.xyz[30, :2]
    assert frame.xy(*lat_lon_of(*place.tolist()).tolist(), place) == pytest.approx(place, abs=0.05)
