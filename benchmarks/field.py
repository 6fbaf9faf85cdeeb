"""Speed of the parts of a neural field: `foredrive bench field`.

`grid` reads a hash grid of eight levels with two features each, from 32 to 8192 cells along a side, with at
most 2^17 rows a level. A million points lie on rays in patches of 32 × 32 pixels, 32 samples on each ray.
Arm `proposal` has six levels of one feature. `…_mpoints_per_s` are millions of points forward and backward
per CPU second (on a GPU: per second); with `to_points`, the gradient reaches the points too. Plain PyTorch
reads 65,536 of them.

`scene` is the recipe `field_tiny` with 20 actors: whole steps of training (rays, losses, gradients, Adam), an
image of 480 × 270, and a sweep of 64 × 1800 beams. Its images are noise and its sweeps show a hall of
40 × 20 m. On the CPU freed memory is kept, as by the command line.
"""

import functools
import json
import sys
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import in_a_process, measure
from foredrive.geometry.se3 import exp_se3
from foredrive.methods.neurad.recipes import tiny_field
from foredrive.methods.neurad.scene import FieldScene
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.training import SensorViews, make_optimizer
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.ops.hash_grid import Level, grid_levels, read_hash_grid, read_hash_grid_reference
from foredrive.scene import LidarSweep
from foredrive.sensors import pandar64

