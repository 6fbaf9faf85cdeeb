"""Traffic and pedestrians in CARLA, driven by its traffic manager and its navigation mesh."""

from typing import Any

import numpy as np
from jaxtyping import Float64

from foredrive.integrations.carla.frames import CarlaPose, xyz_of
from foredrive.integrations.carla.session import CarlaSession
from foredrive.scene.conditions import BackgroundTraffic

NEAR_ROUTE_M = 140.0
"""Maximum distance from the route at which vehicles start, m."""
FREE_M = 12.0
"""Minimum distance from the ego vehicle's start at which vehicles start, m."""
ABOVE_M = 0.5
"""Height above the road from which actors are dropped, m."""
WALKING_MPS = (0.8, 1.8)
TRIES = 5
"""Maximum number of attempts per pedestrian, as a place may be taken."""


def add_background_traffic(
    session: CarlaSession,
    background: BackgroundTraffic,
    route_xyz: Float64[np.ndarray, "M 3"],
    rng: np.random.Generator,
) -> None:
    """Add vehicles and pedestrians, at most the numbers in `background`. Places without room are skipped."""
    _add_vehicles(session, background.vehicles, route_xyz, rng)
    if background.pedestrians:
        _add_people(session, background.pedestrians, rng)


def _add_vehicles(
    session: CarlaSession, count: int, route_xyz: Float64[np.ndarray, "M 3"], rng: np.random.Generator
) -> None:
    library = session.world.get_blueprint_library().filter("vehicle.*")
    kinds = sorted(thing.id for thing in library if thing.has_attribute("number_of_wheels"))
    spots = []
    for spot in session.world.get_map().get_spawn_points():
        xy = xyz_of(spot.location)[:2]
        away_m = np.hypot(*(route_xyz[:, :2] - xy).T)
        if away_m.min() < NEAR_ROUTE_M and away_m[0] > FREE_M:
            spots.append(spot)
    for i in rng.permutation(len(spots)).tolist():
        if count <= 0 or not kinds:
            break
        kind = kinds[int(rng.integers(len(kinds)))]
        vehicle = session.spawn(kind, _pose_at(spots[i]), {"role_name": "autopilot"})
        if vehicle is not None:
            vehicle.set_autopilot(True, session.traffic.get_port())
            count -= 1


def _add_people(session: CarlaSession, count: int, rng: np.random.Generator) -> None:
    kinds = sorted(thing.id for thing in session.world.get_blueprint_library().filter("walker.pedestrian.*"))
    controllers = list[Any]()
    for _ in range(count * TRIES):
        place = session.world.get_random_location_from_navigation()
        if place is None or not kinds or len(controllers) == count:
            break
        kind = kinds[int(rng.integers(len(kinds)))]
        pose = CarlaPose(place.x, place.y, place.z + ABOVE_M, yaw_deg=float(rng.uniform(-180.0, 180.0)))
        walker = session.spawn(kind, pose, {"is_invincible": "false"})
        if walker is None:
            continue
        controller = session.spawn("controller.ai.walker", CarlaPose(0.0, 0.0, 0.0), {}, attach_to=walker)
        if controller is not None:
            controllers.append(controller)
    session.tick()  # the navigation knows walkers from here on
    for controller in controllers:
        _let_walk(session, controller, rng)


def _let_walk(session: CarlaSession, controller: Any, rng: np.random.Generator) -> None:
    controller.start()
    controller.set_max_speed(float(rng.uniform(*WALKING_MPS)))
    goal = session.world.get_random_location_from_navigation()
    if goal is not None:
        controller.go_to_location(goal)


def _pose_at(transform: Any) -> CarlaPose:
    location, rotation = transform.location, transform.rotation
    pose = CarlaPose(location.x, location.y, location.z, rotation.roll, rotation.pitch, rotation.yaw)
    return pose._replace(z=pose.z + ABOVE_M)
