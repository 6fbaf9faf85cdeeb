"""Training by two processes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from foredrive.training import read_metrics

SCRIPT = """
import sys
from pathlib import Path
from conftest import synthetic_example  # before anything of the package
from lightning_fabric import Fabric
from test_loop import Items, Prior, collate
from foredrive.training.loop import Schedule, train

fabric = Fabric(accelerator="cpu", devices=2, strategy="ddp")
fabric.launch()
schedule = Schedule(batch_size=1, lr=0.1, steps=12, warmup_steps=4)
train(Prior(), Items(synthetic_example, 4), collate, schedule, Path(sys.argv[1]), fabric)
"""


@pytest.mark.slow
def test_two_processes_take_half_as_many_steps(tmp_path: Path) -> None:
    script = tmp_path / "two.py"
    script.write_text(SCRIPT)
    tests = Path(__file__).parents[1]
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2", "--master-port=29417"]
    subprocess.run(
        [*command, str(script), str(tmp_path)],
        check=True,
        timeout=300,
        env={"PYTHONPATH": f"{tests}:{tests / 'training'}:" + ":".join(sys.path), "OMP_NUM_THREADS": "1"},
    )
    lines = read_metrics(tmp_path / "metrics.jsonl")
    assert [line["step"] for line in lines] == list(range(1, 7))
    assert lines[-1]["loss"] < lines[0]["loss"]
    assert json.loads((tmp_path / "conditions.json").read_text())["processes"] == 2
