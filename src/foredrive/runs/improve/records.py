"""Records of the loop: what is asked for, its rounds, and their result."""

import dataclasses
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from foredrive.data.log_paths import LogPath
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.ncap.outcome import BEST
from foredrive.errors import InputError
from foredrive.files import digest_of
from foredrive.runs.drive.in_reconstruction import ReconstructedRoutes
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import ROUTES_SHA256
from foredrive.runs.improve.failures import Failure
from foredrive.search.find import Hit

_TRUTH = ("sync", "ego_state_se3", "box_detections_se3")
"""Files of a log that decide what a detector should see, and when."""


@dataclass(frozen=True)
class JudgedLogs:
    """Annotated logs on which a detector is judged, in place of routes."""

    logs: tuple[LogPath, ...]

    def noted(self) -> Mapping[str, object]:
        """Return the logs for JSON, with a digest of their annotations, times and poses."""
        truth = [log.folder / f"{name}.arrow" for log in self.logs for name in _TRUTH]
        return {
            "logs": [[str(log.folder), list(log.parts_s)] for log in self.logs],
            ROUTES_SHA256: digest_of(file for file in truth if file.is_file()),
        }


@dataclass(frozen=True)
class ScoredMoment:
    """The set likelihood of what a detector sees at one moment, nats."""

    log: str
    t_s: float
    nll: float
    missed: float
    false: float
    localisation: float


Source = TownRoutes | ReconstructedRoutes | JudgedLogs
Judged = DriveRecord | ScoredMoment


@dataclass(frozen=True)
class Improvement:
    """The request: a driver, where it drives, and a pool to learn from."""

    start: Path
    """Folder of the run that the loop begins with."""
    pool: tuple[LogPath, ...]
    logs: tuple[LogPath, ...]
    """Logs that every round trains on beside the chosen moments, as a rule those of the run."""
    routes: Source
    """Routes or logs that are searched for failures; without `held_out` they judge the rounds too."""
    held_out: Source | None = None
    """Routes or logs that judge a round and are never searched for failures."""
    strategy: str = "failures-diversity"
    budget: int = 500
    """Moments of each round."""
    settings: tuple[str, ...] = ()
    """Entries of the run's recipe to replace, KEY.KEY=VALUE; without any, those of the pupil's `ROUND`."""
    keep_best: bool = False
    """Drop a round that is judged worse than the best one before it."""
    seed: int = 0

    def check(self) -> None:
        """Check the logs of training and pool.

        Raises:
            InputError: a log of the training is missing, or one of the pool is among them.
        """
        for log in self.logs:
            if not log.folder.is_dir():
                raise InputError(
                    f"{log.folder}: a log that the run was trained on is not here; --logs names others, on "
                    "which every round trains beside the chosen moments"
                )
        if common := [log.name for log in self.pool if any(log.overlaps(own) for own in self.logs)]:
            raise InputError(
                f"the pool has {len(common)} logs that the run was trained on, such as {common[0]}: "
                "leave them out"
            )


def score_of(item: Judged) -> float | None:
    """Return the score of a drive or moment; higher is better.

    It is the driving score of leaderboard 1.0, %; with a threat NeuroNCAP's score times progress, % of its
    best, because who never moves is never hit; for a moment its log-likelihood, nats. None: a drive against a
    threat that ended where images are not trusted has no score.
    """
    if isinstance(item, ScoredMoment):
        return -item.nll
    if item.threat is None:
        return item.driving_score_1_0
    scored = item.threat.score_progress
    return None if scored is None else 100.0 * scored / BEST


@dataclass(frozen=True)
class Answer:
    """A failure, the last moment before it, and the chosen moments that resemble it most."""

    failure: Failure
    moment: Hit
    hits: Sequence[Hit]


@dataclass(frozen=True)
class Round:
    """One round, or the run that the loop begins with (number 0)."""

    number: int
    folder: Path
    run: Path
    failures: Sequence[Failure] = ()
    """The failures that this round looked for moments of."""
    hits: Sequence[Hit] = ()
    """The chosen moments, in the order of choice."""
    answers: Sequence[Answer] = ()
    """The failures with their nearest chosen moments."""
    judged: Mapping[str, Judged] = field(default_factory=dict)
    """The drives or moments that judge the round, by name."""
    suite: Path | None = None
    """Folder of the drives that judge the round."""
    kept: bool = True
    """False if the round was dropped, because it was judged worse."""

    @property
    def scores(self) -> dict[str, float]:
        """Return the scores of what judges the round, by name, where there is one; see `score_of`."""
        scores = {name: score_of(item) for name, item in self.judged.items()}
        return {name: score for name, score in scores.items() if score is not None}

    @property
    def score(self) -> float:
        """Return the mean of the scores.

        Raises:
            InputError: nothing has a score.
        """
        if not self.scores:
            raise InputError(f"{self.suite}: no drive has a score: none stays where images are trusted")
        return statistics.fmean(self.scores.values())


@dataclass(frozen=True)
class LoopResult:
    """The rounds, and why the loop ended before the last one that was asked for."""

    rounds: Sequence[Round]
    ended: str = ""

    def followed_by(self, judged: Round, *, keep_best: bool) -> "LoopResult":
        """Return the result with one more round; with `keep_best` a round below the best is not kept."""
        worse = keep_best and judged.score < self.best.score
        return LoopResult([*self.rounds, dataclasses.replace(judged, kept=not worse)])

    @property
    def best(self) -> Round:
        """Return the round whose run is the result."""
        return [of_number for of_number in self.rounds if of_number.kept][-1]
