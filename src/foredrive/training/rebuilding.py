"""Training of a scene from the images and sweeps of a drive, one image or sweep per step."""

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor
from torch.optim import Adam

from foredrive.errors import InputError
from foredrive.losses.rendering import (
    drop_loss,
    intensity_loss,
    line_of_sight_loss,
    photometric_loss,
    published_lidar_losses,
    range_loss,
)
from foredrive.rendering.rebuilt import RebuiltScene
from foredrive.rendering.relocation import random_walk_m
from foredrive.rendering.rendered import PreparedSweep, RenderedSweep
from foredrive.rendering.views import CameraView, SweepView
from foredrive.scene import LidarSweep
from foredrive.training.checkpoints import latest_checkpoint, load_checkpoint
from foredrive.training.gaussian_rates import LearningRates
from foredrive.training.gaussian_steps import grow, relocate
from foredrive.training.loop import CHECKPOINTS, check_finite, step_counter

_SMOOTHING = 0.05
"""Weight of the newest image in the displayed PSNR."""


@dataclass(frozen=True)
class RebuildWeights:
    """Weights of the losses (Hess et al., "SplatAD", 2025, §3.5 and supplement)."""

    ssim: float = 0.2
    """Weight of 1 - SSIM; L1 has the rest."""
    depth: float = 0.1
    intensity: float = 1.0
    drop: float = 0.1
    line_of_sight: float = 0.1
    depth_quantile: float = 0.95
    """Share of the returned beams that count for `depth`. The worst hit something thin or moving."""
    scale: float = 1e-3
    opacity: float = 5e-3
    frame_velocity: float = 1e-6
    frame_turn: float = 1e-5
    """Weights of the mean length of the corrections of the frames' velocities, if they are learned."""


@dataclass(frozen=True)
class RebuildSchedule:
    """Length of a scene's training, and its growth."""

    steps: int
    max_gaussians: int
    rates: LearningRates = field(default_factory=LearningRates)
    weights: RebuildWeights = field(default_factory=RebuildWeights)
    images_per_sweep: int = 1
    beam_stride: int = 1
    """Stride of the beams used from a sweep."""
    shrink_steps: tuple[int, ...] = ()
    """Steps until which images are shrunk. With two entries: by 4 until the first step, by 2 until the
    second."""
    grow_from: int = 500
    grow_until: int = 15_000
    grow_every: int = 100
    growth: float = 0.05
    walk: float = 5e5
    """λ_noise: noise of the centres in units of their learning rate."""
    mirror_share: float = 0.5
    """Probability that a left-right symmetric actor is mirrored in a step."""
    before_hit_m: float = 0.8
    """Light that is stopped more than this distance before a lidar return is penalised, m."""
    lidar_losses: Literal["ours", "published"] = "ours"
    """"published": those of SplatAD's reference implementation, see `published_lidar_losses`."""
    checkpoint_every: int = 500
    seed: int = 0

    def shrink_at(self, step: int) -> int:
        """Return the factor by which images are shrunk at a step."""
        return int(2 ** sum(step < end for end in self.shrink_steps))


@dataclass(frozen=True)
class SensorViews:
    """The training data."""

    cameras: Sequence[CameraView]
    sweeps: Sequence[SweepView]


