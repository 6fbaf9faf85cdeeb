"""Towers that were trained here: kept as a folder, half as precise, and asked through the protocol."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from small_towers import SMALL, WORDS, save_tokenizer
from transformers import BertConfig, BertModel

from foredrive.data import LogPath
from foredrive.data.batches import stack_records
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.methods.lidarclip import LidarEncoder, LidarEncoderConfig
from foredrive.methods.lidarclip.image_tower import ImageTower, ImageTowerConfig
from foredrive.runs.search.towers import find_towers
from foredrive.search.embedded import (
    CARD,
    IMAGE,
    LIDAR,
    TowerCard,
    dataset_of,
    load_towers,
    save_towers,
)
from foredrive.search.embedding import read_views
from foredrive.search.pretrained import PretrainedTowers
from foredrive.search.towers import Towers, unit

IMAGE_SIZE = ImageTowerConfig(widths=(8, 8), depths=(1, 1), heads=2, side_px=24)
LIDAR_SIZE = LidarEncoderConfig(width=16, heads=2, hidden=16, blocks=2)
DIM = 16


@pytest.fixture(scope="module")
def text_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sentence encoder of hardly any width."""
    folder = tmp_path_factory.mktemp("text") / "bert"
    save_tokenizer(folder)
    torch.manual_seed(0)
    BertModel(BertConfig(vocab_size=len(WORDS), **SMALL)).save_pretrained(folder)
    return folder


def save(folder: Path, text: Path, *, lidar: bool = True, seed: int = 0) -> Path:
    torch.manual_seed(seed)
    image = ImageTower(IMAGE_SIZE, dim=DIM)
    card = TowerCard(DIM, str(text), IMAGE_SIZE, "", None, {})
    save_towers(folder, card, (image, torch.full((DIM,), 0.1)), None)
    if lidar:
        base = load_towers(folder)
        card = dataclasses.replace(card, base_fingerprint=base.fingerprint, lidar=LIDAR_SIZE)
        save_towers(folder, card, (image, torch.full((DIM,), 0.1)), LidarEncoder(LIDAR_SIZE, dim=DIM))
    return folder


def test_they_answer_as_the_protocol_asks(text_folder: Path, tmp_path: Path, log: LogPath) -> None:
    towers = find_towers(str(save(tmp_path / "towers", text_folder)))
    assert isinstance(towers, Towers)
    assert (towers.dim, towers.has_lidar, towers.image_side_px) == (DIM, True, 24)
    views = list(read_views(Log(log), 10, towers.image_side_px, towers.crop, with_lidar=True).values())
    images = torch.stack([view.image for view in views if view.image is not None])
    found = towers.embed_images(images)
    assert found.shape == (len(views), DIM)
    torch.testing.assert_close(towers.embed_images(images[1:]), found[1:], atol=1e-5, rtol=1e-4)
    sweeps = [view.sweep for view in views if view.sweep is not None]
    swept = towers.embed_sweeps(stack_records(sweeps))
    assert swept is not None
    for sweep, row in zip(sweeps, swept, strict=True):  # padded to the longest, and alone
        alone = towers.embed_sweeps(stack_records([sweep]))
        torch.testing.assert_close(alone, row[None], atol=1e-5, rtol=1e-4)
    rain, car = towers.embed_text(["rain", "the car"])
    assert float((rain + 0.1).norm()) == pytest.approx(1.0, abs=1e-5)  # the mean of texts has been taken off
    assert float((car + 0.1).norm()) == pytest.approx(1.0, abs=1e-5)


def test_half_precision_turns_vectors_by_next_to_nothing(text_folder: Path, tmp_path: Path) -> None:
    folder = save(tmp_path / "towers", text_folder)
    torch.manual_seed(0)
    exact = ImageTower(IMAGE_SIZE, dim=DIM).eval()
    images = torch.randint(0, 256, (3, 3, 24, 40), dtype=torch.uint8)
    with torch.no_grad():
        cosine = (unit(exact(images)) * unit(load_towers(folder).embed_images(images))).sum(-1)
    assert float(cosine.min()) > 0.9999
    state = sum(p.numel() for p in exact.parameters())
    assert (folder / IMAGE).stat().st_size < 3 * state + 20_000


def test_the_fingerprint_changes_with_either_tower(text_folder: Path, tmp_path: Path) -> None:
    first = load_towers(save(tmp_path / "first", text_folder)).fingerprint
    assert load_towers(save(tmp_path / "again", text_folder)).fingerprint == first
    other = load_towers(save(tmp_path / "other", text_folder, seed=1)).fingerprint
    bare = load_towers(save(tmp_path / "bare", text_folder, lidar=False))
    assert len({first, other, bare.fingerprint}) == 3
    assert first.startswith(bare.fingerprint)
    assert not bare.has_lidar


def test_a_lidar_tower_beside_clip(clip_folder: Path, tmp_path: Path) -> None:
    clip = PretrainedTowers(str(clip_folder))
    card = TowerCard(clip.dim, str(clip_folder), None, clip.fingerprint, LIDAR_SIZE, {})
    save_towers(tmp_path / "towers", card, None, LidarEncoder(LIDAR_SIZE, dim=clip.dim))
    towers = load_towers(tmp_path / "towers")
    images = torch.randint(0, 256, (2, 3, 16, 28), dtype=torch.uint8)
    torch.testing.assert_close(towers.embed_images(images), clip.embed_images(images))
    torch.testing.assert_close(towers.embed_text(["rain"]), clip.embed_text(["rain"]))
    save_towers(
        tmp_path / "towers",
        # as it was when sweeps were not cut to the crop of the image
        dataclasses.replace(card, base_fingerprint=clip.fingerprint.replace("-middle-square", "")),
        None,
        LidarEncoder(LIDAR_SIZE, dim=clip.dim),
    )
    with pytest.raises(InputError, match="another crop of its images; train it again"):
        load_towers(tmp_path / "towers")


def test_what_is_damaged_is_named(text_folder: Path, tmp_path: Path) -> None:
    folder = save(tmp_path / "towers", text_folder)
    with pytest.raises(InputError, match="does not describe towers"):
        load_towers(tmp_path)
    whole = (folder / LIDAR).read_bytes()
    (folder / LIDAR).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=f"{LIDAR}: not the weights of these towers"):
        load_towers(folder)
    (folder / LIDAR).write_bytes(whole)
    card = json.loads((folder / CARD).read_text())
    card["lidar"]["width"] = 32
    (folder / CARD).write_text(json.dumps(card))
    with pytest.raises(InputError, match=f"{LIDAR}: not the weights of these towers"):
        load_towers(folder)
    (folder / CARD).write_text("{}")
    with pytest.raises(InputError, match="does not describe towers"):
        load_towers(folder)


def test_logs_of_one_kind_of_recording_are_of_one_data_set() -> None:
    logs = ("town_train/Town01_seed3", "town-egos_test/Town05_seed0_ego0001", "nuscenes-mini_val/scene-0103")
    assert [dataset_of(log) for log in logs] == ["town", "town", "nuscenes"]
