"""Rounds of the loop: drive, find what resembles the failures, learn it, drive again.

A folder has `index` (the pool's embeddings), `cache` and one folder for each round. `round_0` is of the run
that the loop begins with. `round_N` has `moments.json` (the chosen moments, a clip list), `failures` (an
index of the moments before the failures), `run`, `drives` on the searched routes and, with held-out routes,
`judged`. Everything is made by the function of a verb, which continues where an earlier call stopped.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from foredrive.data.clip_list import ListedClip, clip_list, write_clip_list
from foredrive.data.clips import ClipDataset
from foredrive.data.log_paths import LogPath, find_logs
from foredrive.engine.folder import DRIVES, RunFolder, by_contents
from foredrive.engine.interrupts import start_fork_server
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import AGENT_SHA256, ROUTES_SHA256
from foredrive.runs.improve.choosing import ANEW, Moments, Request, before_failure, choose
from foredrive.runs.improve.detectors import DetectorPupil
from foredrive.runs.improve.drivers import DriverPupil
from foredrive.runs.improve.failures import Failure, counted, logs_before
from foredrive.runs.improve.pupil import Means, Pupil
from foredrive.runs.improve.records import Answer, Improvement, Judged, JudgedLogs, LoopResult, Round
from foredrive.runs.open_clips import open_clips
from foredrive.runs.progress import Progress, silent
from foredrive.runs.shipped import run_digest
from foredrive.search.find import Hit
from foredrive.search.index import FrameIndex

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
_SOURCES = {ROUTES_SHA256: "routes", "held_out_sha256": "held_out"}
"""Entries of a loop's file: the digests of sources, and the sources."""
SHOWN = 3
"""Chosen moments that are shown for each failure."""
CLIP_S = 0.01
"""Half the length of the part of a log that holds one key frame, s."""


def folder_of(improvement: Improvement, out: Path) -> RunFolder:
    """Return the folder of a loop. It belongs to one version of the first run and of the routes."""
    noted = _noted(improvement)
    contents = {
        key: f"the rounds of another version of {name}" for key, name in _by_contents(improvement).items()
    }

    def fixed(noted: Mapping[str, object]) -> dict[str, object]:
        return by_contents(noted, "another loop", contents)

    def read() -> dict[str, object] | None:
        if not (out / LOOP).is_file():
            return None
        try:
            return fixed(dict(json.loads((out / LOOP).read_text())))
        except (ValueError, TypeError) as error:
            raise InputError(f"{out / LOOP}: not the description of a loop: {error}") from error

    def write() -> None:
        with atomic_path(out / LOOP) as temporary:
            temporary.write_text(json.dumps(noted, indent=1) + "\n")

    return RunFolder(out, fixed(noted), read, write)


def _by_contents(improvement: Improvement) -> dict[str, str]:
    """Return the entries of a loop's file that are digests, and whose."""
    sources = (source for source in (improvement.routes, improvement.held_out) if source is not None)
    names = [str(source.noted().get("routes", "the judging logs")) for source in sources]
    return {AGENT_SHA256: str(improvement.start), **dict(zip(_SOURCES, names, strict=False))}


def _noted(improvement: Improvement) -> dict[str, object]:
    routes: dict[str, object] = {AGENT_SHA256: run_digest(improvement.start)}
    for (digest, name), source in zip(
        _SOURCES.items(), (improvement.routes, improvement.held_out), strict=True
    ):
        fields = None if source is None else dict(source.noted())
        routes[digest] = None if fields is None else fields.pop(ROUTES_SHA256, None)
        routes[name] = fields
    logs = {
        name: [[str(log.folder), list(log.parts_s)] for log in of_kind]
        for name, of_kind in (("pool", improvement.pool), ("logs", improvement.logs))
    }
    others = ("strategy", "budget", "settings", "keep_best", "seed")
    plain = {"start": str(improvement.start), **routes, **logs}
    noted: dict[str, object] = json.loads(
        json.dumps(plain | {name: getattr(improvement, name) for name in others})
    )
    return noted


