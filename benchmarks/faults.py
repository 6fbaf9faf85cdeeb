"""SIGKILL at random moments of each verb that writes: `foredrive bench faults`.

Each command is killed, starts again, is killed again, up to three times, and may then end. Its folder has
to equal that of a run that nobody disturbed (`benchmarks.common.killing`). The commands are real ones on
small input, which is made here: a recording of some seconds, images of 36 × 64 pixels, a few steps of
training. Programs are forked from one that has imported the package, so that most moments are those of a
verb's own work and not of its imports.

`bad_inputs` counts the tests of damaged files that pass: one line that names the file, no traceback, no
hang. `field_cases` counts the inputs and situations from public reports whose test runs
(`tests/field_cases.toml`), `field_cases_silent` those whose test fails: they go in wrong without a line.

Folders are made in runs/faults.
"""

import atexit
import dataclasses
import functools
import json
import random
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.killing import Command, kill_and_compare
from benchmarks.common.program_server import ProgramServer
from foredrive.data.commands import route_at
from foredrive.data.log_paths import LogPath, find_logs
from foredrive.data.logs import Log
from foredrive.engine.config import save_recipe
from foredrive.errors import InputError
from foredrive.geometry.polylines import points_at
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import VoxelSpec

ROOT = Path("runs/faults").absolute()
TEMPORARY = ROOT / "tmp"
KILLS = {
    "score": 12,
    "convert": 10,
    "search index": 8,
    "train nemo_tiny": 6,
    "reconstruct": 6,
    "drive": 4,
    "record": 4,
    "evaluate": 4,
    "train driveworld_tiny": 4,
}
"""Kills of each command; fewer of those that take long."""
KILLS_A_RUN = 3
TOWN, IMAGE_HW = "Town02", (36, 64)
TRAIN_STEPS, RECONSTRUCT_STEPS, BATCH_SIZE = 4, 6, 2
ROUTE_M = 20.0
START_S = 1200.0
BAD_INPUTS = (
    "tests/data/test_bad_files.py",
    "tests/data/test_damaged_clips.py",
    "tests/data/test_safe_pickle.py",
    "tests/end_to_end/test_bad_input.py",
)
FIELD_CASES = Path("tests/field_cases.toml")
"""The test of each case by its name."""
PRELUDE = """
import foredrive.runs.drive.recording, foredrive.runs.drive.suite, foredrive.runs.drive.in_towns
import foredrive.runs.convert, foredrive.runs.train.run, foredrive.runs.reconstruction.reconstruct
import foredrive.runs.search.indexing, foredrive.runs.score.run, foredrive.engine.fabric
import foredrive.runs.evaluate.run, foredrive.view.run_report
import foredrive.view.score_report, foredrive.view.drive_report, foredrive.view.reconstruction_sheet
import lancedb
"""


def record() -> Command:
    """Record a drive of one second."""
    out = ROOT / "record"
    return Command("record", ("record", *_recording(1.0), "--out", str(out)), out)


def convert() -> Command:
    """Convert three drives of ten images each."""
    source, out = ROOT / "raw", ROOT / "convert"
    if not source.is_dir():
        for number in range(3):
            _write_nerfstudio(source / f"scene_{number}", number)
    arguments = ("convert", "nerfstudio", str(source), "--workers", "1", "--out", str(out))
    return Command("convert", arguments, out)


def train(recipe: str) -> Command:
    """Pre-train and fine-tune a small world model, with a checkpoint after every step."""
    out, file = ROOT / f"train_{recipe}", ROOT / f"{recipe}.yaml"
    found = find_recipe(recipe)
    clips = dataclasses.replace(
        found.clips,
        now_stride_s=0.25,
        image_hw=(32, 64),
        voxels=VoxelSpec(lower_m=(-16.0, -16.0, -1.0), voxel_m=2.0, shape_zyx=(2, 16, 16)),
    )
    stages = {}
    for name in ("pretrain", "finetune"):
        stage = getattr(found, name)
        schedule = dataclasses.replace(
            stage.schedule, steps=TRAIN_STEPS, batch_size=BATCH_SIZE, workers=0, checkpoint_every=1
        )
        stages[name] = dataclasses.replace(stage, schedule=schedule)
    if recipe.startswith("driveworld"):  # its task prompts need a text encoder, which has to be fetched
        found = dataclasses.replace(found, model=dataclasses.replace(found.model, prompt=None))
    save_recipe(dataclasses.replace(found, clips=clips, **stages), file)
    logs = str(_town().folder)
    return Command(f"train {recipe}", ("train", str(file), "--logs", logs, "--out", str(out)), out)


