"""Conversion of many logs: finished logs are kept, a bad one stops no other, names stay in the data root."""

import json
import os
import shutil
from pathlib import Path

import pytest
import raw_pandaset
from py123d.datatypes import LogMetadata

from foredrive.cli.main import main
from foredrive.data.formats.convert import convert, log_path
from foredrive.data.formats.guard import check_names
from foredrive.errors import InputError
from foredrive.files import sole_writer
from foredrive.runs.convert import convert_all


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    for name in ("001", "002", "003"):
        raw_pandaset.write(tmp_path / "raw" / name)
    return tmp_path / "raw"


def break_log(raw: Path, name: str) -> None:
    (raw / name / "camera" / "left_camera" / "poses.json").write_text('[{"position": ')


def test_a_bad_log_stops_no_other_and_is_told(
    raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    break_log(raw, "002")
    out = tmp_path / "out"
    assert main(["convert", "pandaset", str(raw), "--out", str(out), "--workers", "1"]) == 2
    said = capsys.readouterr()
    assert {log.name for log in (out / "logs" / "pandaset_train").iterdir()} == {"001", "003"}
    assert "1 of 3 logs failed: pandaset_train/002" in said.err
    assert "camera/left_camera/poses.json: Invalid JSON" in said.err
    assert said.err.count("foredrive:") == 1


def test_finished_logs_are_kept_and_damaged_ones_are_not(raw: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert [done.kept for done in convert_all(raw, "pandaset", out, 1)] == [False] * 3
    logs = out / "logs" / "pandaset_train"
    before = (logs / "001" / "sync.arrow").stat().st_mtime_ns
    shutil.rmtree(logs / "003")
    damaged = logs / "002" / "sync.arrow"
    damaged.write_bytes(damaged.read_bytes()[:100])
    done = {one.name[-3:]: one.kept for one in convert_all(raw, "pandaset", out, 1)}
    assert done == {"001": True, "002": False, "003": False}
    assert (logs / "001" / "sync.arrow").stat().st_mtime_ns == before
    assert not any(one.kept for one in convert_all(raw, "pandaset", out, 1, overwrite=True))


def test_a_second_log_of_one_name_is_refused_and_not_taken_for_the_first(tmp_path: Path) -> None:
    """Two sequences whose names differ only in a sign that logs cannot have."""
    raw, out = tmp_path / "raw", tmp_path / "out"
    raw.mkdir()
    for name in ("drive 1", "drive-1"):
        (raw / f"{name}.ncore4.zarr.itar").write_bytes(b"")
    outcomes = list(convert_all(raw, "ncore", out, 1))
    assert [one.name for one in outcomes] == ["ncore_train/drive-1"] * 2
    clash = f"ncore_train/drive-1: a second log of this name, in {raw}; the first is in {raw}"
    assert [one.failure == clash for one in outcomes] == [True, False]  # the other one is damaged


def test_two_conversions_into_one_data_root_share_the_logs(raw: Path, tmp_path: Path) -> None:
    """The second begins when the first has converted one log, and the first goes on when it has ended."""
    out, logs = tmp_path / "out", tmp_path / "out" / "logs" / "pandaset_train"
    first = convert_all(raw, "pandaset", out, 1)
    assert next(first).kept is False
    with sole_writer(logs / "003"):
        second = {one.name[-3:]: (one.kept, one.failure) for one in convert_all(raw, "pandaset", out, 1)}
    busy = f"{logs / '003'}: another process ({os.getpid()}) is writing it; wait for it or end it"
    assert second == {"001": (True, None), "002": (False, None), "003": (False, busy)}
    assert {one.name[-3:]: one.kept for one in first} == {"002": True, "003": False}


def test_workers_write_the_same_logs(raw: Path, tmp_path: Path) -> None:
    break_log(raw, "001")
    together = list(convert_all(raw, "pandaset", tmp_path / "a", 2))
    alone = list(convert_all(raw, "pandaset", tmp_path / "b", 1))
    assert {one.name: one.failure for one in together} == {one.name: one.failure for one in alone}
    for file in (tmp_path / "b" / "logs" / "pandaset_train" / "002").iterdir():
        other = tmp_path / "a" / "logs" / "pandaset_train" / "002" / file.name
        assert other.read_bytes() == file.read_bytes()


@pytest.mark.parametrize("name", ["../../x", "a/b", "", "x\0", ".hidden"])
def test_the_name_of_a_log_stays_in_the_data_root(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be that of a folder"):
        log_path(LogMetadata("own", "own_train", name, location=None), tmp_path)
    check_names(LogMetadata("own", "own_train", "2011_09_26-a.b+c", location="boston-seaport"))
    with pytest.raises(InputError, match="cannot be that of a file"):
        check_names(LogMetadata("own", "own_train", "a", location="../boston"))


def test_a_scene_with_a_path_as_its_name_writes_nothing_outside(tmp_path: Path) -> None:
    folder = tmp_path / "raw" / "v1.0-own"
    folder.mkdir(parents=True)
    (folder / "sample_data.json").write_text("[]")
    (folder / "log.json").write_text('[{"token": "2"}]')
    scene = {"token": "1", "name": "../../../leaked", "log_token": "2"}
    (folder / "scene.json").write_text(json.dumps([scene]))
    with pytest.raises(InputError, match="cannot be that of a folder"):
        convert(tmp_path / "raw", "nuscenes", tmp_path / "out")
    assert not list(tmp_path.rglob("leaked*"))


def test_a_deep_json_is_one_line(raw: Path, tmp_path: Path) -> None:
    (raw / "001" / "meta" / "timestamps.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match=r"timestamps\.json: Invalid JSON: recursion limit exceeded") as told:
        convert(raw / "001", "pandaset", tmp_path / "out")
    assert "\n" not in str(told.value)
