"""Cost of nemo_base at full size, on a synthetic clip: `foredrive bench nemo-base`.

The clip has six cameras of 448×800, two observed and three imagined frames, 200×200×16 voxels, batch 1. The
benchmark runs the second stage of training, without the perceptual loss, whose weights are not always
installed. It uses a GPU if there is one; without a GPU it measures a training step only on coarser voxels.
"""

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from lightning_fabric import Fabric
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import forget_peak, in_a_process, measure, peak_mib
from foredrive.engine.fabric import make_fabric
from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.methods.blocks import lifting
from foredrive.methods.nemo import rendering
from foredrive.methods.nemo.recipes import nemo_base
from foredrive.methods.recipe import Recipe
from foredrive.ops import volume
from foredrive.ops.attention3d import attend_volume_reference
from foredrive.ops.lifting import lift_reference
from foredrive.ops.volume import sample_volume_reference
from foredrive.runs.build import build_agent, build_objective
from foredrive.scene import Boxes, CameraRig, Clip, Example, LidarSweep, Trajectory, VoxelGrid, VoxelSpec
from foredrive.scene.boxes import unlabelled

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
STEPS = 5 if DEVICE == "cuda" else 1
"""Number of timed steps."""
FULL_M, COARSER_M = 0.5, {"cuda": (0.5, 1.0, 2.0), "cpu": (2.0,)}[DEVICE]
"""Voxel size, m, and the voxel sizes for which the plain references may have enough memory."""
CAMERAS, FIELD_OF_VIEW_DEG, CAMERA_HEIGHT_M = 6, 74.0, 1.6


def made_up(recipe: Recipe) -> Example:
    """Return noise at the recipe's sizes: cameras that look all around, no lidar, no annotations."""
    clips, rng = recipe.clips, torch.Generator().manual_seed(0)
    frames, (height, width) = clips.past_frames + 1 + clips.future_frames, clips.image_hw
    shape, steps = (1, frames), clips.horizon_steps
    yes = torch.ones(shape, dtype=torch.bool)
    clip = Clip(
        t_s=((torch.arange(frames) - clips.past_frames) * 0.5)[None],
        T_world_ego=torch.eye(4, dtype=torch.float64).expand(*shape, 4, 4),
        images=torch.randint(0, 256, (*shape, CAMERAS, 3, height, width), generator=rng, dtype=torch.uint8),
        image_valid=torch.ones(*shape, CAMERAS, dtype=torch.bool),
        rig=_rig(frames, height, width),
        sweeps=_no_sweeps(torch.zeros(*shape, 0)),
        sweep_valid=~yes,
        misses_known=~yes,
        boxes=_no_boxes(torch.zeros(*shape, 0)),
        boxes_valid=~yes,
        ego_speed_mps=torch.full(shape, 4.0),
        ego_speed_valid=yes,
        command=torch.full((1,), 2),
        command_valid=yes[:, 0],
        route_xy=torch.zeros(1, 7, 2),
        route_valid=yes[:, :1].expand(-1, 7),
        future=Trajectory(
            xy=torch.stack([torch.arange(1, steps + 1) * 2.0, torch.zeros(steps)], -1)[None, None],
            yaw=torch.zeros(1, 1, steps),
            valid=torch.ones(1, 1, steps, dtype=torch.bool),
            log_prob=torch.zeros(1, 1),
            dt_s=clips.horizon_dt_s,
        ),
    )
    grid = clips.voxels.shape_zyx
    known = torch.rand(*shape, *grid, generator=rng) > 0.5
    occupied = (torch.rand(*shape, 1, *grid, generator=rng) > 0.9).float()
    still = torch.zeros(()).expand(*shape, 3, *grid)
    return Example(
        clip=clip,
        occupancy=VoxelGrid(clips.voxels, occupied, known),
        flow=VoxelGrid(clips.voxels, still, torch.zeros_like(known)),
        key=("made up",),
    )


def _no_sweeps(none: Tensor) -> LidarSweep:
    vectors = none[..., None].expand(*none.shape, 3)
    return LidarSweep(vectors, vectors, none, none.bool(), none, none, none.long(), none.bool())


