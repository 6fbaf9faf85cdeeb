"""Speed of everything that has a path of its own on a GPU: `make gpu`.

`make gpu` first runs tests/ops, which hold the Triton kernels and gsplat to their plain PyTorch references,
values and gradients. The arms here time them, at the sizes and beside the references of `lifting`, `ops`,
`field` and `splats`. `gaussians` needs gsplat and `field` needs SciPy; without them these arms are left
out, and this is said. `nemo_base` is a training step of the paper's size.
`export` compares a torch.export program of a small NeMo with the agent, both on the GPU. `ddp` compares a
training step in a group of one process with a step without a group.

It runs as `python -m benchmarks.gpu` too, on a machine with PyTorch, Triton and numba, and little else:
docs/how-to/first-gpu-run.md names the packages.
"""

import json
import sys
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec

import torch
from lightning_fabric import Fabric

from benchmarks import field, lifting, nemo_base, ops, splats
from benchmarks.common.benchmark import Benchmark, run_benchmark
from benchmarks.common.measuring import CHECKOUT, in_a_process, measure
from foredrive.errors import InputError
from foredrive.integrations.graph import AgentGraph, GraphInputs, GraphOutputs
from foredrive.methods.nemo.recipes import nemo_tiny
from foredrive.methods.recipe import Recipe
from foredrive.runs.build import build_agent

DEVICE, RUNS = nemo_base.DEVICE, 7
NO_GPU = f"no GPU here that PyTorch {torch.__version__} can use: nothing was measured"


def small_recipe() -> Recipe:
    """Return nemo_tiny without the perceptual loss."""
    return nemo_base.without_perceptual_loss(nemo_tiny())


@torch.no_grad()
def export() -> dict[str, float]:
    """Compare a program of torch.export with its agent: largest differences of outputs, and latencies, ms."""
    torch.manual_seed(0)
    recipe = small_recipe()
    agent = build_agent(recipe, fetch=False).eval().to(DEVICE)
    observed = nemo_base.made_up(recipe).clip.observed().to(DEVICE)
    inputs, steps = GraphInputs.from_clip(observed, agent), recipe.clips.future_frames
    graph = AgentGraph(agent, observed.rig.names, recipe.clips.image_hw, steps).eval()
    program = torch.export.export(graph, tuple(inputs)).module()
    truth = GraphOutputs.from_agent(agent(observed, steps))
    outputs = GraphOutputs(**program(*inputs))
    return {
        "waypoints_difference_m": float((outputs.waypoints_xy - truth.waypoints_xy).abs().max()),
        "occupancy_difference": float((outputs.occupancy_logit - truth.occupancy_logit).abs().max()),
        "eager_ms": 1e3 * measure(lambda: agent(observed, steps), RUNS, DEVICE).wall_s,
        "exported_ms": 1e3 * measure(lambda: program(*inputs), RUNS, DEVICE).wall_s,
    }


def ddp() -> dict[str, float]:
    """Compare three steps in a group of one process (NCCL on a GPU) with three steps without a group."""
    warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")
    warnings.filterwarnings("ignore", message="`broadcast_buffers` is deprecated")
    losses, took_s = [], []
    for strategy in ("auto", "ddp_find_unused_parameters_true"):
        fabric = Fabric(accelerator=DEVICE, devices=1, strategy=strategy)
        fabric.launch()
        bench = nemo_base.Bench(small_recipe(), fabric)
        took_s.append(measure(bench.step, 3, DEVICE).wall_s)
        with torch.no_grad():
            losses.append(float(bench.forward()))
    torch.distributed.destroy_process_group()
    return {
        "loss_after_steps": losses[0],
        "loss_difference": abs(losses[1] - losses[0]),
        "step_s": took_s[0],
        "ddp_step_s": took_s[1],
    }


def measure_nemo_base(seed: int) -> dict[str, float]:
    """Return the cost of a training step of nemo_base, and samples per second."""
    step = nemo_base.measure_step(seed)
    return step | {"samples_per_s": 1 / step["step_s"]} if step else step


def measure_program(name: str, _: int) -> dict[str, float]:
    """Return what `export` or `ddp` measures, in a process of its own."""
    return in_a_process(__file__, name)


Measurement = Callable[[int], dict[str, float]]
PROGRAMS: Mapping[str, Callable[[], dict[str, float]]] = {"export": export, "ddp": ddp}
ARMS: dict[str, Measurement] = {
    "lifting": partial(lifting.measure, "cuda"),
    **{case: partial(ops.measure, case, "cuda") for case in ops.CASES},
    **{grid: partial(field.measure_grid, grid, "cuda") for grid in field.GRIDS},
    "gaussians": partial(splats.measure, "cuda"),
    "field": partial(field.measure_scene, "cuda"),
    "nemo_base": measure_nemo_base,
    **{name: partial(measure_program, name) for name in PROGRAMS},
}

NEEDS = {"gaussians": "gsplat", "field": "scipy"}
"""Packages of arms that the other arms do not need."""


def on_a_gpu(measurement: Measurement) -> Measurement:
    """Return a measurement that is refused on a machine without a GPU."""

    def measured(seed: int) -> dict[str, float]:
        if not torch.cuda.is_available():
            raise InputError(NO_GPU)
        return measurement(seed)

    return measured


BENCHMARK = Benchmark(
    question="How fast are the kernels, nemo_base, Gaussians and fields on a GPU?",
    arms={arm: on_a_gpu(measurement) for arm, measurement in ARMS.items()},
    seeds=(0,),
)

if __name__ == "__main__":
    if sys.argv[1:]:
        print(json.dumps(PROGRAMS[sys.argv[1]]()))
    elif not torch.cuda.is_available():
        sys.exit(NO_GPU)
    else:
        absent = {arm: package for arm, package in NEEDS.items() if find_spec(package) is None}
        for arm, package in absent.items():
            print(f"{arm} is not measured: pip install {package}")
        arms = [arm for arm in ARMS if arm not in absent]
        results = CHECKOUT / "benchmarks" / "results"
        print(f"wrote {run_benchmark('gpu', BENCHMARK, results, arms=arms)}")
