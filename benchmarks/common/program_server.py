"""`foredrive` from a process that has imported it already: imports take most of a short program's time.

Each program is a process of its own, forked before anything has run, with its own session and exit code.
"""

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

START_S = 120.0
"""Time for importing."""
SERVER = """
import json, os, sys, warnings
{prelude}
from foredrive.cli.main import main

for line in sys.stdin:
    asked = json.loads(line)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # libraries' threads, which sleep
        child = os.fork()
    if child == 0:
        os.setsid()
        for number, file in enumerate(asked["files"]):
            os.dup2(os.open(file, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        sys.argv[1:] = asked["args"]
        sys.exit(main())
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class ProgramServer:
    """Starts one program after the other.

    Args:
        scratch: folder for what the programs print.
        prelude: Python that imports what the programs need, and adds recipes.
        paths: folders from which it imports besides.
        start_s: time for importing, s.
        temporary: folder for the programs' temporary files; None: the system's.
    """

    def __init__(
        self,
        scratch: Path,
        prelude: str,
        paths: Sequence[Path] = (),
        *,
        start_s: float = START_S,
        temporary: Path | None = None,
    ) -> None:
        path = os.pathsep.join([*map(str, paths), os.environ.get("PYTHONPATH", "")])
        self._err, self._start_s = scratch / "stderr", start_s
        self._group: int | None = None
        process = subprocess.Popen(
            [sys.executable, "-W", "error", "-c", SERVER.format(prelude=prelude)],
            bufsize=0,  # so that `poll` sees every line that is not read yet
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": path} | ({"TMPDIR": str(temporary)} if temporary else {}),
            start_new_session=True,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        self._process, self._stdin, self._stdout = process, process.stdin, process.stdout

    def start(self, *args: str | Path) -> int:
        """Start the program, and return its process, which is also its group and its session."""
        self._end_the_last()
        files = [os.devnull, os.devnull, str(self._err)]
        asked = json.dumps({"args": [str(arg) for arg in args], "files": files})
        self._stdin.write(asked.encode() + b"\n")
        self._group = self._read(self._start_s)
        return self._group

    def is_running(self) -> bool:
        """Return whether the program that was started last has not ended yet."""
        return not self._heard(0)

    def finish(self, patience_s: float) -> tuple[int, str]:
        """Wait for the program to end; return its exit code and what it printed on stderr."""
        code, self._group = self._read(patience_s), None
        return code, self._err.read_text()

    def close(self) -> None:
        """End the server."""
        self._end_the_last()
        self._process.communicate(timeout=self._start_s)

    def _end_the_last(self) -> None:
        """End a program that a failed test has left."""
        if self._group is not None:
            os.killpg(self._group, signal.SIGKILL)
            self.finish(self._start_s)

    def _read(self, patience_s: float) -> int:
        assert self._heard(patience_s), "nothing was heard of it"
        return int(self._stdout.readline())

    def _heard(self, patience_s: float) -> bool:
        """Return whether the server says something within some time."""
        # Not select(), which takes no descriptor above 1023: a process of tests may have as many open
        poll = select.poll()
        poll.register(self._stdout, select.POLLIN | select.POLLHUP)
        return bool(poll.poll(1000 * patience_s))