def _no_boxes(none: Tensor) -> Boxes:
    vectors = none[..., None].expand(*none.shape, 3)
    return Boxes(
        vectors,
        vectors,
        none,
        vectors[..., :2],
        none.long(),
        none.long(),
        none.bool(),
        **unlabelled(*none.shape),
    )


def _rig(frames: int, height: int, width: int) -> CameraRig:
    turned = matrix_from_yaw(torch.arange(CAMERAS) * (2 * math.pi / CAMERAS), torch.zeros(CAMERAS, 3))
    turned[:, :3, :3] @= torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turned[:, 2, 3] = CAMERA_HEIGHT_M
    focal = width / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG / 2))
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return CameraRig(
        K=K.expand(1, frames, CAMERAS, 3, 3),
        T_ego_cam=turned.expand(1, frames, CAMERAS, 4, 4),
        dist=torch.zeros(1, frames, CAMERAS, 5),
        readout_s=torch.zeros(1, frames, CAMERAS),
        names=tuple(f"camera_{i}" for i in range(CAMERAS)),
        size_hw=(height, width),
    )


def recipe_at(voxel_m: float) -> Recipe:
    """Return nemo_base with voxels of this size and without the perceptual loss."""
    recipe = nemo_base()
    spec = recipe.clips.voxels
    z, y, x = (round(n * spec.voxel_m / voxel_m) for n in spec.shape_zyx)
    clips = dataclasses.replace(recipe.clips, voxels=VoxelSpec(spec.lower_m, voxel_m, (z, y, x)))
    return without_perceptual_loss(dataclasses.replace(recipe, clips=clips))


def without_perceptual_loss(recipe: Recipe) -> Recipe:
    """Return a recipe whose second stage needs no weights of a perceptual loss."""
    return dataclasses.replace(recipe, finetune=dataclasses.replace(recipe.finetune, perceptual=None))


@contextmanager
def kernels_as(change: Callable[[str, Callable[..., Tensor]], Callable[..., Tensor]]) -> Iterator[None]:
    """Replace every kernel `op` of the model by change(name, op) within the context."""
    places = [(lifting, "lift"), (lifting, "attend_volume"), (rendering, "attend_volume")]
    places += [(rendering, "sample_volume"), (volume, "sample_volume")]
    kept = [getattr(module, name) for module, name in places]
    for (module, name), op in zip(places, kept, strict=True):
        setattr(module, name, change(name, op))
    try:
        yield
    finally:
        for (module, name), op in zip(places, kept, strict=True):
            setattr(module, name, op)


REFERENCES: Mapping[str, Callable[..., Tensor]] = {
    "lift": lift_reference,
    "attend_volume": attend_volume_reference,
    "sample_volume": sample_volume_reference,
}


class Bench:
    """An objective, its optimizer and an example, ready for training steps."""

    def __init__(self, recipe: Recipe, fabric: Fabric | None = None) -> None:
        torch.manual_seed(0)
        self.fabric = fabric or make_fabric(recipe.precision)
        self.agent = build_agent(recipe, fetch=False)
        objective = build_objective(recipe, recipe.finetune, self.agent)
        optimizer = torch.optim.AdamW(objective.parameters(), lr=recipe.finetune.schedule.lr)
        self.objective, self.optimizer = self.fabric.setup(objective, optimizer)
        self.example = made_up(recipe).to(DEVICE)

    def forward(self) -> Tensor:
        """Return the loss."""
        losses: dict[str, Tensor] = self.objective(self.example, torch.Generator().manual_seed(0))
        return losses["loss"]

    def step(self) -> None:
        """Do one step as `training.train` does."""
        loss = self.forward()
        self.optimizer.zero_grad(set_to_none=True)
        self.fabric.backward(loss)
        self.fabric.clip_gradients(self.objective, self.optimizer, max_norm=35.0)
        self.optimizer.step()

    def parameters(self) -> dict[str, float]:
        """Return the number of parameters of each part."""
        world = self.agent.world_model
        parts = {
            "backbone": world.backbone,
            "lifting": world.encoder,
            "motion": world.motion,
            "renderer": world.renderer,
            "occupancy": world.occupancy,
            "planner": self.agent.planner,
        }
        counts = {f"parameters.{name}": sum(p.numel() for p in m.parameters()) for name, m in parts.items()}
        return counts | {"parameters": sum(counts.values())}


