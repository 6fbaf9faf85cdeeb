"""Rounds of the loop: drive, find what resembles the failures, learn it, drive again.

A folder has `index` (the pool's embeddings), `cache` and one folder for each round. `round_0` is of the run
that the loop begins with. `round_N` has `moments.json` (the chosen moments, a clip list), `failures` (an
index of the moments before the failures), `run`, `drives` on the searched routes and, with held-out routes,
`judged`. Everything is made by the function of a verb, which continues where an earlier call stopped.
"""

import contextlib
import dataclasses
import json
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from foredrive.data.clip_list import ListedClip, clip_list, write_clip_list
from foredrive.data.clips import ClipDataset
from foredrive.data.log_paths import LogPath, find_logs
from foredrive.driver.judging import missed_by, uncertainty_of
from foredrive.driver.packed import PackedClips, batches
from foredrive.driver.recipes import DriverRecipe
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.route_sets import load_route_set
from foredrive.engine.folder import CONFIG, DRIVES, RunFolder
from foredrive.engine.interrupts import start_fork_server
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.improve.choosing import ANEW, Moments, Request, before_failure, choose
from foredrive.runs.improve.failures import Failure, failures_of, logs_before
from foredrive.runs.open_clips import open_clips
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.search.indexing import index_logs
from foredrive.runs.train.driver import load_driver, open_driver, train_driver
from foredrive.search.find import Hit
from foredrive.search.index import FrameIndex
from foredrive.towns.map.names import TEST_TOWNS

MOMENTS, FAILURES, INDEX, RUN, JUDGED, LOOP = (
    "moments.json",
    "failures",
    "index",
    "run",
    "judged",
    "loop.json",
)
STRIDE_S = 0.5
ANEW_SEED = 10_000
"""Distance of the seeds of drives that are made anew from those of the routes, per round."""
SHOWN = 3
"""Chosen moments that are shown for each failure."""
CLIP_S = 0.01
"""Half the length of the part of a log that holds one key frame, s."""
Progress = Callable[[str, int], AbstractContextManager[Callable[[], None]]]
"""Shows an activity and its number of parts; the function is called after each part."""


@dataclass(frozen=True)
class Improvement:
    """The request: a driver, where it drives, and a pool to learn from."""

    start: Path
    """Folder of the driver's run that the loop begins with."""
    pool: tuple[LogPath, ...]
    logs: tuple[LogPath, ...]
    """Logs that every round trains on beside the chosen moments, as a rule those of the run."""
    routes: TownRoutes
    """Where failures are looked for, and without `held_out` also what a round is judged by."""
    held_out: TownRoutes | None = None
    """Routes that judge a round and are never searched for failures."""
    strategy: str = "failures-diversity"
    budget: int = 500
    """Moments of each round."""
    settings: tuple[str, ...] = ()
    """Entries of the run's recipe to replace, KEY.KEY=VALUE."""
    keep_best: bool = False
    """Whether a round that is judged worse than the one before it is dropped."""
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
        for source in filter(None, (self.routes, self.held_out)):
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
    """What was chosen for each failure."""
    judged: Mapping[str, DriveRecord] = field(default_factory=dict)
    """The drives that judge the round, by name."""
    suite: Path | None = None
    """Folder of these drives."""
    kept: bool = True
    """False if the round was dropped, because it was judged worse."""

    @property
    def score(self) -> float:
        """Return the mean driving score of the drives that judge the round."""
        return statistics.fmean(drive.driving_score_1_0 for drive in self.judged.values())


@dataclass(frozen=True)
class LoopResult:
    """The rounds, and why the loop ended before the last one that was asked for."""

    rounds: list[Round]
    ended: str = ""

    @property
    def best(self) -> Round:
        """Return the round whose run is the result."""
        return [of_number for of_number in self.rounds if of_number.kept][-1]


