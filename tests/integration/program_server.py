"""`foredrive` from a process that has imported it already: imports take most of a short program's time.

Each program is a process of its own, forked before anything has run, with its own session and exit code.
"""

import json
import os
import select
import signal
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
START_S = 120.0
"""Time for importing."""
SERVER = """
import json, os, sys, warnings
import foredrive.runs.drive.recording, foredrive.runs.evaluate.run, foredrive.runs.train.run
import foredrive.view.overview, foredrive.view.run_report, foredrive.view.summary_tables
from miniature import miniature
from foredrive.cli.main import main
from foredrive.recipes import RECIPES

RECIPES["miniature"] = miniature()
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
    """

    def __init__(self, scratch: Path) -> None:
        path = os.pathsep.join([str(TESTS), str(TESTS / "data"), os.environ.get("PYTHONPATH", "")])
        self._err = scratch / "stderr"
        self._group: int | None = None
        self._process = subprocess.Popen(
            [sys.executable, "-W", "error", "-c", SERVER],
            bufsize=0,  # so that `select` sees every line that is not read yet
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": path},
            start_new_session=True,
            cwd=TESTS,
        )

    def start(self, *args: str | Path) -> int:
        """Start the program, which knows the recipe "miniature" too, and return its process and group."""
        self._end_the_last()
        files = [os.devnull, os.devnull, str(self._err)]
        asked = json.dumps({"args": [str(arg) for arg in args], "files": files})
        assert self._process.stdin is not None
        self._process.stdin.write(asked.encode() + b"\n")
        self._group = self._read(START_S)
        return self._group

    def is_running(self) -> bool:
        """Return whether the program that was started last has not ended yet."""
        return not select.select([self._process.stdout], [], [], 0)[0]

    def finish(self, patience_s: float) -> tuple[int, str]:
        """Wait for the program to end; return its exit code and what it printed on stderr."""
        code, self._group = self._read(patience_s), None
        return code, self._err.read_text()

    def close(self) -> None:
        """End the server."""
        self._end_the_last()
        self._process.communicate(timeout=START_S)

    def _end_the_last(self) -> None:
        """End a program that a failed test has left."""
        if self._group is not None:
            os.killpg(self._group, signal.SIGKILL)
            self.finish(START_S)

    def _read(self, patience_s: float) -> int:
        assert self._process.stdout is not None
        assert select.select([self._process.stdout], [], [], patience_s)[0], "nothing was heard of it"
        return int(self._process.stdout.readline())
