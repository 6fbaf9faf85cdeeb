"""Detectors in the loop: world models with heads, judged on annotated logs by the set likelihood."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from foredrive.data.clip_config import ClipConfig
from foredrive.data.log_paths import LogPath
from foredrive.data.logs import Log
from foredrive.engine.folder import CONFIG
from foredrive.errors import InputError
from foredrive.methods.recipe import Recipe, rescheduled
from foredrive.runs.evaluate.run import RESULTS, evaluate_run
from foredrive.runs.improve.choosing import DIVERSE_FAILURES, DIVERSITY, FAILURES, RANDOM
from foredrive.runs.improve.failures import APART_S, Failure
from foredrive.runs.improve.pupil import Pupil
from foredrive.runs.improve.records import Judged, JudgedLogs, ScoredMoment, Source
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.score.run import FRAMES, score_detections
from foredrive.runs.train.run import open_run, train_run
from foredrive.search.scores import read_scores
from foredrive.tasks.detection.score import ScoreConfig

ROUND = ("finetune.schedule.steps=100",)
"""Settings of a round's training: it continues from weights that have been trained."""
SCORED, DETECTION = "scored", "detection.json"
MISSED_NATS = 3.0
"""A moment fails if the objects that are missed in it cost more than this."""
MOST = 12
"""Largest number of failures, the worst ones."""
MOMENT_S = 0.01


class DetectorPupil(Pupil):
    """A detector of road users; the routes of its request are `JudgedLogs`."""

    items = "moments"
    strategies = (RANDOM, DIVERSITY, FAILURES, DIVERSE_FAILURES)

    @property
    def clips(self) -> ClipConfig:
        """Return what a clip of the pool has to hold."""
        return self._recipe().clips

    def check(self) -> None:
        """Check the run, its heads, the settings, the logs and the strategy."""
        super().check()
        open_run(self._of.start).weights  # noqa: B018 - raises where training has not finished
        tasks = self._recipe().tasks
        if tasks is None or "detection" not in tasks.heads.tasks:
            raise InputError(f"{self._of.start}: has no head for detection (foredrive train --tasks)")
        for source in (self._of.routes, self._of.held_out):
            names = [log.name for log in _logs(source)] if source is not None else []
            if len(set(names)) < len(names):
                raise InputError("two of the logs that judge have one name: leave out one of them")

    def check_pool(self, pool: Sequence[Log]) -> None:
        """Refuse a pool with parts of the logs that judge the rounds."""
        judged = [log for source in (self._of.routes, self._of.held_out) if source for log in _logs(source)]
        for log in pool:
            if any(log.path.overlaps(other) for other in judged):
                raise InputError(f"{log.path.name}: judges the rounds: leave it out of the pool")

    def judge(self, run: Path, source: Source, out: Path) -> dict[str, Judged]:
        """Score what a run detects in the annotated moments of logs."""
        logs = {log.name: log for log in _logs(source)}
        if not (out / SCORED / FRAMES).is_file():
            evaluate_run(open_run(run), list(logs.values()), out, views=False, results_files=True)
            truth = Path(os.path.commonpath([log.folder.absolute() for log in logs.values()]))
            score_detections(out / RESULTS / DETECTION, truth, out / SCORED, config=ScoreConfig())
        start_us = {name: int(Log(log).t_us[0]) for name, log in logs.items()}
        judged: dict[str, Judged] = {}
        for key, values in read_scores(out / SCORED / FRAMES).items():
            name, _, t_us = key.rpartition("@")
            parts = (values[part] for part in ("nll", "missed", "false", "localisation"))
            judged[key] = ScoredMoment(name, 1e-6 * (int(t_us) - start_us[name]), *parts)
        return judged

    def failures(self, out: Path, judged: Mapping[str, Judged]) -> list[Failure]:
        """Return the moments in which missed objects cost most, as far as they are apart."""
        logs = {log.name: log for log in _logs(self._of.routes)}
        moments = [item for item in judged.values() if isinstance(item, ScoredMoment)]
        failed: list[ScoredMoment] = []
        for moment in sorted(moments, key=lambda item: -item.missed):
            near = [other for other in failed if other.log == moment.log]
            is_apart = all(abs(other.t_s - moment.t_s) >= APART_S for other in near)
            if moment.missed > MISSED_NATS and is_apart and len(failed) < MOST:
                failed.append(moment)
        return [_failure(moment, logs[moment.log]) for moment in failed]

    def learn(self, logs: Sequence[LogPath], folder: Path, start: Path) -> None:
        """Train world model and heads on logs, from those of a run."""
        train_run(self._recipe(), logs, folder, self._means.cache, start)

    def _recipe(self) -> Recipe[Any, Any]:
        recipe = find_recipe(str(self._of.start / CONFIG), self._of.settings or ROUND)
        finetune = rescheduled(recipe.finetune, seed=self._of.seed)
        return dataclasses.replace(recipe, transfer="perception", finetune=finetune)


def _logs(source: Source) -> tuple[LogPath, ...]:
    """Return the logs of a source.

    Raises:
        InputError: it is of routes.
    """
    if not isinstance(source, JudgedLogs):
        raise InputError("a detector is judged on logs (--on LOGS), not on routes")
    return source.logs


def _failure(moment: ScoredMoment, log: LogPath) -> Failure:
    opened = Log(log)
    t_s = 1e-6 * (opened.t_us - opened.t_us[0])
    x, y = opened.T_world_ego[int(np.abs(t_s - moment.t_s).argmin()), :2, 3].tolist()
    part = (max(0.0, moment.t_s - MOMENT_S), moment.t_s + MOMENT_S)
    what, place = f"missed objects cost {moment.missed:.1f} nats", LogPath(log.folder, log.maps_dir, (part,))
    return Failure(moment.log, moment.log, "missed", what, moment.t_s, (x, y), None, place)