def rebuild(scene: RebuiltScene, views: SensorViews, schedule: RebuildSchedule, folder: Path) -> None:
    """Train `scene`, continuing from a checkpoint in `folder` if there is one.

    Writes `folder/metrics.jsonl` and `folder/checkpoints/step_N`. An interrupted run that is resumed gives
    the same scene as an uninterrupted one: all random numbers follow from the seed and the step. Ctrl-C ends
    the run after the current step, with a checkpoint.

    Raises:
        InputError: there are neither images nor sweeps, or a loss is not finite.
    """
    if not views.cameras and not views.sweeps:
        raise InputError("there is nothing to learn from: neither images nor sweeps")
    found = latest_checkpoint(folder / CHECKPOINTS)
    done = 0
    if found is not None:
        scene.resize(found / "model.safetensors")
    optimizer = make_optimizer(scene, schedule.rates)
    if found is not None:
        done = load_checkpoint(found, scene, optimizer)
    if done >= schedule.steps:
        return
    trainer, shown_db = _Trainer(scene, views, schedule, optimizer), math.nan
    with step_counter(folder, scene, optimizer, done, schedule.steps, schedule.checkpoint_every) as end_step:
        for step in range(done, schedule.steps):
            before_s = time.process_time()
            losses = trainer.step(step)
            losses["computing_s"] = torch.tensor(time.process_time() - before_s)
            if "psnr_db" in losses:
                now_db = float(losses["psnr_db"])
                shown_db = now_db if math.isnan(shown_db) else shown_db + _SMOOTHING * (now_db - shown_db)
            note = "" if math.isnan(shown_db) else f"  PSNR {shown_db:.1f} dB"
            if end_step(losses, f"{len(scene.actor)} Gaussians{note}"):
                break


def make_optimizer(scene: RebuiltScene, rates: LearningRates) -> Adam:
    """Return Adam with one group per kind of parameter, named as in `LearningRates`."""
    groups = []
    for rate in dataclasses.fields(rates):
        if rate.name == "decoders":
            parameters = [*scene.camera_decoder.parameters(), *scene.lidar_decoder.parameters()]
        elif getattr(scene, rate.name) is None:
            continue
        else:
            parameters = [getattr(scene, rate.name)]
        groups.append({"params": parameters, "name": rate.name, "lr": getattr(rates, rate.name).first})
    return Adam(groups, eps=1e-15)


