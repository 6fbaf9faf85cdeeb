"""Renderings of a reconstructed scene next to the recorded images."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from foredrive.files import atomic_path
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.views import CameraView
from foredrive.tasks.rendering.image_scores import psnr_db
from foredrive.view.image_drawing import to_image
from foredrive.view.palette import MAX_RANGE_M, MIN_RANGE_M, range_colours

ROWS = 4
WIDTH_IN = 4.0
"""Width of one picture, inches."""


@torch.no_grad()
def write_reconstruction_sheet(
    path: Path,
    scene: ReconstructedScene,
    views: Sequence[CameraView],
    title: str,
    graph: SceneGraph | None = None,
) -> None:
    """Write some views as a PNG: recorded, rendered, their difference, and the range.

    Args:
        path: path of the picture.
        scene: the shown scene.
        views: views with images; some of them, spread over the drive, are shown.
        title: title of the picture.
        graph: the scene after edits; None: the scene without edits.
    """
    chosen = [views[i] for i in np.linspace(0, len(views) - 1, min(ROWS, len(views))).round().astype(int)]
    height = WIDTH_IN * max(view.size_hw[0] / view.size_hw[1] for view in chosen) + 0.3
    figure = Figure(figsize=(4 * WIDTH_IN, len(chosen) * height + 0.4), layout="constrained")
    axes = figure.subplots(len(chosen), 4, squeeze=False)
    figure.suptitle(title)
    for row, view in zip(axes, chosen, strict=True):
        assert view.image is not None
        picture = scene.camera(graph or scene.graph, view.to(scene.device))
        real, rgb = view.image.float() / 255, picture.rgb.clamp(0, 1).cpu()
        valid = torch.ones(1, *view.size_hw, dtype=torch.bool)
        quality = float(psnr_db(rgb[None], real[None], valid))
        shown = {
            f"recorded at {view.t_s:.1f} s": to_image(real),
            f"rendered, {quality:.1f} dB": to_image(rgb),
            "difference": to_image((rgb - real).abs()),
            f"range, {MIN_RANGE_M:g} m bright to {MAX_RANGE_M:g} m dark": range_colours(
                picture.range_m.cpu().numpy()
            ),
        }
        for axis, (name, image) in zip(row, shown.items(), strict=True):
            axis.imshow(image)
            axis.set_title(name, fontsize=9)
            axis.set_axis_off()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")
