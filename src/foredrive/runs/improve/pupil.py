"""What learns in the rounds of the loop, a driver or a detector, and what it needs for that."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from foredrive.data.clip_config import ClipConfig
from foredrive.data.clips import ClipDataset
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.runs.improve.choosing import Moments
from foredrive.runs.improve.failures import Failure
from foredrive.runs.improve.records import Judged, Source
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


class Pupil(Protocol):
    """What is judged, fails and learns."""

    @property
    def items(self) -> str:
        """Return the word for what is judged: drives, or moments."""
        ...

    @property
    def clips(self) -> ClipConfig:
        """Return what a clip of the pool has to hold."""
        ...

    def check(self) -> None:
        """Check the run that the loop begins with, the settings and the sources, before anything is made.

        Raises:
            InputError: something does not fit.
        """
        ...

    def check_pool(self, pool: Sequence[Log]) -> None:
        """Refuse a pool with logs that judge the rounds and have to stay unseen.

        Raises:
            InputError: there is one.
        """
        ...

    def judge(self, run: Path, source: Source, out: Path) -> dict[str, Judged]:
        """Return what judges a run, by name. What is in the folder already stays.

        Raises:
            InputError: the run, or the simulator, fails.
        """
        ...

    def failures(self, out: Path, judged: Mapping[str, Judged]) -> list[Failure]:
        """Return the failures among what `judge` returned for a folder."""
        ...

    def learn(self, logs: Sequence[LogPath], folder: Path, start: Path) -> None:
        """Train on logs, from the weights of a run."""
        ...

    def unsure(self, run: Path, pool: ClipDataset) -> Mapping[str, float]:
        """Return how unsure a run is about each moment of the pool, by key."""
        ...

    def anew(
        self,
        folder: Path,
        number: int,
        run: Path,
        failures: Sequence[Failure],
        judged: Mapping[str, Judged],
        rng: np.random.Generator,
    ) -> tuple[Moments, list[Hit]]:
        """Return new moments that resemble failures, and which of them are chosen in a round."""
        ...
