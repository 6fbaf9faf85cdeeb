"""Drivers in the loop: judged on routes through towns or in rebuilt logs, they learn what they do not see."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from foredrive.data.clip_config import ClipConfig
from foredrive.data.clips import ClipDataset
from foredrive.data.log_paths import LogPath, find_logs
from foredrive.data.logs import Log
from foredrive.driver.judging import missed_by, uncertainty_of
from foredrive.driver.packed import PackedClips, batches
from foredrive.driver.recipes import DriverRecipe
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.route_sets import load_route_set
from foredrive.engine.folder import CONFIG, DRIVES
from foredrive.errors import InputError
from foredrive.runs.drive.in_reconstruction import ReconstructedRoutes
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.improve.choosing import STRATEGIES, Moments
from foredrive.runs.improve.failures import Failure, failures_of
from foredrive.runs.improve.pupil import STRIDE_S, Pupil
from foredrive.runs.improve.records import Judged, JudgedLogs, Source
from foredrive.runs.open_clips import open_clips
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.reconstruction.reconstruction_run import open_run_log
from foredrive.runs.train.driver import load_driver, open_driver, train_driver
from foredrive.search.find import Hit
from foredrive.search.index import FrameIndex
from foredrive.towns.map.names import is_held_out

ROUND = ("emphasis=1", "see.epochs=4", "see.lr=3e-3")
"""Settings of a round's training. Drawn three times as often (`DriverRecipe.emphasis`), clips in which the
driver is wrong made it see more lights that are not there."""
ANEW_SEED = 10_000
"""Distance of the seeds of drives that are made anew from those of the routes, per round."""


class DriverPupil(Pupil):
    """A driver by sight."""

    items = "drives"
    strategies = STRATEGIES

    @property
    def clips(self) -> ClipConfig:
        """Return what a clip of the pool has to hold."""
        return self._recipe().clips

    def check(self) -> None:
        """Check the run, the settings, the routes and the strategy."""
        super().check()
        open_driver(self._of.start).weights  # noqa: B018 - raises where training has not finished
        self._recipe()
        for source in (self._of.routes, self._of.held_out):
            if source is not None:
                _routes(source).jobs(str(self._of.start))

    def check_pool(self, pool: Sequence[Log]) -> None:
        """Refuse a pool with logs of the towns that judge the rounds and have to stay unseen.

        The log in whose reconstruction the driver is judged has to stay unseen too.
        """
        sources = [source for source in (self._of.routes, self._of.held_out) if source is not None]
        unseen = {
            route.town
            for source in sources
            if isinstance(source, TownRoutes)
            for route in load_route_set(source.routes)
            if source is self._of.held_out or is_held_out(route.town)
        }
        rebuilt = {
            open_run_log(Path(source.run))[1].name
            for source in sources
            if isinstance(source, ReconstructedRoutes)
        }
        for log in pool:
            if log.path.name in rebuilt:
                raise InputError(
                    f"{log.path.name}: the driver is judged in its reconstruction: leave it out of the pool"
                )
            if log.metadata.location in unseen:
                raise InputError(
                    f"{log.path.name}: recorded in {log.metadata.location}, where the routes that judge "
                    "the rounds are: leave such logs out of the pool"
                )

    def judge(self, run: Path, source: Source, out: Path) -> dict[str, Judged]:
        """Drive the routes."""
        source = _routes(source)
        suite = DriveSuite(str(run.absolute()), source, sensors=False, lidar=False)
        what = source.routes if isinstance(source, TownRoutes) else f"in {Path(source.run).name}"
        with self._means.progress(f"driving {what}", len(suite.jobs())) as tick:
            driven = drive_suite(
                suite, out, self._means.workers, on_ray=self._means.on_ray, tick=lambda *_: tick()
            )
        if driven.broken:
            job, why = next(iter(driven.broken.items()))
            raise InputError(f"{len(driven.broken)} drives failed, such as {job.name}: {why}")
        # A driver that raises an error has no failures to learn from, and its score says nothing
        for job, drive in driven.drives.items():
            if drive.score.failed:
                raise InputError(f"{run}: the driver failed in {out / DRIVES / job.name}.json: {drive.error}")
        return {job.name: drive for job, drive in driven.drives.items()}

    def failures(self, out: Path, judged: Mapping[str, Judged]) -> list[Failure]:
        """Return the failures of the drives in a folder."""
        return failures_of(out)

    def learn(self, logs: Sequence[LogPath], folder: Path, start: Path) -> None:
        """Train the driver on logs, from the weights of a run."""
        train_driver(self._recipe(), logs, folder, self._means.cache, start, self._means.progress)

    def unsure(self, run: Path, pool: ClipDataset) -> Mapping[str, float]:
        """Return how unsure the driver is of what it sees at each moment of the pool, by key."""
        clips = PackedClips(pool, self._means.cache / "packed")
        with self._means.progress("packing the pool", clips.logs) as tick:
            clips.pack(tick)
        with self._means.progress("looking at the pool", batches(len(clips))) as tick:
            unsure = uncertainty_of(load_driver(open_driver(run)), clips, tick)
        return {pool.key(n): float(value) for n, value in enumerate(unsure)}

    def anew(
        self, folder: Path, number: int, run: Path, failures: Sequence[Failure], judged: Mapping[str, Judged]
    ) -> tuple[Moments, list[Hit]]:
        """Drive the routes of failures again, with other traffic or threats, and return moments of it.

        The truth of new drives is at hand, so that moments in which the driver is wrong come first; the
        others are drawn.
        """
        routes = tuple(dict.fromkeys(failure.route for failure in failures))
        drives = [drive for drive in judged.values() if isinstance(drive, DriveRecord)]
        driven_s = sum(drive.score.duration_s for drive in drives if drive.score.route in routes)
        # Twice as many moments as are chosen
        count = math.ceil(2 * self._of.budget * STRIDE_S / max(driven_s, 1.0))
        source = _routes(self._of.routes).anew(routes, count, ANEW_SEED * number)
        self.judge(run, source, folder)
        logs = find_logs(folder)
        dataset = open_clips(logs, self.clips, self._means.cache)
        clips = PackedClips(dataset, self._means.cache / "packed")
        with self._means.progress("packing the new drives", clips.logs) as tick:
            clips.pack(tick)
        with self._means.progress("looking for mistakes", batches(len(clips))) as tick:
            missed = missed_by(load_driver(open_driver(run)), clips, tick)
        self._means.index(logs, folder / "index", "indexing the new drives")
        moments = Moments.of(FrameIndex(str(folder / "index")))
        rows = {row.key: row for row in moments.rows}
        rng = np.random.default_rng((self._of.seed, number))
        order = sorted(rng.permutation(len(dataset)).tolist(), key=lambda n: not missed[n])
        hits = [
            Hit(rows[dataset.key(n)], float(missed[n]), {"missed": float(missed[n])})
            for n in order
            if dataset.key(n) in rows
        ]
        return moments, hits[: self._of.budget]

    def _recipe(self) -> DriverRecipe:
        recipe = find_recipe(str(self._of.start / CONFIG), self._of.settings or ROUND, DriverRecipe)
        return dataclasses.replace(recipe, see=dataclasses.replace(recipe.see, seed=self._of.seed))


def _routes(source: Source) -> TownRoutes | ReconstructedRoutes:
    """Return a source of drives.

    Raises:
        InputError: it is of logs.
    """
    if isinstance(source, JudgedLogs):
        raise InputError("a driver is judged on routes, not on logs")
    return source
