"""Two processes with an emulated card each train by DDP as one process on the CPU does."""

import subprocess
import sys
from pathlib import Path

from miniature import assert_same_losses, in_two_parts

from foredrive.data import LogPath
from foredrive.engine.config import save_recipe
from foredrive.runs import train_run

HERE = Path(__file__).parent
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