class _Trainer:
    """A trainer that runs one step at a time."""

    def __init__(
        self, scene: RebuiltScene, views: SensorViews, schedule: RebuildSchedule, optimizer: Adam
    ) -> None:
        self.scene, self.views, self.schedule, self.optimizer = scene, views, schedule, optimizer
        self.sweeps: dict[int, tuple[SweepView, PreparedSweep]] = {}

    def step(self, step: int) -> dict[str, Tensor]:
        schedule = self.schedule
        generator = torch.Generator().manual_seed((schedule.seed * 1_000_003 + step) * 1009)
        for group in self.optimizer.param_groups:
            group["lr"] = getattr(schedule.rates, group["name"]).at(step, schedule.steps)
        kind, number = self._item(step)
        mirrored = torch.rand(len(self.scene.track_id), generator=generator) < schedule.mirror_share
        mirror = mirrored.to(self.scene.actor.device) & self.scene.tracks.mirrored
        if kind == "image":
            random = self.scene.config.background == "after_decoder"
            background_rgb = torch.rand(3, generator=generator) if random else None
            losses = self._image(number, schedule.shrink_at(step), mirror, background_rgb)
        else:
            losses = self._sweep(number, mirror)
        losses["loss"] = losses["loss"] + self._regularisers()
        descended = {name: value for name, value in losses.items() if name != "psnr_db"}  # may be infinite
        check_finite(descended, step, f"{kind} {number}")
        self.optimizer.zero_grad(set_to_none=True)
        losses["loss"].backward()
        self.optimizer.step()
        self._evolve(step, generator)
        return {name: value.detach() for name, value in losses.items()}

    def _item(self, step: int) -> tuple[Literal["image", "sweep"], int]:
        """Choose the item of a step: one sweep after every few images, each in a new order per epoch."""
        images, sweeps = len(self.views.cameras), len(self.views.sweeps)
        turn = self.schedule.images_per_sweep + 1
        if not images or (sweeps and step % turn == turn - 1):
            return "sweep", self._shuffled(step // turn if images else step, sweeps, 1)
        return "image", self._shuffled(step - step // turn if sweeps else step, images, 0)

    def _shuffled(self, number: int, items: int, kind: int) -> int:
        seed = ((self.schedule.seed * 1_000_003 + number // items) * 2 + kind) * 7919
        order = torch.randperm(items, generator=torch.Generator().manual_seed(seed))
        return int(order[number % items])

    def _image(
        self, number: int, shrink: int, mirror: Tensor, background_rgb: Tensor | None
    ) -> dict[str, Tensor]:
        view = self.views.cameras[number].shrunk(shrink).to(self.scene.actor.device)
        assert view.image is not None
        real = view.image.float() / 255
        rgb = self.scene(self.scene.graph, view, mirror, number, background_rgb).rgb
        loss = photometric_loss(rgb, real, self.schedule.weights.ssim)
        psnr = -10 * ((rgb.detach().clamp(0, 1) - real) ** 2).mean().log10()
        return {"loss": loss, "photometric": loss, "psnr_db": psnr}

    def _sweep(self, number: int, mirror: Tensor) -> dict[str, Tensor]:
        if number not in self.sweeps:
            stride = self.schedule.beam_stride
            view = self.views.sweeps[number]
            view = dataclasses.replace(view, beams=view.beams[number % stride :: stride])
            self.sweeps[number] = (view, self.scene.prepare_sweep(view))
        view, points = self.sweeps[number]
        beams = view.beams.to(self.scene.actor.device)
        hit_m = torch.where(beams.returned, beams.range_m - self.schedule.before_hit_m, torch.inf)
        published = self.schedule.lidar_losses == "published"
        rendered = self.scene.sweep(
            self.scene.graph,
            points,
            view.t_s,
            hit_m,
            mirror,
            "opacities" if published else "weights",
            len(self.views.cameras) + number,
        )
        losses = self._published_losses(rendered, beams) if published else self._our_losses(rendered, beams)
        if view.misses_known:
            losses["drop"] = drop_loss(rendered.drop_logit, beams.returned)
        loss = torch.stack([getattr(self.schedule.weights, name) * value for name, value in losses.items()])
        return {"loss": loss.sum(), **losses}

    def _our_losses(self, rendered: RenderedSweep, beams: LidarSweep) -> dict[str, Tensor]:
        assert rendered.alpha_before_hit is not None
        quantile = self.schedule.weights.depth_quantile
        return {
            "depth": range_loss(rendered.range_m, beams.range_m, beams.returned, quantile),
            "intensity": intensity_loss(rendered.intensity, beams.intensity, beams.returned),
            "line_of_sight": line_of_sight_loss(rendered.alpha_before_hit, beams.returned),
        }

    def _published_losses(self, rendered: RenderedSweep, beams: LidarSweep) -> dict[str, Tensor]:
        assert rendered.alpha_before_hit is not None
        return published_lidar_losses(
            rendered.weighted_range_m,
            rendered.intensity,
            rendered.alpha_before_hit,
            beams.range_m,
            beams.intensity,
            beams.returned,
            self.schedule.weights.depth_quantile,
        )

    def _regularisers(self) -> Tensor:
        weights = self.schedule.weights
        small = self.scene.log_scale.exp().mean()
        loss = weights.scale * small + weights.opacity * self.scene.opacity_logit.sigmoid().mean()
        for name in ("frame_velocity", "frame_turn"):
            if (correction := getattr(self.scene, name)) is not None:
                loss = loss + getattr(weights, name) * correction.norm(dim=-1).mean()
        return loss

    @torch.no_grad()
    def _evolve(self, step: int, generator: torch.Generator) -> None:
        """Relocate, grow and walk."""
        schedule, scene = self.schedule, self.scene
        if schedule.grow_from < step + 1 <= schedule.grow_until and (step + 1) % schedule.grow_every == 0:
            relocate(scene, self.optimizer, generator)
            grow(scene, self.optimizer, schedule.max_gaussians, schedule.growth, generator)
        rate = next(group["lr"] for group in self.optimizer.param_groups if group["name"] == "mean_m")
        scene.mean_m.add_(random_walk_m(scene.gaussians, schedule.walk * rate, generator))
