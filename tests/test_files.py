"""Scratch folders: nobody's own is taken away, a dead process' is."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from foredrive import files
from foredrive.errors import InputError
from foredrive.files import atomic_path, remove_abandoned

KILLED = """
import os, sys
from pathlib import Path
from foredrive.files import atomic_path
with atomic_path(Path(sys.argv[1])) as temporary:
    temporary.write_text("half")
    os.kill(os.getpid(), 9)
"""
WAITING = """
import sys
from pathlib import Path
from foredrive.files import atomic_path
with atomic_path(Path(sys.argv[1]), alone=True):
    print("writing", flush=True)
    sys.stdin.read()
"""
DEAD = 2**22 + 1
"""Beyond the largest number of a process."""


def test_what_a_killed_process_left_is_removed_by_the_next(tmp_path: Path) -> None:
    final = tmp_path / "log.v1" / "a.arrow"
    assert subprocess.run([sys.executable, "-c", KILLED, str(final)]).returncode == -9
    (left,) = final.parent.iterdir()
    assert left.name.endswith(".part")
    foreign = final.parent / ".b.arrow.elsewhere-1-abc.part"  # of another machine
    foreign.mkdir()
    files._tidied.clear()
    with atomic_path(final) as temporary:
        assert set(final.parent.iterdir()) == {foreign, temporary.parent}
        files._tidied.clear()
        with atomic_path(final.parent / "c.arrow") as other:  # the first is being written still
            assert temporary.parent.is_dir()
            other.write_text("c")
        temporary.write_text("whole")
    assert final.read_text() == "whole"


def test_a_scratch_folder_of_a_living_process_number_is_removed_if_nobody_holds_it(tmp_path: Path) -> None:
    """In a container that starts again, the new process often has the number of the killed one."""
    left = tmp_path / f".a.{files._HOST}-{os.getpid()}-abc.part"
    left.mkdir()
    with atomic_path(tmp_path / "a") as temporary:
        temporary.write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_folder_whose_replacement_was_killed_between_two_renames_is_replaced(tmp_path: Path) -> None:
    left = tmp_path / f".log.{files._HOST}-{DEAD}-abc.part"
    for name, text in (("replaced", "old"), ("log", "new")):
        (left / name).mkdir(parents=True)
        (left / name / "a").write_text(text)
    remove_abandoned(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["log"]
    assert (tmp_path / "log" / "a").read_text() == "new"


def test_one_process_writes_a_log_and_the_other_says_so(tmp_path: Path) -> None:
    final = tmp_path / "log"
    other = subprocess.Popen(
        [sys.executable, "-c", WAITING, str(final)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "writing\n"
    says = rf"{final}: another process \({other.pid}\) is writing it"
    with pytest.raises(InputError, match=says), atomic_path(final, alone=True):
        pass
    with atomic_path(final) as temporary:  # what is small is written all the same
        temporary.write_text("small")
    other.kill()
    other.communicate()
    with atomic_path(final, alone=True) as temporary:
        temporary.write_text("whole")
    assert final.read_text() == "whole"
    assert [path.name for path in tmp_path.iterdir()] == ["log"]


def test_what_is_being_written_may_be_written_whole_or_not_at_all_too(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a", alone=True) as outer, atomic_path(outer) as inner:
        inner.write_text("whole")
    assert (tmp_path / "a").read_text() == "whole"
    assert len(list(tmp_path.iterdir())) == 1


def test_abandoned_scratch_is_found_in_all_folders_below(tmp_path: Path) -> None:
    deep = tmp_path / "run" / "cache" / f".b.labels.{files._HOST}-{DEAD}-abc.part"
    deep.mkdir(parents=True)
    remove_abandoned(tmp_path, below=True)
    assert not deep.exists()
    assert deep.parent.is_dir()
    remove_abandoned(tmp_path / "nowhere")