def improve(
    improvement: Improvement,
    out: Path,
    rounds: int,
    workers: int = 1,
    *,
    on_ray: bool = False,
    say: Callable[[str], object] = lambda text: None,
    progress: Progress = lambda what, count: nullcontext(lambda: None),
    report: Callable[[LoopResult], object] = lambda result: None,
) -> LoopResult:
    """Run the rounds; continue where an earlier call stopped. A later call may ask for more of them.

    Args:
        workers: number of drives, and of parts of logs to embed, at a time; on Ray as for `fan_out.fan_out`.
        say: called with a line about each step.
        progress: shows how far a step is.
        report: writes the report, after each round.

    Raises:
        InputError: as `Improvement.check`; the folder holds another loop; a drive could not be simulated.
        OSError: the disk is full.
    """
    improvement.check()
    with _folder(improvement, out).claimed():
        loop = Loop(improvement, out, workers, on_ray=on_ray, say=say, progress=progress)
        result = LoopResult([loop.judged(loop.begin)])
        report(result)
        for number in range(1, rounds + 1):
            best = result.best
            learned = loop.learned(number, result.rounds)
            if isinstance(learned, str):
                say(f"round {number}: {learned}")
                return LoopResult(result.rounds, learned)
            judged = loop.judged(learned)
            if improvement.keep_best and judged.score < best.score:
                judged = dataclasses.replace(judged, kept=False)
                say(f"round {number}: dropped, {judged.score:.1f} after {best.score:.1f}")
            result = LoopResult([*result.rounds, judged])
            report(result)
        return result


def _folder(improvement: Improvement, out: Path) -> RunFolder:
    wanted = {"another loop": _noted(improvement)}

    def read() -> dict[str, object] | None:
        if not (out / LOOP).is_file():
            return None
        try:
            return {"another loop": json.loads((out / LOOP).read_text())}
        except ValueError as error:
            raise InputError(f"{out / LOOP}: not the description of a loop: {error}") from error

    def write() -> None:
        with atomic_path(out / LOOP) as temporary:
            temporary.write_text(json.dumps(_noted(improvement), indent=1) + "\n")

    return RunFolder(out, wanted, read, write)


def _noted(improvement: Improvement) -> object:
    routes = {
        name: None if source is None else dict(source.noted())
        for name, source in (("routes", improvement.routes), ("held_out", improvement.held_out))
    }
    logs = {
        name: [[str(log.folder), list(log.parts_s)] for log in of_kind]
        for name, of_kind in (("pool", improvement.pool), ("logs", improvement.logs))
    }
    others = ("strategy", "budget", "settings", "keep_best", "seed")
    plain = {"start": str(improvement.start), **routes, **logs}
    return json.loads(json.dumps(plain | {name: getattr(improvement, name) for name in others}))


