"""Speed of closed-loop driving, with and without sensors, and growth of its memory.

`foredrive bench drive-speed`. `demonstration_N` records with N cameras and without lidar.

The expert drives Town05's long routes among 40 vehicles and 20 pedestrians; only the simulator's steps are
timed.
"""

import tempfile
import time
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np
import torch

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import held_mib
from foredrive.data.batches import stack_records
from foredrive.data.resizing import shrink_images
from foredrive.driving.controller import ControllerState, follow
from foredrive.driving.dynamics import STEP_S
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.plans import fixed_in_world
from foredrive.driving.route_sets import load_route_set
from foredrive.runs.build import build_agent
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveSuite, drive_one
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import Clip
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.sensors.rigs import DRIVING, TELE, RigPlan, camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.driving.routes import snap_route
from foredrive.towns.driving.town import TownScenario, TownSimulator
from foredrive.towns.driving.town_expert import TownExpert
from foredrive.towns.sensing.capture import SensorSuite

TRAFFIC = BackgroundTraffic(vehicles=40, pedestrians=20)
ROUTES = "town05-long"
SECONDS, HOUR_S, WARM_UP_S = 60.0, 3600.0, 300.0
PLANS = 20
RIGS = (
    ("PCAM_F0",),
    ("PCAM_F0", TELE),
    ("PCAM_F0", "PCAM_L0", "PCAM_R0"),
    tuple(DRIVING.cameras),
)
"""Cameras of the demonstrations."""


def _suite() -> SensorSuite:
    return SensorSuite(camera_rig((144, 256)), roof_lidar(channels=32, azimuth_steps=720))


def _steps(seed: int, sensors: SensorSuite | None, seconds: float) -> Iterator[tuple[float, Clip]]:
    """Yield the time of each simulation step, s, and its observation, over one drive after another."""
    simulator, left_s = TownSimulator(), seconds
    for waypoints in cycle(load_route_set(ROUTES)):
        route = snap_route(waypoints)
        scenario = TownScenario(route.town, route.xyz, seed, TRAFFIC, lanes=route.lanes, sensors=sensors)
        clip, controller, expert, done = (
            simulator.reset(scenario),
            ControllerState(),
            TownExpert(simulator),
            False,
        )
        while not done:
            t_s = simulator.state.t_s
            if simulator.state.step_index % round(FRAME_DT_S / STEP_S) == 0:
                plan = fixed_in_world(expert.act(stack_records([clip])), simulator.ego(), t_s)
                controller = controller.expecting(plan, t_s)
            control, controller = follow(controller, simulator.ego(), t_s)
            began = time.perf_counter()
            step = simulator.step(control)
            yield time.perf_counter() - began, step.clip
            clip, done = step.clip, step.done
            left_s -= STEP_S
            if left_s <= 0:
                return


def sensors(seed: int) -> Mapping[str, float]:
    """Return key frames per second, with all steps between them, and the planning time of nemo_tiny."""
    took, clip = 0.0, None
    for step_s, seen in _steps(seed, _suite(), SECONDS):
        took, clip = took + step_s, seen
    assert clip is not None
    recipe = find_recipe("nemo_tiny")
    agent, plan_s = build_agent(recipe, fetch=False).eval(), []
    for _ in range(PLANS):
        began = time.perf_counter()
        agent.act(shrink_images(stack_records([clip]), recipe.clips.image_hw))
        plan_s.append(time.perf_counter() - began)
    return {
        "town_hz": SECONDS / FRAME_DT_S / took,
        "realtime_factor": SECONDS / took,
        "plan_ms": 1000 * float(np.median(plan_s)),
        "threads": float(torch.get_num_threads()),
    }


def bare(seed: int) -> Mapping[str, float]:
    """Return the speed of the simulator without sensors relative to real time."""
    took = sum(step_s for step_s, _ in _steps(seed, None, SECONDS))
    return {"bare_realtime_factor": SECONDS / took, "step_ms": 1000 * took * STEP_S / SECONDS}


def demonstration(seed: int, cameras: tuple[str, ...]) -> Mapping[str, float]:
    """Return the computing time of a second of the disturbed expert's demonstrations by day, log included."""
    plan = RigPlan(DRIVING.image_hw, {name: DRIVING.cameras[name] for name in cameras})
    source = TownRoutes("training-short", seed=seed, rig=plan)
    suite = DriveSuite("disturbed", source, lidar=False)
    figures = {"cpu_s_a_second": 0.0, "driven_s": 0.0}
    with tempfile.TemporaryDirectory() as folder:
        drive_one(suite.jobs()[0], suite, Path(folder, "warm_up"))  # grows the town, compiles
        began_s = time.process_time()
        record = drive_one(suite.jobs()[1], suite, Path(folder))
        figures["driven_s"] = record.score.duration_s
        figures["cpu_s_a_second"] = (time.process_time() - began_s) / record.score.duration_s
    return figures


def hour(seed: int) -> Mapping[str, float]:
    """Return the growth of memory over an hour of driving with sensors, after the first minutes, MiB."""
    t_s, before, most = 0.0, 0.0, 0.0
    for _ in _steps(seed, _suite(), HOUR_S):
        t_s += STEP_S
        if before == 0.0 and t_s >= WARM_UP_S:
            before = held_mib("cpu")
        if round(t_s / STEP_S) % 1200 == 0:
            most = max(most, held_mib("cpu"))
    return {"rss_after_warm_up_mib": before, "rss_growth_mib": held_mib("cpu") - before, "rss_most_mib": most}


BENCHMARK = Benchmark(
    question="How fast is closed-loop driving in a town, and does its memory stay?",
    arms={"sensors": sensors, "bare": bare, "hour": hour}
    | {f"demonstration_{len(cameras)}": partial(demonstration, cameras=cameras) for cameras in RIGS},
    seeds=(0,),
    config={"routes": ROUTES, "vehicles": 40, "people": 20, "seconds": SECONDS, "hour_s": HOUR_S},
)
