"""The futures that a run imagines from some times of a log, beside the recorded future."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.data import LogPath, collate
from foredrive.data.logs import Log
from foredrive.devices import chosen_device
from foredrive.errors import InputError
from foredrive.methods.blocks.training_rays import thinned_rays
from foredrive.runs.open_clips import open_clips
from foredrive.runs.train.run import Run, load_agent
from foredrive.scene import Belief, Clip, Example, RayRenderer, WorldModel

SEED = 0
MAX_DEFAULT_S = 4.0
"""Longest future that is imagined where no length is asked for, s."""


@dataclass(frozen=True)
class ImaginedFutures:
    """One time of a log, unbatched, with F key frames, now first."""

    example: Example
    """The example with the images and labels of all F frames."""
    futures: Bool[Tensor, "K F Z Y X"]
    """Occupancy in K futures, each frame in its own ego frame; K is 1 for a deterministic model."""
    rendered: Float[Tensor, "F C 3 h w"] | None
    """Camera images of the first future, RGB 0 to 1; None from a model that does not render."""


@torch.no_grad()
def imagine_run(
    run: Run, log: LogPath, *, seconds: float | None = None, samples: int, moments: int, ray_stride: int = 1
) -> Iterator[ImaginedFutures]:
    """Imagine futures from times spread evenly over a log.

    Args:
        seconds: length of a future, s; None: as far as the model imagines and the log goes on, at most
            `MAX_DEFAULT_S`.
        samples: number of futures from a stochastic world model; the seed is fixed, so they are the same in
            every call.
        moments: number of times; fewer if the log is too short for as many.
        ray_stride: one pixel in `ray_stride` along rows and columns is rendered.

    Raises:
        InputError: the log cannot be read or is too short, the run has no weights, or the model cannot
            imagine that far.
    """
    clips = run.recipe.clips
    device = chosen_device()
    world = load_agent(run).world_model.to(device)
    steps = round((MAX_DEFAULT_S if seconds is None else seconds) / clips.frame_dt_s)
    # The longest future in which the log shows what the model is to be compared with
    recorded = Log(log)
    length_s = (recorded.t_us[-1] - recorded.t_us[0]) * 1e-6
    most = int((length_s + 0.5 * recorded.period_s) / clips.frame_dt_s) - clips.past_frames
    if seconds is None:
        steps = min(steps, max(most, 1), *([] if world.max_steps is None else [world.max_steps]))
    if min(steps, samples, moments) < 1:
        raise InputError(f"at least one moment, one sample and one step of {clips.frame_dt_s:g} s are needed")
    if seconds is not None and world.max_steps is not None and steps > world.max_steps:
        max_s = world.max_steps * clips.frame_dt_s
        raise InputError(f"{run.folder}: the model imagines at most {max_s:g} s, not {seconds:g} s")
    if steps > most:
        past_s = clips.past_frames * clips.frame_dt_s
        can = f"at most --seconds {most * clips.frame_dt_s:g}" if most > 0 else "too short for any future"
        raise InputError(
            f"{log.folder}: {length_s:.1f} s long, of which the model sees {past_s:g} s before now: {can}"
        )
    config = dataclasses.replace(clips.judged, future_frames=steps, future_images=True)
    dataset = open_clips([log], config, run.cache_dir)
    generator = torch.Generator().manual_seed(SEED)
    count = min(moments, len(dataset))
    for k in range(count):
        item = dataset[int((k + 0.5) * len(dataset) / count)]
        observed = collate([item]).clip.observed().to(device)
        now = world.observe(observed)
        futures = samples if world.samples_futures else 1
        drawn = [[now, *world.imagine(now, steps, generator=generator)] for _ in range(futures)]
        renderer = world.renderer
        rendered = None if renderer is None else _views(world, renderer, drawn[0], observed, ray_stride)
        occupied = torch.stack([_occupied(world, beliefs) for beliefs in drawn]).cpu()
        yield ImaginedFutures(item, occupied, None if rendered is None else rendered.cpu())


def _occupied(world: WorldModel, beliefs: list[Belief]) -> Bool[Tensor, "F Z Y X"]:
    return torch.stack([world.decode(belief).occupancy_logit[0] > 0 for belief in beliefs])


def _views(
    world: WorldModel, renderer: RayRenderer, beliefs: list[Belief], observed: Clip, ray_stride: int
) -> Tensor:
    """Render every camera at every frame, with the rig of the present frame."""
    rays = thinned_rays(observed, observed.now, ray_stride)
    _, c, _, h, w = rays.rgb.shape
    views = []
    for belief in beliefs:
        seen = world.decode(belief)
        cameras = zip(rays.origin.split(h * w, 1), rays.direction.split(h * w, 1), strict=True)
        parts = [
            renderer(seen.feature, seen.occupancy_logit, origin, direction).rgb[0]
            for origin, direction in cameras
        ]
        views.append(torch.cat(parts).view(c, h, w, 3).permute(0, 3, 1, 2))
    return torch.stack(views)