class Loop:
    """The steps of the rounds. Opening one indexes the pool.

    Args:
        out: folder of the loop.
        workers, on_ray, say, progress: as of `improve`.

    Raises:
        InputError: the pool is empty, or has logs of towns that have to stay unseen.
    """

    begin: Round
    """The run that the loop begins with, not judged yet."""

    def __init__(
        self,
        improvement: Improvement,
        out: Path,
        workers: int = 1,
        *,
        on_ray: bool = False,
        say: Callable[[str], object] = lambda text: None,
        progress: Progress = lambda what, count: nullcontext(lambda: None),
    ) -> None:
        self.of, self.out, self.workers, self.on_ray = improvement, out, workers, on_ray
        self.say, self.progress = say, progress
        self.recipe = improvement.recipe()
        self.pool = open_clips(self.of.pool, self.recipe.clips, self.out / "cache")
        self._check_places(self.pool)
        start_fork_server(preload=TownRoutes.__module__)
        self._index(self.of.pool, self.out / INDEX, "indexing the pool")
        keys = {self.pool.key(number) for number in range(len(self.pool))}
        self.moments = Moments.of(FrameIndex(str(self.out / INDEX)), keys)
        if not len(self.moments):
            raise InputError("the pool is empty: none of its moments has images and a key frame before it")
        say(f"pool: {len(self.moments)} moments of {len(self.of.pool)} logs")
        self.begin = Round(0, self.out / "round_0", self.of.start)

    def learned(self, number: int, rounds: Sequence[Round]) -> Round | str:
        """Return a round that is trained and not judged yet; or why there is none.

        Args:
            number: its number.
            rounds: the rounds before it.
        """
        kept = [of_number for of_number in rounds if of_number.kept]
        best, folder = kept[-1], self.out / f"round_{number}"
        drives = self._drive(best.run, self.of.routes, best.folder / DRIVES)
        failures = failures_of(best.folder / DRIVES)
        if not failures:
            return f"no failures left in {len(drives)} drives"
        self.say(f"round {number}: {_counted(failures)} in {len(drives)} drives")
        used = {hit.row.key for of_number in rounds for hit in of_number.hits}
        hits, answers = self._chosen(number, best, failures, drives, used)
        if not hits:
            return "the pool is used up"
        # Also what the kept rounds before have chosen
        chosen = [log for of_number in kept[1:] for log in find_logs(of_number.folder / MOMENTS)]
        new = find_logs(folder / MOMENTS)
        self.say(f"round {number}: training on {len(hits)} moments of {len(new)} logs")
        run, logs = folder / RUN, (*self.of.logs, *_merged(chosen + new))
        train_driver(self.recipe, logs, run, self.out / "cache", best.run, self.progress)
        return Round(number, folder, run, failures, hits, answers)

    def judged(self, of_number: Round) -> Round:
        """Drive the routes that judge a round."""
        source = self.of.routes if self.of.held_out is None else self.of.held_out
        suite = of_number.folder / (DRIVES if self.of.held_out is None else JUDGED)
        drives = self._drive(of_number.run, source, suite)
        judged = dataclasses.replace(of_number, judged=drives, suite=suite)
        self.say(f"round {of_number.number}: driving score {judged.score:.1f} in {len(drives)} drives")
        return judged

    def _check_places(self, pool: ClipDataset) -> None:
        """Refuse a pool with logs of the towns that judge the rounds and have to stay unseen."""
        unseen = {
            route.town
            for source in (self.of.routes, self.of.held_out)
            if source is not None
            for route in load_route_set(source.routes)
            if source is self.of.held_out or route.town in TEST_TOWNS
        }
        for log in pool.logs:
            if log.metadata.location in unseen:
                raise InputError(
                    f"{log.path.name}: recorded in {log.metadata.location}, where the routes that judge "
                    "the rounds are: leave such logs out of the pool"
                )

    def _index(self, logs: Sequence[LogPath], uri: Path, what: str) -> None:
        with _fraction(self.progress, what) as tick:
            done = index_logs(
                logs, str(uri), "embedded", STRIDE_S, self.workers, on_ray=self.on_ray, tick=tick
            )
        if done.failed:
            name, why = next(iter(done.failed.items()))
            raise InputError(f"{len(done.failed)} logs cannot be indexed: {name}: {why}")

    def _drive(self, run: Path, source: TownRoutes, out: Path) -> dict[str, DriveRecord]:
        suite = DriveSuite(str(run.absolute()), source, sensors=False, lidar=False)
        with self.progress(f"driving {source.routes}", len(suite.jobs())) as tick:
            driven = drive_suite(suite, out, self.workers, on_ray=self.on_ray, tick=lambda *_: tick())
        if driven.broken:
            job, why = next(iter(driven.broken.items()))
            raise InputError(f"{len(driven.broken)} drives failed, such as {job.name}: {why}")
        return {job.name: drive for job, drive in driven.drives.items()}

    def _chosen(
        self,
        number: int,
        best: Round,
        failures: Sequence[Failure],
        drives: Mapping[str, DriveRecord],
        used: set[str],
    ) -> tuple[list[Hit], list[Answer]]:
        """Return the moments of a round, and what was chosen for each failure; write a clip list."""
        folder = self.out / f"round_{number}"
        self._index(logs_before(failures), folder / FAILURES, "indexing the failures")
        before = Moments.of(FrameIndex(str(folder / FAILURES)))
        rng = np.random.default_rng((self.of.seed, number))

        def uncertainty() -> Mapping[str, float]:
            clips = PackedClips(self.pool, self.out / "cache" / "packed")
            with self.progress("packing the pool", clips.logs) as tick:
                clips.pack(tick)
            with self.progress("looking at the pool", batches(len(clips))) as tick:
                unsure = uncertainty_of(load_driver(open_driver(best.run)), clips, tick)
            return {self.pool.key(n): float(value) for n, value in enumerate(unsure)}

        if self.of.strategy == ANEW:
            moments, hits = self._made_anew(folder / ANEW, number, best, failures, drives, rng)
        else:
            moments = _without(self.moments, used)
            request = Request(moments, failures, before, uncertainty, self.of.budget, rng)
            hits = choose(self.of.strategy, request)
        if not hits:
            return [], []
        clips = [
            ListedClip(
                hit.row.folder.absolute(),
                hit.row.maps_dir.absolute(),
                hit.row.t_s - CLIP_S,
                hit.row.t_s + CLIP_S,
            )
            for hit in hits
        ]
        notes = [{"log": hit.row.log, "t_s": hit.row.t_s, "score": hit.score} for hit in hits]
        write_clip_list(folder / MOMENTS, clip_list(clips, notes))
        return hits, _answers(failures, before, moments, hits)

    def _made_anew(
        self,
        folder: Path,
        number: int,
        best: Round,
        failures: Sequence[Failure],
        drives: Mapping[str, DriveRecord],
        rng: np.random.Generator,
    ) -> tuple[Moments, list[Hit]]:
        """Drive the routes of failures again, with other traffic, and return moments of these drives.

        The truth of new drives is at hand, so that moments in which the driver is wrong come first; the
        others are drawn.
        """
        routes = tuple(dict.fromkeys(failure.route for failure in failures))
        driven_s = sum(drive.score.duration_s for drive in drives.values() if drive.score.route in routes)
        source = dataclasses.replace(
            self.of.routes,
            only=routes,
            # Twice as many moments as are chosen
            repetitions=math.ceil(2 * self.of.budget * STRIDE_S / max(driven_s, 1.0)),
            seed=self.of.routes.seed + ANEW_SEED * number,
        )
        self._drive(best.run, source, folder)
        logs = find_logs(folder)
        dataset = open_clips(logs, self.recipe.clips, self.out / "cache")
        clips = PackedClips(dataset, self.out / "cache" / "packed")
        with self.progress("packing the new drives", clips.logs) as tick:
            clips.pack(tick)
        with self.progress("looking for mistakes", batches(len(clips))) as tick:
            missed = missed_by(load_driver(open_driver(best.run)), clips, tick)
        self._index(logs, folder / INDEX, "indexing the new drives")
        moments = Moments.of(FrameIndex(str(folder / INDEX)))
        rows = {row.key: row for row in moments.rows}
        order = sorted(rng.permutation(len(dataset)).tolist(), key=lambda n: not missed[n])
        hits = [
            Hit(rows[dataset.key(n)], float(missed[n]), {"missed": float(missed[n])})
            for n in order
            if dataset.key(n) in rows
        ]
        return moments, hits[: self.of.budget]


