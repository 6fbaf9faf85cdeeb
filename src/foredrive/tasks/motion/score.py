"""Forecasts of Argoverse 2's motion forecasting challenge.

The submission is a parquet file with a row for each future (`scenario_id`, `track_id`, `probability`,
`predicted_trajectory_x`, `predicted_trajectory_y`: 60 steps at 10 Hz), as av2's `ChallengeSubmission` writes
it. The truth is a folder with the scenarios' parquet files.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.evaluation.arrow_tables import read_table

OBSERVED, PREDICTED = 50, 60
"""Steps of a scenario that are given, and those that are forecast, at 10 Hz."""
_SUBMISSION = ("scenario_id", "track_id", "probability", "predicted_trajectory_x", "predicted_trajectory_y")
_SCENARIO = ("track_id", "timestep", "position_x", "position_y")


@dataclass(frozen=True)
class ChallengeForecasts:
    """Futures of the tracks of a submission, and what they drove."""

    future_xy: Float[ndarray, "N K T 2"]
    probability: Float[ndarray, "N K"]
    true_xy: Float[ndarray, "N T 2"]
    scenarios: int
    scenarios_without_results: int


def read_challenge(results: Path, truth: Path) -> ChallengeForecasts:
    """Read a submission of the motion forecasting challenge, and the scenarios that it is about.

    Raises:
        InputError: a file cannot be read, or a row is wrong. The message names it.
    """
    table = read_table(results, _SUBMISSION)
    scenario, track, probability, x, y = (table[name].to_pylist() for name in _SUBMISSION)
    files = {path.stem.removeprefix("scenario_"): path for path in sorted(truth.rglob("scenario_*.parquet"))}
    if not files:
        raise InputError(f"{truth}: holds no scenario_*.parquet")
    rows: dict[tuple[str, str], list[int]] = {}
    for n, key in enumerate(zip(scenario, map(str, track), strict=True)):
        rows.setdefault(key, []).append(n)
    truths: dict[str, dict[str, Float[ndarray, "T 2"]]] = {}
    futures, shares, true = [], [], []
    count = max((len(each) for each in rows.values()), default=1)
    for (name, track_id), each in rows.items():
        where = f"{results}: scenario {name}, track {track_id}"
        if name not in files:
            raise InputError(f"{where} is not in {truth}: of another split?")
        if name not in truths:
            truths[name] = _scenario(files[name])
        if track_id not in truths[name]:
            raise InputError(f"{where} has no whole future in {files[name]}")
        if len(each) != count:
            raise InputError(f"{where} has {len(each)} futures, others {count}")
        futures.append([_trajectory(x[n], y[n], where) for n in each])
        shares.append([probability[n] for n in each])
        true.append(truths[name][track_id])
        if not (np.min(shares[-1]) >= 0 and abs(np.sum(shares[-1]) - 1) < 1e-3):
            raise InputError(f"{where}: its probabilities do not add up to 1")
    return ChallengeForecasts(
        np.array(futures).reshape(len(true), count, PREDICTED, 2),
        np.array(shares, dtype=np.float64).reshape(len(true), count),
        np.array(true).reshape(len(true), PREDICTED, 2),
        len(files),
        len(set(files) - set(truths)),
    )


def _trajectory(x: Sequence[float], y: Sequence[float], where: str) -> Float[ndarray, "T 2"]:
    if len(x) != PREDICTED or len(y) != PREDICTED:
        raise InputError(f"{where}: a future has {len(x)} steps, not {PREDICTED}")
    points = np.stack([np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)], axis=-1)
    if not np.isfinite(points).all():
        raise InputError(f"{where}: a future is not finite")
    return points


def _scenario(path: Path) -> dict[str, Float[ndarray, "T 2"]]:
    """Return the futures of the tracks that are known at every step."""
    table = read_table(path, _SCENARIO)
    track, step, x, y = (table[name].to_numpy() for name in _SCENARIO)
    later = step >= OBSERVED
    found = {}
    for name in np.unique(track[later]):
        rows = np.flatnonzero(later & (track == name))
        rows = rows[np.argsort(step[rows], kind="stable")]
        if len(rows) == PREDICTED:
            found[str(name)] = np.stack([x[rows], y[rows]], axis=-1).astype(np.float64)
    return found