class Loop:
    """The rounds of an improvement in a folder.

    Args:
        out: folder of the loop.
        workers: number of drives, and of parts of logs to embed, at a time; on Ray as for `fan_out.fan_out`.
        say: called with a line about each step.
        progress: shows how far a step is.
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
        progress: Progress = silent,
    ) -> None:
        self.of, self.out, self.say = improvement, out, say
        self.means = Means(out, workers, on_ray, progress)
        detects = isinstance(improvement.routes, JudgedLogs)
        self.pupil: Pupil = (DetectorPupil if detects else DriverPupil)(improvement, self.means)
        self.begin = Round(0, out / "round_0", improvement.start)

    def run(
        self, rounds: int, report: Callable[[LoopResult, str], object] = lambda result, state: None
    ) -> LoopResult:
        """Run the rounds; continue where an earlier call stopped. A later call may ask for more of them.

        Args:
            rounds: their number.
            report: writes the report, with the state of the loop in words: at the beginning of each step, and
                after the last one with an empty state.

        Raises:
            InputError: as `Improvement.check`; the pool is empty, or has logs of towns that have to stay
                unseen; the folder holds another loop; a drive could not be simulated, or the driver raised an
                error in one.
            OSError: the disk is full.
        """
        self.of.check()
        self.pupil.check()
        self.pupil.check_pool(self.pool.logs)  # before the folder is there
        with folder_of(self.of, self.out).claimed():
            start_fork_server(preload=TownRoutes.__module__)
            self.say(f"pool: {len(self.moments)} moments of {len(self.of.pool)} logs")
            if not self.of.logs:
                self.say("the run comes without its logs: rounds train on the chosen moments alone (--logs)")
            result = LoopResult([])
            try:
                for result, state in self._steps(rounds):
                    report(result, state)
            except (InputError, KeyboardInterrupt) as error:
                why = str(error) if isinstance(error, InputError) else "the same command goes on"
                report(result, f"stopped: {why}")
                raise
            return result

    def _steps(self, rounds: int) -> Iterator[tuple[LoopResult, str]]:
        """Yield the result until now and what comes next, in words; at the end the result and nothing."""
        yield LoopResult([]), "judging for the first time"
        result = LoopResult([self.judged(self.begin)])
        for number in range(1, rounds + 1):
            yield result, f"round {number}: choosing moments, and training on them"
            learned = self.learned(number, result.rounds)
            if isinstance(learned, str):
                self.say(f"round {number}: {learned}")
                result = LoopResult(result.rounds, learned)
                break
            yield result, f"round {number}: judging again"
            before = result.best.score
            result = result.followed_by(self.judged(learned), keep_best=self.of.keep_best)
            if not result.rounds[-1].kept:
                self.say(f"round {number}: dropped, {result.rounds[-1].score:.1f} after {before:.1f}")
        yield result, ""

    @functools.cached_property
    def pool(self) -> ClipDataset:
        """Return the clips of the pool."""
        return open_clips(self.of.pool, self.pupil.clips, self.out / "cache")

    @functools.cached_property
    def moments(self) -> Moments:
        """Return the moments of the pool with their embeddings; the first access indexes the pool."""
        keys = {self.pool.key(number) for number in range(len(self.pool))}
        self.means.index(self.of.pool, self.out / INDEX, "indexing the pool")
        moments = Moments.of(FrameIndex(str(self.out / INDEX)), keys)
        if not len(moments):
            raise InputError("the pool is empty: none of its moments has images and a key frame before it")
        return moments

    def learned(self, number: int, rounds: Sequence[Round]) -> Round | str:
        """Return a round that is trained and not judged yet; or why there is none.

        Args:
            number: its number.
            rounds: the rounds before it.
        """
        kept = [of_number for of_number in rounds if of_number.kept]
        best, folder = kept[-1], self.out / f"round_{number}"
        judged = self.pupil.judge(best.run, self.of.routes, best.folder / DRIVES)
        failures = self.pupil.failures(best.folder / DRIVES, judged)
        what = f"{self.pupil.items}: {len(judged)}"
        if not failures:
            return f"no failures left ({what})"
        self.say(f"round {number}: {counted(failures)}; {what}")
        used = {hit.row.key for of_number in rounds for hit in of_number.hits}
        hits, answers = self._chosen(number, best, failures, judged, used)
        if not hits:
            return "the pool is used up"
        # Also what the kept rounds before have chosen
        chosen = [log for of_number in kept[1:] for log in find_logs(of_number.folder / MOMENTS)]
        new = find_logs(folder / MOMENTS)
        self.say(f"round {number}: training on {len(hits)} moments of {len(new)} logs")
        run, logs = folder / RUN, (*self.of.logs, *_merged(chosen + new))
        self.pupil.learn(logs, run, best.run)
        return Round(number, folder, run, failures, hits, answers)

    def judged(self, of_number: Round) -> Round:
        """Judge a round on the routes or logs for it."""
        source = self.of.routes if self.of.held_out is None else self.of.held_out
        suite = of_number.folder / (DRIVES if self.of.held_out is None else JUDGED)
        items = self.pupil.judge(of_number.run, source, suite)
        judged = dataclasses.replace(of_number, judged=items, suite=suite)
        self.say(f"round {of_number.number}: score {judged.score:.1f}; {self.pupil.items}: {len(items)}")
        return judged

    def _chosen(
        self,
        number: int,
        best: Round,
        failures: Sequence[Failure],
        judged: Mapping[str, Judged],
        used: set[str],
    ) -> tuple[list[Hit], list[Answer]]:
        """Return the moments of a round, and what was chosen for each failure; write a clip list."""
        folder = self.out / f"round_{number}"
        self.means.index(logs_before(failures), folder / FAILURES, "indexing the failures")
        before = Moments.of(FrameIndex(str(folder / FAILURES)))

        if self.of.strategy == ANEW:
            moments, hits = self.pupil.anew(folder / ANEW, number, best.run, failures, judged)
        else:
            moments = _without(self.moments, used)
            rng = np.random.default_rng((self.of.seed, number))
            unsure = functools.partial(self.pupil.unsure, best.run, self.pool)
            request = Request(moments, failures, before, unsure, self.of.budget, rng)
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
