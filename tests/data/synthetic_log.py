"""A small log whose geometry is known in closed form: a flat ground, one standing and one moving box.

The ego vehicle drives along world x at a constant speed. Everything a test compares with is computed here by
exact ray casting, independently of the package's own code.
"""

import dataclasses
from pathlib import Path

import numpy as np
import torch

from foredrive.data.log_writer import CameraSpec, Frame, LogWriter
from foredrive.scene import Boxes, Category, LidarSweep
from foredrive.scene.boxes import unlabelled

EGO_SPEED_MPS = 5.0
PERIOD_US = 100_000
START_US = 1_700_000_000_000_000
LIDAR_EGO_M = np.array([1.0, 0.0, 1.8])
MAX_RANGE_M = 40.0
PARKED = {"centre": np.array([14.0, 4.0, 1.0]), "size": np.array([4.0, 2.0, 2.0]), "speed": 0.0}
MOVING = {"centre": np.array([8.0, -4.0, 1.0]), "size": np.array([4.0, 2.0, 2.0]), "speed": 3.0}
WORLD_OFFSET = np.array([100.0, -50.0, 0.0])
"""World position of the ego vehicle at t = 0; the geometry above is relative to it."""
GROUND_RGB, SKY_RGB = (90, 90, 90), (130, 180, 250)
PARKED_RGB, MOVING_RGB = (220, 40, 40), (40, 200, 60)

_T_BODY_CAM = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def cameras(height: int = 48, width: int = 96) -> list[CameraSpec]:
    """A camera ahead and one to the left, 90° wide."""
    K = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])
    ahead = np.eye(4)
    ahead[:3, 3] = (1.6, 0.0, 1.5)
    left = np.eye(4)
    left[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    left[:3, 3] = (0.8, 0.5, 1.5)
    return [
        CameraSpec("ahead", K, ahead @ _T_BODY_CAM, (height, width)),
        CameraSpec("left", K, left @ _T_BODY_CAM, (height, width)),
    ]


def cast(origin: np.ndarray, direction: np.ndarray, t_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the first surface (inf: none) and what it is (0 sky, 1 ground, 2 parked, 3 moving)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(direction[:, 2] < 0, -origin[:, 2] / direction[:, 2], np.inf)
        what = np.where(np.isfinite(distance), 1, 0)
        for label, box in ((2, PARKED), (3, MOVING)):
            centre = box["centre"] + [box["speed"] * t_s, 0, 0]
            near = (centre - box["size"] / 2 - origin) / direction
            far = (centre + box["size"] / 2 - origin) / direction
            enter = np.minimum(near, far).max(-1)
            leave = np.maximum(near, far).min(-1)
            hit = (enter <= leave) & (enter > 0) & (enter < distance)
            distance = np.where(hit, enter, distance)
            what = np.where(hit, label, what)
    return distance, what


def driven(t_s: float) -> np.ndarray:
    return np.array([EGO_SPEED_MPS * t_s, 0.0, 0.0])


def ego_pose(t_s: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = WORLD_OFFSET + driven(t_s)
    return T


def sweep(t_s: float, rows: int = 16, columns: int = 120) -> LidarSweep:
    """An instantaneous sweep; beams that hit nothing within MAX_RANGE_M are misses."""
    elevation = np.deg2rad(np.linspace(-25, 5, rows))
    azimuth = np.deg2rad(np.arange(columns) * 360 / columns)
    beam, angle = (g.ravel() for g in np.meshgrid(np.arange(rows), azimuth, indexing="ij"))
    direction = np.stack(
        [
            np.cos(elevation[beam]) * np.cos(angle),
            np.cos(elevation[beam]) * np.sin(angle),
            np.sin(elevation[beam]),
        ],
        axis=-1,
    )
    origin = np.tile(LIDAR_EGO_M, (len(direction), 1))
    distance, what = cast(origin + driven(t_s), direction, t_s)
    returned = distance <= MAX_RANGE_M
    as_tensor = lambda a: torch.from_numpy(np.asarray(a, dtype=np.float32))  # noqa: E731
    return LidarSweep(
        origin_ego=as_tensor(origin),
        dir_ego=as_tensor(direction),
        range_m=as_tensor(np.where(returned, distance, MAX_RANGE_M)),
        returned=torch.from_numpy(returned),
        intensity=as_tensor(np.where(returned, what / 4, 0)),
        dt_s=torch.zeros(len(direction)),
        beam=torch.from_numpy(beam),
        valid=torch.ones(len(direction), dtype=torch.bool),
    )


def image(spec: CameraSpec, t_s: float) -> np.ndarray:
    height, width = spec.size_hw
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], -1) @ np.linalg.inv(spec.K).T
    direction = rays @ spec.T_ego_cam[:3, :3].T
    origin = np.tile(spec.T_ego_cam[:3, 3] + driven(t_s), (len(rays), 1))
    what = cast(origin, direction, t_s)[1]
    palette = np.array([SKY_RGB, GROUND_RGB, PARKED_RGB, MOVING_RGB], dtype=np.uint8)
    return palette[what].reshape(height, width, 3)


def boxes(t_s: float) -> Boxes:
    both = (PARKED, MOVING)
    centre = np.stack([b["centre"] + [b["speed"] * t_s, 0, 0] - driven(t_s) for b in both])
    return Boxes(
        centre=torch.tensor(centre, dtype=torch.float32),
        size_lwh=torch.tensor(np.stack([b["size"] for b in both]), dtype=torch.float32),
        yaw=torch.zeros(2),
        velocity=torch.tensor([[b["speed"], 0.0] for b in both]),
        track_id=torch.tensor([7, 11]),
        category=torch.tensor([Category.CAR, Category.TRUCK]),
        valid=torch.ones(2, dtype=torch.bool),
        **unlabelled(2),
    )


def frame(index: int, specs: list[CameraSpec]) -> Frame:
    t_s = index * PERIOD_US * 1e-6
    return Frame(
        t_us=START_US + index * PERIOD_US,
        T_world_ego=ego_pose(t_s),
        velocity_ego_mps=np.array([EGO_SPEED_MPS, 0.0, 0.0]),
        acceleration_ego_mps2=np.zeros(3),
        images={spec.name: image(spec, t_s) for spec in specs},
        sweep=sweep(t_s),
        boxes=boxes(t_s),
    )


def write(
    root: Path,
    frames: int = 51,
    name: str = "flat",
    specs: list[CameraSpec] | None = None,
    route_xyz: np.ndarray | None = None,
    empty_sweeps: bool = False,
) -> Path:
    """Write the log and return its folder."""
    specs = cameras() if specs is None else specs
    with LogWriter(root, "flat_train", name, specs, None, None, route_xyz) as writer:
        for index in range(frames):
            item = frame(index, specs)
            if empty_sweeps:
                nothing = item.sweep[torch.zeros_like(item.sweep.valid)]
                item = dataclasses.replace(item, sweep=nothing)
            writer.write(item)
    return root / "logs" / "flat_train" / name
