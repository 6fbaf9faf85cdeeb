"""Frames of 123D logs that results name LOG@T_US."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from foredrive.data.log_paths import find_logs
from foredrive.data.logs import Log
from foredrive.errors import InputError


@dataclass(frozen=True)
class LogFrame:
    """A frame of a log."""

    name: str
    log: Log
    frame: int
    drive: int
    """Number of the log."""


def log_frames(folder: Path, wanted: Collection[str], path: Path) -> Iterator[LogFrame]:
    """Yield the wanted frames of the logs in a folder, log by log and in order of time.

    Other frames of the logs are not judged: results are mostly of fewer frames than a log has.

    Args:
        folder: with logs, as `find_logs` takes it.
        wanted: names of frames.
        path: of the results, for messages.

    Raises:
        InputError: a frame is not in the logs. The message names the first.
    """
    left = dict.fromkeys(wanted)
    for drive, log_path in enumerate(find_logs(folder)):
        if not any(name.startswith(f"{log_path.name}@") for name in left):
            continue
        log = Log(log_path)
        for frame, t_us in enumerate(log.t_us.tolist()):
            name = f"{log_path.name}@{t_us}"
            if name in left:
                del left[name]
                yield LogFrame(name, log, frame, drive)
    if left:
        raise InputError(
            f"{path}: frame {next(iter(left))} ({len(left)} in all) is not in {folder}: of another split?"
        )
