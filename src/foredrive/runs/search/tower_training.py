"""Train towers: an image tower on sentences, then a lidar tower on the image tower's embeddings."""

import functools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from pydantic import TypeAdapter

from foredrive.data import LogPath
from foredrive.engine.folder import RECIPE, RunFolder
from foredrive.engine.loop import Schedule, train
from foredrive.engine.one_cycle import OneCycle
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.methods.blocks.text_encoder import PACKAGED_MODEL
from foredrive.methods.lidarclip import LidarEncoder, LidarEncoderConfig
from foredrive.methods.lidarclip.alignment import ContrastConfig, ContrastObjective, DistillationObjective
from foredrive.methods.lidarclip.image_tower import ImageTower, ImageTowerConfig
from foredrive.runs.search.sector_views import LogViews, gather_views
from foredrive.runs.search.tower_data import (
    CaptionedViews,
    ImagedViews,
    collate_captioned,
    collate_imaged,
    image_targets,
    text_targets,
)
from foredrive.runs.search.towers import find_towers
from foredrive.search.embedded import LidarTowers, SentenceTowers, TowerCard, load_towers, save_towers
from foredrive.search.towers import Towers

if TYPE_CHECKING:
    from lightning_fabric import Fabric

IMAGE_STAGE, LIDAR_STAGE = "image", "lidar"
TOWERS = "towers"


@dataclass(frozen=True)
class TowerRecipe:
    """The settings of a training of towers."""

    contrast: Schedule
    distil: Schedule
    image: ImageTowerConfig
    lidar: LidarEncoderConfig
    stride_s: float = 0.2
    """Time between the moments of a log that are used, s."""
    texts: int = 16
    """Number of true texts of each view; a training step uses one of them."""
    loss: Literal["mse", "cosine"] = "mse"
    """Loss of the lidar tower."""
    text: str = PACKAGED_MODEL
    """Name of the sentence encoder, as for `TextEncoder`."""
    alignment: ContrastConfig = field(default_factory=ContrastConfig)
    """Temperatures and cropping of the image tower's training."""


def tower_recipe(
    size: Literal["tiny", "base"] = "tiny",
    loss: Literal["mse", "cosine"] = "mse",
    image_steps: int | None = None,
    lidar_steps: int | None = None,
    seed: int = 0,
) -> TowerRecipe:
    """Return the recipe of towers.

    Args:
        size: size of the lidar tower and length of its training. "tiny" is that of the shipped towers, for
            processors. "base" is LidarCLIP's (Hess et al. 2024), for a GPU: SST at its full depth, Adam with
            the 1cycle policy, batches of 128, one epoch. The image tower is the same in both.
        image_steps, lidar_steps: training steps in place of epochs.
    """
    contrast = Schedule(batch_size=64, lr=1e-3, epochs=20, weight_decay=0.05, warmup_steps=100, seed=seed)
    if size == "tiny":
        distil = Schedule(batch_size=32, lr=1e-3, epochs=10, weight_decay=0.05, warmup_steps=100, seed=seed)
    else:
        cycle = OneCycle()
        distil = Schedule(batch_size=128, lr=1e-3, epochs=1, weight_decay=0.0, seed=seed, one_cycle=cycle)
    return TowerRecipe(
        contrast=_with_steps(contrast, image_steps),
        distil=_with_steps(distil, lidar_steps),
        image=ImageTowerConfig(widths=(32, 64, 128, 256), depths=(2, 2, 2, 2), heads=8, side_px=128),
        lidar=LidarEncoderConfig(block_layers=1 if size == "tiny" else 2),
        loss=loss,
    )


