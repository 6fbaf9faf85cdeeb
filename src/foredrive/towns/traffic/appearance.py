"""Actors of traffic for the renderer and the labels."""

import numpy as np
from jaxtyping import Bool

from foredrive.scene import Category
from foredrive.scene.actors import ActorState
from foredrive.towns.traffic.pedestrians import Pedestrians
from foredrive.towns.traffic.scripted_actors import ScriptedActor
from foredrive.towns.traffic.vehicles import MOTION_S, Poses, Vehicles

BRAKE_LIGHTS_MPS2, STANDSTILL_MPS = 0.7, 0.1
"""Deceleration above which brake lights are on, m/s², because the engine alone slows less; and the speed
below which a standing vehicle has them on, m/s."""


def vehicle_actors(
    v: Vehicles, poses: Poses, motion: tuple[Poses, Poses], kept: Bool[np.ndarray, "N"]
) -> list[ActorState]:
    """Return the actors of the vehicles in `kept`.

    Args:
        motion: the result of `motion`.
    """
    before, after = motion
    # Mean velocity over `MOTION_S` about now
    velocity_mps = (after.centre_m - before.centre_m) / MOTION_S
    slows = (v.acceleration_mps2 < -BRAKE_LIGHTS_MPS2) | (v.speed_mps < STANDSTILL_MPS)
    braking = slows & (v.category != Category.BICYCLE)
    return [
        ActorState(
            track_id=int(v.track_id[i]),
            category=Category(int(v.category[i])),
            centre_m=poses.centre_m[i],
            yaw=float(poses.yaw[i]),
            pitch=float(poses.pitch[i]),
            size_lwh=v.size_lwh[i],
            velocity_mps=velocity_mps[i],
            style=int(v.style[i]),
            parked=False,
            braking=bool(braking[i]),
        )
        for i in np.flatnonzero(kept)
    ]


def people_actors(p: Pedestrians) -> list[ActorState]:
    """Return the actors of all people on walkways and crossings."""
    return [
        ActorState(
            track_id=int(p.track_id[i]),
            category=Category.PEDESTRIAN,
            # Positions are those of the feet; boxes are placed by their centre
            centre_m=p.xyz[i] + [0.0, 0.0, 0.5 * p.size_lwh[i, 2]],
            yaw=float(p.yaw[i]),
            pitch=0.0,
            size_lwh=p.size_lwh[i],
            velocity_mps=p.velocity_mps[i],
            style=int(p.style[i]),
            parked=False,
        )
        for i in np.flatnonzero(p.active)
    ]


def scripted_actor_state(actor: ScriptedActor) -> ActorState:
    """Return the state of a scripted actor for the renderer."""
    return ActorState(
        track_id=actor.track_id,
        category=actor.category,
        centre_m=actor.xyz + np.array([0.0, 0.0, 0.5 * actor.size_lwh[2]]),
        yaw=actor.yaw_rad,
        pitch=0.0,
        size_lwh=actor.size_lwh,
        velocity_mps=np.append(actor.speed_mps * actor.ahead, 0.0),
        style=actor.style,
        parked=False,
    )
