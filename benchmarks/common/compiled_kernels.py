"""Triton's kernels, compiled for cards that are not here: `python -m benchmarks.common.compiled_kernels 90`.

Triton compiles for a card that a driver names. The driver here names one, and starts nothing; tensors are on
PyTorch's device "meta", so that the sizes are those of whole models and take no memory. The launching code is
the package's own. Prints a line of JSON for each variant of a kernel: its registers and its stack, by
`cuobjdump`, which comes with Triton. A stack holds what does not fit into registers.
"""

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import triton
from torch import Tensor
from triton.backends.compiler import GPUTarget
from triton.runtime.jit import JITFunction

from foredrive.ops.hash_grid_triton import read_hash_grid_triton
from foredrive.ops.lifting_triton import lift_triton
from foredrive.ops.ray_boxes_triton import crossing_pairs_triton
from foredrive.ops.volume_triton import attend_volume_triton

BF16, FP16, FP32 = torch.bfloat16, torch.float16, torch.float32
NEMO_LEVELS = tuple((448 // stride, 800 // stride) for stride in (4, 8, 16, 32))
"""Feature maps of `nemo_base`."""
VOXELS = 16 * 200 * 200
USAGE = re.compile(r"REG:(\d+) STACK:(\d+)")


class NoCard:
    """A driver of a card that compiles for it and starts nothing."""

    class utils:  # noqa: N801
        """Answers Triton's questions about the card."""

        @staticmethod
        def get_device_properties(device: int) -> dict[str, int]:
            """Return the limits of a card of the data centre."""
            return {
                "max_shared_mem": 166_912,
                "multiprocessor_count": 108,
                "warpSize": 32,
                "max_num_regs": 65_536,
            }

    def __init__(self, capability: int) -> None:
        self._target = GPUTarget("cuda", capability, 32)

    def get_current_target(self) -> GPUTarget:
        """Return what is compiled for."""
        return self._target

    def get_current_device(self) -> int:
        """Return the only card."""
        return 0

    def get_current_stream(self, device: int | None = None) -> int:
        """Return the only stream."""
        return 0

    def get_active_torch_device(self) -> torch.device:
        """Return the card as PyTorch names it."""
        return torch.device("cuda", 0)

    def map_python_to_cpp_type(self, kind: str) -> str:
        """Return a type for the launcher, which is not built."""
        return "void*"

    @property
    def launcher_cls(self) -> Callable[..., None]:
        """Return what stands for the launcher."""
        return lambda *_: None


def empty(*shape: int, dtype: torch.dtype = FP32, learned: bool = False) -> Tensor:
    """Return a tensor of a size and nothing else."""
    return torch.empty(*shape, dtype=dtype, device="meta", requires_grad=learned)


def lifting(
    cameras: int,
    levels: Sequence[tuple[int, int]],
    width: int,
    queries: int,
    heads: int,
    points: int,
    dtype: torch.dtype = FP32,
    *,
    values: bool = True,
    offsets: bool = True,
) -> None:
    """Compile the lifting of features, forward and backward."""
    sizes, first = [], 0
    for height, wide in levels:
        sizes.append((height, wide, first))
        first += height * wide
    shape = (1, queries, heads, len(levels), points)
    out = lift_triton(
        empty(1, cameras, first, width, dtype=dtype, learned=values),
        sizes,
        empty(1, cameras, queries, 2),
        empty(1, cameras, queries, dtype=torch.bool),
        empty(*shape, 2, learned=offsets),
        empty(*shape, learned=offsets),
    )
    out.backward(torch.empty_like(out))


def volume(
    shape_zyx: tuple[int, int, int],
    width: int,
    queries: int,
    heads: int,
    points: int,
    dtype: torch.dtype = FP32,
    *,
    places: bool = True,
) -> None:
    """Compile attention to a volume, forward and backward."""
    shape = (1, queries, heads, points)
    out = attend_volume_triton(
        empty(1, *shape_zyx, width, dtype=dtype, learned=True),
        empty(*shape, 3, learned=places),
        empty(*shape, learned=places),
    )
    out.backward(torch.empty_like(out))


def grid(
    features: int, points: int, dtype: torch.dtype = FP32, *, table: bool = True, places: bool = True
) -> None:
    """Compile the reading of a hash grid of eight levels, forward and backward."""
    levels, rows = 8, 2**17
    of_levels = [(32 * 2**level, rows * level, rows, level < 2) for level in range(levels)]
    out = read_hash_grid_triton(
        empty(rows * levels, features, dtype=dtype, learned=table),
        empty(points, 3, learned=places),
        of_levels,
        empty(points),
        empty(points, dtype=torch.int64),
    )
    out.backward(torch.empty_like(out))


def boxes(rays: int, count: int, times: int) -> None:
    """Compile the crossings of rays and boxes."""
    keys = [
        *(empty(rays, 3), empty(rays, 3), empty(rays, dtype=torch.int32), empty(rays)),
        *(empty(count, times, 3), empty(count, times, 3, 3), empty(count, times, 3), empty(count, 3)),
        empty(count, max(times - 1, 1), dtype=torch.bool),
    ]
    try:
        crossing_pairs_triton(keys)
    except (NotImplementedError, RuntimeError) as error:
        # Behind the kernel, the number of pairs depends on values, which "meta" has not
        if "meta" not in str(error):
            raise


CASES: dict[str, Callable[[], None]] = {
    "lift nemo_base, bf16": lambda: lifting(6, NEMO_LEVELS, 64, VOXELS, 8, 8, BF16),
    "lift nemo_base": lambda: lifting(6, NEMO_LEVELS, 64, VOXELS, 8, 8),
    "lift fp16": lambda: lifting(6, NEMO_LEVELS, 64, 1000, 8, 8, FP16),
    "lift one of all": lambda: lifting(1, [(3, 5)], 1, 1, 1, 1),
    "lift odd sizes": lambda: lifting(3, [(7, 9), (3, 5), (1, 1)], 21, 17, 3, 5),
    "lift values alone": lambda: lifting(6, NEMO_LEVELS, 64, 1000, 8, 8, BF16, offsets=False),
    "lift places alone": lambda: lifting(6, NEMO_LEVELS, 64, 1000, 8, 8, BF16, values=False),
    "attention nemo_base, bf16": lambda: volume((16, 200, 200), 64, VOXELS, 8, 8, BF16),
    "attention nemo_base": lambda: volume((16, 200, 200), 64, VOXELS, 8, 8),
    "warp": lambda: volume((16, 200, 200), 64, VOXELS, 1, 1),
    "samples along rays": lambda: volume((16, 200, 200), 64, 6 * 5600 * 96, 1, 1),
    "samples of 33 channels": lambda: volume((8, 64, 64), 33, 2048 * 48, 1, 1),
    "samples of a flow": lambda: volume((16, 200, 200), 3, VOXELS, 1, 1),
    "attention, one of all": lambda: volume((1, 1, 1), 1, 1, 1, 1),
    "attention, odd sizes": lambda: volume((8, 64, 64), 21, 1_000_003, 3, 5),
    "attention, values alone": lambda: volume((16, 200, 200), 64, 1000, 8, 8, BF16, places=False),
    **{f"grid of {f} features": lambda f=f: grid(f, 2**20) for f in (1, 2, 4, 8)},  # type: ignore[misc]
    "grid fp16": lambda: grid(2, 2**20, FP16),
    "grid, table alone": lambda: grid(2, 2**20, places=False),
    "grid, places alone": lambda: grid(2, 2**20, table=False),
    "grid, a point": lambda: grid(2, 1),
    "boxes of field_base": lambda: boxes(480 * 270, 60, 80),
    "boxes, one of all": lambda: boxes(1, 1, 1),
}


def usage(kernel: Any) -> tuple[int, int]:
    """Return the registers of a thread and its stack, bytes."""
    program = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(kernel.asm["cubin"])
        file.flush()
        command = [str(program), "--dump-resource-usage", file.name]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    match = USAGE.search(text)
    assert match is not None, text
    return int(match[1]), int(match[2])


def main() -> None:
    """Compile the cases that are named, or all, for a card of a compute capability such as 90."""
    capability, *names = sys.argv[1:]
    triton.runtime.driver.set_active(NoCard(int(capability)))
    started, variants, case = JITFunction.run, dict[int, str](), ""

    def compiled(self: Any, *args: Any, grid: Any, warmup: bool, **kwargs: Any) -> Any:
        # Limits of a launch: programs along the first axis, and along the others
        assert 0 < grid[0] < 2**31
        assert all(0 < size < 2**16 for size in grid[1:])
        kernel = started(self, *args, grid=grid, warmup=True, **kwargs)
        if id(kernel) not in variants:
            registers, stack = usage(kernel)
            variants[id(kernel)] = self.fn.__name__
            line = {"case": case, "kernel": self.fn.__name__, "registers": registers, "stack_bytes": stack}
            print(json.dumps(line), flush=True)
        return kernel

    JITFunction.run = compiled
    for case in names or CASES:
        CASES[case]()


if __name__ == "__main__":
    main()
