"""Memory of a training step of nemo_base at full size, without a card: `foredrive bench nemo-memory`.

The bytes of all live tensors are counted through a step on coarser voxels (`common.live_memory`): what
autograd keeps, what checkpoints compute again, gradients, weights, moments. Between voxels of 0.8 m and of
0.5 m the peak lies in the lifting, and grows with the number of voxels. In bfloat16 as on a card, but for
kernels of the CPU, which read and keep 32 bits: a card holds less.
"""

import json
import math
import sys

import torch

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.live_memory import LiveMemory
from benchmarks.common.measuring import in_a_process
from benchmarks.nemo_base import FULL_M, Bench, recipe_at

MEASURED_M = (0.8, 0.625)
"""Voxel sizes from whose memory that of the full size follows."""


def live_memory(voxel_m: float) -> dict[str, float]:
    """Return the peak of the bytes of live tensors in a training step, GiB, and the number of voxels."""
    recipe = recipe_at(voxel_m)
    bench = Bench(recipe)
    # The first step makes the optimizer's moments, which a card holds from then on
    bench.step()
    state = [value for values in bench.optimizer.state.values() for value in values.values()]
    there = [*bench.objective.parameters(), *bench.objective.buffers(), *filter(torch.is_tensor, state)]
    memory = LiveMemory([*there, bench.example.clip.images])
    with memory:
        bench.step()
    return {"peak_gib": memory.peak_bytes / 2**30, "voxels": float(math.prod(recipe.clips.voxels.shape_zyx))}


def measure_memory(seed: int) -> dict[str, float]:
    """Return the peak memory of a training step at full size, on the line through two coarser grids."""
    coarse, finer = (in_a_process(__file__, str(voxel_m)) for voxel_m in MEASURED_M)
    slope = (finer["peak_gib"] - coarse["peak_gib"]) / (finer["voxels"] - coarse["voxels"])
    full = math.prod(recipe_at(FULL_M).clips.voxels.shape_zyx)
    return {
        "peak_gib": finer["peak_gib"] + slope * (full - finer["voxels"]),
        **{
            f"peak_{metres:g}m_gib": part["peak_gib"]
            for metres, part in zip(MEASURED_M, (coarse, finer), strict=True)
        },
    }


BENCHMARK = Benchmark(
    question="What memory does a training step of nemo_base take?",
    arms={"step": measure_memory},
    seeds=(0,),
    config={"voxels_m": list(MEASURED_M)},
    decided_by=("benchmarks.nemo_memory", "foredrive.methods", "foredrive.ops"),
)

if __name__ == "__main__":
    print(json.dumps(live_memory(float(sys.argv[1]))))