def reconstruct() -> Command:
    """Reconstruct the recording with few Gaussians."""
    out, log = ROOT / "reconstruct", str(_town().folder)
    few = {
        "initial.lidar_points": 1100, "initial.unseen_points": 400, "initial.pixel_points": 1000,
        "initial.actor_points": 40, "schedule.steps": RECONSTRUCT_STEPS, "schedule.checkpoint_every": 1,
        "schedule.max_gaussians": 3000, "schedule.grow_from": 2, "schedule.grow_every": 2,
    }  # fmt: skip
    entries = [f"representation.{name}={value}" for name, value in few.items()]
    arguments = ("reconstruct", log, "--image-size", "24", "48", "--set", *entries, "--out", str(out))
    return Command("reconstruct", arguments, out)


def search_index() -> Command:
    """Index the recording with the embedded towers."""
    out, log = ROOT / "index", str(_town().folder)
    arguments = ("search", "index", log, "--stride", "0.5", "--workers", "1", "--index", str(out))
    return Command("search index", arguments, out)


def drive() -> Command:
    """Drive the beginning of the recording's route twice, in two worker processes."""
    out, file = ROOT / "drive", ROOT / "routes.xml"
    route = route_at(Log(_town()), 0)  # not the driven path, which a red light may cut short
    assert route is not None
    arc_m, xyz, start_m = route
    ends = points_at(xyz, arc_m, start_m + np.array([0.0, ROUTE_M]))
    points = "".join(f'<waypoint x="{x:.2f}" y="{-y:.2f}" z="{z:.2f}"/>' for x, y, z in ends.tolist())
    file.write_text(f'<routes><route id="short" town="{TOWN}">{points}</route></routes>\n')
    traffic = ("--vehicles", "3", "--people", "2", "--no-scenarios", "--no-sensors")
    arguments = ("drive", "--agent", "constant-velocity", "--routes", str(file), *traffic)
    return Command("drive", (*arguments, "--repetitions", "2", "--workers", "2", "--out", str(out)), out)


def score() -> Command:
    """Score detections in forty frames as sets."""
    out, results, truth = ROOT / "score", ROOT / "kitti/results", ROOT / "kitti/truth"
    if not results.is_dir():
        draw = random.Random(0)
        for folder in (results, truth):
            folder.mkdir(parents=True)
        for frame in range(40):
            boxes = [(draw.uniform(-20, 20), draw.uniform(5, 50), draw.random()) for _ in range(6)]
            for folder, noise_m in ((truth, 0.0), (results, 0.3)):
                lines = [
                    f"Car 0.00 0 0.0 0 0 50 50 1.6 1.8 4.2 {x + draw.gauss(0, noise_m):.2f} 1.70 {z:.2f} 0.0"
                    + (f" {certain:.2f}" if noise_m else "")
                    for x, z, certain in boxes
                ]
                (folder / f"{frame:06d}.txt").write_text("\n".join(lines) + "\n")
    return Command("score", ("score", str(results), "--truth", str(truth), "--out", str(out)), out)


def evaluate() -> Command:
    """Evaluate the shipped world model on the recording."""
    out, log = ROOT / "evaluate", str(_town().folder)
    arguments = ("evaluate", "embedded:nemo_town", "--logs", log, "--examples", "1", "--out", str(out))
    return Command("evaluate", arguments, out)


def _kills_of(make: Callable[[], Command]) -> Callable[[int], dict[str, float]]:
    def measure(seed: int) -> dict[str, float]:
        command = make()
        found = kill_and_compare(
            command, _server(), TEMPORARY, kills=KILLS[command.name], kills_a_run=KILLS_A_RUN, seed=seed
        )
        return {name: float(value) for name, value in dataclasses.asdict(found).items()}

    return measure


@functools.cache
def _server() -> ProgramServer:
    """Return the server of all arms, which has imported what the verbs need."""
    shutil.rmtree(TEMPORARY, ignore_errors=True)
    TEMPORARY.mkdir(parents=True)
    server = ProgramServer(ROOT, PRELUDE, start_s=START_S, temporary=TEMPORARY)
    atexit.register(server.close)
    return server


