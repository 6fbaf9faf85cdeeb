"""A small log of a street with everything that the tasks' truth is read from, and predictions near its truth.

The ego vehicle turns, pitches and rolls, so that frames of reference that are mixed up show.
"""

import dataclasses
from pathlib import Path

import numpy as np
import synthetic_log as world
import torch
from flat_street import street
from scipy.spatial.transform import Rotation

from foredrive.data import ClipConfig, ClipDataset, collate, find_logs
from foredrive.data.clip_config import TaskTruthConfig
from foredrive.data.log_writer import LogWriter
from foredrive.data.maps import write_map
from foredrive.data.modalities import FullOccupancy
from foredrive.heads.agents_head import AGENT_CLASSES
from foredrive.scene import Attribute, Boxes, Category, Example, VoxelSpec
from foredrive.scene.agents import Agents, MapLines
from foredrive.scene.map_elements import ElementKind
from foredrive.tasks.predictor import Prediction

STEP_S, SECONDS = 0.25, 9.0
GRID = VoxelSpec((-8.0, -8.0, -1.0), 0.5, (6, 32, 32))
KINDS = (Category.CAR, Category.CAR, Category.TRUCK, Category.PEDESTRIAN)
ATTRIBUTES = (
    Attribute.VEHICLE_MOVING,
    Attribute.VEHICLE_PARKED,
    Attribute.VEHICLE_MOVING,
    Attribute.PEDESTRIAN_MOVING,
)
SPEED_MPS = np.array([4.0, 0.0, 2.0, 1.2])
START_XY = np.array([[8.0, 0.0], [14.0, 4.0], [-9.0, 0.0], [6.0, -3.0]])
TURN_RADPS = np.array([0.1, 0.0, -0.1, 0.2])


def ego_pose(t_s: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [0.4 + 0.05 * t_s, 0.06, -0.04]).as_matrix()
    T[:3, 3] = world.WORLD_OFFSET + np.array([2.0 * t_s, 1.0, 0.1 * t_s])
    return T


def boxes_at(t_s: float) -> Boxes:
    """Road users that drive straight on while they turn, in the ego frame."""
    T_ego_world = np.linalg.inv(ego_pose(t_s))
    yaw = 0.3 + TURN_RADPS * t_s
    xyz = np.concatenate([START_XY, np.full((4, 1), 0.8)], axis=1) + world.WORLD_OFFSET
    velocity = SPEED_MPS[:, None] * np.array([np.cos(0.3), np.sin(0.3), 0.0])
    centre = (xyz + velocity * t_s) @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(4)], axis=-1) @ T_ego_world[:3, :3].T
    return Boxes(
        centre=torch.from_numpy(centre).float(),
        size_lwh=torch.tensor([[4.0, 2.0, 1.6], [4.2, 1.9, 1.5], [8.0, 2.5, 3.0], [0.7, 0.7, 1.8]]),
        yaw=torch.from_numpy(np.arctan2(heading[:, 1], heading[:, 0])).float(),
        velocity=torch.from_numpy((velocity @ T_ego_world[:3, :3].T)[:, :2]).float(),
        track_id=torch.tensor([3, 7, 11, 12]),
        category=torch.tensor([int(kind) for kind in KINDS]),
        valid=torch.ones(4, dtype=torch.bool),
        num_points=torch.tensor([9, 3, 20, 2]),
        attribute=torch.tensor([int(each) for each in ATTRIBUTES]),
        visibility=torch.full((4,), -1),
    )


def record(root: Path) -> Path:
    """Write the log and return the folder that holds it, as `foredrive score --truth` takes it."""
    rng = np.random.default_rng(0)
    specs = world.cameras()
    maps_dir = write_map(street(), "Flatland", root)
    with LogWriter(root, "flat_train", "log", specs, maps_dir, "Flatland", None) as writer:
        for k in range(round(SECONDS / STEP_S) + 1):
            index = np.unique(rng.integers(0, GRID.shape_zyx, (400, 3)), axis=0)
            kinds = rng.choice([-1, -4, -5, int(Category.CAR), int(Category.PEDESTRIAN)], len(index))
            speed = np.where(kinds[:, None] >= 0, [[3.0, 1.0, 0.0]], 0.0).astype(np.float32)
            writer.write(
                dataclasses.replace(
                    world.frame(0, specs),
                    t_us=world.START_US + round(1e6 * k * STEP_S),
                    T_world_ego=ego_pose(k * STEP_S),
                    boxes=boxes_at(k * STEP_S),
                    occupancy=FullOccupancy(GRID, index, kinds, speed),
                )
            )
    return root / "logs"


