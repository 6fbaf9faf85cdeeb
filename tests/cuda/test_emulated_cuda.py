"""The package on an emulated card: the same figures as on the CPU, and nothing that CUDA refuses."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import emulation
import pytest
from miniature import assert_same_losses, in_two_parts

from foredrive.data import LogPath
from foredrive.engine.config import save_recipe
from foredrive.runs import train_run

HERE = Path(__file__).parent
CASES = (
    *("nemo", "driveworld", "heads", "run", "gaussians", "gsplat"),
    *("field", "sets", "alignment", "driver", "search"),
)
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "foredrive" / "tests"
CLOSE = {"gaussians": 1e-3, "gsplat": 1e-3, "field": 1e-3, "search": 1e-2, "run": 1e-3}
"""Relative differences where kernels of the CPU and plain PyTorch add up in another order."""
MOST_WAITS = {"nemo": 16, "driveworld": 20, "heads": 80}
"""Waits of the host in a step of fine-tuning and a plan."""

Outcome = dict[str, Any]


@pytest.fixture(scope="module")
def hooks() -> Path:
    if shutil.which("g++") is None:
        pytest.skip("no g++ to build an emulated card")
    return emulation.built_hooks(CACHE)


@pytest.fixture(scope="module")
def outcomes(hooks: Path) -> dict[str, dict[str, Outcome]]:
    """Return what each case gives on both devices, from two processes side by side."""
    program = [sys.executable, str(HERE / "cases.py")]
    started = {
        device: subprocess.Popen(
            [*program, device, str(hooks), *CASES], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for device in ("cpu", "cuda")
    }
    found = {}
    for device, process in started.items():
        out, error = process.communicate()
        lines = [json.loads(line) for line in out.splitlines() if line.startswith('{"case"')]
        assert len(lines) == len(CASES), error[-2000:]
        found[device] = {line["case"]: line for line in lines}
    return found


@pytest.mark.parametrize("case", CASES)
def test_a_card_gives_the_figures_of_the_cpu(case: str, outcomes: dict[str, dict[str, Outcome]]) -> None:
    on_cpu, on_card = outcomes["cpu"][case], outcomes["cuda"][case]
    for outcome in (on_cpu, on_card):
        assert "error" not in outcome, (outcome["error"], outcome["lines"])
    assert on_card["figures"] == pytest.approx(on_cpu["figures"], rel=CLOSE.get(case, 1e-4), abs=1e-5)
    # The card was used, and the CPU's run did not know of it
    assert on_card["counts"]
    assert not on_cpu["counts"]


@pytest.mark.slow
def test_an_export_uses_no_card_that_is_there(hooks: Path) -> None:
    program = [sys.executable, str(HERE / "cases.py"), "unusable", str(hooks), "export"]
    done = subprocess.run(program, capture_output=True, text=True)
    (line,) = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"case"')]
    assert "error" not in line, (line["error"], line["lines"])
    assert len(line["figures"]) > 4
    assert max(line["figures"].values()) < 1e-3


@pytest.mark.parametrize("case", MOST_WAITS)
def test_a_step_makes_the_host_wait_seldom(case: str, outcomes: dict[str, dict[str, Outcome]]) -> None:
    counts = outcomes["cuda"][case]["counts"]
    kinds = (emulation.WAIT, emulation.TO_HOST)  # A copy to the host is waited for too
    waits = {line: count for line, count in counts.items() if line.startswith(kinds)}
    assert sum(waits.values()) <= MOST_WAITS[case], waits


REFUSED = {
    "a tensor of the CPU beside one of the card": "x + torch.ones(3)",
    "a tensor of the card in NumPy": "x.numpy()",
    "a tensor of the card in an array": "numpy.asarray(x)",
    "a generator of the CPU": "torch.rand(3, device='cuda', generator=torch.Generator())",
    "an index of the card into a tensor of the CPU": "torch.ones(3)[torch.tensor([0], device='cuda')]",
    "a module of the CPU": "torch.nn.Linear(3, 2)(x)",
}


def test_what_cuda_refuses_is_refused(hooks: Path) -> None:
    """Controls: each line fails on a card, so it has to fail here. What CUDA allows passes."""
    program = f"""
import sys
sys.path.insert(0, {str(HERE)!r})
import emulation, pathlib
emulation.start(pathlib.Path({str(hooks)!r}))
import emulated_card, numpy, torch
emulated_card.begin()
x = torch.arange(3.0, device="cuda")
for name, line in {REFUSED!r}.items():
    try:
        eval(line)
    except (RuntimeError, TypeError):
        continue
    print(name)
assert (x + torch.tensor(1.0)).device.type == "cuda"  # a number of the host
assert x[torch.tensor([0, 2])].tolist() == [0.0, 2.0]
assert x.cpu().numpy().sum() == 3.0
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


ON_CARDS = """
import pathlib, sys
here, hooks, recipe, log, out = sys.argv[1:]
sys.path[:0] = [here]
import emulation
emulation.start(pathlib.Path(hooks))
import emulated_card, emulated_processes
emulated_card.begin()
emulated_processes.begin()
from foredrive.ops import precision
precision._has_triton = lambda: False  # No card is here that could start kernels
from foredrive.cli.main import main
assert main(["train", recipe, "--logs", log, "--out", out]) == 0
import torch
assert torch.distributed.get_world_size() == 2
try:
    torch.distributed.all_reduce(torch.ones(2))
except RuntimeError:
    sys.exit(0)
sys.exit("NCCL refuses tensors of the host")
"""


def test_two_cards_train_like_one_process(hooks: Path, log: LogPath, tmp_path: Path) -> None:
    recipe, script, out = tmp_path / "recipe.yaml", tmp_path / "on_cards.py", tmp_path / "run"
    save_recipe(in_two_parts(), recipe)
    script.write_text(ON_CARDS)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    arguments = [script, HERE, hooks, recipe, log.folder, out]
    done = subprocess.run([*command, *map(str, arguments)], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]
    alone = train_run(in_two_parts(), [log], tmp_path / "alone")
    assert_same_losses(out, alone.folder)
