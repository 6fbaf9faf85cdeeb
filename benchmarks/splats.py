"""Speed of rendering cameras and lidars from a street of Gaussians: `foredrive bench splats`.

The street has ground, façades, parked cars and trees under flat Gaussians. They are spread evenly over the
surfaces, so that near ones are large in the image and far ones small. They are 0.6 of their spacing wide
(log-normal, by e^0.5), an eighth as thick, and from clear to opaque (logit 0.5 ± 2); 1 % are large ones 200 m
away for the far field. The camera stands at the end of the street and sees 0.9 of 200 k. The lidar (a
Pandar64, 64 × 1800 beams) stands in its middle. Both drive and turn, with rolling shutter. Projection, lists,
compositing and, for training, the gradients of all parameters are timed together; each path runs in its own
process.

The comparisons are plain PyTorch on a smaller case (`small`: 20 k Gaussians, 240 × 135 px), and the
textbook's loop in numba, pixel by pixel over its tile's list (only compositing, forward, on the same lists).
`street_range_error_mm_…` are errors of lidar ranges at three speeds (see the function).
Rasterisers on PyPI that may run on a CPU (splax in JAX, gausscam) are not measured here.
"""

import functools
import json
import math
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import in_a_process
from benchmarks.common.measuring import measure as time_of
from foredrive.geometry.se3 import exp_se3, inverse_se3, sensor_twist
from foredrive.methods.splatad import Gaussians, project_camera, project_lidar, scan_times, tiled_lidar_beams
from foredrive.ops.splat_points import TiledPoints, pixel_points
from foredrive.ops.splatting import (
    Composited,
    Splats,
    composite_splats,
    composite_splats_reference,
    list_splats,
)
from foredrive.sensors import pandar64

RUNS = 7
READOUT_S = 0.03
CAM_SCENE = torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, 1.6], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Transform from the scene (x forward, z up) to a camera 1.6 m above the ground."""
WIDTH_M, HEIGHT_M, CARS, TREES = 24.0, 10.0, 24, 20


class View(NamedTuple):
    """A timed sensor and its Gaussians."""

    project: Callable[[Gaussians], Splats]
    points: TiledPoints
    gaussians: Gaussians


def street(count: int, begin_m: float, end_m: float) -> Gaussians:
    """Return the street of this file's docstring; it runs along x."""
    rng = torch.Generator().manual_seed(0)
    shares = ((_ground, 0.41), (_fronts, 0.36), (_cars, 0.1), (_trees, 0.12))
    parts = [surface(int(share * count), rng) for surface, share in shares]
    mean, normal = (torch.cat(both) for both in zip(*parts, strict=True))
    mean = mean * torch.tensor([end_m - begin_m, 1, 1]) + torch.tensor([begin_m, 0, 0])
    area_m2 = (end_m - begin_m) * (WIDTH_M + 2 * HEIGHT_M) + 27 * CARS + 50 * TREES
    width_m = 0.6 * math.sqrt(area_m2 / len(mean))
    log_scale = math.log(width_m) + 0.5 * torch.randn(len(mean), 3, generator=rng)
    log_scale[:, 2] -= 2.0
    far = count - len(mean)
    around = 2 * math.pi * torch.rand(far, generator=rng)
    sky = torch.stack([200 * around.cos(), 200 * around.sin(), 100 * torch.rand(far, generator=rng)], -1)
    return Gaussians(
        mean_m=torch.cat([mean, sky]),
        quaternion=torch.cat([_from_z(normal), torch.tensor([1.0, 0, 0, 0]).expand(far, 4)]),
        log_scale=torch.cat([log_scale, torch.full((far, 3), math.log(5.0))]),
        opacity_logit=0.5 + 2 * torch.randn(count, generator=rng),
        feature=torch.rand(count, 3, generator=rng),
    )


def _from_z(normal: Tensor) -> Tensor:
    """Return quaternions (not normalised) that rotate z to the normals."""
    nx, ny, nz = normal.unbind(-1)
    return torch.stack([1.001 + nz, -ny, nx, torch.zeros_like(nx)], -1)


