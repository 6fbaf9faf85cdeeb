"""Speed of the parts of a neural field: `foredrive bench field`.

`grid` reads a hash grid of eight levels with two features each, from 32 to 8192 cells along a side, with at
most 2^17 rows a level. A million points lie on rays in patches of 32 × 32 pixels, 32 samples on each ray.
Arm `proposal` has six levels of one feature. `…_mpoints_per_s` are millions of points forward and backward
per CPU second; with `to_points`, the gradient reaches the points too. Plain PyTorch reads 65,536 of them.
"""

import json
import sys
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.common.measuring import in_a_process, measure
from foredrive.evaluation.bench import Benchmark
from foredrive.ops.hash_grid import Level, grid_levels, read_hash_grid, read_hash_grid_reference

RUNS, POINTS, REFERENCE_POINTS = 7, 2**20, 2**16
GRIDS = {"grid": (8, 2, 8192), "proposal": (6, 1, 2048)}
"""Levels, features, finest cells of each arm; 32 cells in the coarsest level, 2^17 rows."""


def points_on_rays(count: int) -> Tensor:
    """Return points in the unit cube, 32 on each ray, for patches of 32 × 32 rays from the centre."""
    rng = torch.Generator().manual_seed(0)
    rays = count // 32
    pixel = torch.linspace(-0.03, 0.03, 32)
    within = torch.stack(torch.meshgrid(pixel, pixel, indexing="ij"), dim=-1).view(-1, 2)
    patch = 0.6 * torch.rand(rays // 1024, 1, 2, generator=rng) - 0.3
    across = (patch + within).view(rays, 2)
    direction = torch.nn.functional.normalize(torch.cat([torch.ones(rays, 1), across], dim=-1), dim=-1)
    distance = torch.linspace(0.01, 0.4, 32) + 0.01 * torch.rand(rays, 1, generator=rng)
    return (0.5 + direction[:, None] * distance[..., None]).view(-1, 3)


def _measure_here(arm: str, path: str) -> dict[str, float]:
    number, features, finest = GRIDS[arm]
    levels = grid_levels(number, 32, finest, 17)
    table = 0.1 * torch.randn(levels[-1].first_row + levels[-1].rows, features)
    read: Callable[[Tensor, Tensor, tuple[Level, ...]], Tensor] = read_hash_grid
    count, runs = POINTS, RUNS
    if path == "reference":
        read, count, runs = read_hash_grid_reference, REFERENCE_POINTS, 2
    points = points_on_rays(count)
    figures = {}
    for name, wanted in (("", [True, False]), ("to_points_", [True, True])):
        leaves = [x.clone().requires_grad_(w) for x, w in zip((table, points), wanted, strict=True)]
        upstream = torch.ones(number * features, count)

        def step(leaves: list[Tensor] = leaves, upstream: Tensor = upstream) -> None:
            out = read(*leaves, levels)  # type: ignore[call-arg]
            torch.autograd.grad(out, [x for x in leaves if x.requires_grad], upstream)

        step()  # compiles
        figures[f"{name}mpoints_per_s"] = count / 1e6 / measure(step, runs, "cpu").cpu_s
    return figures


def measure_grid(arm: str) -> dict[str, float]:
    """Return the speed of the kernel and of plain PyTorch."""
    fast, slow = (in_a_process(__file__, arm, path) for path in ("fast", "reference"))
    figures = {f"{arm}_{name}": value for name, value in fast.items()}
    figures |= {f"{arm}_reference_{name}": value for name, value in slow.items()}
    return figures | {"threads": float(torch.get_num_threads())}


BENCHMARK = Benchmark(
    question="How fast are the parts of a neural field on a CPU?",
    arms={arm: lambda seed, arm=arm: measure_grid(arm) for arm in GRIDS},  # type: ignore[misc]
    seeds=(0,),
)

if __name__ == "__main__":
    print(json.dumps(_measure_here(*sys.argv[1:])))
