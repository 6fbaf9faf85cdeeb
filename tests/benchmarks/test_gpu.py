"""`make gpu` on the CPU, with the packages that a machine for GPUs may lack taken away."""

import json
import subprocess
import sys

import pytest
import torch

from benchmarks.common.measuring import CHECKOUT

ABSENT = ("py123d", "pyarrow", "pandas", "cv2", "shapely", "trimesh", "embreex", "geopandas", "tyro", "scipy")
PROGRAM = """
import json, sys
sys.modules.update(dict.fromkeys(sys.argv[2].split(",")))
from benchmarks import gpu
print(json.dumps(gpu.PROGRAMS[sys.argv[1]]()))
"""


def figures(name: str) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, name, ",".join(ABSENT)],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    measured: dict[str, float] = json.loads(done.stdout)
    return measured


def test_an_exported_program_gives_what_the_agent_gives() -> None:
    measured = figures("export")
    assert measured["waypoints_difference_m"] < 1e-4
    assert measured["occupancy_difference"] < 1e-3


def test_a_group_of_one_process_learns_the_same() -> None:
    measured = figures("ddp")
    assert 0 < measured["loss_after_steps"] < 100
    assert measured["loss_difference"] <= 1e-4 * measured["loss_after_steps"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="measures where a GPU is")
def test_a_machine_without_a_gpu_is_told_so_in_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.gpu"], cwd=CHECKOUT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("no GPU here")
    assert done.stderr.count("\n") == 1
