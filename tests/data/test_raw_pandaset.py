"""Raw PandaSet: whole logs convert, and what its pickles ask for is never run."""

import os
from pathlib import Path

import pytest
import raw_pandaset

from foredrive.data.boxes import read_boxes
from foredrive.data.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.errors import InputError

PICKLES = (raw_pandaset.CUBOIDS, raw_pandaset.SEMSEG, raw_pandaset.LIDAR)


class Intruder:
    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple:
        return os.system, (self.command,)


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    raw_pandaset.write(tmp_path / "raw")
    return tmp_path / "raw"


def test_a_whole_log_converts(raw: Path, tmp_path: Path) -> None:
    log = Log(convert(raw, "pandaset", tmp_path / "out")[0])
    boxes = read_boxes(log, 0)
    assert boxes is not None
    assert boxes.size_lwh[0].tolist() == pytest.approx([4.7, 1.9, 1.6])
    sweep = read_sweep(log, 0)
    assert sweep is not None
    assert len(sweep[0].range_m) == 3
    assert sweep[0].intensity[0].item() == pytest.approx(7 / 255)


@pytest.mark.parametrize("file", PICKLES)
def test_what_a_pickle_asks_for_is_not_run(file: str, raw: Path, tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    raw_pandaset.write_pickle(raw / file, raw_pandaset.table({"x": [Intruder(f"touch {ran}")]}))
    with pytest.raises(InputError, match=rf"{file}: .*posix\.system") as refusal:
        convert(raw, "pandaset", tmp_path / "out")
    assert "\n" not in str(refusal.value)
    assert not ran.exists()
    assert not list((tmp_path / "out").glob("logs/*/*"))


@pytest.mark.parametrize("file", PICKLES)
def test_a_file_that_was_cut_short_is_named(file: str, raw: Path, tmp_path: Path) -> None:
    whole = (raw / file).read_bytes()
    (raw / file).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=file):
        convert(raw, "pandaset", tmp_path / "out")


def test_a_pickle_that_is_no_table_is_refused(raw: Path, tmp_path: Path) -> None:
    raw_pandaset.write_pickle(raw / raw_pandaset.CUBOIDS, [1, 2])
    with pytest.raises(InputError, match="not a table but a list"):
        convert(raw, "pandaset", tmp_path / "out")
