"""Records of the loop: what is asked for, its rounds, and their result."""

import dataclasses
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from foredrive.data.log_paths import LogPath
from foredrive.driver.recipes import DriverRecipe
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.ncap.outcome import BEST
from foredrive.engine.folder import CONFIG
from foredrive.errors import InputError
from foredrive.runs.drive.in_reconstruction import ReconstructedRoutes
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.improve.failures import Failure
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.train.driver import open_driver
from foredrive.search.find import Hit

Routes = TownRoutes | ReconstructedRoutes


@dataclass(frozen=True)
class Improvement:
    """The request: a driver, where it drives, and a pool to learn from."""

    start: Path
    """Folder of the driver's run that the loop begins with."""
    pool: tuple[LogPath, ...]
    logs: tuple[LogPath, ...]
    """Logs that every round trains on beside the chosen moments, as a rule those of the run."""
    routes: Routes
    """Routes that are searched for failures; without `held_out` they judge the rounds too."""
    held_out: TownRoutes | None = None
    """Routes that judge a round and are never searched for failures."""
    strategy: str = "failures-diversity"
    budget: int = 500
    """Moments of each round."""
    settings: tuple[str, ...] = ()
    """Entries of the run's recipe to replace, KEY.KEY=VALUE."""
    keep_best: bool = False
    """Drop a round that is judged worse than the best one before it."""
    seed: int = 0

    def recipe(self) -> DriverRecipe:
        """Return the recipe of the rounds.

        Raises:
            InputError: a setting does not fit it.
        """
        recipe = find_recipe(str(self.start / CONFIG), self.settings, DriverRecipe)
        return dataclasses.replace(recipe, see=dataclasses.replace(recipe.see, seed=self.seed))

    def check(self) -> None:
        """Check what can be checked before the first drive.

        Raises:
            InputError: the run is no driver or not trained, there is no such route, a log of its training
                is missing, or one of the pool is among them.
        """
        open_driver(self.start).weights  # noqa: B018 - raises where training has not finished
        self.recipe()
        for source in (self.routes, self.held_out):
            if source is not None:
                source.jobs(str(self.start))
        for log in self.logs:
            if not log.folder.is_dir():
                raise InputError(
                    f"{log.folder}: a log that the run was trained on is not here; --logs names others, on "
                    "which every round trains beside the chosen moments"
                )
        trained = {log.name for log in self.logs}
        if common := [log.name for log in self.pool if log.name in trained]:
            raise InputError(
                f"the pool has {len(common)} logs that the run was trained on, such as {common[0]}: "
                "leave them out"
            )


def score_of(drive: DriveRecord) -> float:
    """Return the driving score of leaderboard 1.0, %; with a threat NeuroNCAP's score as a share of its best.

    What ends where images are not trusted has not been hit until then.
    """
    if drive.threat is None:
        return drive.driving_score_1_0
    return 100.0 if drive.threat.score is None else 100.0 * drive.threat.score / BEST


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
    judged: Mapping[str, DriveRecord] = field(default_factory=dict)
    """The drives that judge the round, by name."""
    suite: Path | None = None
    """Folder of these drives."""
    kept: bool = True
    """False if the round was dropped, because it was judged worse."""

    @property
    def score(self) -> float:
        """Return the mean score of the drives that judge the round, see `score_of`."""
        return statistics.fmean(score_of(drive) for drive in self.judged.values())


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
