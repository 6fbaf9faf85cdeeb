"""Views of logs for training towers: images, returns and facts of sectors, read once and cached on disk."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int, UInt8
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from foredrive.data.batches import stack_records
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.methods.lidarclip import PointCloud
from foredrive.runs.search.indexing import log_digest, moments
from foredrive.search.crops import Crop
from foredrive.search.embedding import View, read_views
from foredrive.search.facts import Thing, ViewFacts, view_facts

ROWS, TENSORS = "rows.json", "views.safetensors"
VIEWS_VERSION = 2
"""Part of the hash in each folder's name: raise it when the views change."""


class ViewRow(NamedTuple):
    """One view of one moment."""

    log: str
    frame: int
    view: str
    facts: ViewFacts

    @property
    def name(self) -> str:
        """Return the name of the view for error messages."""
        return f"{self.log}@{self.frame}/{self.view}"


class LogViews:
    """The views with an image of one log, stored in a folder; each view is read when it is needed."""

    def __init__(self, folder: Path) -> None:
        try:
            facts = json.loads((folder / ROWS).read_text())
            with safe_open(folder / TENSORS, framework="pt"):
                pass
        except (OSError, SafetensorError, ValueError) as error:
            raise InputError(f"{folder}: views cannot be read ({error}); delete it") from error
        self.name, self._file = folder.name, folder / TENSORS
        self.rows = [_row_of(*entry["row"]) for entry in facts]
        self._place = [(entry["row"][2], entry["at"], entry["points"]) for entry in facts]

    def __len__(self) -> int:
        return len(self.rows)

    def image(self, row: int) -> UInt8[Tensor, "3 H W"]:
        """Return the image of a view."""
        view, corner, _ = self._place[row]
        with safe_open(self._file, framework="pt") as opened:
            return opened.get_slice(f"image.{view}")[corner]

    def points(self, row: int) -> Float[Tensor, "P 4"]:
        """Return x, y, z and intensity of a view's returns."""
        first, last = self._place[row][2]
        with safe_open(self._file, framework="pt") as opened:
            return opened.get_slice("points")[first:last]

    def images_by_view(self) -> Iterator[tuple[Int[Tensor, "f"], UInt8[Tensor, "f 3 H W"]]]:
        """Yield for each camera the row numbers and all its images."""
        for view in {view for view, _, _ in self._place}:
            rows = [row for row, place in enumerate(self._place) if place[0] == view]
            with safe_open(self._file, framework="pt") as opened:
                images = opened.get_tensor(f"image.{view}")
            yield torch.tensor(rows), images[[self._place[row][1] for row in rows]]


def gather_views(
    logs: Sequence[LogPath], stride_s: float, side_px: int, crop: Crop, cache_dir: Path
) -> list[LogViews]:
    """Return the views of each log; read them from the log only if they are not in the cache.

    Raises:
        InputError: a log cannot be read, or has no view with an image.
    """
    views = []
    for path in logs:
        asked = f"{VIEWS_VERSION} {path} {log_digest(path)} {stride_s} {side_px} {crop}"
        folder = cache_dir / "views" / hashlib.sha256(asked.encode()).hexdigest()[:24]
        if not folder.is_dir():
            _write_views(Log(path), stride_s, side_px, crop, folder)
        views.append(LogViews(folder))
    return views


def _write_views(log: Log, stride_s: float, side_px: int, crop: Crop, folder: Path) -> None:
    rows: list[dict[str, object]] = []
    images: dict[str, list[Tensor]] = {}
    points, count = [torch.zeros(0, 4)], 0
    for frame in moments(log, stride_s):
        views = read_views(log, frame, side_px, crop, with_lidar=True)
        facts = view_facts(log, frame, {name: view.sector for name, view in views.items()})
        for name, view in views.items():
            if view.image is None:
                continue
            mine, cloud = images.setdefault(name, []), _points(view)
            row = ViewRow(log.path.name, frame, name, facts[name])
            rows.append({"row": row, "at": len(mine), "points": (count, count + len(cloud))})
            mine.append(view.image)
            points.append(cloud)
            count += len(cloud)
    if not rows:
        raise InputError(f"{log.path.folder}: no camera images, and towers learn from images")
    tensors = {f"image.{name}": torch.stack(those) for name, those in images.items()}
    with atomic_path(folder) as temporary:
        temporary.mkdir()
        save_file({**tensors, "points": torch.cat(points)}, temporary / TENSORS)
        (temporary / ROWS).write_text(json.dumps(rows))


def _points(view: View) -> Float[Tensor, "P 4"]:
    if view.sweep is None:
        return torch.zeros(0, 4)
    return PointCloud.from_sweeps(stack_records([view.sweep])).points


def _row_of(log: str, frame: int, view: str, facts: Sequence[Any]) -> ViewRow:
    """Return a row from its JSON form."""
    time_of_day, weather, place, things = facts
    seen = None if things is None else tuple(Thing(noun, tuple(manners)) for noun, manners in things)
    return ViewRow(log, frame, view, ViewFacts(time_of_day, weather, place, seen))
