"""CARLA's actors as Foredrive's actors, and the collisions of the ego vehicle with them."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from foredrive.integrations.carla.frames import matrix_of, xyz_of
from foredrive.scene import Category, Event
from foredrive.scene.actors import ActorState

CATEGORY_OF_BASE_TYPE = {
    "car": Category.CAR,
    "van": Category.CAR,
    "truck": Category.TRUCK,
    "bus": Category.BUS,
    "motorcycle": Category.MOTORCYCLE,
    "bicycle": Category.BICYCLE,
}
"""By the blueprints' attribute `base_type`."""
SAME_S, SAME_M = 5.0, 5.0
MIN_MPS = 0.1
"""CARLA's CollisionTest: contacts with one actor within `SAME_S`, or at places within `SAME_M`, are one
collision. A vehicle slower than `MIN_MPS` has caused none."""


def category_of(type_id: str, attributes: dict[str, str]) -> Category | None:
    """Return the category of an actor. None if it is no road user."""
    if type_id.startswith("walker.pedestrian"):
        return Category.PEDESTRIAN
    if not type_id.startswith("vehicle."):
        return None
    return CATEGORY_OF_BASE_TYPE.get(attributes.get("base_type", "car"), Category.OTHER)


def actor_state(actor: Any) -> ActorState | None:
    """Convert a `carla.Actor`. Return None if it is no road user."""
    category = category_of(actor.type_id, actor.attributes)
    if category is None:
        return None
    T, box = matrix_of(actor.get_transform()), actor.bounding_box
    return ActorState(
        track_id=int(actor.id),
        category=category,
        centre_m=T[:3, :3] @ xyz_of(box.location) + T[:3, 3],
        yaw=math.atan2(T[1, 0], T[0, 0]),
        pitch=-math.asin(min(max(float(T[2, 0]), -1.0), 1.0)),
        size_lwh=2.0 * np.array([box.extent.x, box.extent.y, box.extent.z]),
        velocity_mps=xyz_of(actor.get_velocity()),
        style=int(actor.id),
        parked=False,
    )


@dataclass(frozen=True)
class LastCollision:
    """The last collision of the ego vehicle."""

    actor_id: int | None = None
    """None for an object that belongs to the town."""
    t_s: float = -math.inf
    xy: tuple[float, float] | None = None


def collision(
    event: Any,
    ego_xy: Float64[np.ndarray, "2"],
    ego_velocity: Float64[np.ndarray, "2"],
    t_s: float,
    last: LastCollision,
) -> tuple[Event | None, LastCollision]:
    """Return the collision that a `carla.CollisionEvent` reports, and the updated contact.

    The collision is None if the event belongs to the last collision, if the ego vehicle stands, or if it
    touches a sidewalk.

    Args:
        ego_velocity: velocity before the step of the collision, m/s, world frame.
    """
    other, speed_mps = event.other_actor, float(np.hypot(*ego_velocity))
    actor_id = other.id if other.id != 0 else None
    if last.xy is not None and np.hypot(*(ego_xy - last.xy)) > SAME_M:
        last = dataclasses.replace(last, xy=None)
    same = actor_id is not None and actor_id == last.actor_id and t_s - last.t_s <= SAME_S
    category = category_of(other.type_id, other.attributes)
    if same or last.xy is not None or speed_mps < MIN_MPS or other.type_id.startswith("static.sidewalk"):
        return None, last
    kind, what, severity = "collision_static", other.type_id.removeprefix("static."), speed_mps
    if category is not None:
        kind = "collision_pedestrian" if category is Category.PEDESTRIAN else "collision_vehicle"
        what = category.name.lower()
        severity = float(np.hypot(*(ego_velocity - xyz_of(other.get_velocity())[:2])))
    where = (float(ego_xy[0]), float(ego_xy[1]))
    text = f"{other.type_id} {other.id} at {severity:.1f} m/s"
    return Event(kind, t_s, where, text, what, severity), LastCollision(actor_id, t_s, where)
