"""Logs and profiles of commands and of their workers: `--verbose` and `--profile`.

Workers learn of both from the environment, so no code between a command and its workers passes them on.
"""

import contextlib
import dataclasses
import gzip
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

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
        length_s: length of the recording. By the number of operators, a second takes 1 MB to 1.5 GB of
            memory.
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
    logger = logging.getLogger("foredrive")
    level = logger.level
    if is_verbose():
        logging.basicConfig(format="%(relativeCreated)7d ms %(process)d %(name)s: %(message)s")
        logger.setLevel(logging.DEBUG)
    try:
        with _profiling(worker):
            yield
    finally:
        logger.setLevel(level)


@contextlib.contextmanager
def _profiling(worker: bool) -> Iterator[None]:
    if PROFILE not in os.environ or _Recording.current is not None:  # A worker records in its first job
        yield
        return
    plan = ProfilePlan.parse(os.environ[PROFILE])
    if worker:
        # NAME.json.gz becomes NAME.PROCESS.json.gz
        plan = dataclasses.replace(
            plan, file=plan.file.with_suffix("").with_suffix(f".{os.getpid()}.json.gz")
        )
    _Recording.current = recording = _Recording(plan)
    try:
        yield
    finally:
        recording.end()
        if not worker:  # a worker records in its first job alone, a process that runs commands in each
            _Recording.current = None


def profile_step() -> None:
    """Start or end the recording of `--profile` if it is time. Long loops call this once a step.

    A signal or a timer would do so in the middle of an operator, which crashes PyTorch's profiler.
    """
    if _Recording.current is not None:
        _Recording.current.step()


class _Recording:
    """The profile of this process."""

    current: "ClassVar[_Recording | None]" = None

    def __init__(self, plan: ProfilePlan) -> None:
        from torch.profiler import profile

        # A first, empty profile: the first one of a process loses operators while the profiler sets itself up
        with profile(with_stack=True):
            pass
        # With stacks, the trace has Python's own functions as well as those of PyTorch
        self._profiler = profile(with_stack=True)
        self._plan, self._begins_s = plan, time.monotonic() + plan.start_s
        self._ends_s: float | None = None
        self._is_over = False

    def step(self) -> None:
        """Start the profiler at its time, and write the trace when the recording is long enough."""
        now_s = time.monotonic()
        if self._is_over or now_s < self._begins_s:
            return
        if self._ends_s is None:
            self._ends_s = now_s + self._plan.length_s
            self._profiler.start()
        elif now_s >= self._ends_s:
            self.end()

    def end(self) -> None:
        """Write the trace, once. A command that ends before its recording starts says so.

        A full disk costs the trace, and not the work of the command.
        """
        if self._is_over:
            return
        self._is_over = True
        file = self._plan.file
        if self._ends_s is None:
            _log.warning(
                "%s was not written: no step of this process began after %g s; its workers write their own",
                file,
                self._plan.start_s,
            )
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
        _log.warning("profile: %s (open it at https://ui.perfetto.dev)", file)


def _check_whole(trace: Path) -> None:
    """Check that a trace has its end: the profiler leaves it cut off on a full disk, and returns.

    Raises:
        OSError: it is cut off.
    """
    with trace.open("rb") as file:
        file.seek(-min(16, trace.stat().st_size), os.SEEK_END)
        if not file.read().rstrip().endswith(b"}"):
            raise OSError("it was cut off; is the disk full?")
