"""Forecast agents scored under every protocol."""

from pathlib import Path

import numpy as np

from foredrive.evaluation.motion.av2_challenge import ChallengeForecasts, read_challenge
from foredrive.evaluation.motion.av2_sensor import (
    CLASSES,
    SensorForecasts,
    has_sensor_logs,
    read_end_to_end,
)
from foredrive.evaluation.motion.files import AgentFiles, read_agents
from foredrive.evaluation.summary import Figures
from foredrive.metrics.motion.argoverse import forecast_errors, forecast_precision
from foredrive.metrics.motion.moving import score_moving
from foredrive.metrics.motion.protocols import PROTOCOLS, Rectangle
from foredrive.metrics.motion.scores import motion_figures, score_motion

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

    A protocol that the files do not tell enough for has no figures.
    """
    figures: Figures = {"motion.frames_counted": files.frames}
    figures["frames_without_results"] = files.frames_without_results
    for name, protocol in PROTOCOLS.items():
        if isinstance(protocol.region, Rectangle) and not files.heading_known:
            continue
        scores = score_motion(files.predicted, files.true, protocol)
        figures |= {f"motion.{name}.{key}": value for key, value in motion_figures(scores).items()}
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
