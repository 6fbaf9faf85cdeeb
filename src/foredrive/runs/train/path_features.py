"""Path features of every demonstration, sampled along the initial plans and cached on disk."""

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
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.planner.ego_mlp import ego_motion, route_target
from foredrive.methods.planner.path_fit import PathDemonstrations
from foredrive.runs.open_clips import open_clips
from foredrive.scene import Example

BATCH_SIZE = 8


@torch.no_grad()
def sample_paths(
    agent: PlanningAgent[Any], logs: Sequence[LogPath], clips: ClipConfig, cache_dir: Path, stride_s: float
) -> PathDemonstrations:
    """Sample the present volume of clips `stride_s` apart along their initial plans.

    The features are stored in half precision. Runs with the same logs and the same weights share one file.

    Raises:
        InputError: a log cannot be read.
    """
    file = cache_dir / "path_features" / f"{_key(agent, logs, clips, stride_s)}.safetensors"
    try:
        cached = load_file(file)
    except (OSError, SafetensorError):
        cached = _sample(agent, logs, dataclasses.replace(clips, now_stride_s=stride_s), cache_dir)
        with atomic_path(file, durable=False) as temporary:
            save_file(cached, temporary)
    return PathDemonstrations(**cached)


def _sample(
    agent: PlanningAgent[Any], logs: Sequence[LogPath], clips: ClipConfig, cache_dir: Path
) -> dict[str, Tensor]:
    dataset = open_clips(logs, dataclasses.replace(clips, future_images=False), cache_dir)
    loader: Iterable[Example] = DataLoader(dataset, batch_size=BATCH_SIZE, collate_fn=collate)
    agent.eval()
    device = agent.planner.plan.device
    rows = [
        _sample_batch(agent, example.to(device))
        for example in track(loader, description="sampling along plans", total=-(-len(dataset) // BATCH_SIZE))
    ]
    return {name: torch.cat([row[name] for row in rows]) for name in rows[0]}


def _sample_batch(agent: PlanningAgent[Any], example: Example) -> dict[str, Tensor]:
    planner = agent.planner
    assert planner.path is not None
    clip = example.clip.observed()
    beliefs = agent.rollout(clip, planner.imagined_frames)
    plan = agent.plan(clip, beliefs)
    poses, speeds = ego_motion(clip, planner.history)
    past = torch.cat([poses, speeds[:, :-1, None]], dim=-1)
    target = route_target(clip) if planner.target else None
    initial_xy, status = planner.initial_plan(clip.command, clip.command_valid, speeds[:, -1], past, target)
    samples = planner.path.sample(agent.planner_volume(beliefs[0]), initial_xy)
    change = planner.path(samples, status).cumsum(dim=1)
    future = example.clip.future
    row = {
        "values": samples.values.half(),
        "positions_m": samples.positions_m,
        "status": status,
        "planned_xy": plan.xy[:, 0] - change,
        "driven_xy": future.xy[:, 0],
        "valid": future.valid[:, 0],
    }
    return {name: tensor.contiguous().cpu() for name, tensor in row.items()}


def _key(agent: PlanningAgent[Any], logs: Sequence[LogPath], clips: ClipConfig, stride_s: float) -> str:
    digest = hashlib.blake2b(digest_size=16)
    path = agent.planner.path
    assert path is not None
    sampled = (str(logs), repr(dataclasses.asdict(clips)), repr(stride_s))
    places = (path.distances_m.tolist(), path.lateral_m.tolist())
    digest.update("\n".join([*sampled, repr(places)]).encode())
    for name, tensor in sorted(agent.state_dict().items()):
        if not name.startswith("planner.path."):
            digest.update(name.encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
