"""The towers that come with the package: whole, small, and good for something in a town they never saw."""

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.common.tower_quality import embed_all
from foredrive.cli.main import main
from foredrive.data import LogPath
from foredrive.data.logs import Log
from foredrive.runs.drive.recording import record_plan
from foredrive.runs.search.captioning import CAPTIONS, caption_views, load_captions
from foredrive.runs.search.searching import ask
from foredrive.runs.search.sector_views import gather_views
from foredrive.runs.search.towers import EMBEDDED, SHIPPED, find_towers
from foredrive.search.crops import Crop
from foredrive.search.embedding import read_views
from foredrive.search.index import FrameIndex
from foredrive.search.query import Query
from foredrive.search.zero_shot import class_vectors, classify
from foredrive.sensors.rigs import SURROUND
from foredrive.towns.campaign import DrivePlan

MOST_BYTES = 10_000_000
LIGHTS = {"clear": ("by day in clear weather", "on a sunny day"), "night": ("at night", "in the dark")}


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, LogPath]:
    """A moment of the held-out town, by day and by night."""
    out = tmp_path_factory.mktemp("held_out")
    return {
        light: record_plan(DrivePlan("Town05", 77, light, 20, 10, 0.5, 2.0), out, SURROUND)
        for light in LIGHTS
    }


def test_they_are_small_enough_to_come_along() -> None:
    files = {file.name: file.stat().st_size for file in SHIPPED.iterdir()}
    assert set(files) == {"towers.json", "image.safetensors", "lidar.safetensors", "captions.safetensors"}
    assert sum(files.values()) < MOST_BYTES


def test_they_look_at_the_whole_image() -> None:
    towers = find_towers(EMBEDDED)
    assert towers.crop is Crop.WHOLE
    images = torch.randint(0, 256, (1, 3, 128, 228), dtype=torch.uint8)
    for columns in (slice(0, 8), slice(-8, None)):
        changed = images.clone()
        changed[..., columns] = 255 - changed[..., columns]
        assert float((towers.embed_images(changed) - towers.embed_images(images)).norm()) > 0.01


@pytest.mark.slow
def test_they_tell_night_from_day(drives: dict[str, LogPath], tmp_path: Path) -> None:
    towers = find_towers(EMBEDDED)
    views = gather_views(list(drives.values()), 0.5, towers.image_side_px, towers.crop, tmp_path)
    named = classify(torch.from_numpy(embed_all(views, towers)["image"]), class_vectors(towers, LIGHTS))
    true = np.repeat(range(len(LIGHTS)), 6)
    assert (named.numpy() == true).mean() >= 0.9


@pytest.mark.slow
def test_searching_works_with_nothing_else(
    drives: dict[str, LogPath], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    index = str(tmp_path / "index")
    logs = [str(log.folder) for log in drives.values()]
    assert main(["search", "index", *logs, "--index", index, "--workers", "1"]) == 0
    for modality in ("image", "joint"):
        hits = ask(FrameIndex(index), Query(text="at night", modality=modality, view="sectors")).hits
        assert "night" in hits[0].row.log
    assert main(["search", "a car close by", "--modality", "lidar", "--index", index]) == 0


@pytest.mark.slow
def test_nothing_resembles_what_they_do_not_know(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = record_plan(DrivePlan("Town05", 77, "clear", 20, 10, 8.0, 2.0), tmp_path, SURROUND)
    index = str(tmp_path / "index")
    assert main(["search", "index", str(log.folder), "--index", index, "--workers", "1"]) == 0
    opened = FrameIndex(index)
    for modality in ("image", "lidar", "joint"):
        for text, unlike in (("a bus at a junction", False), ("an elephant", True), ("a beach", True)):
            assert ask(opened, Query(text=text, modality=modality)).unlike is unlike
    capsys.readouterr()
    assert main(["search", "snow", "--index", index, "--top", "3", "--gap", "1"]) == 0
    said = capsys.readouterr().out
    assert "nothing in the index resembles the text" in said
    assert "3 moments, no hits, among" in said
    assert "never saw" not in said


@pytest.mark.slow
def test_they_say_whether_it_is_night(drives: dict[str, LogPath]) -> None:
    towers = find_towers(EMBEDDED)
    decoder = load_captions(SHIPPED / CAPTIONS, towers)
    for light, log in drives.items():
        said = caption_views(
            read_views(Log(log), 0, towers.image_side_px, towers.crop, with_lidar=True), towers, decoder
        )
        assert len(said) == 6
        at_night = ["at night" in str(each.by_image) for each in said.values()]
        assert sum(at_night) >= 5 if light == "night" else sum(at_night) <= 1
        assert all(each.by_lidar for each in said.values())
