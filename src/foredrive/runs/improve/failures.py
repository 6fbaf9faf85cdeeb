"""Failures of drives: what went wrong, and the seconds before it as a part of the drive's log."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.data.log_paths import LogPath
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.ncap.outcome import Outcome
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.scores import Ending
from foredrive.engine.folder import DRIVES
from foredrive.runs.drive.records import read_drive

BEFORE_S = 3.0
"""Time before a failure whose key frames are examples of it, s."""
APART_S = 3.0
"""Time after a failure within which other events belong to it, s."""
STANDING_MPS = 0.1


@dataclass(frozen=True)
class Failure:
    """One failure of a drive."""

    drive: str
    """Stem of the drive's files."""
    route: str
    kind: str
    """An `InfractionKind` or an `Ending`."""
    what: str
    """Object that was hit, or line that was crossed."""
    t_s: float
    """Time since the beginning of the drive, s; where the vehicle stopped for good, that of the stop."""
    xy_world: tuple[float, float]
    town: str | None
    """None without a map."""
    log: LogPath
    """The drive's log, and as its only part the seconds before the failure."""

    @property
    def name(self) -> str:
        """Return the failure in words."""
        return f"{self.kind.replace('_', ' ')} at {self.t_s:.1f} s of {self.drive}"


def failures_of(suite: Path) -> list[Failure]:
    """Return the failures of all drives in a folder, by drive and time.

    Drives in which the agent itself failed (an error, no plan) are left out: they say nothing about driving.
    """
    drives = {path.stem: read_drive(path) for path in sorted((suite / DRIVES).glob("*.json"))}
    return [
        failure
        for name, drive in drives.items()
        if not drive.score.failed
        for failure in _of_drive(suite, name, drive)
    ]


def counted(failures: Sequence[Failure]) -> str:
    """Return the number of failures, in all and by kind."""
    kinds = [failure.kind.replace("_", " ") for failure in failures]
    of_kinds = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    return f"{len(failures)} {'failure' if len(failures) == 1 else 'failures'} ({of_kinds})"


def logs_before(failures: Sequence[Failure]) -> list[LogPath]:
    """Return the logs of failures, each with the seconds before all its failures as parts."""
    parts: dict[LogPath, list[tuple[float, float]]] = {}
    for failure in failures:
        whole = LogPath(failure.log.folder, failure.log.maps_dir)
        parts.setdefault(whole, []).extend(failure.log.parts_s)
    return [LogPath(log.folder, log.maps_dir, tuple(of_log)) for log, of_log in parts.items()]


def _of_drive(suite: Path, name: str, drive: DriveRecord) -> list[Failure]:
    score = drive.score
    # Who stands before what was sent into the way, or left the trusted region, has not failed
    if drive.threat is not None and drive.threat.outcome not in (Outcome.COLLIDED, Outcome.LEFT_WAY):
        return []
    events = [(entry.t_s, str(entry.kind), entry.what, entry.xy_world) for entry in score.infractions]
    if score.ending not in (Ending.COMPLETED, Ending.COLLISION, Ending.UNTRUSTED):
        stop = _last_moving(drive)
        # Who never moved has failed by the time that is looked back on
        stop_s = max(drive.track.t_s[stop], min(BEFORE_S, score.duration_s))
        events.append((stop_s, str(score.ending), "", drive.track.xy[stop]))
    failures: list[Failure] = []
    for t_s, kind, what, xy in sorted(events):
        if failures and t_s - failures[-1].t_s < APART_S:
            continue
        # At least the first key frame of the drive
        part = (max(0.0, t_s - BEFORE_S), max(t_s, FRAME_DT_S))
        log = LogPath(suite / drive.log, suite / "maps", (part,))
        failures.append(Failure(name, score.route, kind, what, t_s, xy, drive.town, log))
    return failures


def _last_moving(drive: DriveRecord) -> int:
    """Return the last state of the track in which the vehicle moved; the first if it never did."""
    moving = [k for k, speed in enumerate(drive.track.speed_mps) if speed > STANDING_MPS]
    return moving[-1] if moving else 0
