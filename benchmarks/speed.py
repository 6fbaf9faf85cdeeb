"""CPU time of what users wait for, beside an earlier commit: `foredrive bench speed`, about an hour.

Each command runs with one thread in a clone of that commit and in this tree, turn by turn: once so that
kernels are compiled and caches written, then to be measured. `cpu_ratio` is this tree's CPU seconds (user and
system, all processes) over the other's, `quality_difference` what its figure of quality gains. Both use the
packages that are installed here.

The real log is the raw PandaSet in FOREDRIVE_REAL_DATA/pandaset.
"""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.study import pandaset_log
from foredrive.engine.summary import numbers, read_summary
from foredrive.errors import InputError

COMMIT = "fdb5680e"
HERE, WORK = Path(__file__).resolve().parents[1], Path("runs/speed").absolute()
RECONSTRUCT = "reconstruct {log} --cameras pcam_f0 --out {out}/run --recipe"
SCHEDULE = "representation.schedule"


@dataclass(frozen=True)
class Command:
    """A command of the program; `{out}` is an empty folder, `{seed}` a seed, `{log}` a real log."""

    words: str
    short: str = ""
    """More words for the run that compiles and fills caches."""
    quality: Callable[[Path], float] | None = None
    """Returns what it made is worth, of its folder; more is better."""
    before: str = ""
    """A command whose results in `{out}` it needs; its time does not count."""


def _psnr_db(out: Path) -> float:
    return numbers(read_summary(out / "run" / "summary.json"))["psnr_db"]


COMMANDS = {
    "gaussians_tiny": Command(
        f"{RECONSTRUCT} gaussians_tiny --set {SCHEDULE}.seed={{seed}}", f"{SCHEDULE}.steps=4", _psnr_db
    ),
    "gaussians_small": Command(
        f"{RECONSTRUCT} gaussians_small --set {SCHEDULE}.seed={{seed}}", f"{SCHEDULE}.steps=4", _psnr_db
    ),
    "record_30_frames": Command("record --town Town05 --seconds 3 --seed {seed} --out {out}/data"),
    "record_130_frames": Command("record --town Town05 --seconds 13 --seed {seed} --out {out}/data"),
    "virtual_egos": Command(
        "record --town Town05 --virtual-egos 16 --seeds {seed}..{seed} --rig driving --out {out}/data"
    ),
    "pretrain_nemo": Command(
        "train nemo_tiny --logs {out}/data --out {out}/run --set finetune.schedule.steps=1 "
        "pretrain.schedule.warmup_steps=4 pretrain.schedule.steps=120",
        "pretrain.schedule.steps=5",
        before="record --town Town02 --seconds 8 --seed {seed} --out {out}/data",
    ),
    "drive": Command(
        "drive --agent embedded:driver --routes town05-short --only {seed} --no-sensors --out {out}/suite"
    ),
}


def other_tree() -> Path:
    """Return a clone of this repository at the earlier commit; make it if it is missing.

    Raises:
        InputError: this is no clone with the commit in its history.
    """
    tree = WORK / COMMIT
    if not tree.is_dir():
        WORK.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(dir=WORK))
        steps = ["git", "clone", "--quiet", str(HERE), str(scratch)], ["git", "checkout", "--quiet", COMMIT]
        for step, folder in zip(steps, (HERE, scratch), strict=True):
            if subprocess.run(step, cwd=folder, check=False).returncode:
                raise InputError(f"{HERE} is no git repository with commit {COMMIT}")
        scratch.rename(tree)
    return tree


def _cpu_s(tree: Path, words: str) -> float:
    """Return the CPU seconds of a command of the program in a tree.

    Raises:
        InputError: it failed.
    """
    own = {"PYTHONPATH": str(tree / "src"), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", "foredrive", *words.split()],
        env={**os.environ, **own},
        check=False,
        capture_output=True,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise InputError(f"{tree.name}: {words}: {done.stderr.strip()[-500:]}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def compare(name: str, seed: int) -> Mapping[str, float]:
    """Return the CPU seconds of a command in both trees, their ratio and the difference of quality."""
    command, found = COMMANDS[name], dict[str, float]()
    given: dict[str, object] = {"seed": seed}
    if "{log}" in command.words:
        given["log"] = pandaset_log(WORK / "pandaset").folder.absolute()
    for turn, tree in (("other", other_tree()), ("own", HERE)):
        for measured in (False, True):
            out = Path(tempfile.mkdtemp(dir=WORK))
            words = command.words.format(out=out, **given)
            if command.before:
                _cpu_s(tree, command.before.format(out=out, **given))
            taken_s = _cpu_s(tree, words if measured else f"{words} {command.short}".strip())
            if measured:
                found[f"{turn}_cpu_s"] = taken_s
                if command.quality is not None:
                    found[f"{turn}_quality"] = command.quality(out)
            shutil.rmtree(out)
    if command.quality is not None:
        found["quality_difference"] = found["own_quality"] - found["other_quality"]
    return {"cpu_ratio": found["own_cpu_s"] / found["other_cpu_s"], **found}


BENCHMARK = Benchmark(
    question="How much CPU time do the commands take that users wait for, beside an earlier commit?",
    arms={name: partial(compare, name) for name in COMMANDS},
    config={"commit": COMMIT, "commands": {name: command.words for name, command in COMMANDS.items()}},
)