def _answers(
    failures: Sequence[Failure], before: Moments, moments: Moments, hits: Sequence[Hit]
) -> list[Answer]:
    """Return what was chosen for each failure, as far as the last moment before it has an embedding."""
    of_key = {row.key: vector for row, vector in zip(moments.rows, moments.vectors, strict=True)}
    vectors = np.stack([of_key[hit.row.key] for hit in hits])
    answers = []
    for failure in failures:
        mine = before_failure(before, failure)
        if not mine:
            continue
        last = max(mine, key=lambda n: before.rows[n].t_s)
        likeness = vectors @ before.vectors[last]
        nearest = [hits[n] for n in np.argsort(-likeness, kind="stable")[:SHOWN]]
        answers.append(Answer(failure, Hit(before.rows[last], 0.0, {}), nearest))
    return answers


def _without(moments: Moments, keys: set[str]) -> Moments:
    """Return the moments whose keys are not among these."""
    kept = [n for n, row in enumerate(moments.rows) if row.key not in keys]
    return Moments([moments.rows[n] for n in kept], moments.vectors[kept])


def _merged(logs: Sequence[LogPath]) -> list[LogPath]:
    """Return each log once, with all its parts."""
    parts: dict[tuple[Path, Path], list[tuple[float, float]]] = {}
    for log in logs:
        parts.setdefault((log.folder, log.maps_dir), []).extend(log.parts_s)
    return [LogPath(*place, tuple(sorted(of_log))) for place, of_log in parts.items()]


def _counted(failures: Sequence[Failure]) -> str:
    """Return the number of failures, in all and by kind."""
    kinds = [failure.kind.replace("_", " ") for failure in failures]
    of_kinds = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    return f"{len(failures)} failures ({of_kinds})"


@contextlib.contextmanager
def _fraction(progress: Progress, what: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that takes the number of finished parts and of all parts, for `progress`."""
    with contextlib.ExitStack() as stack:
        ticks: list[Callable[[], None]] = []
        finished = 0

        def tick(done: int, total: int) -> None:
            nonlocal finished
            if not ticks:
                ticks.append(stack.enter_context(progress(what, total)))
            for _ in range(done - finished):
                ticks[0]()
            finished = done

        yield tick
