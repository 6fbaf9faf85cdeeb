"""Training by two processes of torchrun: losses of one, files of the first, a lost process, going on."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from miniature import assert_same_losses, in_two_parts, losses
from safetensors.torch import load_file

from foredrive.data import LogPath
from foredrive.engine.config import save_recipe
from foredrive.runs import Run, open_run, train_run

TESTS = Path(__file__).parents[1]
BOTH = """
import os, signal, sys
from pathlib import Path

recipe, log, out, cache = sys.argv[1:]
second = os.environ["RANK"] == "1"
touched = []

def note(event, args):
    writes = event == "open" and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR)
    if (writes or event in ("os.rename", "os.mkdir")) and str(args[0]).startswith(out):
        touched.append(str(args[0]))

if second:
    sys.addaudithook(note)

from foredrive.cli.main import main
from foredrive.methods.nemo.objective import NemoObjective

def train(name, *more):
    return main(["train", recipe, "--logs", log, "--out", f"{out}/{name}", "--cache", cache, *more])

calls, stop_at, forward = 0, 3 + 2, NemoObjective.forward

def stopped(self, *args):
    global calls
    calls += 1
    if second and calls == stop_at:
        Path(cache, "touched").write_text(" ".join(touched))
        os.kill(os.getpid(), number)
    return forward(self, *args)

NemoObjective.forward = stopped
number = signal.SIGINT
assert train("fsdp", "--strategy", "fsdp") == 130  # both stop after the second step of fine-tuning
assert train("fsdp", "--strategy", "fsdp") == 0
calls, stop_at, number = 0, 3 + 3, signal.SIGKILL  # in the last step of fine-tuning
sys.exit(train("ddp"))
"""


@pytest.fixture(scope="module")
def alone(log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The same recipe trained by this process."""
    return train_run(in_two_parts(), [log], tmp_path_factory.mktemp("alone") / "run")


@pytest.fixture(scope="module")
def both(
    alone: Run, log: LogPath, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Callable[[int], str]]:
    """Folder of two runs of two processes, by FSDP and by DDP; what each rank printed on stderr.

    Ctrl-C in the second process stopped the run by FSDP, which then went on. The second process of the run by
    DDP was killed in its last step.
    """
    folder = tmp_path_factory.mktemp("both")
    recipe, script, cache = folder / "recipe.yaml", folder / "both.py", folder / "cache"
    save_recipe(alone.recipe, recipe)
    script.write_text(BOTH)
    cache.mkdir()
    logs = folder / "logs"
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += [f"--log-dir={logs}", "--redirects=3", "--", str(script)]
    path = os.pathsep.join([str(TESTS), str(TESTS / "data"), *sys.path])
    done = subprocess.run(
        [*command, str(recipe), str(log.folder), str(folder / "runs"), str(cache)],
        timeout=600,
        capture_output=True,
        env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode != 0

    def stderr(rank: int) -> str:
        (file,) = logs.glob(f"*/attempt_0/{rank}/stderr.log")
        return file.read_text()

    assert (folder / "runs" / "ddp").is_dir(), stderr(0) + stderr(1)
    return folder, stderr


def test_shards_give_the_losses_and_weights_of_one_process(
    alone: Run, both: tuple[Path, Callable[[int], str]]
) -> None:
    run = both[0] / "runs" / "fsdp"
    assert_same_losses(run, alone.folder)
    found, expected = load_file(open_run(run).weights), load_file(alone.weights)
    assert {name: value.shape for name, value in found.items()} == {
        name: value.shape for name, value in expected.items()
    }
    conditions = json.loads((run / "finetune" / "conditions.json").read_text())
    assert (conditions["processes"], conditions["parts"]) == (2, 2)


def test_only_the_first_process_writes(both: tuple[Path, Callable[[int], str]]) -> None:
    assert (both[0] / "cache" / "touched").read_text() == ""


def test_the_others_end_with_one_line_when_a_process_is_lost(both: tuple[Path, Callable[[int], str]]) -> None:
    lines = [line for line in both[1](0).splitlines() if "ended" in line or "Traceback" in line]
    assert lines == [
        "foredrive (rank 0): another process of this training has ended; "
        "the same command goes on from the last checkpoint"
    ]


def test_one_process_goes_on_with_what_two_have_begun(
    alone: Run, both: tuple[Path, Callable[[int], str]], log: LogPath
) -> None:
    run = both[0] / "runs" / "ddp"
    assert [line["step"] for line in losses(run, "finetune")] == [1, 2]
    assert not (run / "finetune" / "model.safetensors").exists()
    train_run(alone.recipe, [log], run, both[0] / "cache")
    assert_same_losses(run, alone.folder)
    assert json.loads((run / "finetune" / "conditions.json").read_text())["processes"] == 1
