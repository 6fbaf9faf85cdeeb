"""Some seconds of traffic in every town: nothing happens that must not."""

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.common.traffic_audit import Audit
from foredrive.scene import Category
from foredrive.towns.map.names import TOWNS
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.traffic.expert import ExpertDrive
from foredrive.towns.traffic.traffic import Traffic

DT_S = 0.1
EVERY_TIME = ("Town02", "Town10HD")
SECONDS = dict.fromkeys(TOWNS, 8.0) | dict.fromkeys(("Town03", "Town04", "Town05", "Town06"), 5.0)


@pytest.mark.parametrize(
    "town", [pytest.param(town, marks=[] if town in EVERY_TIME else pytest.mark.slow) for town in TOWNS]
)
def test_nothing_goes_wrong(town: str, town_of: Callable[[str], TownMap]) -> None:
    town_map, seconds = town_of(town), SECONDS[town]
    traffic = Traffic(town_map, seed=5, vehicle_count=30, people_count=15)
    drive, audit = ExpertDrive(traffic, seconds, steering_noise=0.02), Audit(town_map, traffic)
    state, driven_m = drive.state, 0.0
    for _ in range(round(seconds / DT_S)):
        before = state
        drive.step(DT_S)
        state = drive.state
        audit.watch(before, state, drive.poses())
        driven_m += DT_S * float(state.vehicles.speed_mps[state.vehicles.active].mean())
    assert audit.examples == {name: [] for name in audit.counts}
    assert driven_m / seconds > 1.0
    kinds = set(state.vehicles.category[state.vehicles.active].tolist())
    assert int(Category.CAR) in kinds
    if state.people.active.any():  # the walkways of Town07 are far from most of its roads
        assert np.abs(state.people.velocity_mps).max() > 0.8
