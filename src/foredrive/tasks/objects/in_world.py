"""Boxes and detections of an ego frame in the world frame, where drives are scored."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64, Int64
from numpy import ndarray

from foredrive.scene import Boxes, Category
from foredrive.scene.agents import Agents
from foredrive.tasks.objects.object_rows import ObjectRows, make_rows

MIN_SCORE = 0.001
"""Detections with a lower score are left out, which keeps files small. A class that is never more probable
than this has no detections."""

Pose = Float64[ndarray, "4 4"]


def places_in_world(xyz_ego: Float[ndarray, "*n 3"], T_world_ego: Pose) -> Float64[ndarray, "*n 3"]:
    """Return places of the ego frame in the world frame, m."""
    return xyz_ego @ T_world_ego[:3, :3].T + T_world_ego[:3, 3]


def futures_in_world(
    future_xy: Float[ndarray, "n *s 2"], centre: Float[ndarray, "n 3"], T_world_ego: Pose
) -> Float64[ndarray, "n *s 2"]:
    """Return x and y in the world frame of futures of the ego frame, at the heights of their boxes, m."""
    # Futures keep the height of their box
    height = centre[:, 2].reshape(-1, *[1] * (future_xy.ndim - 1))
    xyz = np.concatenate([future_xy, np.broadcast_to(height, (*future_xy.shape[:-1], 1))], axis=-1)
    return places_in_world(xyz, T_world_ego)[..., :2]


def levelled(xy_world: Float64[ndarray, "*n 2"], T_world_ego: Pose) -> Float64[ndarray, "*n 2"]:
    """Return x and y of the world frame relative to the ego vehicle, along and across its heading, m.

    Pitch and roll of the vehicle are left out, as in files, which state places over ground.
    """
    # Rotation by -yaw of the offset from the vehicle
    x, y = np.moveaxis(xy_world - T_world_ego[:2, 3], -1, 0)
    yaw = ego_yaw(T_world_ego)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def ego_yaw(T_world_ego: Pose) -> float:
    """Return the heading of the ego vehicle, rad."""
    return float(np.arctan2(T_world_ego[1, 0], T_world_ego[0, 0]))


def velocities_in_world(velocity: Float[ndarray, "n 2"], T_world_ego: Pose) -> Float64[ndarray, "n 2"]:
    """Return velocities over ground along the axes of the world frame, m/s. NaN stays NaN."""
    # Vertical velocity is 0
    level = np.concatenate([velocity, np.zeros((len(velocity), 1))], axis=1)
    return (level @ T_world_ego[:3, :3].T)[:, :2]


def box_rows(boxes: Boxes, T_world_ego: Pose, frame: int, classes: Sequence[str]) -> ObjectRows:
    """Return the valid boxes of an unbatched frame.

    Args:
        boxes: in the ego frame.
        T_world_ego: pose of the ego vehicle.
        frame: number of the frame.
        classes: of the protocol. Others have the label -1.
    """
    kept = boxes[boxes.valid].to("cpu")
    return make_rows(
        *_columns(kept, T_world_ego, frame, classes),
        **_offsets(kept, T_world_ego),
        attribute=kept.attribute.numpy(),
        num_points=kept.num_points.numpy(),
        track=kept.track_id.numpy(),
    )


def agent_rows(agents: Agents, T_world_ego: Pose, frame: int, classes: Sequence[str]) -> ObjectRows:
    """Return detected agents of an unbatched frame; arguments as for `box_rows`."""
    agents = agents.to("cpu")
    return make_rows(
        *_columns(agents, T_world_ego, frame, classes),
        **_offsets(agents, T_world_ego),
        attribute=agents.attribute.numpy(),
        score=agents.score.double().numpy(),
        track=agents.track_id.numpy(),
    )


def likely(agents: Agents) -> Agents:
    """Return the unbatched agents whose score is at least `MIN_SCORE`."""
    return agents[agents.score >= MIN_SCORE]


# Frames in order, concatenated column by column
def stacked(rows: Sequence[ObjectRows]) -> ObjectRows:
    """Return the rows of all frames in order."""
    if not rows:
        zero = np.zeros(0, np.int64)
        return make_rows(zero, zero, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    return ObjectRows(**{name: np.concatenate([vars(part)[name] for part in rows]) for name in vars(rows[0])})


def _columns(
    objects: Agents | Boxes, T_world_ego: Pose, frame: int, classes: Sequence[str]
) -> tuple[Int64[ndarray, "n"], Int64[ndarray, "n"], ndarray, ndarray, Float64[ndarray, "n"]]:
    # Labels of the protocol's classes; others get -1
    label_of = {Category[name.upper()]: label for label, name in enumerate(classes)}
    label = [label_of.get(Category(kind), -1) for kind in objects.category.tolist()]
    return (
        np.full(len(label), frame, dtype=np.int64),
        np.array(label, dtype=np.int64),
        places_in_world(objects.centre.double().numpy(), T_world_ego),
        objects.size_lwh.double().numpy(),
        objects.yaw.double().numpy() + ego_yaw(T_world_ego),
    )


def _offsets(objects: Agents | Boxes, T_world_ego: Pose) -> dict[str, Float64[ndarray, "n 2"]]:
    centre = places_in_world(objects.centre.double().numpy(), T_world_ego)
    return {
        "velocity": velocities_in_world(objects.velocity.double().numpy(), T_world_ego),
        "from_ego": centre[:, :2] - T_world_ego[:2, 3],
    }
