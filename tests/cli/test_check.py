"""`foredrive check` prints what a log holds and what looks wrong, as a table or as JSON."""

import json
from pathlib import Path

import pytest
from miniature import write_log as write_small_log

from foredrive.cli.main import main


def test_a_log_is_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_small_log(tmp_path, frames=8)
    assert main(["check", str(log.folder)]) == 0
    printed = capsys.readouterr().out
    assert f"{log.name}: 8 frames" in " ".join(printed.split())
    assert main(["check", str(log.folder), "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)
    assert told["log"] == log.name
    assert told["frames"] == 8
    assert {"camera.pcam_f0", "ego_state_se3"} <= {stream["name"] for stream in told["streams"]}
    assert all(finding["level"] in ("problem", "note") for finding in told["findings"])


def test_a_folder_without_logs_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(tmp_path)]) == 2
    assert "no 123D log here" in capsys.readouterr().err


def test_a_damaged_log_stops_no_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_small_log(tmp_path, frames=4)
    bad, whole = (write_small_log(tmp_path / name, frames=4) for name in ("a", "b"))
    (bad.folder / "sync.arrow").write_bytes(b"ARROW1 but no more")
    assert main(["check", str(bad.folder), str(whole.folder), "--json"]) == 2
    said = capsys.readouterr()
    first, second = json.loads(said.out)
    assert first["findings"][0]["level"] == "problem"
    assert "sync.arrow" in first["findings"][0]["text"]
    assert second["frames"] == 4
    assert "1 of 2 logs" in said.err
    assert main(["check", str(bad.folder), str(whole.folder)]) == 2
    assert "4 frames" in " ".join(capsys.readouterr().out.split())
