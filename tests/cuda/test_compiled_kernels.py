"""Triton's kernels compile for cards, at the sizes of whole models, and little of them is spilled."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
MOST_STACK_BYTES = 64
"""Sine and cosine of large angles alone take 32."""


@pytest.mark.parametrize("capability", [80, 90])
def test_kernels_compile_and_fit_into_registers(capability: int, tmp_path: Path) -> None:
    pytest.importorskip("triton", reason="Triton is not installed")
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    paths = os.pathsep.join([str(ROOT), *sys.path])
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.common.compiled_kernels", str(capability)],
        env=environment | {"TRITON_CACHE_DIR": str(tmp_path), "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    variants = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert len(variants) > 40
    assert [variant for variant in variants if variant["stack_bytes"] > MOST_STACK_BYTES] == []


def test_three_features_are_refused_in_a_sentence() -> None:
    pytest.importorskip("triton", reason="Triton is not installed")
    from foredrive.ops.hash_grid_triton import read_hash_grid_triton

    with pytest.raises(ValueError, match="1, 2, 4 or 8 features, not 3"):
        read_hash_grid_triton(torch.zeros(8, 3), torch.zeros(1, 3), [(1, 0, 8, True)])
