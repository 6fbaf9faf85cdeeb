"""Scratch folders: nobody's own is taken away, a dead process' is."""

import subprocess
import sys
from pathlib import Path

from foredrive import files
from foredrive.files import atomic_path

KILLED = """
import os, sys
from pathlib import Path
from foredrive.files import atomic_path
with atomic_path(Path(sys.argv[1])) as temporary:
    temporary.write_text("half")
    os.kill(os.getpid(), 9)
"""


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
