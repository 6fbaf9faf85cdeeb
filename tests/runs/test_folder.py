"""Folders of runs: one process at a time, and free again once it is gone."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from miniature import miniature

from foredrive.data import LogPath
from foredrive.engine import folder
from foredrive.engine.folder import RunFolder, held
from foredrive.errors import InputError
from foredrive.runs import train_run
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.search.indexing import index_logs
from foredrive.runs.search.tower_training import tower_recipe, train_towers

HOLDER = """
import sys, time
from pathlib import Path
from foredrive.engine.folder import RunFolder, held
with held(Path(sys.argv[1])):
    print("holds", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that writes to tmp_path / "run"."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path / "run")], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "holds\n"
    yield process
    process.kill()
    process.communicate()


def test_a_second_process_is_refused_by_everything_that_goes_on(
    holder: subprocess.Popen[str], log: LogPath, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    for second in (
        lambda: train_run(miniature(), [log], run),
        lambda: drive_suite(DriveSuite("stop", TownRoutes("town05-short")), run, workers=1),
        lambda: train_towers(tower_recipe(), [log], run),
        lambda: index_logs([log], str(run), "embedded", 1.0, 1),
    ):
        with pytest.raises(InputError, match=f"{run}: another process is writing to it"):
            second()
    assert [file.name for file in run.iterdir()] == [".lock"]


def asking(folder: Path, for_what: int, *, grows: bool = False) -> RunFolder:
    """A folder that holds a number."""
    file, what = folder / "number", "another number"

    def read() -> dict[str, object] | None:
        return {what: int(file.read_text())} if file.is_file() else None

    return RunFolder(folder, {what: for_what}, read, lambda: file.write_text(str(for_what)) and None, grows)


def test_a_folder_is_gone_on_with_by_who_asks_for_the_same(tmp_path: Path) -> None:
    with asking(tmp_path, 1).claimed():
        assert asking(tmp_path, 1).check()
    with pytest.raises(InputError, match=f"{tmp_path}: holds another number; choose another folder"):
        asking(tmp_path, 2).check()
    with asking(tmp_path, 1).claimed():
        pass


def test_a_run_keeps_the_commit_it_was_begun_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(folder, "COMMIT", "abc")
    for _ in range(2):
        with asking(tmp_path, 1).claimed():
            pass
    assert caplog.messages == []
    monkeypatch.setattr(folder, "COMMIT", "def")
    with asking(tmp_path, 1).claimed():
        pass
    assert caplog.messages == [f"{tmp_path}: begun with the code of abc, goes on with that of def"]
    assert json.loads((tmp_path / folder.MADE_BY).read_text()) == {"commit": "abc"}
    (tmp_path / folder.MADE_BY).unlink()  # as in a run of before
    with asking(tmp_path, 1).claimed():
        pass
    assert len(caplog.messages) == 1


def test_a_killed_process_leaves_the_folder_free(holder: subprocess.Popen[str], tmp_path: Path) -> None:
    holder.kill()
    holder.wait()
    with held(tmp_path / "run"):
        pass
    with held(tmp_path / "run"), pytest.raises(InputError, match="another process"), held(tmp_path / "run"):
        pass
