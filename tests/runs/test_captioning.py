"""Captions end to end: a decoder beside small towers, asked by image and by lidar."""

from pathlib import Path

import pytest
import torch
from miniature import write_log
from small_towers import save_clip

from foredrive.cli.main import main
from foredrive.data import LogPath
from foredrive.engine.loop import Schedule
from foredrive.errors import InputError
from foredrive.methods.lidarclip import LidarEncoder, LidarEncoderConfig
from foredrive.runs.search.captioning import CAPTIONS, load_captions, train_captions
from foredrive.runs.search.towers import find_towers
from foredrive.search.embedded import TowerCard, save_towers


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return write_log(tmp_path_factory.mktemp("captions"), frames=21)


@pytest.fixture(scope="module")
def towers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lidar tower that learned nothing beside a CLIP that did not either."""
    root = tmp_path_factory.mktemp("towers")
    base = find_towers(str(save_clip(root / "clip")))
    size = LidarEncoderConfig(width=16, heads=2, hidden=16, blocks=1)
    torch.manual_seed(0)
    card = TowerCard(base.dim, str(root / "clip"), None, base.fingerprint, size, {})
    save_towers(root / "both", card, None, LidarEncoder(size, dim=base.dim))
    return root / "both"


def test_views_are_told_by_image_and_by_lidar(
    log: LogPath, towers: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moment = f"{log.folder}@0.5s"
    assert main(["search", "caption", moment, "--towers", str(towers)]) == 2
    assert "no captions were trained for these towers" in capsys.readouterr().err
    file = train_captions([log], towers, tmp_path / "run", Schedule(batch_size=4, lr=1e-2, steps=30))
    assert file == towers / CAPTIONS
    decoder = load_captions(file, find_towers(str(towers)))
    assert "car" in decoder.words or "cars" in decoder.words
    assert main(["search", "caption", moment, "--towers", str(towers)]) == 0
    told = capsys.readouterr().out
    assert "by image" in told
    assert any(word in told for word in decoder.words)
    assert main(["search", "caption", "nowhere@1s", "--towers", str(towers)]) == 2
    assert "nowhere: no folder of a log" in capsys.readouterr().err


def test_a_decoder_reads_the_embeddings_that_it_was_made_for(
    log: LogPath, towers: Path, tmp_path: Path
) -> None:
    file = train_captions([log], towers, tmp_path / "run", Schedule(batch_size=4, lr=1e-2, steps=1))
    chosen = find_towers(str(towers))
    other = find_towers(str(save_clip(tmp_path / "clip")))
    with pytest.raises(InputError, match="made for towers"):
        load_captions(file, other)
    damaged = tmp_path / CAPTIONS
    damaged.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(InputError, match="not a decoder of captions"):
        load_captions(damaged, chosen)
