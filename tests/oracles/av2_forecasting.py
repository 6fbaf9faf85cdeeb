"""Scenes for the parity of motion forecasts with the package av2 0.3.6, and the script that asks it.

    python tests/oracles/av2_forecasting.py

writes `av2_forecasting.json` beside this file, in an environment that holds av2 and Foredrive's sources.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from foredrive.tasks.motion.agents import PredictedAgents, TrueAgents
from foredrive.tasks.motion.argoverse import forecast_errors, forecast_precision

GOLDEN = Path(__file__).with_suffix(".json")
CLASSES = ["REGULAR_VEHICLE", "PEDESTRIAN", "BICYCLIST", "BUS"]
FRAMES, AGENTS, STEPS, FUTURES = 10, 24, 6, 5


def single_agents(seed: int = 11) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """40 agents with 6 futures of 60 steps at 10 Hz: futures, probabilities, truth."""
    rng = np.random.default_rng(seed)
    true = np.cumsum(rng.normal(0.3, 0.4, (40, 60, 2)), axis=1)
    future = true[:, None] + np.cumsum(rng.normal(0, 0.25, (40, 6, 60, 2)), axis=2)
    return future, rng.dirichlet(np.ones(6), 40), true


def forecasting_scene(seed: int = 12) -> tuple[PredictedAgents, TrueAgents]:
    """Agents of four classes that stand, drive on or turn, up to 55 m away, some with a short future."""
    rng = np.random.default_rng(seed)
    n = FRAMES * AGENTS
    t = 0.5 * np.arange(1, STEPS + 1)
    motion = rng.integers(0, 3, n)
    velocity = rng.normal(0, 4, (n, 2)) * (motion > 0)[:, None]
    xy = rng.uniform(-40, 40, (n, 2))
    bend = rng.normal(0, 1.2, (n, 1, 2)) * (motion == 2)[:, None, None]
    future = xy[:, None] + velocity[:, None] * t[:, None] + bend * t[:, None] ** 2
    known = np.where(rng.random(n) < 0.3, rng.integers(0, STEPS, n), STEPS)
    true = TrueAgents(
        frame=np.repeat(np.arange(FRAMES), AGENTS),
        category=rng.integers(0, 3, n),  # no bus
        xy=xy,
        future_xy=future,
        future_valid=np.arange(STEPS) < known[:, None],
        seen=np.ones(n, dtype=bool),
    )
    source = np.concatenate([np.flatnonzero(rng.random(n) < 0.85), rng.integers(0, n, n // 4)])
    m = len(source)
    shift = rng.normal(0, 0.8, (m, 2))
    drift = rng.normal(0, 0.3, (m, FUTURES, 1, 2)) * np.arange(1, STEPS + 1)[:, None]
    category = np.where(rng.random(m) < 0.1, rng.integers(0, len(CLASSES), m), true.category[source])
    predicted = PredictedAgents(
        frame=true.frame[source],
        category=category,
        score=np.round(rng.beta(2, 1.5, m), 2),
        xy=xy[source] + shift,
        future_xy=(future[source] + shift[:, None])[:, None] + drift,
        probability=rng.dirichlet(np.ones(FUTURES), m),
    )
    return predicted, true


def forecasting_of_av2(predicted: PredictedAgents, true: TrueAgents) -> dict[str, dict[str, float | None]]:
    """What av2's `accumulate` says of each class and kind of motion: the mean AP, and the errors at 2 m."""
    from av2.evaluation.forecasting import constants, utils
    from av2.evaluation.forecasting.eval import accumulate

    speeds = constants.CATEGORY_TO_VELOCITY_M_PER_S

    def agent(frame: int, label: int, xy: np.ndarray, **more: object) -> dict[str, object]:
        base = {"seq_id": "drive", "timestamp_ns": int(frame), "name": CLASSES[label]}
        found = {**base, "current_translation_m": xy, **more}
        found["velocity_m_per_s"] = utils.agent_velocity_m_per_s(found)
        found["trajectory_type"] = utils.trajectory_type(found, speeds)
        return found

    steps = true.steps_known(STEPS)
    truth = [
        agent(true.frame[j], true.category[j], true.xy[j], future_translation_m=true.future_xy[j, : steps[j]])
        for j in range(len(steps))
        if steps[j] and np.linalg.norm(true.xy[j]) < 50
    ]
    guesses = [
        agent(
            predicted.frame[i],
            predicted.category[i],
            predicted.xy[i],
            prediction_m=predicted.future_xy[i],
            score=predicted.probability[i],
            detection_score=float(predicted.score[i]),
        )
        for i in range(len(predicted.score))
        if np.linalg.norm(predicted.xy[i]) < 50
    ]
    found: dict[str, dict[str, float | None]] = {}
    for name in CLASSES:
        for motion in constants.VELOCITY_TYPES:
            each = {
                d: accumulate(guesses, truth, FUTURES, name, motion, speeds[name], d)[:3]
                for d in constants.DISTANCE_THRESHOLDS_M
            }
            figures = (np.mean([score[0] for score in each.values()]), *each[2][1:])
            found[f"{name}.{motion.replace('-', '_')}"] = {
                key: None if np.isnan(value) else float(value)
                for key, value in zip(("ap", "ade", "fde"), figures, strict=True)
            }
    return found


def single_agents_of_av2(future: np.ndarray, probability: np.ndarray, true: np.ndarray) -> dict[str, Any]:
    """What av2's measures say of each future of each agent."""
    from av2.datasets.motion_forecasting.eval import metrics

    measures = {"ade": metrics.compute_ade, "fde": metrics.compute_fde}
    measures["missed"] = metrics.compute_is_missed_prediction
    found = {
        key: [measure(f, t).tolist() for f, t in zip(future, true, strict=True)]
        for key, measure in measures.items()
    }
    found["brier_fde"] = [
        metrics.compute_brier_fde(f, t, p).tolist() for f, t, p in zip(future, true, probability, strict=True)
    ]
    return found


def check_single_agents(future: np.ndarray, probability: np.ndarray, true: np.ndarray, of_av2: Any) -> None:
    """Compare the future that ends nearest."""
    errors = forecast_errors(future, probability, true)
    best = np.array(of_av2["fde"]).argmin(1)
    row = np.arange(len(best))
    pairs = {"fde": errors.fde_m, "ade": errors.ade_m, "brier_fde": errors.brier_fde_m}
    for key, values in pairs.items():
        np.testing.assert_allclose(values, np.array(of_av2[key])[row, best], atol=1e-9)
    np.testing.assert_array_equal(errors.missed, np.array(of_av2["missed"])[row, best])


def check_forecasting(predicted: PredictedAgents, true: TrueAgents, of_av2: Any) -> None:
    """Compare every class and kind of motion."""
    figures = forecast_precision(predicted, true, CLASSES)
    for group, expected in of_av2.items():
        for key, name in (("map_f", "ap"), ("ade_m", "ade"), ("fde_m", "fde")):
            value = np.nan if expected[name] is None else expected[name]
            np.testing.assert_allclose(figures[f"{group}.{key}"], value, atol=1e-9, err_msg=group)


def main() -> None:
    golden = {
        "single_agents": single_agents_of_av2(*single_agents()),
        "forecasting": forecasting_of_av2(*forecasting_scene()),
    }
    GOLDEN.write_text(json.dumps(golden) + "\n")


if __name__ == "__main__":
    main()
