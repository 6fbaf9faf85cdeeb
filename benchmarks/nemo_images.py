"""Rendered frames of NeMo: observed beside imagined ones, with and without a perceptual loss.

`foredrive bench nemo_images` takes an hour on one core. Drives, cache, runs and pictures are kept in
runs/nemo_images/COMMIT.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import fmean

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.study import StudyTowns, record_study, seeded, work_folder
from foredrive.data import ClipDataset, collate
from foredrive.methods.blocks.training_rays import thinned_rays
from foredrive.methods.nemo import Nemo
from foredrive.methods.nemo.recipes import NemoRecipe
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.recipe import rescheduled
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.train.run import load_agent, train_run
from foredrive.scene import Example, VoxelGrid
from foredrive.tasks.occupancy.scores import OccupancyCounts, above_ground, count_occupancy
from foredrive.tasks.rendering.image_scores import psnr_db

WORK = work_folder(Path("runs/nemo_images"))
TOWNS = StudyTowns(train=("Town01", "Town03", "Town10HD"), train_seeds=(1, 2), test_seeds=(1, 2))
CAMERAS = ("pcam_l0", "pcam_f0", "pcam_r0")
STEPS, LEARNED_STRIDE, SHOWN_STRIDE, JUDGED_EVERY = 200, 4, 2, 6
FRAMES = ("now", "in_05s", "in_1s")


def image_recipe(*, future: float, perceptual: str | None) -> NemoRecipe:
    """Return `nemo_town`'s pre-training with three cameras, fewer steps and area averages as pixels.

    Args:
        future: weight of an imagined frame relative to now.
        perceptual: network of the perceptual loss.
    """
    recipe = find_recipe("nemo_town")
    assert recipe.pretrain is not None
    stage = dataclasses.replace(
        rescheduled(recipe.pretrain, steps=STEPS, warmup_steps=20),
        weights=dataclasses.replace(recipe.pretrain.weights, future=future),
        ray_stride=LEARNED_STRIDE,
        pixels="averaged",
        perceptual=perceptual,
    )
    clips = dataclasses.replace(recipe.clips, cameras=CAMERAS)
    none = rescheduled(stage, steps=0)  # only pre-training is of interest
    planner = dataclasses.replace(recipe.planner, ego_mlp=None, path=None)
    return dataclasses.replace(
        recipe,
        clips=clips,
        planner=planner,
        path=None,
        pretrain=stage,
        finetune=none,
        precision="bf16-mixed",
    )


ARMS = {
    "l1": image_recipe(future=0.25, perceptual=None),
    "l1_equal_weights": image_recipe(future=1.0, perceptual=None),
    "l1_tower": image_recipe(future=0.25, perceptual="tower"),
}


def arm(name: str) -> Callable[[int], dict[str, float]]:
    """Return an arm that trains a recipe and judges its frames in the held-out town."""

    def measure(seed: int) -> dict[str, float]:
        logs = record_study(TOWNS, WORK / "towns", workers=1)
        recipe, folder = seeded(ARMS[name], seed), WORK / "runs" / f"{name}_seed{seed}"
        run = train_run(recipe, logs.train, folder, WORK / "cache")
        clips = ClipDataset(list(logs.test), recipe.clips, cache_dir=WORK / "cache")
        return judge(load_agent(run), clips, WORK / "pictures" / f"{name}_seed{seed}.png")

    return measure


@torch.no_grad()
def judge(agent: PlanningAgent[Nemo], clips: ClipDataset, picture: Path) -> dict[str, float]:
    """Return figures of rendered frames and of occupancy, by frame.

    `sharpness` is the mean gradient of rendered over that of real images (1 is as sharp as they are), and
    `gradient_error` the mean difference of gradients over the same: a grey image has 1.
    `repeated_psnr_db` shows the rendered present in place of an imagined frame.
    """
    world = agent.world_model
    found: dict[str, list[float]] = defaultdict(list)
    counts: list[OccupancyCounts] = []
    for number, example in enumerate(_examples(clips)):
        clip, frames = example.clip, slice(example.clip.now, None)
        decoded = [world.decode(belief) for belief in agent.rollout(clip.observed(), len(FRAMES) - 1)]
        shown, real = [], []
        for k, frame in enumerate(decoded):
            rays = thinned_rays(clip, clip.now + k, SHOWN_STRIDE)
            rgb = world.renderer(frame.feature, frame.occupancy_logit, rays.origin, rays.direction).rgb
            b, c, _, h, w = rays.rgb.shape
            shown.append(rgb.view(b * c, h, w, 3).permute(0, 3, 1, 2))
            real.append(rays.rgb.flatten(0, 1))
            for key, value in image_figures(shown[-1], real[-1]).items():
                found[f"{FRAMES[k]}.{key}"].append(value)
            if k:
                repeated = image_figures(shown[0], real[-1])["psnr_db"]
                found[f"{FRAMES[k]}.repeated_psnr_db"].append(repeated)
        logit = torch.stack([frame.occupancy_logit for frame in decoded], dim=1)
        labels = VoxelGrid(
            world.spec, example.occupancy.values[:, frames], example.occupancy.known[:, frames]
        )
        counts.append(count_occupancy(logit > 0, labels, above_ground(world.spec)))
        if number == 0:
            _write_picture(picture, shown, real)
    total = sum(counts[1:], start=counts[0])
    ious = {f"{name}.iou_above_ground": float(iou) for name, iou in zip(FRAMES, total.iou, strict=True)}
    return {key: fmean(values) for key, values in found.items()} | ious


def image_figures(shown: Float[Tensor, "n 3 h w"], real: Float[Tensor, "n 3 h w"]) -> dict[str, float]:
    """Return PSNR, sharpness and gradient error, see `judge`; no network takes part in them."""
    known = torch.ones_like(real[:, 0], dtype=torch.bool)
    of_shown, of_real = _gradients(shown), _gradients(real)
    scale = of_real.abs().mean()
    return {
        "psnr_db": float(psnr_db(shown, real, known).mean()),
        "sharpness": float(of_shown.abs().mean() / scale),
        "gradient_error": float((of_shown - of_real).abs().mean() / scale),
    }


def _gradients(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 6 _h _w"]:
    """Return differences of neighbouring pixels along rows and columns."""
    across = images[:, :, 1:, 1:] - images[:, :, 1:, :-1]
    down = images[:, :, 1:, 1:] - images[:, :, :-1, 1:]
    return torch.cat([across, down], dim=1)


def _examples(clips: ClipDataset) -> Iterator[Example]:
    for index in range(0, len(clips), JUDGED_EVERY):
        yield collate([clips[index]])


def _write_picture(path: Path, shown: list[Tensor], real: list[Tensor]) -> None:
    """Write real frames above rendered ones: a row of cameras for each."""
    rows = [torch.cat(list(images), dim=2) for pair in zip(real, shown, strict=True) for images in pair]
    pixels = (torch.cat(rows, dim=1).clamp(0, 1) * 255).byte().permute(1, 2, 0).numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


BENCHMARK = Benchmark(
    question="Do imagined frames blur, need they a smaller weight, does a perceptual loss sharpen them?",
    arms={name: arm(name) for name in ARMS},
    config={
        "recipes": {name: dataclasses.asdict(recipe) for name, recipe in ARMS.items()},
        "towns": dataclasses.asdict(TOWNS),
        "judged": {"cameras": CAMERAS, "stride": SHOWN_STRIDE, "every": JUDGED_EVERY},
    },
)
