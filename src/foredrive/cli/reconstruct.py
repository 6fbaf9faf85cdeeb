"""`foredrive reconstruct`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from foredrive.cli.arguments import ImageSize, OptionalPath, Settings, check_image_size, check_out_folder
from foredrive.data.log_paths import find_one_log
from foredrive.errors import InputError
from foredrive.lazy import importing


def reconstruct(
    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    out: Path,
    method: Literal["gaussians", "field"] | None = None,
    recipe: str | None = None,
    cameras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CAMERA [CAMERA ...]")] = (),
    image_size: ImageSize | None = None,
    cache: OptionalPath = None,
    lpips_weights: OptionalPath = None,
    fid_weights: OptionalPath = None,
    set: Settings = (),
) -> None:
    """Reconstruct a log as a scene that renders cameras and lidars, or continue an interrupted run.

    Every second frame is held out, and the scene is evaluated on the held-out frames. The run's folder holds
    the scene, its metrics (summary.json), pictures of held-out frames (held_out.png) and the static part as a
    PLY file for viewers of 3-D Gaussians (static.ply).

    Args:
        log: Folder of a 123D log, or of a split or data root with exactly one log in it.
        out: Folder of the run. If it holds this run already, the run continues from the last checkpoint.
        method: Representation of the scene; by default the recipe's.
        recipe: Name of the recipe: gaussians_tiny (minutes on two cores), field_tiny (half an hour on two
            cores), gaussians_base, gaussians_published or field_base (a GPU), or a YAML file; by default
            METHOD_tiny.
        cameras: Use only these cameras, by their own names or 123D's, such as pcam_f0; by default the
            recipe's.
        image_size: Images are shrunk to this size (height, width), px; by default the recipe's, 270 480 or
            1080 1920.
        cache: Folder for shrunk images; by default "cache" in the run's folder.
        lpips_weights: Evaluate LPIPS too, with this file of torchvision's AlexNet (.pth or .safetensors).
        fid_weights: Evaluate FID too, with this file of the Inception of 2015 that pytorch-fid publishes.
        set: Entries of the recipe to replace, such as representation.schedule.steps=2000; `foredrive recipes
            RECIPE` prints all entries.
    """
    check_image_size(image_size)
    check_out_folder(out)
    found = find_one_log(log)

    with importing():
        from foredrive.evaluation.perceptual import PerceptualMetrics, PerceptualWeights
        from foredrive.recipes.rebuilding import find_rebuild_recipe
        from foredrive.runs.rebuild.reconstruct import reconstruct as rebuild_log

    chosen = find_rebuild_recipe(recipe or f"{method or 'gaussians'}_tiny", set)
    kind = chosen.representation.kind
    if method not in (None, kind):
        raise InputError(f"--method {method} does not go with the recipe {chosen.name}, which is {kind}")
    if cameras:
        chosen = dataclasses.replace(chosen, cameras=cameras)
    if image_size is not None:
        chosen = dataclasses.replace(chosen, image_hw=image_size)
    perceptual = None
    if lpips_weights is not None or fid_weights is not None:
        perceptual = PerceptualMetrics(PerceptualWeights(lpips_weights, fid_weights))
    run = rebuild_log(chosen, found, out, cache, perceptual)
    if run.held_out.cameras:
        from foredrive.view.rebuilt_sheet import write_rebuilt_sheet

        title = f"{found.name}, frames that were held out"
        write_rebuilt_sheet(out / "held_out.png", run.scene, run.held_out.cameras, title)
    if not run.held_out.cameras and not run.held_out.sweeps:
        print(f"{found.name} is too short: no frame was held out, so the scene is not evaluated")
    print(f"rebuilt {found.name} by {kind}: {out}")
    for name in (
        *(*run.scene.sizes, "minutes", "psnr_db", "nearest.psnr_db", "ssim", "lpips", "fid"),
        *("depth_median_sq_m2", "intensity_rmse", "drop_accuracy", "chamfer_m2"),
    ):
        if run.summary.get(name) is not None:
            print(f"  {name}: {run.summary[name]:.4g}")
