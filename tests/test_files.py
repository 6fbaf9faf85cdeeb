"""Scratch folders: nobody's own is taken away, a dead process' is."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from foredrive import files
from foredrive.errors import InputError
from foredrive.files import atomic_path, latest, remove_abandoned, sole_writer, together

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


@pytest.mark.parametrize("written", ["log", "together"])
def test_a_folder_whose_replacement_was_killed_between_two_renames_is_replaced(
    written: str, tmp_path: Path
) -> None:
    left = tmp_path / f".{written}.{files._HOST}-{DEAD}-abc.part"
    for name, text in (("replaced/log", "old"), ("log", "new")):
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


def write(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text)


def test_files_of_one_folder_appear_together(tmp_path: Path) -> None:
    first, second, elsewhere = tmp_path / "a" / "1", tmp_path / "a" / "2", tmp_path / "a" / "cache" / "3"
    with together(tmp_path / "a"):
        write(first, "half")
        write(first, "whole")
        write(elsewhere, "at once")
        assert latest(second) == second
        write(second, "whole")
        assert not first.exists()
        assert not second.exists()
        assert elsewhere.read_text() == "at once"
        assert latest(first).read_text() == "whole"
    assert first.read_text() == second.read_text() == "whole"
    assert sorted(path.name for path in first.parent.iterdir()) == ["1", "2", "cache"]
    assert latest(first) == first


def test_folders_appear_together_with_files(tmp_path: Path) -> None:
    """Two folders take the places of others, whole; while they are written, the others are there."""
    for name in ("a", "b"):
        (tmp_path / name / "old").mkdir(parents=True)
    with together(tmp_path):
        for name in ("a", "b"):
            with atomic_path(tmp_path / name) as folder:
                write(folder / "new", name)
        write(tmp_path / "c", "c")
        assert sorted(path.name for path in tmp_path.glob("[abc]*")) == ["a", "b"]
        assert (tmp_path / "a" / "old").is_dir()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]
    assert [[path.name for path in (tmp_path / name).iterdir()] for name in ("a", "b")] == [["new"]] * 2


def test_files_of_one_folder_stay_away_together(tmp_path: Path) -> None:
    write(tmp_path / "1", "before")

    def spoil() -> None:
        with together(tmp_path):
            write(tmp_path / "1", "after")
            with atomic_path(tmp_path / "2") as temporary:
                temporary.write_text("half")
                raise OSError("full")

    with pytest.raises(OSError, match="full"):
        spoil()
    assert [path.name for path in tmp_path.iterdir()] == ["1"]
    (tmp_path / "2").mkdir()

    def replace_a_folder() -> None:
        with together(tmp_path):
            write(tmp_path / "1", "after")
            write(tmp_path / "2", "after")

    with pytest.raises(IsADirectoryError):
        replace_a_folder()
    assert (tmp_path / "1").read_text() == "before"


def test_what_is_written_is_on_the_disk_before_it_has_its_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The order of the calls that a power cut may come between: the content, the name, the folder."""
    calls = []

    def sync(opened: int) -> None:
        calls.append(Path(os.readlink(f"/proc/self/fd/{opened}")))

    def replace(source: Path, final: Path) -> None:
        calls.append("rename")
        os.rename(source, final)

    monkeypatch.setattr(files.os, "fsync", sync)
    monkeypatch.setattr(files.os, "replace", replace)
    with atomic_path(tmp_path / "log") as log:
        (log / "inner").mkdir(parents=True)
        (log / "inner" / "a.arrow").write_text("a")
    assert calls == [log, log / "inner" / "a.arrow", log / "inner", "rename", tmp_path]
    calls.clear()
    with atomic_path(tmp_path / "cached", durable=False) as entry:
        entry.write_text("a")
    assert calls == ["rename"]


def test_a_path_has_one_writer_at_a_time_who_may_leave_it(tmp_path: Path) -> None:
    final = tmp_path / "logs" / "a"
    waiting = WAITING.replace("atomic_path(Path(sys.argv[1]), alone=True)", "sole_writer(Path(sys.argv[1]))")
    other = subprocess.Popen(
        [sys.executable, "-c", waiting.replace("import atomic_path", "import sole_writer"), str(final)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert other.stdout is not None
    assert other.stdout.readline() == "writing\n"
    with pytest.raises(InputError, match=rf"{final}: another process \({other.pid}\)"), sole_writer(final):
        pass
    with sole_writer(tmp_path / "logs" / "b"):
        pass
    other.communicate()
    with sole_writer(final), atomic_path(final, alone=True) as temporary:
        temporary.write_text("whole")
    assert [path.name for path in final.parent.iterdir()] == ["a"]
