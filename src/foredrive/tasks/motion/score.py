"""Score forecast agents under every protocol.

The submission to Argoverse 2's challenge is a parquet file with a row for each future (`scenario_id`,
`track_id`, `probability`, `predicted_trajectory_x`, `predicted_trajectory_y`: 60 steps at 10 Hz), as av2's
`ChallengeSubmission` writes it. The truth is a folder with the scenarios' parquet files.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from foredrive.engine.summary import Figures
from foredrive.errors import InputError
from foredrive.tasks.files.arrow_tables import read_table
from foredrive.tasks.motion.argoverse import forecast_errors, forecast_precision
from foredrive.tasks.motion.av2_sensor import CLASSES, SensorForecasts, has_sensor_logs, read_end_to_end
from foredrive.tasks.motion.files import AgentFiles, read_agents
from foredrive.tasks.motion.moving import score_moving
from foredrive.tasks.motion.protocols import PROTOCOLS, Rectangle
from foredrive.tasks.motion.scores import motion_figures, score_motion

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
    # Rows of each track: one for each of its futures
    rows: dict[tuple[str, str], list[int]] = {}
    for n, key in enumerate(zip(scenario, map(str, track), strict=True)):
        rows.setdefault(key, []).append(n)
    truths: dict[str, dict[str, Float[ndarray, "T 2"]]] = {}
    futures, shares, true = [], [], []
    # All tracks have the same number of futures
    count = max((len(row) for row in rows.values()), default=1)
    for (name, track_id), row in rows.items():
        where = f"{results}: scenario {name}, track {track_id}"
        if name not in files:
            raise InputError(f"{where} is not in {truth}: of another split?")
        if name not in truths:
            # A scenario is read once for all of its tracks
            truths[name] = _scenario(files[name])
        if track_id not in truths[name]:
            raise InputError(f"{where} has no whole future in {files[name]}")
        if len(row) != count:
            raise InputError(f"{where} has {len(row)} futures, others {count}")
        futures.append([_trajectory(x[n], y[n], where) for n in row])
        shares.append([probability[n] for n in row])
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
    # Only what follows the observed steps is forecast
    later = step >= OBSERVED
    scenario = {}
    for name in np.unique(track[later]):
        rows = np.flatnonzero(later & (track == name))
        rows = rows[np.argsort(step[rows], kind="stable")]
        # Tracks that are known at every step; others cannot be judged
        if len(rows) == PREDICTED:
            scenario[str(name)] = np.stack([x[rows], y[rows]], axis=-1).astype(np.float64)
    return scenario


LIKELIEST = (6, 1)
"""Numbers of futures that Argoverse 2's challenge judges."""


def score_motion_results(results: Path, truth: Path) -> Figures:
    """Return the figures of results, whichever format they are in.

    They are a submission to Argoverse 2's challenge if they are parquet, and end-to-end forecasts if the
    truth holds Argoverse 2's sensor logs.

    Raises:
        InputError: a file cannot be read, or an entry is wrong. The message names it.
    """
    if results.suffix == ".parquet":
        return score_challenge(read_challenge(results, truth))
    if has_sensor_logs(truth):
        return score_end_to_end(read_end_to_end(results, truth))
    return score_agent_files(read_agents(results, truth))


def score_agent_files(files: AgentFiles) -> Figures:
    """Return `motion.uniad.car.min_ade_m`, … and, of moving vehicles alone, `motion.moving.car.map_f`, …

    A protocol has no figures if the files lack an entry that it needs.
    """
    figures: Figures = {"motion.frames_counted": files.frames}
    figures["frames_without_results"] = files.frames_without_results
    for name, protocol in PROTOCOLS.items():
        # VAD's rectangle needs the heading of the ego vehicle
        if isinstance(protocol.region, Rectangle) and not files.heading_known:
            continue
        scores = score_motion(files.predicted, files.true, protocol)
        figures |= {f"motion.{name}.{key}": value for key, value in motion_figures(scores).items()}
    # Moving vehicles need futures in the frame of the boxes
    if files.futures_placed:
        for name, moving in score_moving(files.predicted, files.true).items():
            figures |= {f"motion.moving.{name}.{key}": value for key, value in vars(moving).items()}
    return figures


def score_challenge(forecasts: ChallengeForecasts) -> Figures:
    """Return `motion.argoverse.min_ade_m`, … of the six likeliest futures, and of one with `_k1`."""
    figures: Figures = {"scenarios": forecasts.scenarios, "tracks": len(forecasts.true_xy)}
    figures["scenarios_without_results"] = forecasts.scenarios_without_results
    for k in LIKELIEST:
        errors = forecast_errors(forecasts.future_xy, forecasts.probability, forecasts.true_xy, k=k)
        end = "" if k == LIKELIEST[0] else f"_k{k}"
        for key, values in (
            ("min_ade_m", errors.ade_m),
            ("min_fde_m", errors.fde_m),
            ("miss_rate", errors.missed),
            ("brier_min_fde_m", errors.brier_fde_m),
        ):
            figures[f"motion.argoverse.{key}{end}"] = float(np.mean(values)) if len(values) else None
    return figures


def score_end_to_end(forecasts: SensorForecasts) -> Figures:
    """Return `motion.argoverse.map_f`, … over all classes, by kind of motion and by class."""
    scores = forecast_precision(forecasts.predicted, forecasts.true, CLASSES)
    return {
        "motion.frames_counted": forecasts.frames,
        **{f"motion.argoverse.{key}": value for key, value in scores.items()},
    }
