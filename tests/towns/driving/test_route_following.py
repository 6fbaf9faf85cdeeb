"""Routes of Town05 can be driven: plans along them, twice a second and late, keep the vehicle on the line."""

import math

import numpy as np
import pytest
import torch

from foredrive.driving.controller import ControllerState, follow
from foredrive.driving.dynamics import STEP_S, step
from foredrive.driving.plans import fixed_in_world
from foredrive.driving.route_sets import load_route_set
from foredrive.scene import BicycleState, Trajectory
from foredrive.towns.driving.routes import DriveRoute, snap_route

SPEED_MPS, LATENCY_S, DT_S = 4.5, 0.15, 0.5


def ahead(route: DriveRoute, arc_m: float, state: BicycleState) -> Trajectory:
    ways = arc_m + SPEED_MPS * DT_S * np.arange(1, 7)
    world = np.stack([np.interp(ways, route.arc_m, axis) for axis in route.xyz[:, :2].T], axis=1)
    cos, sin = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    xy = (world - [state.x_m, state.y_m]) @ np.array([[cos, -sin], [sin, cos]])
    points = torch.tensor(xy, dtype=torch.float32)[None, None]
    flat = points[..., 0]
    return Trajectory(points, 0 * flat, torch.ones_like(flat, dtype=torch.bool), torch.zeros(1, 1), DT_S)


@pytest.mark.parametrize(
    ("name", "id"), [("town05-short", "28"), ("town05-short", "16"), ("town05-long", "21")]
)
def test_a_route_is_driven_to_its_end_on_its_line(name: str, id: str) -> None:
    route = snap_route(next(given for given in load_route_set(name) if given.id == id))
    xy = route.xyz[:, :2]
    heading = math.atan2(*(xy[4] - xy[0])[::-1])
    state = BicycleState(float(xy[0, 0]), float(xy[0, 1]), heading, SPEED_MPS)
    controller, near, off_m = ControllerState(), 0, [0.0]
    for index in range(round(1.2 * route.length_m / SPEED_MPS / STEP_S)):
        if near >= len(xy) - 2:
            break
        window = xy[near : near + 20]
        near += int(np.argmin(((window - [state.x_m, state.y_m]) ** 2).sum(axis=1)))
        along = xy[near + 1] - xy[max(near - 1, 0)]
        aside = xy[near] - [state.x_m, state.y_m]
        off_m.append(abs(along[0] * aside[1] - along[1] * aside[0]) / np.hypot(*along))
        if index % 10 == 0:
            plan = fixed_in_world(ahead(route, float(route.arc_m[near]), state), state, index * STEP_S)
            controller = controller.expecting(plan, index * STEP_S + (LATENCY_S if index else 0.0))
        control, controller = follow(controller, state, index * STEP_S)
        state = step(state, control)
    assert near >= len(xy) - 2
    assert max(off_m) < 0.25
    assert np.sqrt(np.mean(np.square(off_m))) < 0.1