def read_batch(
    logs: Path,
    tasks: TaskTruthConfig | None = None,
    spec: VoxelSpec = GRID,
    cameras: tuple[str, ...] | None = None,
) -> Example:
    """Return all clips with one frame, 0.5 s apart, as one batch."""
    truth = TaskTruthConfig() if tasks is None else tasks
    config = ClipConfig(2, 0, (12, 24), spec, cameras=cameras, tasks=truth)
    clips = ClipDataset(find_logs(logs), config, None)
    return collate([clips[number] for number in range(len(clips))])


def near_truth(example: Example, seed: int = 0, modes: int = 3) -> Prediction:
    """Return noisy truth: agents with clutter and wrong classes, polylines, voxels."""
    rng = torch.Generator().manual_seed(seed)
    truth, clip = example.truth, example.clip
    assert truth is not None
    assert truth.futures is not None
    boxes = clip.boxes[:, clip.now]
    b, m = boxes.yaw.shape
    again = torch.arange(2 * m) % m
    wrong = torch.rand(b, 2 * m, generator=rng) < 0.2
    drawn = torch.tensor([int(kind) for kind in AGENT_CLASSES])[
        torch.randint(len(AGENT_CLASSES), (b, 2 * m), generator=rng)
    ]

    def noise(*shape: int, std: float) -> torch.Tensor:
        return std * torch.randn(b, 2 * m, *shape, generator=rng)

    far = (torch.arange(2 * m) >= m).float()[:, None] * noise(3, std=6.0)
    centre = boxes.centre[:, again] + noise(3, std=0.5) + far
    spread = noise(modes, 12, 2, std=0.5)
    agents = Agents(
        centre=centre,
        size_lwh=boxes.size_lwh[:, again] * noise(3, std=0.1).exp(),
        yaw=boxes.yaw[:, again] + noise(std=0.2),
        velocity=boxes.velocity[:, again] + noise(2, std=0.5),
        category=torch.where(wrong, drawn, boxes.category[:, again]),
        score=torch.rand(b, 2 * m, generator=rng),
        attribute=torch.where(wrong, 0, boxes.attribute[:, again]),
        track_id=(torch.arange(2 * m) + 100 * (torch.arange(b) % 3 == 0)[:, None]),
        future_xy=truth.futures.xy[:, again][:, :, None] + spread + far[:, :, None, None, :2],
        log_prob=noise(modes, std=1.0).log_softmax(dim=-1),
    )
    return Prediction(
        agents=agents, map_lines=_lines_near(example, rng), semantics=_voxels_near(example, rng)
    )


def _lines_near(example: Example, rng: torch.Generator) -> MapLines | None:
    elements = None if example.truth is None else example.truth.elements
    if elements is None:
        return None
    b, e = elements.kind.shape
    share = torch.linspace(0, 1, 10)[:, None]
    first = elements.vertices[:, :, :1]
    last_at = elements.valid.sum(dim=-1).clamp_min(1) - 1
    last = elements.vertices.gather(2, last_at[..., None, None].expand(b, e, 1, 2))
    points = first + share * (last - first) + 0.4 * torch.randn(b, e, 10, 2, generator=rng)
    kind = elements.kind.clamp(0, ElementKind.BOUNDARY)
    return MapLines(points, kind, torch.rand(b, e, generator=rng))


def _voxels_near(example: Example, rng: torch.Generator) -> torch.Tensor | None:
    semantics = None if example.truth is None else example.truth.semantics
    if semantics is None:
        return None
    other = torch.rand(semantics.index.shape, generator=rng) < 0.2
    return torch.where(other, semantics.index.roll(1, dims=-1), semantics.index)