def _ground(n: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return points and normals; here and below, x runs from 0 to 1 along the street, y and z are in m."""
    place = (torch.rand(n, 3, generator=rng) - torch.tensor([0, 0.5, 0])) * torch.tensor([1, WIDTH_M, 0])
    return place, torch.tensor([0.0, 0, 1]).expand(n, 3)


def _fronts(n: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    place = torch.rand(n, 3, generator=rng)
    place[:, 1] = place[:, 1].round() - 0.5
    return place * torch.tensor([1, WIDTH_M, HEIGHT_M]), torch.tensor([0.0, 1, 0]).expand(n, 3)


def _cars(n: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    face = torch.nn.functional.one_hot(torch.randint(0, 3, (n,), generator=rng), 3).float()
    within = torch.rand(n, 3, generator=rng)
    within = torch.where(face > 0, within.round(), within) - 0.5
    return _stands(n, CARS, 6.0, 0.8, rng) + within * torch.tensor([0.037, 1.8, 1.5]), face


def _trees(n: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    out = torch.nn.functional.normalize(torch.randn(n, 3, generator=rng), dim=-1)
    within = out * torch.rand(n, 1, generator=rng) ** 0.33 * torch.tensor([0.017, 2, 2])
    return _stands(n, TREES, 9.0, 4.0, rng) + within, out


def _stands(n: int, many: int, aside_m: float, up_m: float, rng: torch.Generator) -> Tensor:
    """Return for each point the centre of one of many objects on both sides of the street."""
    k = torch.randint(0, many, (n,), generator=rng)
    y = torch.where(k % 2 == 0, -aside_m, aside_m)
    return torch.stack([k / many, y, torch.full((n,), up_m)], -1)


def camera(count: int, size_hw: tuple[int, int], device: str) -> View:
    """Return a camera with RGB and range, 60° wide, at 10 m/s and 0.1 rad/s."""
    height, width = size_hw
    focal = 830.0 * width / 960
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], device=device)
    T, dist = CAM_SCENE.to(device), torch.zeros(5, device=device)
    twist = torch.tensor([0.0, 0, 10, 0, 0.1, 0], device=device)

    def project(gaussians: Gaussians) -> Splats:
        return project_camera(gaussians, T, K, dist, size_hw, twist_cam=twist)

    return View(
        project, pixel_points(size_hw, READOUT_S).to(device), _learnable(street(count, 2, 120), device)
    )


def lidar(count: int, device: str) -> View:
    """Return 64 × 1800 beams of a Pandar64 with three features, range and median."""
    T_ego_lidar = exp_se3(torch.tensor([0.0, 0, 1.8, 0, 0, 0]))
    twist = torch.tensor([10.0, 0, 0, 0, 0, 0.1])
    points = tiled_lidar_beams(pandar64(T_ego_lidar).beams(twist), T_ego_lidar, twist).to(device)
    T, twist = exp_se3(torch.tensor([0.0, 0, -1.8, 0, 0, 0])).to(device), twist.to(device)
    scan_s = scan_times(points)

    def project(gaussians: Gaussians) -> Splats:
        return project_lidar(gaussians, T, twist_lidar=twist, scan_s=scan_s)

    return View(project, points, _learnable(street(count, -80, 80), device))


def street_range_error_mm(speed_mps: float, count: int = 200_000, within_m: float = 20.0) -> float:
    """Return the median error of the median ranges of a driving lidar between ground and façades.

    The Gaussians are flat discs on the surfaces. The truth is the range at which a beam meets a surface, from
    where the lidar is when it fires. Beams that end within `within_m` count.
    """
    rng = torch.Generator().manual_seed(0)
    length_m, half_m = 120.0, WIDTH_M / 2
    (ground, up), (fronts, out) = _ground(count // 2, rng), _fronts(count // 2, rng)
    mean = (torch.cat([ground, fronts]) - torch.tensor([0.5, 0, 0])) * torch.tensor([length_m, 1, 1])
    log_scale = torch.full((len(mean), 3), math.log(0.6 * math.sqrt(length_m * (WIDTH_M + 20) / len(mean))))
    log_scale[:, 2] = math.log(0.01)
    gaussians = Gaussians(
        mean_m=mean,
        quaternion=_from_z(torch.cat([up, out])),
        log_scale=log_scale,
        opacity_logit=torch.full((len(mean),), 4.0),
        feature=torch.ones(len(mean), 1),
    )
    T_ego_lidar, twist = (
        exp_se3(torch.tensor([1.0, 0, 1.8, 0, 0, 0])),
        torch.tensor([speed_mps, 0, 0, 0, 0, 0.1]),
    )
    rays = pandar64(T_ego_lidar).beams(twist)
    middle_s = float(rays.dt_s.min() + rays.dt_s.max()) / 2
    points = tiled_lidar_beams(rays, T_ego_lidar, twist, middle_s)
    splats = project_lidar(
        gaussians,
        inverse_se3(exp_se3(middle_s * twist) @ T_ego_lidar),
        twist_lidar=sensor_twist(T_ego_lidar, twist),
        scan_s=scan_times(points),
    )
    found_m = composite_splats(splats, points).median_range_m
    origin, direction = rays.origin_ego, rays.dir_ego
    to_ground_m = torch.where(direction[:, 2] < 0, -origin[:, 2] / direction[:, 2], math.inf)
    side_m = half_m * direction[:, 1].sign()
    to_front_m = torch.where(direction[:, 1] != 0, (side_m - origin[:, 1]) / direction[:, 1], math.inf)
    truth_m = torch.minimum(to_ground_m, to_front_m)
    top_m = origin[:, 2] + truth_m * direction[:, 2]
    counts = (truth_m < within_m) & (top_m < HEIGHT_M) & found_m.isfinite()
    return 1000 * float((found_m - truth_m).abs()[counts].median())


def _learnable(gaussians: Gaussians, device: str) -> Gaussians:
    return gaussians.map_tensors(lambda tensor: tensor.to(device).requires_grad_())


def _times(view: View, device: str, composite: Callable[..., Composited], runs: int) -> dict[str, float]:
    """Measure wall time and CPU time (all threads), s, forward and for a training step."""
    project, points, gaussians = view
    leaves = [getattr(gaussians, name) for name in vars(gaussians)]

    @torch.no_grad()
    def forward() -> Composited:
        return composite(project(gaussians), points)

    def train() -> tuple[Tensor, ...]:
        seen = composite(project(gaussians), points)
        return torch.autograd.grad((seen.feature - 0.5).abs().sum() + seen.expected_range_m.sum(), leaves)

    forward(), train()  # compiles
    figures: dict[str, float] = {}
    for name, call in (("forward", forward), ("train", train)):
        took = time_of(call, runs, device)
        figures |= {f"{name}_s": took.wall_s, f"{name}_cpu_s": took.cpu_s}
    return figures


@numba.njit(error_model="numpy", fastmath=True, nogil=True)
def textbook(packed: Any, feature: Any, splat: Any, first: Any, place: Any, index: Any, out: Any) -> None:
    """Run the loop of Kerbl et al.: every pixel walks along its tile's list; libm's exp, `out` [P D + 2]."""
    for tile in range(index.shape[0]):
        for s in range(index.shape[1]):
            if index[tile, s] < 0:
                continue
            row, left = out[index[tile, s]], np.float32(1)
            row[:] = 0
            for at in range(first[tile], first[tile + 1]):
                i = splat[at]
                dx = place[tile, 0, s] - packed[i, 0] - packed[i, 3] * place[tile, 2, s]
                dy = place[tile, 1, s] - packed[i, 1] - packed[i, 4] * place[tile, 2, s]
                exponent = packed[i, 5] * dx * dx + packed[i, 6] * dx * dy + packed[i, 7] * dy * dy
                alpha = min(packed[i, 2] * np.exp(exponent), np.float32(0.999))
                if alpha < np.float32(1 / 255):
                    continue
                if left * (1 - alpha) <= np.float32(1e-4):
                    break
                for d in range(feature.shape[1]):
                    row[d] += left * alpha * feature[i, d]
                row[feature.shape[1]] += left * alpha * packed[i, 8]
                row[feature.shape[1] + 1] += left * alpha
                left *= 1 - alpha


def _textbook(view: View) -> dict[str, float]:
    """Measure compositing alone on one thread, on our lists; and our path on one thread, with the lists."""
    with torch.no_grad():
        splats, points = view.project(view.gaussians), view.points
        seen = composite_splats(splats, points, median=False)
        lists = list_splats(splats, points)
    shape = splats.inverse_covariance * torch.tensor([-0.5, -1.0, -0.5])
    packed = torch.cat(
        [splats.mean, splats.opacity[:, None], splats.velocity, shape, splats.range_m[:, None]], -1
    ).detach()
    arrays = [packed, splats.feature.detach(), lists.splat, lists.first, points.rows, points.index]
    arguments = [array.numpy() for array in arrays]
    out = np.zeros((points.count, splats.feature.shape[1] + 2), np.float32)
    textbook(*arguments, out)
    assert np.abs(out[:, -1] - seen.alpha.numpy()).mean() < 1e-4
    torch.set_num_threads(1)
    with torch.no_grad():
        ours = time_of(lambda: composite_splats(splats, points, median=False), RUNS, "cpu")
    return {
        "textbook_s": time_of(lambda: textbook(*arguments, out), 3, "cpu").cpu_s,
        "ours_s": ours.cpu_s,
        "listed": float(len(lists.splat)),
        "seen": float(len(splats.mean)),
    }


def _fast(splats: Splats, points: TiledPoints) -> Composited:
    return composite_splats(splats, points, median=points.size_hw is None)


def _measure_here(device: str, path: str) -> dict[str, float]:
    if path == "camera":
        return _times(camera(200_000, (540, 960), device), device, _fast, RUNS)
    if path == "lidar":
        return _times(lidar(200_000, device), device, _fast, RUNS)
    if path == "textbook":
        return _textbook(camera(200_000, (540, 960), device))
    reference = path == "reference"
    view = camera(20_000, (135, 240), device)
    return _times(view, device, composite_splats_reference if reference else _fast, 2 if reference else RUNS)


def measure(device: str, _: int) -> dict[str, float]:
    """Return all metrics of a device; those per CPU second do not depend on other programs."""
    paths = ("camera", "lidar", "small", "reference", *(("textbook",) if device == "cpu" else ()))
    found = {path: in_a_process(__file__, device, path) for path in paths}
    figures: dict[str, float] = {"threads": float(torch.get_num_threads())}
    for path, unit, millions in (("camera", "mp", 540 * 960 / 1e6), ("lidar", "mrays", 64 * 1800 / 1e6)):
        for step in ("forward", "train"):
            figures[f"{path}_{step}_{unit}_per_s"] = millions / found[path][f"{step}_s"]
            figures[f"{path}_{step}_{unit}_per_cpu_s"] = millions / found[path][f"{step}_cpu_s"]
    for clock, end in (("s", ""), ("cpu_s", "_cpu")):
        took = [sum(found[path][f"{step}_{clock}"] for step in ("forward", "train")) for path in paths[2:4]]
        figures[f"small.speedup_over_reference{end}"] = took[1] / took[0]
    if device == "cpu":
        for speed_mps in (0, 12, 25):
            figures[f"street_range_error_mm_{speed_mps}mps"] = street_range_error_mm(speed_mps)
        figures |= {f"compositing.{name}": value for name, value in found["textbook"].items()}
        figures["compositing.speedup_over_textbook"] = (
            found["textbook"]["textbook_s"] / found["textbook"]["ours_s"]
        )
    return figures


DEVICES = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
BENCHMARK = Benchmark(
    question="How fast do cameras and lidars see a street of 200 k Gaussians?",
    arms={device: functools.partial(measure, device) for device in DEVICES},
    seeds=(0,),
)

if __name__ == "__main__":
    print(json.dumps(_measure_here(*sys.argv[1:])))
