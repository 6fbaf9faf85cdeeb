"""Speed and memory of the CPU kernels that read volumes, compared with plain PyTorch: `foredrive bench ops`.

Every kernel and every reference runs in its own process. Lifting has its own benchmark.
"""

import functools
import json
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import compare, in_a_process, measure_op
from foredrive.geometry.se3 import exp_se3
from foredrive.ops.attention3d import attend_volume, attend_volume_reference
from foredrive.ops.volume import sample_volume, sample_volume_reference, source_points, warp_volume
from foredrive.scene import VoxelSpec

RUNS = 7


class Case(NamedTuple):
    """One op at one size: the op and its reference as functions of their differentiable inputs."""

    fast: Callable[..., Tensor]
    reference: Callable[..., Tensor]
    inputs: Sequence[Tensor]


def attention3d() -> Case:
    """Return self-attention of four volumes of 8×64×64, 4 heads of 4 points, D = 32."""
    spec = VoxelSpec(lower_m=(0.0, 0.0, 0.0), voxel_m=1.0, shape_zyx=(8, 64, 64))
    centres = spec.centres_m().flatten(0, 2)
    points = centres[:, None, None] + 2 * torch.randn(4, len(centres), 4, 4, 3)
    weights = torch.randn(4, len(centres), 4, 4).softmax(-1)
    return Case(attend_volume, attend_volume_reference, [torch.randn(4, 8, 64, 64, 32), points, weights])


def rays() -> Case:
    """Return 2048 rays of 48 samples through a volume of 8×64×64, 33 channels."""
    direction = torch.nn.functional.normalize(torch.randn(2048, 1, 3) * torch.tensor([1.0, 1.0, 0.1]), dim=-1)
    points = torch.tensor([32.0, 32.0, 4.0]) + direction * torch.linspace(1, 40, 48)[:, None]
    volume = torch.randn(1, 8, 64, 64, 33)
    return Case(sample_volume, sample_volume_reference, [volume, points.view(1, -1, 3)])


def warp() -> Case:
    """Return four volumes of 8×64×64, D = 32, moved by a small motion."""
    T = exp_se3(torch.tensor([[0.5, 0.1, 0.0, 0.0, 0.0, 0.05]] * 4))
    lower_m, voxel_m = (-24.0, -24.0, -1.5), 0.75

    def reference(volume: Tensor, flow: Tensor, T: Tensor) -> Tensor:
        points = source_points(T, volume.shape[2:], lower_m, voxel_m).flatten(1, 3)
        points = points + sample_volume_reference(flow.permute(0, 2, 3, 4, 1), points) / voxel_m
        read = sample_volume_reference(volume.permute(0, 2, 3, 4, 1), points)
        return read.unflatten(1, volume.shape[2:]).permute(0, 4, 1, 2, 3)

    def fast(volume: Tensor, flow: Tensor, T: Tensor) -> Tensor:
        return warp_volume(volume, flow, T, lower_m, voxel_m)

    volume = torch.randn(4, 32, 8, 64, 64).contiguous(memory_format=torch.channels_last_3d)
    return Case(fast, reference, [volume, 0.1 * torch.randn(4, 3, 8, 64, 64), T])


CASES: dict[str, Callable[[], Case]] = {case.__name__: case for case in (attention3d, rays, warp)}


def measure(case: str, device: str, _: int) -> dict[str, float]:
    """Return the metrics of both paths and their ratios."""
    fast, reference = (in_a_process(__file__, case, device, path) for path in ("fast", "reference"))
    return {"threads": torch.get_num_threads()} | compare(fast, reference)


def _measure_here(case: str, device: str, path: str) -> dict[str, float]:
    torch.manual_seed(0)
    fast, reference, inputs = CASES[case]()
    inputs = [x.to(device) for x in inputs]
    if path == "reference":
        return measure_op(reference, inputs, RUNS, device)
    started = time.perf_counter()
    _compile(device)
    compile_s = time.perf_counter() - started
    return measure_op(fast, inputs, RUNS, device) | {"compile_s": compile_s}


def _compile(device: str) -> None:
    """Call the kernels on tiny inputs, so that they compile."""
    values, points = (torch.ones(1, 1, 1, 1, size, device=device) for size in (1, 3))
    weights = torch.ones(1, 1, 1, 1, device=device)
    attend_volume(values.requires_grad_(), points, weights).sum().backward()


BENCHMARK = Benchmark(
    question="How much faster and leaner are the CPU kernels than their plain PyTorch references?",
    arms={case: functools.partial(measure, case, "cpu") for case in CASES},
    seeds=(0,),
)

if __name__ == "__main__":
    print(json.dumps(_measure_here(*sys.argv[1:])))
