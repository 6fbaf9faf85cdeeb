"""How fast the CPU kernels are and how much memory they take, beside their plain PyTorch references.

Every kernel runs in a process of its own, and its reference in another: `foredrive bench ops`.
"""

import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import torch
from torch import Tensor

from foredrive.evaluation import Benchmark
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import exp_se3, inverse_se3, matrix_from_yaw, transform_points
from foredrive.ops.attention3d import attend_volume, attend_volume_reference
from foredrive.ops.lifting import lift, lift_reference
from foredrive.ops.volume import places_before, sample_volume, sample_volume_reference, warp_volume
from foredrive.scene import VoxelSpec

RUNS = 7


class Case(NamedTuple):
    """One op at one size: the op and its reference as functions of what they are differentiated by."""

    fast: Callable[..., Tensor]
    reference: Callable[..., Tensor]
    inputs: Sequence[Tensor]


def lifting() -> Case:
    """20 k voxels, six cameras all around, four levels of 448×800 images, 8 heads of 8 points, D = 64."""
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
        return lambda offsets, weights, *values: op(values, uv, visible[None], offsets, weights)

    return Case(run(lift), run(lift_reference), [offsets, weights, *values])


def attention3d() -> Case:
    """Self-attention of four volumes of 8×64×64, 4 heads of 4 points, D = 32."""
    spec = VoxelSpec(lower_m=(0.0, 0.0, 0.0), voxel_m=1.0, shape_zyx=(8, 64, 64))
    centres = spec.centres_m().flatten(0, 2)
    points = centres[:, None, None] + 2 * torch.randn(4, len(centres), 4, 4, 3)
    weights = torch.randn(4, len(centres), 4, 4).softmax(-1)
    return Case(attend_volume, attend_volume_reference, [torch.randn(4, 8, 64, 64, 32), points, weights])


def rays() -> Case:
    """2048 rays of 48 samples through a volume of 8×64×64, 33 channels."""
    direction = torch.nn.functional.normalize(torch.randn(2048, 1, 3) * torch.tensor([1.0, 1.0, 0.1]), dim=-1)
    points = torch.tensor([32.0, 32.0, 4.0]) + direction * torch.linspace(1, 40, 48)[:, None]
    volume = torch.randn(1, 8, 64, 64, 33)
    return Case(sample_volume, sample_volume_reference, [volume, points.view(1, -1, 3)])


def warp() -> Case:
    """Four volumes of 8×64×64, D = 32, moved by a small motion."""
    T = exp_se3(torch.tensor([[0.5, 0.1, 0.0, 0.0, 0.0, 0.05]] * 4))
    lower_m, voxel_m = (-24.0, -24.0, -1.5), 0.75

    def reference(volume: Tensor, flow: Tensor, T: Tensor) -> Tensor:
        places = places_before(flow, T, lower_m, voxel_m).flatten(1, 3)
        read = sample_volume_reference(volume.permute(0, 2, 3, 4, 1), places)
        return read.unflatten(1, volume.shape[2:]).permute(0, 4, 1, 2, 3)

    def fast(volume: Tensor, flow: Tensor, T: Tensor) -> Tensor:
        return warp_volume(volume, flow, T, lower_m, voxel_m)

    volume = torch.randn(4, 32, 8, 64, 64).contiguous(memory_format=torch.channels_last_3d)
    return Case(fast, reference, [volume, 0.1 * torch.randn(4, 3, 8, 64, 64), T])


CASES: dict[str, Callable[[], Case]] = {case.__name__: case for case in (lifting, attention3d, rays, warp)}


def measure(case: str) -> dict[str, float]:
    """Milliseconds (medians), peak MiB above the inputs, seconds of compiling, ratios of the two paths."""
    figures: dict[str, float] = {"threads": torch.get_num_threads()}
    found = {path: _in_a_process(case, path) for path in ("fast", "reference")}
    for path, values in found.items():
        figures |= {f"{path}.{key}": value for key, value in values.items()}
    took = {path: values["forward_ms"] + values["backward_ms"] for path, values in found.items()}
    figures["speedup"] = took["reference"] / took["fast"]
    figures["memory_ratio"] = found["fast"]["peak_mib"] / found["reference"]["peak_mib"]
    return figures


def _in_a_process(case: str, path: str) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as empty_cache:
        done = subprocess.run(
            [sys.executable, __file__, case, path],
            env=os.environ | {"NUMBA_CACHE_DIR": empty_cache},
            stdout=subprocess.PIPE,
            check=True,
            text=True,
        )
    figures: dict[str, float] = json.loads(done.stdout)
    return figures


def _measure_here(case: str, path: str) -> dict[str, float]:
    torch.manual_seed(0)
    inputs: Sequence[Tensor]
    fast, reference, inputs = CASES[case]()
    op = fast if path == "fast" else reference
    inputs = [x.requires_grad_() for x in inputs]
    started = time.perf_counter()
    if path == "fast":
        _compile()
    compile_s = time.perf_counter() - started
    Path("/proc/self/clear_refs").write_text("5")  # forget the highest memory use so far
    before_mib = _memory_mib("VmRSS")
    forward_s, backward_s = [], []
    for run in range(RUNS + 1):
        started = time.perf_counter()
        out = op(*inputs)
        forward_s.append(time.perf_counter() - started)
        upstream = torch.ones_like(out)
        started = time.perf_counter()
        torch.autograd.grad(out, inputs, upstream)
        backward_s.append(time.perf_counter() - started)
        if run == 0:
            peak_mib = _memory_mib("VmHWM") - before_mib
    figures = {
        "forward_ms": 1e3 * median(forward_s[1:]),
        "backward_ms": 1e3 * median(backward_s[1:]),
        "peak_mib": peak_mib,
    }
    return figures | ({"compile_s": compile_s} if path == "fast" else {})


def _compile() -> None:
    """Call the kernels on next to nothing."""
    values, points = torch.ones(1, 1, 1, 1, 1, requires_grad=True), torch.ones(1, 1, 1, 1, 3)
    attend_volume(values, points, torch.ones(1, 1, 1, 1)).sum().backward()
    one = torch.ones(1, 1, 1, 1, 1)
    seen = torch.ones(1, 1, 1, dtype=torch.bool)
    lift([values], torch.ones(1, 1, 1, 2), seen, torch.ones(1, 1, 1, 1, 1, 2), one).sum().backward()


def _memory_mib(field: str) -> float:
    found = re.search(rf"{field}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


BENCHMARK = Benchmark(
    question="How much faster and leaner are the CPU kernels than their plain PyTorch references?",
    arms={case: lambda seed, case=case: measure(case) for case in CASES},  # type: ignore[misc]
    seeds=(0,),
)

if __name__ == "__main__":
    print(json.dumps(_measure_here(*sys.argv[1:])))