def bad_inputs(seed: int) -> dict[str, float]:
    """Return the number of tests of damaged files and of bad input, and how many of them fail."""
    counts = {
        what: int(number) for number, what in re.findall(r"(\d+) (passed|failed|error)", _tested(BAD_INPUTS))
    }
    failed = counts.get("failed", 0) + counts.get("error", 0)
    return {"bad_inputs": float(counts.get("passed", 0)), "bad_inputs_failed": float(failed)}


def field_cases(seed: int) -> dict[str, float]:
    """Return the number of cases whose tests run, and of those whose tests do not all pass."""
    cases = tomllib.loads(FIELD_CASES.read_text())
    printed = _tested(["-rpfE", *sorted({f"tests/{test}" for test in cases.values()})])
    # A parametrised test has several results, of which a skipped one is none
    results: dict[str, set[str]] = {}
    for result, test in re.findall(r"^(PASSED|FAILED|ERROR) tests/([^\s\[]+)", printed, re.MULTILINE):
        results.setdefault(test, set()).add(result)
    ran = [results[test] for test in cases.values() if test in results]
    return {
        "field_cases": float(len(ran)),
        "field_cases_silent": float(sum(of_case != {"PASSED"} for of_case in ran)),
    }


def _tested(arguments: Sequence[str]) -> str:
    """Run pytest, and return what it prints.

    Raises:
        InputError: it did not come to its end, so that only some of the tests ran.
    """
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode not in (0, 1):  # all passed, or some failed
        raise InputError(f"pytest did not end (exit code {done.returncode}): {done.stdout[-500:]}")
    return done.stdout


def _recording(seconds: float) -> tuple[str, ...]:
    size = tuple(map(str, IMAGE_HW))
    return (
        "--town",
        TOWN,
        "--seconds",
        f"{seconds:g}",
        "--rate",
        "4",
        "--image-size",
        *size,
        "--vehicles",
        "8",
    )


def _town() -> LogPath:
    """Return a recording of six seconds, which is made only once."""
    folder = ROOT / "town"
    if not (folder / "logs").is_dir():
        _server().start("record", *_recording(6.0), "--out", str(folder))
        code, said = _server().finish(START_S)
        if code != 0:
            raise RuntimeError(f"recording ended with {code}: {said[-3000:]}")
    (log,) = find_logs(folder)
    return log


def _write_nerfstudio(folder: Path, number: int) -> None:
    """Write a camera that drives along x."""
    draw, frames = np.random.default_rng(number), []
    (folder / "images").mkdir(parents=True)
    for index in range(10):
        image = draw.integers(0, 256, (90, 160, 3), dtype=np.uint8)
        Image.fromarray(image).save(folder / f"images/{index}.png")
        T_world_cam = [[0, 0, -1, 0.5 * index], [-1, 0, 0, 0], [0, 1, 0, 1.5], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": T_world_cam})
    lens = {"w": 160, "h": 90, "fl_x": 120.0, "fl_y": 120.0, "cx": 80.0, "cy": 45.0, "camera_model": "OPENCV"}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))


BENCHMARK = Benchmark(
    question="After SIGKILL at random moments of each verb: is anything lost, or left, when it goes on?",
    arms={
        "score": _kills_of(score),
        "convert": _kills_of(convert),
        "search index": _kills_of(search_index),
        "train nemo_tiny": _kills_of(lambda: train("nemo_tiny")),
        "reconstruct": _kills_of(reconstruct),
        "drive": _kills_of(drive),
        "record": _kills_of(record),
        "evaluate": _kills_of(evaluate),
        "train driveworld_tiny": _kills_of(lambda: train("driveworld_tiny")),
        "bad inputs": bad_inputs,
        "field cases": field_cases,
    },
    seeds=(0,),
    config={
        "kills": KILLS,
        "kills_a_run": KILLS_A_RUN,
        "town": TOWN,
        "image_hw": IMAGE_HW,
        "train_steps": TRAIN_STEPS,
        "rebuild_steps": RECONSTRUCT_STEPS,
        "route_m": ROUTE_M,
        "bad_inputs": BAD_INPUTS,
    },
    decided_by=("benchmarks.faults", "benchmarks.common.killing", "foredrive.files", "foredrive.runs"),
)
