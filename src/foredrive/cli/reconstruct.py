"""`foredrive reconstruct`."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from foredrive.cli.arguments import (
    ImageSize,
    OptionalPath,
    Settings,
    check_image_size,
    check_number,
    check_out_folder,
)
from foredrive.cli.failures import listed_failures
from foredrive.cli.progress import job_progress
from foredrive.data.log_paths import LogPath, find_logs
from foredrive.errors import InputError
from foredrive.lazy import importing

if TYPE_CHECKING:
    from foredrive.methods.reconstruction.perceptual import PerceptualWeights
    from foredrive.runs.recipes.reconstruction import ReconstructionRecipe

FIGURES = (
    *("minutes", "psnr_db", "nearest.psnr_db", "ssim", "lpips", "fid", "tower_lpips", "tower_fid"),
    *("depth_median_sq_m2", "intensity_rmse", "drop_accuracy", "chamfer_m2"),
)


def reconstruct(
    logs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOGS")],
    out: Path,
    method: Literal["gaussians", "field"] | None = None,
    recipe: str | None = None,
    cameras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CAMERA [CAMERA ...]")] = (),
    image_size: ImageSize | None = None,
    cache: OptionalPath = None,
    lpips_weights: OptionalPath = None,
    fid_weights: OptionalPath = None,
    tower_metrics: bool = False,
    set: Settings = (),
    workers: int = 1,
    ray: bool = False,
) -> None:
    """Reconstruct logs as scenes that render cameras and lidars, or continue interrupted runs.

    Every second frame is held out, and the scene is evaluated on the held-out frames. A run's folder holds
    the scene, its metrics (summary.json), pictures of held-out frames (held_out.png) and the static part as a
    PLY file for viewers of 3-D Gaussians (static.ply).

    Args:
        logs: Folder of a 123D log, of a split or of a data root.
        out: Folder of the run; of several logs, each has its run in SPLIT/NAME there. If it holds a run
            already, the run continues from the last checkpoint, and a finished run is kept.
        method: Representation of the scene; by default the recipe's.
        recipe: Name of the recipe: gaussians_tiny (minutes on two cores), gaussians_small (ten minutes of a
            core, better), field_tiny (half an hour), gaussians_base, gaussians_published or field_base (a
            GPU), or a YAML file; by default METHOD_tiny.
        cameras: Use only these cameras, by their own names or 123D's, such as pcam_f0; by default the
            recipe's.
        image_size: Images are shrunk to this size (height, width), px; by default the recipe's, 270 480 or
            1080 1920.
        cache: Folder for shrunk images; by default "cache" in OUT.
        lpips_weights: Evaluate LPIPS too, with this file of torchvision's AlexNet (.pth or .safetensors).
        fid_weights: Evaluate FID too, with this file of the Inception of 2015 that pytorch-fid publishes.
        tower_metrics: Evaluate the formulas of LPIPS and FID too on the image tower that comes with the
            package: tower_lpips and tower_fid. They compare runs with each other, not with published figures.
        set: Entries of the recipe to replace, such as representation.schedule.steps=2000; `foredrive recipes
            RECIPE` prints every entry with its meaning.
        workers: Number of logs reconstructed at a time, if there are several. On Ray it is the size of a
            cluster that is started here.
        ray: Reconstruct on Ray: on the cluster at RAY_ADDRESS, or on a cluster that is started here.
    """
    check_image_size(image_size)
    check_number("--workers", workers, low=1)
    check_out_folder(out)
    log_paths = find_logs(logs)

    with importing():
        from foredrive.methods.reconstruction.perceptual import PerceptualWeights
        from foredrive.runs.recipes.known import find_recipe
        from foredrive.runs.recipes.reconstruction import ReconstructionRecipe

    chosen = find_recipe(recipe or f"{method or 'gaussians'}_tiny", set, ReconstructionRecipe)
    kind = chosen.representation.kind
    if method not in (None, kind):
        raise InputError(f"--method {method} does not go with the recipe {chosen.name}, which is {kind}")
    if cameras:
        chosen = dataclasses.replace(chosen, cameras=cameras)
    if image_size is not None:
        chosen = dataclasses.replace(chosen, image_hw=image_size)
    work = functools.partial(
        reconstruct_log,
        recipe=chosen,
        cache=(cache or out / "cache").absolute(),
        weights=PerceptualWeights(lpips_weights, fid_weights),
        tower_metrics=tower_metrics,
    )
    if len(log_paths) == 1 and not ray:
        print(work((log_paths[0], out)), flush=True)
    else:
        _reconstruct_logs(log_paths, out.absolute(), work, workers, ray)


def reconstruct_log(
    job: tuple[LogPath, Path],
    recipe: "ReconstructionRecipe[Any]",
    cache: Path,
    weights: "PerceptualWeights",
    tower_metrics: bool,
    threads: int | None = None,
) -> str:
    """Reconstruct one log in a folder, draw its held-out frames, and return its figures as lines."""
    import torch

    from foredrive.methods.reconstruction.perceptual import PerceptualMetrics, PerceptualWeights
    from foredrive.runs.reconstruction.reconstruct import Reconstruction, reconstruct, shipped_tower
    from foredrive.view.reconstruction_sheet import write_reconstruction_sheet

    if threads is not None:
        torch.set_num_threads(threads)
    log, out = job
    perceptual = None
    if tower_metrics or weights != PerceptualWeights():
        perceptual = PerceptualMetrics(weights, shipped_tower() if tower_metrics else None)

    def draw(run: Reconstruction) -> None:
        if run.held_out.cameras:
            title = f"{log.name}, frames that were held out"
            write_reconstruction_sheet(out / "held_out.png", run.scene, run.held_out.cameras, title)

    run = reconstruct(recipe, log, out, cache, perceptual, draw)
    lines = [f"reconstructed {log.name} by {recipe.representation.kind}: {out}"]
    if not run.held_out.cameras and not run.held_out.sweeps:
        lines.insert(0, f"{log.name} is too short: no frame was held out, so the scene is not evaluated")
    shared = {
        name: value for name in (*run.scene.sizes, *FIGURES) if (value := run.summary.get(name)) is not None
    }
    return "\n".join([*lines, *(f"  {name}: {value:.4g}" for name, value in shared.items())])


def _reconstruct_logs(
    log_paths: Sequence[LogPath], out: Path, work: Callable[..., str], workers: int, on_ray: bool
) -> None:
    """Reconstruct several logs, some at a time.

    Raises:
        InputError: some logs failed.
    """
    import torch

    from foredrive.engine.fan_out import fan_out, reason

    jobs = [(log, out / log.name) for log in log_paths]
    # The logs that are reconstructed at the same time share the cores
    work = functools.partial(work, threads=max(1, torch.get_num_threads() // workers))
    failed = {}
    results = fan_out(jobs, work, workers, on_ray=on_ray, on_gpu=True)
    with contextlib.closing(results), job_progress("reconstructing logs", len(jobs)) as tick:
        for (log, _), result in results:
            if isinstance(result, BaseException):
                failed[log.name] = reason(log.name, result)
            else:
                print(result, flush=True)
            tick()
    if failed:
        raise InputError(f"{len(failed)} of {len(jobs)} logs failed: {listed_failures(failed)}")
