"""`foredrive search` from logs to lists of clips, and what it says where it cannot go on."""

import json
import os
import shlex
import shutil
from pathlib import Path

import pytest
from miniature import write_log
from PIL import Image
from small_towers import save_clip

from foredrive.cli.main import main
from foredrive.data import find_logs


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An index of one log."""
    root = tmp_path_factory.mktemp("search")
    save_clip(root / "clip")
    log = write_log(root, frames=11)
    line = f"search index {log.folder} --index {root / 'index'} --towers {root / 'clip'} --workers 1"
    assert main(shlex.split(line)) == 0
    return root


def test_a_text_finds_pictures_and_clips(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    index = ["--index", str(root / "index"), "--gap", "0.4"]
    kept = ["--out", str(tmp_path / "hits.png"), "--clips", str(tmp_path / "clips.json"), "--tag", "few"]
    assert main(["search", "a car at night", *index, "--top", "2", "--save", "cars", *kept]) == 0
    assert "2 hits among 9 rows" in capsys.readouterr().out
    with Image.open(tmp_path / "hits.png") as sheet:
        assert sheet.width > 1000
    assert find_logs(tmp_path / "clips.json")[0].parts_s
    assert main(["search", "--tagged", "few", *index]) == 0
    assert "2 hits" in capsys.readouterr().out
    page = tmp_path / "hits.html"
    assert main(["search", "--saved", "cars", *index, "--out", str(page)]) == 0
    assert page.read_text().count("<figure>") == 2
    assert main(["search", "--untag", "few", *index]) == 0
    assert main(["search", "--tagged", "few", *index]) == 0
    assert "nothing found among 9 rows" in capsys.readouterr().out


def test_lidar_and_images_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, index, out = write_log(tmp_path, frames=11), tmp_path / "index", tmp_path / "shares.json"
    assert main(shlex.split(f"search index {log.folder} --index {index} --workers 1")) == 0
    assert main(shlex.split(f"search evaluate --index {index} --moments 2 --out {out}")) == 0
    shares = json.loads(out.read_text())
    assert shares["frames.recall_at_5.lidar_to_image"] == {"value": 1.0, "low": None, "high": None}
    assert 0 <= shares["views.recall_at_1.image_to_lidar"]["value"] <= 1
    assert "frames: recall at 5" in capsys.readouterr().out
    assert main(shlex.split(f"search evaluate --index {index} --moments -1")) == 2
    capsys.readouterr()
    for asked in ("'a car'", "--like flat@0.5s"):
        assert main(shlex.split(f"search {asked} --index {index} --gap 0.4")) == 0
        assert "the towers never saw data of flat: they learned from town\n" in capsys.readouterr().out
    assert main(shlex.split(f"search --where 'ego_speed >= 0' --index {index}")) == 0
    assert "never saw" not in capsys.readouterr().out  # nothing is compared


def test_a_folder_that_cannot_be_written_is_one_line(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = f"search index {find_logs(root)[0].folder} --towers {root / 'clip'} --workers 1 --index /sys/index"
    assert main(shlex.split(line)) == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert told in [
        f"foredrive: /sys/index: {why}" for why in ("permission denied", "nothing can be written there")
    ]


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_an_index_that_may_only_be_read_is_one_line(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    index = shutil.copytree(root / "index", tmp_path / "index")
    for path in (index, *index.rglob("*")):
        path.chmod(path.stat().st_mode & ~0o222)
    assert main(["search", "rain", "--index", str(index)]) == 0
    assert main(["search", "rain", "--index", str(index), "--tag", "wet"]) == 2
    assert capsys.readouterr().err == f"foredrive: {index}: permission denied\n"


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ("", "an empty query"),
        ("''", "an empty text"),
        ("rain --where 'speed >>'", "the condition 'speed >>' cannot be understood"),
        ("rain --modality lidar", "no lidar embeddings"),
        ("--like flat@99s", "has nothing at 99 s"),
        ("--like nowhere@1s", "no log of this name"),
        ("--like flat@0.5s/roof", "no view roof; there are ahead, left"),
        ("--like flat@0.5s/left:0,0,500,500", "outside the image of 96 x 48 px"),
        ("--saved unknown", "no saved query unknown"),
        ("rain --view roof", "no view roof; there are any, sectors, ahead, all, left"),
        ("rain --out hits.jpg", "a contact sheet ends on .png or .html"),
        ("rain --index nowhere", "nowhere: no index here"),
    ],
)
def test_what_cannot_be_found_is_one_line(
    root: Path, asked: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    where = [] if "--index" in asked else ["--index", str(root / "index")]
    assert main(["search", *shlex.split(asked), *where]) == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert told.startswith("foredrive: ")
    assert why in told