def forward_pass() -> dict[str, float]:
    """Measure one forward pass with losses, without gradients, at full size; count floating point
    operations.
    """
    bench = Bench(recipe_at(FULL_M))
    bench.agent.requires_grad_(False)
    kernel_flops = {"lift": 0, "attend_volume": 0, "sample_volume": 0}

    def counting(name: str, op: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def run(*inputs: Any) -> Tensor:
            if name == "lift":  # four pixels around a point; a product and a sum for each channel of its head
                values, _, visible, _, weights = inputs
                kernel_flops[name] += 8 * int(visible.sum()) * weights[0, 0, 0].numel() * values[0].shape[-1]
            else:
                points, channels = inputs[1], inputs[0].shape[-1]
                heads = points.shape[2] if name == "attend_volume" else 1
                kernel_flops[name] += 16 * (points.numel() // 3) * (channels // heads)
            return op(*inputs)

        return run

    def attention_flops(query: Any, key: Any, value: Any, *_: Any, **__: Any) -> int:
        return sdpa_flop_count(query, key, value)

    on_cpu = {torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: attention_flops}
    forget_peak(DEVICE)
    with (
        torch.no_grad(),
        kernels_as(counting),
        FlopCounterMode(display=False, custom_mapping=on_cpu) as counter,
    ):
        bench.forward()
    figures = bench.parameters()
    figures |= {f"flops.{name}": float(flops) for name, flops in kernel_flops.items()}
    figures["flops"] = counter.get_total_flops() + sum(kernel_flops.values())
    with torch.no_grad():
        took = measure(bench.forward, STEPS, DEVICE)
    figures |= {"forward_s": took.wall_s, "forward_cpu_s": took.cpu_s}
    return figures | {"peak_gib": peak_mib(DEVICE) / 1024}


def training_step(voxel_m: float, path: str) -> dict[str, float]:
    """Measure training steps by the kernels ("fast") or the plain references; {} if memory is too small."""
    bench = Bench(recipe_at(voxel_m))
    forget_peak(DEVICE)
    try:
        with kernels_as(lambda name, op: op if path == "fast" else REFERENCES[name]):
            if DEVICE == "cuda" or path == "fast":  # plain PyTorch compiles nothing on the CPU
                bench.step()
            took = measure(bench.step, STEPS, DEVICE)
    except torch.OutOfMemoryError:
        return {}
    return {"step_s": took.wall_s, "step_cpu_s": took.cpu_s, "peak_gib": peak_mib(DEVICE) / 1024}


def measure_step(seed: int) -> dict[str, float]:
    """Measure a training step at full size."""
    return in_a_process(__file__, "step", str(FULL_M), "fast")


def measure_speedup(seed: int) -> dict[str, float]:
    """Measure training steps of the two paths on the finest voxels that fit into memory with the
    references.
    """
    for voxel_m in COARSER_M:
        reference = in_a_process(__file__, "step", str(voxel_m), "reference")
        if reference:
            break
    fast = in_a_process(__file__, "step", str(voxel_m), "fast")
    figures = {f"fast.{key}": value for key, value in fast.items()}
    figures |= {f"reference.{key}": value for key, value in reference.items()}
    return figures | {"voxel_m": voxel_m, "speedup_over_reference": reference["step_s"] / fast["step_s"]}


ARMS = {"forward": lambda seed: in_a_process(__file__, "forward"), "speedup": measure_speedup}
BENCHMARK = Benchmark(
    question="What does nemo_base take, and how much faster do the kernels make it?",
    arms=ARMS | ({"step": measure_step} if DEVICE == "cuda" else {}),
    seeds=(0,),
    config={"device": DEVICE},
)

if __name__ == "__main__":
    if sys.argv[1] == "forward":
        print(json.dumps(forward_pass()))
    else:
        print(json.dumps(training_step(float(sys.argv[2]), sys.argv[3])))
