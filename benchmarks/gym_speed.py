"""Speed of the towns as Gymnasium environments, beside highway-env: `foredrive bench gym-speed`, two minutes.

Every environment acts five times a second of its time, with one thread. `vehicles` is how many vehicles move.
highway-env (installed with `pip install highway-env`) has straight lanes, no junctions, lights or people, and
draws the road from above; its simulation takes ten steps a second, the towns take twenty.
"""

import importlib
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np

from benchmarks.common.benchmark import Benchmark
from foredrive.errors import InputError
from foredrive.integrations.gym.town_env import TownEnv
from foredrive.sensors.rigs import FRONT_TELE, SURROUND

ACTION_S, WARM_STEPS = 0.2, 10
VEHICLES = 40
HIGHWAY = {
    "vehicles_count": VEHICLES,
    "lanes_count": 4,
    "simulation_frequency": 10,
    "policy_frequency": 5,
    "duration": 60,
}
FROM_ABOVE = {
    "type": "GrayscaleObservation",
    "observation_shape": (256, 144),
    "stack_size": 1,
    "weights": [0.3, 0.6, 0.1],
    "scaling": 1.75,
}


def _simulated_s(env: gymnasium.Env[Any, Any], action: Any, steps: int, seed: int) -> float:
    """Return how many seconds are simulated in a CPU second."""
    env.reset(seed=seed)
    taken_s = 0.0
    for step in range(WARM_STEPS + steps):
        began_s = time.process_time()
        *_, ended, cut, _ = env.step(action)
        taken_s += time.process_time() - began_s if step >= WARM_STEPS else 0.0
        if ended or cut:
            env.reset()  # does not count
    return ACTION_S * steps / taken_s


def town(cameras: Any, steps: int) -> Callable[[int], Mapping[str, float]]:
    """Return an arm of Town05, with or without cameras."""

    def measure(seed: int) -> Mapping[str, float]:
        env = TownEnv("Town05", cameras=cameras, skip=4, scenarios=False, stops_at_collision=False)
        speed = _simulated_s(env, np.array([0.3, 0.0], np.float32), steps, seed)
        moving = int(env._simulator.state.traffic.vehicles.active.sum())
        return {"simulated_s_per_cpu_s": speed, "vehicles": moving}

    return measure


def highway(config: Mapping[str, Any], steps: int) -> Callable[[int], Mapping[str, float]]:
    """Return an arm of highway-env."""

    def measure(seed: int) -> Mapping[str, float]:
        try:
            importlib.import_module("highway_env")  # registers
        except ImportError as error:
            raise InputError("highway-env is not installed: pip install highway-env") from error
        warnings.simplefilter("ignore")
        env = gymnasium.make("highway-v0", config={**HIGHWAY, **config}, render_mode="rgb_array")
        return {"simulated_s_per_cpu_s": _simulated_s(env, 1, steps, seed), "vehicles": VEHICLES}

    return measure


BENCHMARK = Benchmark(
    question="How fast are the towns as Gymnasium environments, beside highway-env?",
    arms={
        "town": town(None, 200),
        "town_two_cameras": town(FRONT_TELE.of_size((144, 256)), 60),
        "town_six_cameras": town(SURROUND.of_size((144, 256)), 30),
        "highway": highway({}, 100),
        "highway_from_above": highway({"observation": FROM_ABOVE}, 60),
    },
    config={"highway": HIGHWAY},
)
