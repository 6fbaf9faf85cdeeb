"""Path features of every demonstration, sampled along plans that do not use the volume; cached on disk."""

import dataclasses
import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from rich.progress import track
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.utils.data import DataLoader

from foredrive.data import ClipConfig, LogPath, collate
from foredrive.files import atomic_path
from foredrive.models.agent import PlanningAgent
from foredrive.models.ego_mlp import ego_motion, route_lead
from foredrive.runs.open_clips import open_clips
from foredrive.scene import Example
from foredrive.training import PathDemonstrations

BATCH = 8


@torch.no_grad()
def read_paths(
    agent: PlanningAgent[Any], logs: Sequence[LogPath], clips: ClipConfig, cache_dir: Path, stride_s: float
) -> PathDemonstrations:
    """Sample the present volume of clips `stride_s` apart along the plans that do not use the volume.

    The features are stored in half precision. Runs with the same logs and the same weights share one file.

    Raises:
        InputError: a log cannot be read.
    """
    file = cache_dir / "paths" / f"{_key(agent, logs, clips, stride_s)}.safetensors"
    try:
        kept = load_file(file)
    except (OSError, SafetensorError):
        kept = _read(agent, logs, dataclasses.replace(clips, now_stride_s=stride_s), cache_dir)
        with atomic_path(file) as temporary:
            save_file(kept, temporary)
    return PathDemonstrations(**kept)


def _read(
    agent: PlanningAgent[Any], logs: Sequence[LogPath], clips: ClipConfig, cache_dir: Path
) -> dict[str, Tensor]:
    dataset = open_clips(logs, dataclasses.replace(clips, future_images=False), cache_dir)
    loader: Iterable[Example] = DataLoader(dataset, batch_size=BATCH, collate_fn=collate)
    agent.eval()
    device = agent.planner.plan.device
    rows = [
        _row(agent, example.to(device))
        for example in track(loader, description="reading along plans", total=-(-len(dataset) // BATCH))
    ]
    return {name: torch.cat([row[name] for row in rows]) for name in rows[0]}


def _row(agent: PlanningAgent[Any], example: Example) -> dict[str, Tensor]:
    planner = agent.planner
    assert planner.path is not None
    clip = example.clip.observed()
    beliefs = agent.foresee(clip, planner.looks_ahead)
    plan = agent.plan(clip, beliefs)
    poses, speeds = ego_motion(clip, planner.history)
    past = torch.cat([poses, speeds[:, :-1, None]], dim=-1)
    unseen_xy, told = planner.without_looking(
        clip.command, clip.command_valid, speeds[:, -1], past, route_lead(clip) if planner.target else None
    )
    reads = planner.path.read(agent.planned_on(beliefs[0]), unseen_xy)
    change = planner.path(reads, told).cumsum(dim=1)
    future = example.clip.future
    row = {
        "values": reads.values.half(),
        "places_m": reads.places_m,
        "told": told,
        "planned_xy": plan.xy[:, 0] - change,
        "driven_xy": future.xy[:, 0],
        "valid": future.valid[:, 0],
    }
    return {name: tensor.contiguous().cpu() for name, tensor in row.items()}


def _key(agent: PlanningAgent[Any], logs: Sequence[LogPath], clips: ClipConfig, stride_s: float) -> str:
    digest = hashlib.blake2b(digest_size=16)
    read = (str(logs), repr(dataclasses.asdict(clips)), repr(stride_s))
    digest.update("\n".join(read).encode())
    for name, tensor in sorted(agent.state_dict().items()):
        if not name.startswith("planner.path."):
            digest.update(name.encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    assert agent.planner.path is not None
    digest.update(agent.planner.path.distances_m.cpu().numpy().tobytes())
    return digest.hexdigest()
