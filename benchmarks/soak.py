"""Programs that run for an hour: is their memory flat, do they leak files, threads or processes?

`foredrive bench soak` starts each program as a user does and looks every few seconds at the whole tree of
its processes: memory, open file descriptors, threads. At the end it presses Ctrl-C, and counts the
processes and the temporary files that are left.

- `driving`: `foredrive drive` with the expert in Town05, small images and sweeps logged, drive after drive.
- `training`: `foredrive train nemo_tiny` with batches of two, loaded by one worker process.
- `search_page`: 20 clients search by text, ask for the map of the scenes and for pictures.
- `viewer`: 20 browsers open the page of a log, step through its frames, and reload every few frames.

FOREDRIVE_SOAK_MINUTES shortens the arms; each result has its real length. Folders are made in runs/soak.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.killing import left_temporary
from benchmarks.common.page_clients import SearchClients, ViewerClients
from benchmarks.common.process_tree import TreeUse, in_session, tree_use
from foredrive.engine.metrics_log import read_metrics
from foredrive.view.page import free_port

ROOT = Path("runs/soak")
MINUTES = float(os.environ.get("FOREDRIVE_SOAK_MINUTES", 60))
SETTLED_MIN = 10.0 if MINUTES >= 20 else MINUTES / 3
"""Minutes until caches are full; growth is counted from there."""
COMPARED = 0.25
"""The mean of the last quarter of the time after `SETTLED_MIN` is compared with that of the first quarter."""
LOOK_S, END_S, WORKERS_END_S = 5.0, 120.0, 20.0
CLIENTS = 20
TOWN, SECONDS, IMAGE_HW = "Town02", 10.0, (72, 128)


class Look(NamedTuple):
    """The tree of processes at one time."""

    t_min: float
    use: TreeUse


def driving(seed: int) -> dict[str, float]:
    """Drive the ten short routes in Town05 again and again, with new traffic."""
    out = _new_folder("driving")
    suite = ("--agent", "expert", "--routes", "town05-short-10", "--repetitions", "1000", "--seed", str(seed))
    sensors = ("--image-size", "36", "64")
    arguments = ("drive", *suite, *sensors, "--workers", "1", "--out", str(out / "suite"))
    return _soak(out, arguments, done=lambda: {"drives": _count(out / "suite/drives", "*.json")})


def training(seed: int) -> dict[str, float]:
    """Load and train on small batches; a checkpoint every 200 steps."""
    out, logs = _new_folder("training"), _recorded()
    long = ("schedule.steps=1000000", "schedule.batch_size=2", "schedule.workers=1", f"schedule.seed={seed}")
    recipe = ("nemo_tiny", "--set", *(f"pretrain.{entry}" for entry in long))
    arguments = ("train", *recipe, "--logs", str(logs), "--out", str(out / "run"))
    metrics = out / "run/pretrain/metrics.jsonl"
    return _soak(out, arguments, done=lambda: {"steps": float(len(read_metrics(metrics)))})


def search_page(seed: int) -> dict[str, float]:
    """Twenty clients search one index."""
    out, logs, port = _new_folder("search_page"), _recorded(), free_port("127.0.0.1", 8090)
    index = str(out / "index")
    _run("search", "index", str(logs), "--index", index, "--workers", "1")
    clients = SearchClients(port, CLIENTS, seed)
    arguments = ("search", "page", "--index", index, "--host", "127.0.0.1", "--port", str(port))
    return _soak(out, arguments, clients, lambda: clients.counts)


def viewer(seed: int) -> dict[str, float]:
    """Twenty browsers watch one log."""
    out, logs, port = _new_folder("viewer"), _recorded(), free_port("127.0.0.1", 8190)
    clients = ViewerClients(port, CLIENTS, seed)
    arguments = ("view", str(logs), "--host", "127.0.0.1", "--port", str(port))
    return _soak(out, arguments, clients, lambda: clients.counts)


def _soak(
    folder: Path,
    arguments: Sequence[str],
    clients: AbstractContextManager[object] | None = None,
    done: Callable[[], Mapping[str, float]] = dict,
) -> dict[str, float]:
    """Run a program under its clients for `MINUTES`, and return the figures.

    Raises:
        RuntimeError: the program ended by itself, or not after Ctrl-C.
    """
    temporary = folder / "tmp"
    temporary.mkdir()
    said = folder / "said.txt"
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell starts jobs in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)
    with said.open("w") as output:
        program = subprocess.Popen(
            [sys.executable, "-m", "foredrive", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=os.environ | {"TMPDIR": str(temporary.absolute()), "PYTHONUNBUFFERED": "1"},
            start_new_session=True,
        )
    try:
        with clients or nullcontext():
            looks = _watch(program, said)
            count = dict(done())
        os.killpg(program.pid, signal.SIGINT)
        program.wait(END_S)
        until_s = time.monotonic() + WORKERS_END_S
        while (left := in_session(program.pid)) and time.monotonic() < until_s:
            time.sleep(1.0)
    finally:
        for pid in in_session(program.pid):
            os.kill(pid, signal.SIGKILL)
    scratch = [path for path in folder.rglob("*.part") if path.is_dir()]
    return {
        **_figures(looks),
        **count,
        "processes_left": float(len(left)),
        "temporary_files_left": float(len(left_temporary(temporary))),
        "scratch_left": float(len(scratch)),
        "exit_code": float(program.returncode),
    }


def _watch(program: "subprocess.Popen[bytes]", said: Path) -> list[Look]:
    began_s, looks = time.monotonic(), list[Look]()
    while (t_min := (time.monotonic() - began_s) / 60) < MINUTES:
        if program.poll() is not None:
            raise RuntimeError(f"{said.parent.name}: the program has ended: {said.read_text()[-2000:]}")
        looks.append(Look(t_min, tree_use(program.pid)))
        time.sleep(LOOK_S)
    return looks


def _figures(looks: Sequence[Look]) -> dict[str, float]:
    """Return how much more the program holds at the end than after it has settled."""
    end = looks[-1].t_min
    span = COMPARED * (end - SETTLED_MIN)
    first = [look.use for look in looks if SETTLED_MIN <= look.t_min <= SETTLED_MIN + span]
    last = [look.use for look in looks if look.t_min >= end - span]

    def mean(of: Sequence[TreeUse], name: str) -> float:
        return fmean(getattr(use, name) for use in of)

    settled_mib, end_mib = mean(first, "memory_mib"), mean(last, "memory_mib")
    return {
        "minutes": end,
        "growth_pct": 100 * (end_mib / settled_mib - 1),
        "settled_mib": settled_mib,
        "end_mib": end_mib,
        "peak_mib": max(look.use.memory_mib for look in looks),
        **{
            f"{name}_more": mean(last, name) - mean(first, name)
            for name in ("descriptors", "threads", "processes")
        },
        "descriptors": mean(last, "descriptors"),
    }


def _new_folder(arm: str) -> Path:
    folder = ROOT / arm
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _recorded() -> Path:
    """Return a data root with one log, which is recorded only once."""
    if not (ROOT / "town/logs").is_dir():
        size = tuple(map(str, IMAGE_HW))
        arguments = ("--town", TOWN, "--seed", "1", "--seconds", f"{SECONDS:g}", "--image-size", *size)
        _run("record", *arguments, "--out", str(ROOT / "town"))
    return ROOT / "town"


def _run(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "foredrive", *arguments], check=True, stdout=subprocess.DEVNULL)


def _count(folder: Path, pattern: str) -> float:
    return float(sum(1 for _ in folder.glob(pattern)))


BENCHMARK = Benchmark(
    question="Programs that run for an hour: is their memory flat, and do they leak files or processes?",
    arms={"driving": driving, "training": training, "search_page": search_page, "viewer": viewer},
    seeds=(0,),
    config={
        "clients": CLIENTS,
        "town": TOWN,
        "seconds": SECONDS,
        "image_hw": IMAGE_HW,
        "settled_min": 10,
        "compared": COMPARED,
    },
    decided_by=("benchmarks.soak", "benchmarks.common.page_clients", "benchmarks.common.process_tree"),
)