def _with_steps(schedule: Schedule, steps: int | None) -> Schedule:
    if steps is None:
        return schedule
    return replace(schedule, steps=steps, epochs=None, warmup_steps=min(schedule.warmup_steps, steps // 10))


def train_towers(
    recipe: TowerRecipe,
    logs: Sequence[LogPath],
    folder: Path,
    cache_dir: Path | None = None,
    beside: str | None = None,
) -> Path:
    """Train towers, or continue where an earlier call with the same arguments stopped.

    Args:
        folder: folder of the run.
        cache_dir: folder for images and points of views; by default in `folder`.
        beside: name of towers, as for `find_towers`. Only a lidar tower is trained then, on the embeddings of
            their image tower. By default an image tower is trained first, on the recipe's sentence encoder.

    Returns:
        The folder of the towers.

    Raises:
        InputError: `folder` holds another run, or another process writes to it; the logs cannot be read or
            have no known facts.
    """
    from foredrive.engine.fabric import make_fabric  # the import takes seconds

    with _folder_of(folder, recipe, logs, beside).claimed():
        cache_dir, fabric = cache_dir or folder / "cache", make_fabric("32-true")
        if beside is None:
            views = gather_views(logs, recipe.stride_s, recipe.image.side_px, SentenceTowers.crop, cache_dir)
            base: Towers = _train_image(recipe, views, folder, fabric)
        else:
            base = find_towers(beside)
            base = base.base if isinstance(base, LidarTowers) else base
            views = gather_views(logs, recipe.stride_s, base.image_side_px, base.crop, cache_dir)
        return _train_lidar(recipe, views, folder, fabric, base)


def _train_image(recipe: TowerRecipe, views: list[LogViews], folder: Path, fabric: "Fabric") -> Towers:
    """Train the image tower and save it as towers without lidar, from which the lidar tower is trained."""
    stage = folder / IMAGE_STAGE
    if not (stage / TOWERS).is_dir():
        embed = functools.partial(text_targets, model=recipe.text, folder=stage)
        dataset = CaptionedViews(views, embed, recipe.texts)
        torch.manual_seed(recipe.contrast.seed)
        tower = ImageTower(recipe.image, dim=len(dataset.text_mean))
        objective = ContrastObjective(tower, recipe.alignment)
        train(objective, dataset, collate_captioned, recipe.contrast, stage, fabric)
        card = TowerCard(
            dim=len(dataset.text_mean),
            text=recipe.text,
            image=recipe.image,
            base_fingerprint="",
            lidar=None,
            trained=_described(recipe, views),
        )
        save_towers(stage / TOWERS, card, (tower, dataset.text_mean), None)
    return load_towers(stage / TOWERS)


def _train_lidar(
    recipe: TowerRecipe,
    views: list[LogViews],
    folder: Path,
    fabric: "Fabric",
    base: Towers,
) -> Path:
    """Train the lidar tower from points and image embeddings; it uses no texts."""
    final = folder / TOWERS
    if not final.is_dir():
        dataset = ImagedViews(views, image_targets(views, base, folder / LIDAR_STAGE))
        torch.manual_seed(recipe.distil.seed)
        encoder = LidarEncoder(recipe.lidar, dim=base.dim)
        objective = DistillationObjective(encoder, recipe.loss)
        train(objective, dataset, collate_imaged, recipe.distil, folder / LIDAR_STAGE, fabric)
        sentences = base if isinstance(base, SentenceTowers) else None
        card = TowerCard(
            dim=base.dim,
            text=base.name if sentences is None else sentences.text,
            image=None if sentences is None else sentences.size,
            base_fingerprint=base.fingerprint,
            lidar=recipe.lidar,
            trained=_described(recipe, views),
        )
        image = None if sentences is None else (sentences.tower, sentences.text_mean)
        save_towers(final, card, image, encoder)
    return final


def _described(recipe: TowerRecipe, views: Sequence[LogViews]) -> dict[str, object]:
    """Return the description of the training for the card: the recipe, the logs and the number of views."""
    logs = sorted({row.log for log in views for row in log.rows})
    return {"recipe": asdict(recipe), "logs": logs, "views": sum(map(len, views))}


def _folder_of(folder: Path, recipe: TowerRecipe, logs: Sequence[LogPath], beside: str | None) -> RunFolder:
    file = folder / RECIPE
    wanted = {"recipe": recipe, "logs": [str(log.folder) for log in logs], "beside": beside}

    def named(values: dict[str, object]) -> dict[str, object]:
        return {f"a run with another {what}": values.get(what) for what in wanted}

    def read() -> dict[str, object] | None:
        if not file.is_file():
            return None
        try:
            stored = json.loads(file.read_text())
            return named({**stored, "recipe": TypeAdapter(TowerRecipe).validate_python(stored["recipe"])})
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise InputError(f"{file}: cannot be read: {error}") from error

    def write() -> None:
        with atomic_path(file) as temporary:
            temporary.write_text(json.dumps({**wanted, "recipe": asdict(recipe)}, indent=1))

    return RunFolder(folder, named(wanted), read, write)
