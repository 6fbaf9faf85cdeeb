"""Logs and profiles of commands and of their workers: `--verbose` and `--profile`.

Workers learn of both from the environment, so no code between a command and its workers passes them on.
"""

import contextlib
import dataclasses
import functools
import gzip
import logging
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from foredrive.errors import InputError

_log = logging.getLogger(__name__)

VERBOSE, PROFILE = "FOREDRIVE_VERBOSE", "FOREDRIVE_PROFILE"
"""Environment variables. The first may have any value, the second is FILE:START_S:LENGTH_S."""
DEFAULT_START_S, DEFAULT_LENGTH_S = 30.0, 5.0


@dataclasses.dataclass(frozen=True)
class ProfilePlan:
    """File and time of a profile.

    Args:
        file: where the trace goes, gzipped JSON that Perfetto opens. Workers add their process number.
        start_s: time from the start of a process to that of its recording.
        length_s: length of the recording; every second takes some 10 MB of memory or more.
    """

    file: Path
    start_s: float = DEFAULT_START_S
    length_s: float = DEFAULT_LENGTH_S

    @classmethod
    def parse(cls, text: str) -> "ProfilePlan":
        """Read FILE, FILE:START_S or FILE:START_S:LENGTH_S.

        Raises:
            InputError: the file has another suffix, or a time is no positive number.
        """
        name, *times = text.split(":")
        try:
            numbers = [float(time) for time in times]
        except ValueError:
            numbers = [-1.0]
        if not name.endswith(".json.gz") or len(numbers) > 2 or not all(0 < n < 86_400 for n in numbers):
            raise InputError(
                f"--profile takes FILE.json.gz or FILE.json.gz:START_S:LENGTH_S, times above 0; got {text!r}"
            )
        return cls(Path(name).absolute(), *numbers)


def take_debugging(args: Sequence[str]) -> list[str]:
    """Take `--verbose` and `--profile FILE` out of a command's arguments, into the environment.

    Raises:
        InputError: `--profile` is without a file, or its text is not understood.
    """
    for variable in (VERBOSE, PROFILE):  # Left by an earlier command in this process
        os.environ.pop(variable, None)
    rest: list[str] = []
    words = iter(args)
    for word in words:
        flag, equals, value = word.partition("=")
        if word == "--verbose":
            os.environ[VERBOSE] = "1"
        elif flag == "--profile":
            plan = ProfilePlan.parse(value if equals else next(words, ""))
            if not os.access(plan.file.parent, os.W_OK):  # the command would do its work and lose the trace
                raise InputError(
                    f"--profile: {plan.file.parent}: no such folder, or nothing can be written there"
                )
            os.environ[PROFILE] = f"{plan.file}:{plan.start_s}:{plan.length_s}"
        else:
            rest.append(word)
    return rest


def is_verbose() -> bool:
    """Return whether `--verbose` was given to this command."""
    return VERBOSE in os.environ


@contextlib.contextmanager
def debugging(worker: bool = False) -> Iterator[None]:
    """Log and profile inside the block, as the environment says.

    Args:
        worker: whether this is a worker process of a command. Its trace has its own file name.
    """
    if is_verbose():
        logging.basicConfig(format="%(relativeCreated)7d ms %(process)d %(name)s: %(message)s")
        logging.getLogger("foredrive").setLevel(logging.DEBUG)
    if PROFILE not in os.environ or _Recording.is_made:
        yield
        return
    plan = ProfilePlan.parse(os.environ[PROFILE])
    if worker:
        # NAME.json.gz becomes NAME.PROCESS.json.gz
        plan = dataclasses.replace(
            plan, file=plan.file.with_suffix("").with_suffix(f".{os.getpid()}.json.gz")
        )
    recording = _Recording(plan)
    # An alarm of wall-clock time starts the recording in whatever code runs then
    signal.signal(signal.SIGALRM, recording)
    signal.setitimer(signal.ITIMER_REAL, plan.start_s)
    try:
        yield
    finally:
        # No alarm may arrive while the trace is written
        signal.setitimer(signal.ITIMER_REAL, 0)
        recording.end()


class _Recording:
    """A handler of alarms. The first one starts the profiler, the second one writes the trace."""

    is_made = False
    """Whether this process has had its recording: a worker records in its first job."""

    def __init__(self, plan: ProfilePlan) -> None:
        # Not imported in the handler, which may interrupt an import halfway
        from torch.profiler import profile

        # With stacks, the trace has Python's own functions as well as those of PyTorch
        self._made = functools.partial(profile, with_stack=True)
        # A first, empty profile: the first one of a process loses operators while the profiler sets itself up
        with self._made():
            pass
        self._plan, _Recording.is_made = plan, True
        self._profiler: Any = None
        self._is_over = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self._profiler is not None:
            self.end()
            return
        self._profiler = self._made()
        self._profiler.start()
        signal.setitimer(signal.ITIMER_REAL, self._plan.length_s)

    def end(self) -> None:
        """Write the trace, once. A command that ends before its recording starts says so.

        A full disk costs the trace, and not the work of the command that is interrupted here.
        """
        if self._is_over:
            return
        self._is_over = True
        file = self._plan.file
        if self._profiler is None:
            _log.warning("%s was not written: the process ended before %g s", file, self._plan.start_s)
            return
        self._profiler.stop()
        try:
            # Written beside its place and renamed, so that the file is complete when it appears
            with tempfile.TemporaryDirectory(dir=file.parent) as folder:
                plain, written = Path(folder) / "trace.json", Path(folder) / file.name
                self._profiler.export_chrome_trace(str(plain))
                _check_whole(plain)
                with plain.open("rb") as source, gzip.open(written, "wb", compresslevel=5) as packed:
                    shutil.copyfileobj(source, packed)
                written.replace(file)
        except OSError as error:
            _log.warning("%s was not written: %s", file, error.strerror or error)
            return
        _log.warning("profile of %g s: %s (open it at https://ui.perfetto.dev)", self._plan.length_s, file)


def _check_whole(trace: Path) -> None:
    """Check that a trace has its end: the profiler leaves it cut off on a full disk, and returns.

    Raises:
        OSError: it is cut off.
    """
    with trace.open("rb") as file:
        file.seek(-min(16, trace.stat().st_size), os.SEEK_END)
        if not file.read().rstrip().endswith(b"}"):
            raise OSError("it was cut off; is the disk full?")