RUNS, POINTS, REFERENCE_POINTS = 7, 2**20, 2**16
CAM_AHEAD = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Pose of a camera that looks along x of its mount."""
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


def hall(count: int = 20) -> tuple[FieldScene, SensorViews]:
    """Return a scene of `field_tiny` before training, and a drive of four frames at 5 m/s."""
    rng = torch.Generator().manual_seed(0)
    mount = exp_se3(torch.tensor([1.0, 0, 1.8, 0, 0, 0]))
    cameras, sweeps = [], []
    for frame in range(4):
        T_scene_ego = exp_se3(torch.tensor([0.5 * frame, 0, 0, 0, 0, 0]))
        rays = pandar64(mount).beams(torch.zeros(6))
        apart = torch.tensor([20.0, 10.0, 1.8]) / rays.dir_ego.abs().clamp_min(1e-6)
        range_m = apart.amin(-1)
        beams = LidarSweep(
            origin_ego=rays.origin_ego,
            dir_ego=rays.dir_ego,
            range_m=range_m,
            returned=range_m < 50,
            intensity=torch.full_like(range_m, 0.3),
            dt_s=rays.dt_s,
            beam=torch.zeros(len(range_m), dtype=torch.int64),
            valid=torch.ones(len(range_m), dtype=torch.bool),
        )
        sweeps.append(SweepView(beams, True, T_scene_ego, torch.zeros(6), 0.1 * frame))
        cameras.append(
            CameraView(
                K=torch.tensor([[490.0, 0, 240], [0, 490, 135], [0, 0, 1]]),
                dist=torch.zeros(5),
                T_scene_cam=T_scene_ego @ mount @ CAM_AHEAD,
                twist_cam=torch.tensor([0.0, 0, 5, 0, 0.01, 0]),
                t_s=0.1 * frame,
                readout_s=0.04,
                size_hw=(270, 480),
                sensor=0,
                image=torch.randint(256, (3, 270, 480), generator=rng, dtype=torch.uint8),
            )
        )
    place = torch.rand(count, 1, 6, generator=rng) * torch.tensor([30.0, 16, 0, 0, 0, 6])
    tracks = ActorTracks(
        track_id=torch.arange(count),
        category=torch.zeros(count, dtype=torch.int64),
        size_lwh=torch.tensor([[4.5, 1.9, 1.6]]).repeat(count, 1),
        t_s=torch.tensor([0.0, 0.3]),
        T_scene_actor=exp_se3(place - torch.tensor([15.0, 8, -0.8, 0, 0, 0])).repeat(1, 2, 1, 1),
        present=torch.ones(count, 2, dtype=torch.bool),
    )
    views = SensorViews(cameras, sweeps)
    return tiny_field().begin(views, tracks, 1, 200.0), views


def measure_scene(device: str, _: int) -> dict[str, float]:
    """Return the speed of training, of an image and of a sweep."""
    return in_a_process(__file__, "scene", device, "fast") | {"threads": float(torch.get_num_threads())}


def _measure_scene(device: str) -> dict[str, float]:
    if device == "cpu":
        from foredrive.cli.main import keep_freed_memory  # needs packages that a machine for GPUs may lack

        keep_freed_memory()
    scene, views = hall()
    scene = scene.to(device)
    training = tiny_field().training(scene, views)
    optimizer, rng = make_optimizer(training), torch.Generator().manual_seed(0)
    schedule = training.schedule

    def step() -> None:
        loss = training.losses(0, rng).losses["loss"]
        optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        optimizer.step()

    for _ in range(5):  # compiles; the proposals find the walls
        step()
    took = measure(step, 15, device)
    with torch.no_grad():
        view = views.cameras[1].to(device)
        image = measure(lambda: scene.camera(scene.graph, view), 5, device)
        points = scene.prepare_sweep(views.sweeps[1])
        sweep = measure(lambda: scene.sweep(scene.graph, points, 0.1), 3, device)
    krays = (schedule.patches * schedule.patch**2 + schedule.beams) / 1000
    return {
        "train_krays_per_s": krays / took.wall_s,
        "train_krays_per_cpu_s": krays / took.cpu_s,
        "image_s": image.wall_s,
        "image_cpu_s": image.cpu_s,
        "sweep_s": sweep.wall_s,
        "sweep_cpu_s": sweep.cpu_s,
    }


def _measure_here(arm: str, device: str, path: str) -> dict[str, float]:
    if arm == "scene":
        return _measure_scene(device)
    number, features, finest = GRIDS[arm]
    levels = grid_levels(number, 32, finest, 17)
    table = 0.1 * torch.randn(levels[-1].first_row + levels[-1].rows, features, device=device)
    read: Callable[[Tensor, Tensor, tuple[Level, ...]], Tensor] = read_hash_grid
    count, runs = POINTS, RUNS
    if path == "reference":
        read, count, runs = read_hash_grid_reference, REFERENCE_POINTS, 2
    points = points_on_rays(count).to(device)
    figures = {}
    for name, wanted in (("", [True, False]), ("to_points_", [True, True])):
        leaves = [x.clone().requires_grad_(w) for x, w in zip((table, points), wanted, strict=True)]
        upstream = torch.ones(number * features, count, device=device)

        def step(leaves: list[Tensor] = leaves, upstream: Tensor = upstream) -> None:
            out = read(leaves[0], leaves[1], levels)
            torch.autograd.grad(out, [x for x in leaves if x.requires_grad], upstream)

        step()  # compiles
        took = measure(step, runs, device)
        figures[f"{name}mpoints_per_s"] = count / 1e6 / (took.cpu_s if device == "cpu" else took.wall_s)
    return figures


def measure_grid(arm: str, device: str, _: int) -> dict[str, float]:
    """Return the speed of the kernel and of plain PyTorch."""
    fast, slow = (in_a_process(__file__, arm, device, path) for path in ("fast", "reference"))
    figures = {f"{arm}_{name}": value for name, value in fast.items()}
    figures |= {f"{arm}_reference_{name}": value for name, value in slow.items()}
    return figures | {"threads": float(torch.get_num_threads())}


BENCHMARK = Benchmark(
    question="How fast are the parts of a neural field on a CPU?",
    arms={arm: functools.partial(measure_grid, arm, "cpu") for arm in GRIDS}
    | {"scene": functools.partial(measure_scene, "cpu")},
    seeds=(0,),
)

if __name__ == "__main__":
    print(json.dumps(_measure_here(*sys.argv[1:])))
