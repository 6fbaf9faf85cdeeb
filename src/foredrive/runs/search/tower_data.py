"""Training data of towers: images with texts, and sweeps with image embeddings."""

import bisect
import hashlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from rich.progress import track
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.utils.data import Dataset

from foredrive.data.batches import stack_records
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.methods.blocks.text_encoder import TextEncoder
from foredrive.methods.lidarclip import PointCloud
from foredrive.methods.lidarclip.alignment import CaptionedImages, ImagedSweeps
from foredrive.runs.search.sector_views import LogViews, ViewRow
from foredrive.search.phrases import Phrase, phrases
from foredrive.search.towers import Towers

TEXTS_AT_ONCE = 4096


class _ViewsOfLogs:
    """The rows of several logs under one running index."""

    def __init__(self, views: Sequence[LogViews]) -> None:
        self.views = views
        self._ends = list(itertools.accumulate(len(log) for log in views))

    def __len__(self) -> int:
        return self._ends[-1]

    def find(self, index: int) -> tuple[LogViews, int]:
        """Return the log of a row, and the row's index in that log."""
        log = bisect.bisect_right(self._ends, index)
        return self.views[log], index - (self._ends[log - 1] if log else 0)

    def all(self) -> list[ViewRow]:
        """Return all rows."""
        return [row for log in self.views for row in log.rows]


class CaptionedViews(Dataset[CaptionedImages]):
    """Views with T texts each; views without known facts are left out.

    Args:
        embed: maps texts to vectors; it is called once, with all texts.
        texts: T, the number of texts of a view.

    Raises:
        InputError: no view has known facts, or the images differ in size.
    """

    text_mean: Float[Tensor, "D"]
    """Mean of the embeddings of all texts."""

    def __init__(
        self, views: Sequence[LogViews], embed: Callable[[list[str]], Float[Tensor, "N D"]], texts: int
    ) -> None:
        self._rows = _ViewsOfLogs(views)
        captions = [phrases(row.facts, seed, texts) for seed, row in enumerate(self._rows.all())]
        self._known = [index for index, those in enumerate(captions) if those]
        if not self._known:
            raise InputError("no view of these logs has annotated boxes or a recorded setting")
        sizes = {tuple(images.shape[1:]) for log in views for _, images in log.images_by_view()}
        if len(sizes) > 1:
            raise InputError(f"all images must have one size; these logs have {sorted(sizes)}")
        distinct = sorted({phrase.text for those in captions for phrase in those})
        embedded = embed(distinct)
        number = {text: n for n, text in enumerate(distinct)}
        self._text_of = {index: [number[phrase.text] for phrase in captions[index]] for index in self._known}
        used = torch.tensor([n for those in self._text_of.values() for n in those])
        self.text_mean = embedded[used].mean(0)
        self._texts = embedded - self.text_mean
        self._set_facts(captions)

    def _set_facts(self, captions: Sequence[Sequence[Phrase]]) -> None:
        rows = self._rows.all()
        true = [rows[index].facts.facts for index in self._known]
        vocabulary = {fact: n for n, fact in enumerate(sorted(set[str]().union(*true)))}
        self._holds = torch.stack([_several_hot(facts, vocabulary) for facts in true])
        self._stated = torch.stack(
            [
                torch.stack([_several_hot(phrase.facts, vocabulary) for phrase in captions[index]])
                for index in self._known
            ]
        )

    def __len__(self) -> int:
        return len(self._known)

    def __getitem__(self, index: int) -> CaptionedImages:
        log, row = self._rows.find(self._known[index])
        return CaptionedImages(
            images=log.image(row),
            texts=self._texts[self._text_of[self._known[index]]],
            stated=self._stated[index],
            holds=self._holds[index],
            key=(log.rows[row].name,),
        )


class ImagedViews(Dataset[ImagedSweeps]):
    """Sweeps with the image towers' embeddings of the same views, for the image and for its mirror image."""

    def __init__(self, views: Sequence[LogViews], targets: Float[Tensor, "n 2 D"]) -> None:
        self._rows, self._targets = _ViewsOfLogs(views), targets

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> ImagedSweeps:
        log, row = self._rows.find(index)
        points = log.points(row)
        cloud = PointCloud(points, torch.zeros(len(points), dtype=torch.int64))
        return ImagedSweeps(cloud, self._targets[index], (log.rows[row].name,))


def text_targets(texts: Sequence[str], model: str, folder: Path) -> Float[Tensor, "N E"]:
    """Embed texts with a text encoder; cache the result in a folder."""
    key = hashlib.sha256("\n".join([model, *texts]).encode()).hexdigest()[:24]
    file = folder / f"texts-{key}.safetensors"
    if not file.is_file():
        encoder, vectors = TextEncoder(model), []
        for start in track(range(0, len(texts), TEXTS_AT_ONCE), "embedding texts"):
            vectors.append(encoder(texts[start : start + TEXTS_AT_ONCE]))
        with atomic_path(file) as temporary:
            save_file({"texts": torch.cat(vectors)}, temporary)
    return load_file(file)["texts"]


def image_targets(views: Sequence[LogViews], towers: Towers, folder: Path) -> Float[Tensor, "n 2 D"]:
    """Embed every view's image and its mirror image; cache the result in a folder, one file for each log."""
    return torch.cat([_targets_of(log, towers, folder) for log in views])


def _targets_of(log: LogViews, towers: Towers, folder: Path) -> Float[Tensor, "n 2 D"]:
    file = folder / "targets" / f"{log.name}-{towers.fingerprint}.safetensors"
    if file.is_file():
        return load_file(file)["targets"]
    targets = torch.zeros(len(log), 2, towers.dim)
    for rows, images in log.images_by_view():
        targets[rows, 0] = towers.embed_images(images)
        targets[rows, 1] = towers.embed_images(images.flip(-1))
    with atomic_path(file) as temporary:
        save_file({"targets": targets}, temporary)
    return targets


def collate_captioned(items: Sequence[CaptionedImages]) -> CaptionedImages:
    """Return a batch of views."""
    keys = tuple(key for item in items for key in item.key)
    return replace(stack_records([replace(item, key=()) for item in items]), key=keys)


def collate_imaged(items: Sequence[ImagedSweeps]) -> ImagedSweeps:
    """Return a batch of sweeps with their points concatenated."""
    counts = torch.tensor([len(item.cloud.points) for item in items])
    cloud = PointCloud(
        torch.cat([item.cloud.points for item in items]),
        torch.repeat_interleave(torch.arange(len(items)), counts),
    )
    keys = tuple(key for item in items for key in item.key)
    return ImagedSweeps(cloud, torch.stack([item.targets for item in items]), keys)


def _several_hot(facts: frozenset[str], vocabulary: dict[str, int]) -> Bool[Tensor, "V"]:
    out = torch.zeros(len(vocabulary), dtype=torch.bool)
    out[[vocabulary[fact] for fact in facts]] = True
    return out
