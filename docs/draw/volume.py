"""Draws docs/nemo_volume.jpg: `python docs/draw/volume.py LOG RUN SECONDS [SECONDS ...]`."""

import dataclasses
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from foredrive.data import find_logs
from foredrive.runs import open_run
from foredrive.runs.shipped import run_folder
from foredrive.view.example_panel import front_camera
from foredrive.view.image_drawing import Camera, resize
from foredrive.view.log_frames import LogFrames
from foredrive.view.model_panel import shown_voxels
from foredrive.view.voxel_drawing import draw_volume_pca, draw_voxels

DOCS = Path(__file__).parents[1]
CELL_HW = (198, 352)
PCA_PX, GAP = 198, 6
NAMES = ("camera", "rendered from the volume", "PCA, mean over Z", "occupancy now", "imagined, 1 s ahead")


def row(frames: LogFrames, t_s: float) -> list[np.ndarray]:
    """What the front camera saw, and what the model made of it."""
    index = frames.nearest(t_s)
    clip, prediction = frames.clip(index), frames.prediction(index)
    if (
        prediction is None
        or frames.predictor is None
        or frames.run is None
        or (c := front_camera(clip)) is None
    ):
        sys.exit(f"no view of {frames.name} at {t_s:g} s")
    spec, camera = frames.run.recipe.clips.voxels, Camera.of(clip.rig[clip.now], c).resized(CELL_HW)
    one = clip.rig[clip.now, c : c + 1]
    rig = dataclasses.replace(one, K=camera.K[None], names=(clip.rig.names[c],), size_hw=CELL_HW)
    last = len(prediction.occupancy_logit) - 1
    occupied = [shown_voxels(prediction, k, spec, 0.5, spec.lower_m[2]) for k in (0, last)]
    return [
        resize(clip.images[clip.now, c].permute(1, 2, 0).numpy(), CELL_HW),
        (255 * frames.predictor.render(prediction, 0, rig)[0]).to(torch.uint8).numpy(),
        resize(draw_volume_pca(prediction.volume[0]), (PCA_PX, PCA_PX)),
        *(draw_voxels(voxels, spec, CELL_HW) for voxels in occupied),
    ]


def sheet(rows: list[list[np.ndarray]]) -> Image.Image:
    """Rows of pictures of one height, named above."""
    head = 26
    left = np.cumsum([0, *(cell.shape[1] + GAP for cell in rows[0])])
    page = Image.new("RGB", (int(left[-1]) - GAP, head + len(rows) * (CELL_HW[0] + GAP) - GAP), "white")
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(15)
    for x, name in zip(left, NAMES, strict=False):
        draw.text((int(x) + 4, 4), name, font=font, fill="black")
    for y, cells in enumerate(rows):
        for x, cell in zip(left, cells, strict=False):
            page.paste(Image.fromarray(cell), (int(x), head + y * (CELL_HW[0] + GAP)))
    return page


def main(log: Path, run: Path, *seconds: float) -> None:
    """One row a time."""
    with tempfile.TemporaryDirectory() as folder:  # for the run that comes with the package
        frames = LogFrames(find_logs(log)[0], CELL_HW[1], open_run(run_folder(run, Path(folder))))
        page = sheet([row(frames, t_s) for t_s in seconds])
    page.save(DOCS / "nemo_volume.jpg", quality=88, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(float, sys.argv[3:]))
