"""Some seconds of traffic in every town: nothing happens that must not."""

import numpy as np
import pytest

from foredrive.scene import Category
from foredrive.towns.map.town_map import TOWNS, load_town_map
from foredrive.towns.traffic.audit import Audit
from foredrive.towns.traffic.expert import Drive
from foredrive.towns.traffic.traffic import Traffic

DT_S, SECONDS = 0.1, 15.0


@pytest.mark.parametrize("town", TOWNS)
def test_nothing_goes_wrong(town: str) -> None:
    town_map = load_town_map(town)
    traffic = Traffic(town_map, seed=11, vehicle_count=30, people_count=15)
    drive, audit = Drive(traffic, SECONDS), Audit(town_map, traffic)
    state, driven_m = drive.state, 0.0
    for _ in range(round(SECONDS / DT_S)):
        after = traffic.step(state, DT_S)
        audit.watch(state, after)
        state = after
        driven_m += DT_S * float(state.vehicles.speed_mps[state.vehicles.active].mean())
    assert audit.examples == {name: [] for name in audit.counts}
    assert driven_m / SECONDS > 1.0
    kinds = set(state.vehicles.category[state.vehicles.active].tolist())
    assert int(Category.CAR) in kinds
    if state.people.active.any():  # the walkways of Town07 are far from most of its roads
        assert np.abs(state.people.velocity_mps).max() > 0.8
