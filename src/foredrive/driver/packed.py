"""Clips packed for fast reading: one file of a log, so that images are decoded and truth is read once."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from torch.utils.data import Dataset

from foredrive.data import ClipDataset
from foredrive.data.batches import stack_records
from foredrive.data.disk_cache import entry_file, map_fingerprint
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.scene import Clip
from foredrive.scene.affordances import Affordances
from foredrive.scene.record import Record

BATCH = 32
"""Clips that are looked at together where none is trained on."""
PACK_VERSION = 5
"""Version in every name. Increase it when the content of the files changes."""
R = TypeVar("R", bound=Record)


@dataclass(frozen=True)
class RouteExample(Record):
    """A clip and what is on its route: one item of a driver's training."""

    clip: Clip
    truth: Affordances
    key: tuple[str, ...]


def join(examples: Sequence[RouteExample]) -> RouteExample:
    """Return a batch. Lamps and boxes are padded to the maximum in it."""
    keys = tuple(key for example in examples for key in example.key)
    batch = stack_records([dataclasses.replace(example, key=()) for example in examples])
    return dataclasses.replace(batch, key=keys)


def batches(clips: int) -> int:
    """Return the number of batches of `BATCH` clips."""
    return -(-clips // BATCH)


class PackedClips(Dataset[RouteExample]):
    """The clips of a data set with their affordances, read from packed files.

    A frame's images are kept once, however many clips show it. The name of a file is a hash of all that its
    content depends on. Damaged files are made again.

    Args:
        dataset: clips with affordances among their tasks.
        folder: folder of the files.

    Raises:
        InputError: the clips have no affordances.
    """

    def __init__(self, dataset: ClipDataset, folder: Path) -> None:
        if dataset.config.tasks is None or not dataset.config.tasks.affordances:
            raise InputError("a driver learns from affordances: set clips.tasks.affordances to true")
        self._dataset, self._folder = dataset, folder
        of_log: dict[int, list[int]] = {}
        for index in range(len(dataset)):
            of_log.setdefault(dataset.frames_of(index)[0], []).append(index)
        self._files = {self._file(log, clips): clips for log, clips in of_log.items()}
        """Clips of each file, in the order of its rows. A file has those of one log."""
        self._rows = {
            index: (file, row) for file, clips in self._files.items() for row, index in enumerate(clips)
        }
        self._template = self._read(0)

    def __len__(self) -> int:
        return len(self._rows)

    def pack(self, tick: Callable[[], None] = lambda: None) -> None:
        """Write the files that are missing. `tick` is called after each log.

        Raises:
            InputError: data cannot be read.
            OSError: the disk is full.
        """
        for file, clips in self._files.items():
            if not _is_whole(file):
                self._write(file, clips)
            tick()

    @property
    def logs(self) -> int:
        """Return the number of logs."""
        return len(self._files)

    def __getitem__(self, index: int) -> RouteExample:
        """Read one clip.

        Raises:
            InputError: its file is missing or damaged.
        """
        file, row = self._rows[index]
        try:
            with safe_open(file, "pt") as stored:
                tensors = {
                    name: stored.get_slice(name)[row]
                    for name in stored.keys()  # noqa: SIM118 - it is no mapping
                    if name not in ("frames", "images")
                }
                images = stored.get_slice("images")
                seen = torch.stack([images[frame] for frame in stored.get_slice("frames")[row].tolist()])
        except (OSError, SafetensorError) as error:
            raise InputError(f"{file}: a packed clip cannot be read: {error}") from error
        example = _with_tensors(self._template, tensors)
        return dataclasses.replace(
            example, clip=dataclasses.replace(example.clip, images=seen), key=(self._dataset.key(index),)
        )

    def _file(self, number: int, clips: Sequence[int]) -> Path:
        """Return the file of the clips of a log."""
        log, dataset = self._dataset.logs[number], self._dataset
        frames = [dataset.frames_of(index)[1] for index in clips]
        road = map_fingerprint(log)
        key = (PACK_VERSION, log.fingerprint, road, dataset.config, dataset.camera_names, frames)
        return entry_file(self._folder, key, "safetensors")

    def _write(self, file: Path, clips: list[int]) -> None:
        examples = [self._read(index) for index in clips]
        numbers = [self._dataset.frames_of(index)[1] for index in clips]
        images: dict[int, Tensor] = {}
        for example, frames in zip(examples, numbers, strict=True):
            # Each frame is stored once; the clips refer to rows
            images |= dict(zip(frames, example.clip.images, strict=True))
        rows = {frame: row for row, frame in enumerate(images)}
        batch = stack_records([_without_images(example) for example in examples])
        tensors = _tensors(batch) | {
            "images": torch.stack(list(images.values())),
            "frames": torch.tensor([[rows[frame] for frame in frames] for frames in numbers]),
        }
        with atomic_path(file, durable=False) as temporary:
            save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, temporary)

    def _read(self, index: int) -> RouteExample:
        """Read a clip from its log."""
        clip, truth = self._dataset.clip(index), self._dataset.truth(index)
        assert truth is not None
        assert truth.affordances is not None
        return RouteExample(clip, truth.affordances, ())


def _without_images(example: RouteExample) -> RouteExample:
    images = example.clip.images[..., :0, :0]
    return dataclasses.replace(example, clip=dataclasses.replace(example.clip, images=images))


def _tensors(record: Record, prefix: str = "") -> dict[str, Tensor]:
    """Return the tensors of a record by dotted names."""
    tensors: dict[str, Tensor] = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if isinstance(value, Tensor):
            tensors[prefix + field.name] = value
        elif isinstance(value, Record):
            tensors |= _tensors(value, f"{prefix}{field.name}.")
    return tensors


def _with_tensors(record: R, tensors: dict[str, Tensor], prefix: str = "") -> R:
    """Return a record with other tensors, by the names of `_tensors`."""
    changed: dict[str, Tensor | Record] = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if isinstance(value, Tensor):
            changed[field.name] = tensors[prefix + field.name]
        elif isinstance(value, Record):
            changed[field.name] = _with_tensors(value, tensors, f"{prefix}{field.name}.")
    return dataclasses.replace(record, **changed)


def _is_whole(file: Path) -> bool:
    try:
        with safe_open(file, "pt"):
            return True
    except (OSError, SafetensorError):
        return False
