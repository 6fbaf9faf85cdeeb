"""Runs of tower training, end to end, on a log of two seconds."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from miniature import write_log
from pydantic import TypeAdapter
from small_towers import SMALL, WORDS, save_clip, save_tokenizer
from transformers import BertConfig, BertModel

from foredrive.data import LogPath
from foredrive.engine.loop import Schedule
from foredrive.engine.metrics_log import read_metrics
from foredrive.errors import InputError
from foredrive.methods.blocks.text_encoder import TextEncoder
from foredrive.methods.lidarclip import LidarEncoderConfig
from foredrive.methods.lidarclip.alignment import is_true
from foredrive.methods.lidarclip.image_tower import ImageTowerConfig
from foredrive.runs.search.sector_views import gather_views
from foredrive.runs.search.tower_data import (
    CaptionedViews,
    ImagedViews,
    collate_captioned,
    collate_imaged,
    image_targets,
    text_targets,
)
from foredrive.runs.search.tower_training import TowerRecipe, tower_recipe, train_towers
from foredrive.runs.search.towers import SHIPPED, find_towers
from foredrive.search.crops import Crop
from foredrive.search.embedded import CARD, LidarTowers, SentenceTowers, load_towers


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return write_log(tmp_path_factory.mktemp("towers"), frames=21)


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> TowerRecipe:
    """Steps of some hundredths of a second."""
    folder = tmp_path_factory.mktemp("text") / "bert"
    save_tokenizer(folder)
    torch.manual_seed(0)
    BertModel(BertConfig(vocab_size=len(WORDS), **SMALL)).save_pretrained(folder)
    return small_recipe(str(folder))


def small_recipe(text: str) -> TowerRecipe:
    return TowerRecipe(
        contrast=Schedule(batch_size=4, lr=1e-3, steps=3),
        distil=Schedule(batch_size=4, lr=1e-3, steps=3),
        image=ImageTowerConfig(widths=(8, 8), depths=(1, 1), heads=2, side_px=24),
        lidar=LidarEncoderConfig(width=16, heads=2, hidden=16, blocks=2),
        stride_s=0.5,
        texts=3,
        text=text,
    )


def test_a_run_trains_both_towers_and_is_not_begun_again(
    recipe: TowerRecipe, log: LogPath, tmp_path: Path
) -> None:
    folder = train_towers(recipe, [log], tmp_path / "run")
    towers = find_towers(str(folder))
    assert (towers.dim, towers.has_lidar) == (16, True)
    assert [
        len(read_metrics(tmp_path / "run" / stage / "metrics.jsonl")) for stage in ("image", "lidar")
    ] == [3, 3]
    card = json.loads((folder / "towers.json").read_text())
    assert card["trained"]["logs"] == [log.name]
    assert card["trained"]["recipe"]["contrast"]["steps"] == 3
    written = {file: file.stat().st_mtime_ns for file in folder.iterdir()}
    assert train_towers(recipe, [log], tmp_path / "run") == folder
    assert {file: file.stat().st_mtime_ns for file in folder.iterdir()} == written
    base = load_towers(tmp_path / "run" / "image" / "towers")
    assert isinstance(base, SentenceTowers)
    assert towers.fingerprint.startswith(base.fingerprint)
    other = dataclasses.replace(recipe, loss="cosine")
    with pytest.raises(InputError, match="holds a run with another recipe"):
        train_towers(other, [log], tmp_path / "run")

    another = dataclasses.replace(recipe, distil=dataclasses.replace(recipe.distil, seed=1))
    beside = train_towers(another, [log], tmp_path / "beside", tmp_path / "cache", beside=str(folder))
    found = load_towers(beside)
    assert found.fingerprint.startswith(base.fingerprint)
    assert found.fingerprint != towers.fingerprint
    torch.testing.assert_close(found.embed_text(["a car"]), towers.embed_text(["a car"]), rtol=0, atol=0)


def test_a_lidar_tower_beside_clip_needs_nothing_that_could_be_said(
    recipe: TowerRecipe, log: LogPath, tmp_path: Path
) -> None:
    views = gather_views([log], recipe.stride_s, 16, Crop.WHOLE, tmp_path)

    class Wordless:
        """The image tower of a CLIP, and nothing else."""

        name, fingerprint, dim, image_side_px = "wordless", "0", 4, 16
        crop, has_lidar = Crop.WHOLE, False

        def embed_images(self, images: torch.Tensor) -> torch.Tensor:
            return images.float().flatten(1)[:, :4]

        def embed_sweeps(self, sweeps: object) -> None:
            raise AssertionError

        def embed_text(self, texts: object) -> torch.Tensor:
            raise AssertionError("no text is asked for")

    targets = image_targets(views, Wordless(), tmp_path)
    item = ImagedViews(views, targets)[1]
    image = views[0].image(1)
    torch.testing.assert_close(item.targets[0], image.float().flatten()[:4])
    torch.testing.assert_close(item.targets[1], image.flip(-1).float().flatten()[:4])
    again = image_targets(views, Wordless(), tmp_path)
    torch.testing.assert_close(again, targets, rtol=0, atol=0)

    clip = save_clip(tmp_path / "clip")
    towers = find_towers(str(train_towers(recipe, [log], tmp_path / "run", tmp_path, beside=str(clip))))
    assert (towers.dim, towers.has_lidar) == (find_towers(str(clip)).dim, True)
    assert not (tmp_path / "run" / "image").exists()


def test_recipes_that_were_stored_before_open_unchanged() -> None:
    told = json.loads((SHIPPED / CARD).read_text())["trained"]["recipe"]
    assert "block_layers" not in told["lidar"]
    assert "one_cycle" not in told["distil"]
    read = TypeAdapter(TowerRecipe).validate_python(told)
    assert read == tower_recipe("tiny", image_steps=2400, lidar_steps=900)


def test_a_lidar_tower_of_full_depth_beside_clip(log: LogPath, tmp_path: Path) -> None:
    recipe = tower_recipe("base", lidar_steps=2)
    assert recipe.lidar.blocks * recipe.lidar.block_layers == 8  # four blocks of two layers, as in SST
    recipe = dataclasses.replace(
        recipe,
        distil=dataclasses.replace(recipe.distil, batch_size=2),
        lidar=dataclasses.replace(recipe.lidar, width=16, heads=2, hidden=16),
        stride_s=1.0,
    )
    towers = train_towers(recipe, [log], tmp_path / "run", beside=str(save_clip(tmp_path / "clip")))
    loaded = find_towers(str(towers))
    assert isinstance(loaded, LidarTowers)
    assert len(loaded.encoder.attention.blocks) == 8
    assert loaded.crop is Crop.MIDDLE_SQUARE


def test_views_are_read_once_and_hold_what_their_sector_does(
    recipe: TowerRecipe, log: LogPath, tmp_path: Path
) -> None:
    (views,) = gather_views([log], 0.5, 24, Crop.WHOLE, tmp_path)
    assert len(views) == 5 * 2  # five moments, two cameras
    assert {row.view for row in views.rows} == {row.view for row in views.rows[:2]}
    for row in range(2):
        points = views.points(row)
        assert len(points) > 0
        ahead = torch.atan2(points[:, 1], points[:, 0]).abs()  # x points along the sector's middle
        assert float(ahead.max()) < 1.0
        assert views.image(row).shape[0] == 3
    (again,) = gather_views([log], 0.5, 24, Crop.WHOLE, tmp_path)
    assert again.rows == views.rows
    (rows_file,) = tmp_path.glob("views/*/rows.json")
    rows_file.write_text("{")
    with pytest.raises(InputError, match="cannot be read"):
        gather_views([log], 0.5, 24, Crop.WHOLE, tmp_path)


def test_texts_are_embedded_once(recipe: TowerRecipe, tmp_path: Path) -> None:
    texts = ["a car", "rain", "a car in the rain"]
    found = text_targets(texts, recipe.text, tmp_path)
    torch.testing.assert_close(found, TextEncoder(recipe.text)(texts))
    (file,) = tmp_path.iterdir()
    written = file.stat().st_mtime_ns
    assert torch.equal(text_targets(texts, recipe.text, tmp_path), found)
    assert file.stat().st_mtime_ns == written
    assert len(text_targets(texts[:2], recipe.text, tmp_path)) == 2


def test_every_text_of_a_view_is_true_of_it(recipe: TowerRecipe, log: LogPath, tmp_path: Path) -> None:
    views = gather_views([log], 0.5, 24, Crop.WHOLE, tmp_path)
    dataset = CaptionedViews(views, TextEncoder(recipe.text), 3)
    batch = collate_captioned([dataset[n] for n in range(len(dataset))])
    assert batch.texts.shape == (len(dataset), 3, 16)
    for text in range(3):
        assert is_true(batch.stated[:, text], batch.holds).diagonal().all()
    torch.testing.assert_close(batch.texts.mean((0, 1)), torch.zeros(16), atol=1e-5, rtol=0)


def test_sweeps_of_a_batch_stay_apart(log: LogPath, tmp_path: Path) -> None:
    views = gather_views([log], 0.5, 24, Crop.WHOLE, tmp_path)
    dataset = ImagedViews(views, torch.zeros(len(views[0]), 2, 4))
    batch = collate_imaged([dataset[n] for n in (0, 3)])
    for item, row in enumerate((0, 3)):
        torch.testing.assert_close(batch.cloud.points[batch.cloud.item == item], views[0].points(row))
    assert batch.key == (views[0].rows[0].name, views[0].rows[3].name)
