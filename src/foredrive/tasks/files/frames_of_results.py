"""Frames that results name: those of the truth, and those of 123D logs, LOG@T_US."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.data.boxes import read_boxes
from foredrive.data.log_paths import find_logs
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.scene import Boxes


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
    frames = []
    for drive, log_path in enumerate(find_logs(folder)):
        # Logs without wanted frames are not opened
        if not any(name.startswith(f"{log_path.name}@") for name in wanted):
            continue
        log = Log(log_path)
        for frame, t_us in enumerate(log.t_us.tolist()):
            name = f"{log_path.name}@{t_us}"
            if name in wanted:
                frames.append(name)
                yield LogFrame(name, log, frame, drive)
    check_known_frames(path, wanted, folder, frames)


def annotated_frames(folder: Path, wanted: Collection[str], path: Path) -> Iterator[tuple[LogFrame, Boxes]]:
    """Yield the wanted frames of logs with their boxes, in the ego frame; arguments as for `log_frames`.

    Raises:
        InputError: as `log_frames`; a frame is not annotated.
    """
    for named in log_frames(folder, wanted, path):
        boxes = read_boxes(named.log, named.frame)
        if boxes is None:
            raise InputError(f"{path}: frame {named.name} is not annotated in {named.log.path.folder}")
        yield named, boxes


def check_known_frames(
    path: object, listed: Iterable[str], truth: object, known_frames: Sequence[str]
) -> None:
    """Refuse results of frames that the truth does not have.

    Raises:
        InputError: the message names the first and the number of them.
    """
    frames, true_frames = list(listed), set(known_frames)
    unknown = [name for name in frames if name not in true_frames]
    if len(unknown) == len(frames) > 0:
        raise InputError(
            f"{path}: none of its {len(frames)} frames is in {truth} (first: {unknown[0]}): "
            "results of another split?"
        )
    if unknown:
        raise InputError(
            f"{path}: frame {unknown[0]} ({len(unknown)} of {len(frames)}) has no ground truth in {truth}"
        )
