"""Speed and memory of lifting, compared with plain PyTorch: `foredrive bench lifting`.

It runs on the CPU (numba) and, if there is one, on a GPU (Triton); each path runs in its own process.
"""

import functools
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import compare, in_a_process, measure_op
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw, transform_points
from foredrive.ops.lifting import lift, lift_reference
from foredrive.scene import VoxelSpec

RUNS = 7


class Case(NamedTuple):
    """The op and its reference as functions of the inputs that they are differentiated by."""

    fast: Callable[..., Tensor]
    reference: Callable[..., Tensor]
    inputs: Sequence[Tensor]


def case(device: str) -> Case:
    """Return 20 k voxels, six cameras all around, four levels of 448×800 images, 8 heads of 8 points, D =
    64.
    """
    spec = VoxelSpec(lower_m=(-50.0, -50.0, -3.0), voxel_m=2.0, shape_zyx=(8, 50, 50))
    height, width, cameras, heads, points, channels = 448, 800, 6, 8, 8, 64
    T_ego_cam = matrix_from_yaw(torch.arange(cameras) * (2 * math.pi / cameras), torch.zeros(cameras, 3))
    T_ego_cam[:, :3, :3] @= torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_ego_cam[:, 2, 3] = 1.6
    focal = width / 2 / math.tan(math.radians(37))
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).expand(cameras, 3, 3)
    centres = spec.centres_m().flatten(0, 2)
    in_camera = transform_points(inverse_se3(T_ego_cam), centres.expand(cameras, -1, -1))
    uv, _, visible = project(in_camera, K, torch.zeros(cameras, 5), (height, width))
    uv = (uv / torch.tensor([width, height]))[None]
    sizes = [(height // stride, width // stride) for stride in (4, 8, 16, 32)]
    values = [torch.randn(1, cameras, h, w, channels) for h, w in sizes]
    offsets = 3 * torch.randn(1, len(centres), heads, len(sizes), points, 2)
    weights = torch.randn(1, len(centres), heads, len(sizes) * points).softmax(-1).view(offsets.shape[:-1])

    def run(op: Callable[..., Tensor]) -> Callable[..., Tensor]:
        return lambda offsets, weights, *values: op(values, uv, visible, offsets, weights)

    uv, visible = uv.to(device), visible[None].to(device)
    inputs = [x.to(device) for x in (offsets, weights, *values)]
    return Case(run(lift), run(lift_reference), inputs)


def measure(device: str, _: int) -> dict[str, float]:
    """Return the metrics of both paths and their ratios."""
    fast, reference = (in_a_process(__file__, device, path) for path in ("fast", "reference"))
    return {"threads": torch.get_num_threads()} | compare(fast, reference)


def _measure_here(device: str, path: str) -> dict[str, float]:
    torch.manual_seed(0)
    fast, reference, inputs = case(device)
    if path == "reference":
        return measure_op(reference, inputs, RUNS, device)
    started = time.perf_counter()
    _compile(device)
    compile_s = time.perf_counter() - started
    return measure_op(fast, inputs, RUNS, device) | {"compile_s": compile_s}


def _compile(device: str) -> None:
    """Call the kernels on tiny inputs, so that they compile."""
    one = torch.ones(1, 1, 1, 1, 1, device=device, requires_grad=True)
    seen = torch.ones(1, 1, 1, dtype=torch.bool, device=device)
    offsets = torch.ones(1, 1, 1, 1, 1, 2, device=device)
    lift([one], torch.ones(1, 1, 1, 2, device=device), seen, offsets, one.detach()).sum().backward()


DEVICES = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
BENCHMARK = Benchmark(
    question="How much faster and leaner is lifting than in plain PyTorch, on the CPU and on a GPU?",
    arms={device: functools.partial(measure, device) for device in DEVICES},
    seeds=(0,),
)

if __name__ == "__main__":
    print(json.dumps(_measure_here(*sys.argv[1:])))
