"""Describe what learns in the rounds of the loop: a driver or a detector."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from foredrive.data.clip_config import ClipConfig
from foredrive.data.clips import ClipDataset
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.runs.improve.choosing import Moments
from foredrive.runs.improve.failures import Failure
from foredrive.runs.improve.records import Improvement, Judged, Source
from foredrive.runs.progress import Progress, fraction, silent
from foredrive.runs.search.indexing import index_logs
from foredrive.search.find import Hit

STRIDE_S = 0.5
"""Time between the indexed moments, s."""


@dataclass(frozen=True)
class Means:
    """The folder of a loop, its workers, and how it shows progress."""

    out: Path
    workers: int = 1
    on_ray: bool = False
    progress: Progress = silent

    @property
    def cache(self) -> Path:
        """Return the folder of labels and packed clips."""
        return self.out / "cache"

    def index(self, logs: Sequence[LogPath], uri: Path, what: str) -> None:
        """Embed the moments of logs that are not in an index yet.

        Raises:
            InputError: a log cannot be indexed.
        """
        with fraction(self.progress, what) as tick:
            done = index_logs(
                logs, str(uri), "embedded", STRIDE_S, self.workers, on_ray=self.on_ray, tick=tick
            )
        if done.failed:
            name, why = next(iter(done.failed.items()))
            raise InputError(f"{len(done.failed)} logs cannot be indexed: {name}: {why}")


class Pupil(ABC):
    """A run that is judged, fails and learns.

    Args:
        improvement: the request.
        means: folder, workers and progress of the loop.
    """

    items: str
    """Word for what judges it: drives, or moments."""
    strategies: tuple[str, ...]
    """The strategies that it can be asked for."""

    def __init__(self, improvement: Improvement, means: Means) -> None:
        self._of, self._means = improvement, means

    @property
    @abstractmethod
    def clips(self) -> ClipConfig:
        """Return what a clip of the pool has to hold."""

    def check(self) -> None:
        """Check the run that the loop begins with, the settings, the sources and the strategy.

        Raises:
            InputError: something does not fit.
        """
        if self._of.strategy not in self.strategies:
            raise InputError(
                f"no strategy {self._of.strategy!r} for what is judged by {self.items}; there are "
                f"{', '.join(self.strategies)}"
            )

    @abstractmethod
    def check_pool(self, pool: Sequence[Log]) -> None:
        """Refuse a pool with logs that judge the rounds and have to stay unseen.

        Raises:
            InputError: there is one.
        """

    @abstractmethod
    def judge(self, run: Path, source: Source, out: Path) -> dict[str, Judged]:
        """Return what judges a run, by name. What is in the folder already stays.

        Raises:
            InputError: the run, or the simulator, fails.
        """

    @abstractmethod
    def failures(self, out: Path, judged: Mapping[str, Judged]) -> list[Failure]:
        """Return the failures among what `judge` returned for a folder."""

    @abstractmethod
    def learn(self, logs: Sequence[LogPath], folder: Path, start: Path) -> None:
        """Train on logs, from the weights of a run."""

    def unsure(self, run: Path, pool: ClipDataset) -> Mapping[str, float]:
        """Return how unsure a run is about each moment of the pool, by key, for `uncertainty`."""
        raise NotImplementedError

    def anew(
        self, folder: Path, number: int, run: Path, failures: Sequence[Failure], judged: Mapping[str, Judged]
    ) -> tuple[Moments, list[Hit]]:
        """Return new moments that resemble failures, and those that a round chooses, for `anew`."""
        raise NotImplementedError
