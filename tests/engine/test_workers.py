"""The processes that load data, and the process that they are forked from."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

PATIENCE_S = 300.0
KILLED = """
import os
from pathlib import Path

from torch.utils.data import Dataset

from foredrive.engine.loop import _loader
from foredrive.engine.parts import Part


class Workers(Dataset):
    def __len__(self):
        return 100

    def __getitem__(self, index):
        return os.getpid()


if __name__ == "__main__":
    steps = [[Part(0, 1.0, [number])] for number in range(50)]
    batches = iter(_loader(Workers(), list, steps, 2, pinned=False))
    Path("workers").write_text(f"{next(batches)[0]} {next(batches)[0]}")
    os.kill(os.getpid(), 9)
"""


def test_a_collection_in_a_worker_leaves_the_modules_it_was_born_with_alone() -> None:
    """Else the first full collection in each worker would copy the memory that all of them share."""
    code = (
        "import gc, multiprocessing\n"
        "from foredrive.engine.interrupts import start_fork_server\n"
        "start_fork_server(preload='decimal')\n"
        "with multiprocessing.get_context('forkserver').Pool(1) as pool:\n"
        "    print(pool.apply(gc.get_freeze_count))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 5_000  # objects of the modules that any Python process imports


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()  # a zombie waits for its parent only


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_the_workers_of_a_killed_training_end(tmp_path: Path) -> None:
    script = tmp_path / "killed.py"
    script.write_text(KILLED)
    with (tmp_path / "errors.txt").open("w") as errors:  # a pipe would be waited for until the workers end
        done = subprocess.run([sys.executable, script], cwd=tmp_path, stdout=errors, stderr=errors)
    assert done.returncode == -9, (tmp_path / "errors.txt").read_text()
    workers = {int(worker) for worker in (tmp_path / "workers").read_text().split()}
    assert len(workers) == 2
    until = time.monotonic() + PATIENCE_S
    while any(is_running(worker) for worker in workers):
        assert time.monotonic() < until, "a worker still runs"
        time.sleep(0.1)
