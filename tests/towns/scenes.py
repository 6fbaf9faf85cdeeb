"""Where the tests of what sensors see put the vehicle and those around it."""

import dataclasses

import numpy as np

from foredrive.scene import Category
from foredrive.scene.actors import ActorState
from foredrive.towns.map.town_map import Strip, StripKind, TownMap

STILL = np.zeros(6)
"""The twist of a vehicle at rest."""
ACTOR_ID = 17


def ego_pose(town: TownMap) -> np.ndarray:
    """`T_world_ego` on the middle of a long straight lane."""
    lane = max((x for x in town.lanes if x.junction_id is None), key=lambda x: len(x.centreline_xyz))
    line = lane.centreline_xyz
    k = len(line) // 2
    yaw = np.arctan2(*(line[k + 1] - line[k])[1::-1])
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = line[k]
    return T


def actor_at(T_world_ego: np.ndarray, xyz: tuple[float, float, float], **changes: object) -> ActorState:
    """A box-shaped road user that stands, its middle at a point of the ego frame and its axes those of it."""
    state = ActorState(
        track_id=ACTOR_ID,
        category=Category.BARRIER,  # drawn as its box
        centre_m=T_world_ego[:3, :3] @ xyz + T_world_ego[:3, 3],
        yaw=float(np.arctan2(T_world_ego[1, 0], T_world_ego[0, 0])),
        pitch=0.0,
        size_lwh=np.array([4.0, 2.0, 1.6]),
        velocity_mps=np.zeros(3),
        style=5,
        parked=False,
    )
    return dataclasses.replace(state, **changes)


def straight(name: str, start: tuple[float, ...], end: tuple[float, ...]) -> Strip:
    """A lane of 4 m."""
    line = np.linspace(start, end, 81)
    ahead = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    left = 2.0 * np.array([-ahead[1], ahead[0], 0.0])
    return Strip(name, StripKind.DRIVING, 0, None, line + left, line - left, (), ())
