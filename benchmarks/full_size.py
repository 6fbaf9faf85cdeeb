"""From `convert` to a training step at full size, on the CPU: `foredrive bench full-size`.

A drive of 10 s through a town is written with six images of 900 x 1600 pixels a frame and a lidar, exported
as nuScenes' format and converted, as a user's own data are. Each recipe of the papers' sizes then takes a
step of one sample: `nemo_base` and `driveworld_base` one of pre-training, without named weights and
perceptual loss, `gaussians_base` and `field_base` two of a reconstruction. It shows that the whole way goes
at these sizes, and what it takes on a core; nothing useful is learned. Runs are kept in runs/full_size.
"""

import contextlib
import dataclasses
import functools
import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import forget_peak, in_a_process, peak_mib
from foredrive.cli.main import main as program
from foredrive.data import CameraSpec, LogPath, find_logs, write_log
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.engine.metrics_log import read_metrics
from foredrive.errors import InputError
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe, rescheduled_recipe
from foredrive.runs.reconstruction.reconstruct import reconstruct
from foredrive.runs.train.run import train_run
from foredrive.sensors.rigs import SURROUND, camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.recorder import record
from foredrive.towns.sensing.capture import SensorSuite

WORK = Path("runs/full_size").absolute()
TOWN, SECONDS, FULL_HW = "Town02", 10.0, (900, 1600)
WORLD_MODELS, RECONSTRUCTIONS = ("nemo_base", "driveworld_base"), ("gaussians_base", "field_base")


def converted() -> LogPath:
    """Return the log, written, exported and converted once."""
    raw, data = WORK / "raw", WORK / "data"
    if not (data / "logs").is_dir():
        log = nuscenes_like(WORK / "own", 0)
        for line in (
            ["export", "nuscenes", log.folder, "--out", raw, "--name", "made", "--workers", 1],
            ["convert", "nuscenes", raw, "--out", data, "--workers", 1],
        ):
            if program([str(word) for word in line]):
                raise InputError(f"failed: {line[:2]}")
    (log,) = find_logs(data)
    return log


def nuscenes_like(folder: Path, seed: int) -> LogPath:
    """Write a drive through a town with images of nuScenes' size, enlarged from smaller ones."""
    sensors = SensorSuite(camera_rig(plan=SURROUND.of_size((225, 400))), roof_lidar())
    small = Log(record(TOWN, SECONDS, seed, folder / "small", rate_hz=2.0, sensors=sensors))
    frames, specs, images = range(len(small)), [], {}
    for name, camera in pinhole_cameras(small).items():
        row = [read_camera(small, frame, camera, FULL_HW, True) for frame in frames]
        K, T_ego_cam = row[0].K.double().numpy(), row[0].T_ego_cam.double().numpy()
        specs.append(CameraSpec(name, K, T_ego_cam, FULL_HW))
        images[name] = [shown.image.permute(1, 2, 0).numpy() for shown in row if shown.image is not None]
    sweeps = [seen[0] for frame in frames if (seen := read_sweep(small, frame)) is not None]
    t_s, T_world_ego = (small.t_us - small.t_us[0]) * 1e-6, small.T_world_ego
    return write_log(folder, "full", t_s, T_world_ego, cameras=specs, images=images, sweeps=sweeps)


def step(name: str) -> dict[str, float]:
    """Return the figures of a step of a recipe."""
    log, folder = converted(), WORK / name
    shutil.rmtree(folder, ignore_errors=True)
    forget_peak("cpu")
    began_s = time.process_time()
    if name in WORLD_MODELS:
        train_run(one_step(find_recipe(name)), [log], folder)
        metrics = read_metrics(folder / "pretrain" / "metrics.jsonl")
        figures = {"loss": metrics[-1]["loss"], "step_cpu_s": metrics[-1]["cpu_s"]}
    else:
        # No frame is held out: a field draws such an image for minutes on a core
        recipe = dataclasses.replace(find_recipe(name, (), ReconstructionRecipe), hold_out_every=0)
        reconstruct(rescheduled_recipe(recipe, steps=2), log, folder)
        metrics = read_metrics(folder / "metrics.jsonl")
        figures = {"loss": metrics[-1]["loss"], "step_cpu_s": metrics[-1]["computing_s"]}
    return {**figures, "cpu_min": (time.process_time() - began_s) / 60, "peak_gib": peak_mib("cpu") / 1024}


def one_step(recipe: Any) -> Any:
    """Return a recipe of one step of one sample, whose weights are random."""
    backbone = dataclasses.replace(recipe.model.backbone, weights=None)
    stage = recipe.pretrain
    schedule = dataclasses.replace(stage.schedule, steps=1, epochs=None, batch_size=1, workers=0)
    changes = {"perceptual": None} if hasattr(stage, "perceptual") else {}
    return dataclasses.replace(
        recipe,
        model=dataclasses.replace(recipe.model, backbone=backbone),
        pretrain=dataclasses.replace(stage, schedule=schedule, **changes),
        finetune=dataclasses.replace(
            recipe.finetune, schedule=dataclasses.replace(schedule, steps=0), **changes
        ),
    )


def arm(name: str, _: int) -> dict[str, float]:
    """Measure a recipe in a process of its own."""
    return in_a_process(__file__, name)


BENCHMARK = Benchmark(
    question="Does the whole way go at full size, and what does a step take on the CPU?",
    arms={name: functools.partial(arm, name) for name in (*WORLD_MODELS, *RECONSTRUCTIONS)},
    seeds=(0,),
    decided_by=("benchmarks.full_size", "foredrive.methods", "foredrive.ops", "foredrive.data"),
)

if __name__ == "__main__":
    with contextlib.redirect_stdout(sys.stderr):  # Figures alone are printed
        figures = step(sys.argv[1])
    print(json.dumps(figures))
