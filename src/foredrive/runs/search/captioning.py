"""Captions from embeddings: a decoder for towers, trained on image embeddings and also used on sweeps."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch.utils.data import Dataset

from foredrive.data import LogPath
from foredrive.data.batches import stack_records
from foredrive.engine.loop import Schedule, train
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.methods.lidarclip.caption_decoder import PAD, CaptionDecoder
from foredrive.methods.lidarclip.captioning import CaptionedEmbeddings, CaptionObjective
from foredrive.runs.search.sector_views import gather_views
from foredrive.runs.search.tower_data import image_targets
from foredrive.runs.search.towers import find_towers
from foredrive.search.embedding import View, embed_views
from foredrive.search.phrases import whole_caption
from foredrive.search.towers import Towers, unit

CAPTIONS = "captions.safetensors"
"""File of the decoder, in the folder of the towers whose embeddings it reads."""
_TOLD = "foredrive"


class _CaptionedViews(Dataset[CaptionedEmbeddings]):
    """Views with known facts, held in memory."""

    def __init__(self, items: Sequence[CaptionedEmbeddings]) -> None:
        self._items = items

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: int) -> CaptionedEmbeddings:
        return self._items[index]


def train_captions(
    logs: Sequence[LogPath], towers_folder: Path, folder: Path, schedule: Schedule, stride_s: float = 0.5
) -> Path:
    """Train a caption decoder for towers, or continue an interrupted run, and save it in the towers' folder.

    Args:
        towers_folder: folder of towers that `train_towers` made.
        folder: folder of the run.

    Returns:
        The decoder's file.

    Raises:
        InputError: the logs cannot be read, or no view has known facts.
    """
    from foredrive.engine.fabric import make_fabric  # the import takes seconds

    towers = find_towers(str(towers_folder))
    views = gather_views(logs, stride_s, towers.image_side_px, towers.crop, folder / "cache")
    targets = unit(image_targets(views, towers, folder))
    rows = [row for log in views for row in log.rows]
    whole = [whole_caption(row.facts) for row in rows]
    captioned = [n for n, caption in enumerate(whole) if caption is not None]
    if not captioned:
        raise InputError("no view of these logs has annotated boxes or a recorded setting")
    captions = {n: str(whole[n]) for n in captioned}
    words = sorted({word for caption in captions.values() for word in caption.split()})
    longest = 1 + max(len(caption.split()) for caption in captions.values())
    torch.manual_seed(schedule.seed)
    decoder = CaptionDecoder(towers.dim, words, longest)
    items = []
    for n in captioned:
        numbers = decoder.numbers(captions[n])
        padded = torch.tensor(numbers + [PAD] * (longest - len(numbers)))
        items.append(CaptionedEmbeddings(targets[n], padded, (rows[n].name,)))
    train(
        CaptionObjective(decoder), _CaptionedViews(items), _collate, schedule, folder, make_fabric("32-true")
    )
    file = towers_folder / CAPTIONS
    card = {"words": words, "longest": longest, "fingerprint": towers.fingerprint, "views": len(captioned)}
    with atomic_path(file) as temporary:
        state = {name: value.half().contiguous() for name, value in decoder.state_dict().items()}
        save_file(state, temporary, metadata={_TOLD: json.dumps(card)})
    return file


def load_captions(file: Path, towers: Towers) -> CaptionDecoder:
    """Load the decoder in the towers' folder.

    Raises:
        InputError: there is none, it is damaged, or it was trained for other towers.
    """
    if not file.is_file():
        raise InputError(f"{file}: no captions were trained for these towers; search train-captions does")
    try:
        with safe_open(file, framework="pt") as opened:
            card = json.loads(opened.metadata()[_TOLD])
        decoder = CaptionDecoder(towers.dim, card["words"], card["longest"])
        if card["fingerprint"] == towers.fingerprint:
            decoder.load_state_dict(load_file(file))
    except (OSError, SafetensorError, LookupError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{file}: not a decoder of captions: {str(error).splitlines()[0]}") from error
    if card["fingerprint"] != towers.fingerprint:
        raise InputError(f"{file}: made for towers {card['fingerprint']}, not {towers.fingerprint}")
    return decoder.eval()


class Captioned(NamedTuple):
    """The captions of a view; None where the view has no image, or no lidar return."""

    by_image: str | None
    by_lidar: str | None


def caption_views(views: dict[str, View], towers: Towers, decoder: CaptionDecoder) -> dict[str, Captioned]:
    """Caption each view, once from its image and once from its lidar returns."""
    captions = {}
    for name, view in views.items():
        pair = torch.from_numpy(embed_views(towers, [view])[0])
        said = [decoder.say(vector[None])[0] if vector.isfinite().all() else None for vector in pair]
        captions[name] = Captioned(*said)
    return captions


def _collate(items: Sequence[CaptionedEmbeddings]) -> CaptionedEmbeddings:
    keys = tuple(key for item in items for key in item.key)
    return replace(stack_records([replace(item, key=()) for item in items]), key=keys)
