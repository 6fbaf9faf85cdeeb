"""Volumes of a frozen world model, kept on disk for the training of heads."""

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.progress import track
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from torch.utils.data import Dataset

from foredrive.data import ClipConfig, ClipDataset, LogPath
from foredrive.data.batches import stack_records
from foredrive.files import atomic_path
from foredrive.heads.joint import boxes_now
from foredrive.heads.probe import TaskExample, TaskVolumes, task_volumes
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.runs.open_clips import open_clips
from foredrive.scene import Clip, Task
from foredrive.scene.task_truth import TaskTruth

BATCH_SIZE = 4
VERSION = 2
"""Version in the name of every folder of volumes. Increase it when their files change."""


class KeptVolumes(Dataset[TaskExample]):
    """The volumes of all clips of some logs, with their truth. Truth stays in memory, volumes on disk.

    Volumes are stored in half precision, one file for each clip. Runs with the same weights share the files
    of the logs that they have in common.

    Args:
        agent: its world model is frozen.
        logs: logs to read.
        clips: clips with the truth of the tasks.
        tasks: tasks whose volumes are kept.
        later: number of imagined key frames to keep too.
        cache_dir: folder of the files.

    Raises:
        InputError: a log cannot be read.
    """

    def __init__(
        self,
        agent: PlanningAgent[Any],
        logs: Sequence[LogPath],
        clips: ClipConfig,
        tasks: tuple[Task, ...],
        cache_dir: Path,
        later: int = 0,
    ) -> None:
        dataset = open_clips(logs, dataclasses.replace(clips, future_images=False), cache_dir)
        self.tasks, self._later = tasks, later
        folder = cache_dir / "volumes" / _key(agent, clips, (*tasks, *([f"later {later}"] if later else [])))
        self._files = [folder / f"{_name(dataset, index)}.safetensors" for index in range(len(dataset))]
        self._keep(agent, dataset)
        unseen = ClipDataset(logs, dataset.config, cache_dir, images=False)
        numbers = track(range(len(unseen)), description="reading truth")
        self.examples = [
            _without_volumes(unseen.clip(number), unseen.truth(number), unseen.key(number))
            for number in numbers
        ]

    def __len__(self) -> int:
        return len(self.examples)

    def __getitem__(self, index: int) -> TaskExample:
        """Return one item, unbatched."""
        with safe_open(self._files[index], framework="pt") as file:
            kept = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        volumes = TaskVolumes(
            volume=kept["volume"].float(),
            tasks=self.tasks,
            index=tuple(kept["index"].tolist()),
            past=kept["past"].float() if "past" in kept else None,
            T_past_now=kept.get("T_past_now"),
            later=kept["later"].float() if "later" in kept else None,
            T_now_later=kept.get("T_now_later"),
        )
        return dataclasses.replace(self.examples[index], volumes=volumes)

    def _keep(self, agent: PlanningAgent[Any], dataset: ClipDataset) -> None:
        """Write the volumes that are not there yet."""
        missing = [index for index in range(len(dataset)) if not _is_whole(self._files[index])]
        agent.eval()
        device = agent.planner.plan.device
        starts = range(0, len(missing), BATCH_SIZE)
        for start in track(starts, description="keeping volumes", disable=not missing):
            rows = missing[start : start + BATCH_SIZE]
            clip = stack_records([dataset.clip(row) for row in rows]).to(device)
            world = agent.world_model
            with torch.no_grad():
                volumes = task_volumes(world, world.observe(clip.observed()), self.tasks, self._later)
            for item, row in enumerate(rows):
                with atomic_path(self._files[row]) as temporary:
                    save_file(_tensors(volumes[item].to("cpu")), temporary)


def _tensors(volumes: TaskVolumes) -> dict[str, Tensor]:
    """Return what a file holds of one item."""
    kept = {"volume": volumes.volume.half().contiguous(), "index": torch.tensor(volumes.index)}
    if volumes.past is not None and volumes.T_past_now is not None:
        kept |= {"past": volumes.past.half().contiguous(), "T_past_now": volumes.T_past_now.contiguous()}
    if volumes.later is not None and volumes.T_now_later is not None:
        kept |= {"later": volumes.later.half().contiguous(), "T_now_later": volumes.T_now_later.contiguous()}
    return kept


def collate_kept(examples: Sequence[TaskExample]) -> TaskExample:
    """Collate items to a batch."""
    keys = tuple(key for example in examples for key in example.key)
    batch = stack_records([dataclasses.replace(example, key=()) for example in examples])
    return dataclasses.replace(batch, key=keys)


def _without_volumes(clip: Clip, truth: TaskTruth | None, key: str) -> TaskExample:
    assert truth is not None
    return TaskExample(
        volumes=TaskVolumes(torch.zeros(0, 0, 0, 0, 0), (), ()),
        boxes=boxes_now(clip),
        boxes_valid=clip.boxes_valid[clip.now],
        truth=truth,
        T_world_ego=clip.T_world_ego[clip.now],
        key=(key,),
    )


def _is_whole(file: Path) -> bool:
    try:
        with safe_open(file, framework="pt") as stored:
            return "index" in stored.keys()  # noqa: SIM118 - not a mapping
    except (OSError, SafetensorError):
        return False


def _name(dataset: ClipDataset, index: int) -> str:
    """Return the name of a clip's file, the same in every set of logs."""
    log = dataset.log_path(index)
    text = repr((str(log.folder), str(log.maps_dir), dataset.key(index)))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _key(agent: PlanningAgent[Any], clips: ClipConfig, tasks: Sequence[str]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    read = dataclasses.replace(clips, tasks=None)
    digest.update(repr((VERSION, dataclasses.asdict(read), tuple(tasks))).encode())
    for name, tensor in sorted(agent.world_model.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
