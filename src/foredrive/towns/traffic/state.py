"""The state of traffic: everything that changes from step to step."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from foredrive.towns.traffic.pedestrians import Pedestrians
from foredrive.towns.traffic.scripted_actors import ScriptedActor
from foredrive.towns.traffic.vehicles import Vehicles


@dataclass(frozen=True)
class TrafficState:
    """The state of a town's traffic at one time."""

    time_s: float
    step_index: int
    vehicles: Vehicles
    people: Pedestrians
    next_track_id: int
    route: Int[np.ndarray, "R"]
    """Lanes in which vehicle 0 has to be at the end of each stretch of its route. Empty if it takes random
    turns like the others."""
    route_passed: int
    """Number of stretches of the route that lie behind."""
    scripted_actors: tuple[ScriptedActor, ...] = ()
    """People and cyclists that move on given paths, off the walkways."""
