"""Training of a scene of Gaussians: one whole image or sweep per step, relocation and growth."""

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.optim import Optimizer

from foredrive.engine.ranges import check_at_least, check_shares
from foredrive.methods.reconstruction.rendered import RenderedSweep
from foredrive.methods.reconstruction.training import ParameterGroup, SensorViews, StepLosses, ViewOrder
from foredrive.methods.reconstruction.views import SweepView
from foredrive.methods.splatad.beams import PreparedSweep
from foredrive.methods.splatad.losses import (
    drop_loss,
    intensity_loss,
    line_of_sight_loss,
    published_lidar_losses,
    range_loss,
)
from foredrive.methods.splatad.rates import LearningRates
from foredrive.methods.splatad.relocation import MAX_COPIES, MIN_OPACITY, random_walk_m, split_evenly
from foredrive.methods.splatad.scene import GAUSSIAN_PARAMETERS, GaussianScene
from foredrive.ops.photometric import photometric_loss
from foredrive.scene import LidarSweep


@torch.no_grad()
def relocate(scene: GaussianScene, optimizer: Optimizer, generator: torch.Generator) -> int:
    """Move every dead Gaussian to a live one, drawn by opacity. Return how many were moved.

    Both then render together as the live one did, and start without momentum.
    """
    opacity = scene.opacity_logit.sigmoid()
    dead = (opacity <= MIN_OPACITY).nonzero()[:, 0]
    alive = (opacity > MIN_OPACITY).nonzero()[:, 0]
    if len(dead) == 0 or len(alive) == 0:
        return 0
    # Live Gaussians are drawn in proportion to opacity, as samples of the scene
    chosen = alive[_drawn(opacity[alive], len(dead), generator)]
    # Opacity and scale are shared before copying, so the copies are equal to the original
    _share(scene, chosen)
    for name in GAUSSIAN_PARAMETERS:
        parameter = getattr(scene, name)
        parameter[dead] = parameter[chosen]
        # Moments of Adam belong to the old place: both start without momentum
        _forget(optimizer, parameter, torch.cat([dead, chosen]))
    scene.actor[dead] = scene.actor[chosen]
    return len(dead)


@torch.no_grad()
def grow(
    scene: GaussianScene, optimizer: Optimizer, most: int, share: float, generator: torch.Generator
) -> int:
    """Add a share of new Gaussians, up to `most` in total. Return how many were added.

    Each is placed on one drawn by opacity, as in `relocate`.
    """
    count = min(int((1 + share) * len(scene.actor)), most) - len(scene.actor)
    if count <= 0:
        return 0
    chosen = _drawn(scene.opacity_logit.sigmoid(), count, generator)
    _share(scene, chosen)
    for name in GAUSSIAN_PARAMETERS:
        old = getattr(scene, name)
        new = nn.Parameter(torch.cat([old, old[chosen]]))
        # The originals changed by sharing, so their momentum is void too
        _forget(optimizer, old, chosen)
        _replace(optimizer, old, new)
        setattr(scene, name, new)
    scene.actor = torch.cat([scene.actor, scene.actor[chosen]])
    return count


def _drawn(weight: Float[Tensor, "N"], count: int, generator: torch.Generator) -> Int[Tensor, "count"]:
    """Draw rows by weight, with replacement. torch.multinomial takes no more than 2**24 rows."""
    total = weight.double().cumsum(0).cpu()
    drawn = torch.rand(count, generator=generator, dtype=torch.float64) * total[-1]
    return torch.searchsorted(total, drawn).clamp_max(len(total) - 1).to(weight.device)


def _share(scene: GaussianScene, chosen: Int[Tensor, "count"]) -> None:
    """Lower opacity and scale of the chosen Gaussians, so that with their copies they render as before."""
    # A Gaussian drawn k times splits into k + 1, itself included
    rows, copies = chosen.unique(return_counts=True)
    opacity, scale = split_evenly(scene.opacity_logit[rows].sigmoid(), (copies + 1).clamp_max(MAX_COPIES))
    scene.opacity_logit[rows] = opacity.clamp(MIN_OPACITY, 1 - 1e-6).logit()
    scene.log_scale[rows] += scale.log()[:, None]


def _forget(optimizer: Optimizer, parameter: nn.Parameter, rows: Int[Tensor, "_"]) -> None:
    for value in optimizer.state[parameter].values():
        if value.shape == parameter.shape:
            value[rows] = 0


def _replace(optimizer: Optimizer, old: nn.Parameter, new: nn.Parameter) -> None:
    """Continue the optimizer with a longer parameter."""
    state = optimizer.state.pop(old, {})
    # Moments of new rows start at 0; the step counter has no rows and stays
    optimizer.state[new] = {
        name: torch.cat([value, value.new_zeros(len(new) - len(old), *value.shape[1:])])
        if value.shape == old.shape
        else value
        for name, value in state.items()
    }
    for group in optimizer.param_groups:
        group["params"] = [new if parameter is old else parameter for parameter in group["params"]]


@dataclass(frozen=True)
class GaussianWeights:
    """Weights of the losses (Hess et al., "SplatAD", 2025, §3.5 and supplement)."""

    ssim: float = 0.2
    """Weight of 1 - SSIM; L1 has the rest."""
    depth: float = 0.1
    """Weight of the error of ranges, L1 in m."""
    intensity: float = 1.0
    """Weight of the error of intensities, squared."""
    drop: float = 0.1
    """Weight of the cross-entropy of lost beams."""
    line_of_sight: float = 0.1
    """Weight of the share of light that is stopped before a beam's return."""
    depth_quantile: float = 0.95
    """Share of the returned beams that count for `depth`. The worst hit something thin or moving."""
    scale: float = 1e-3
    """Weight of the mean standard deviation of the Gaussians, m."""
    opacity: float = 5e-3
    """Weight of the mean opacity of the Gaussians."""
    frame_velocity: float = 1e-6
    """Weight of the mean length of the corrections of the frames' velocities, if they are learned."""
    frame_turn: float = 1e-5
    """Weight of the mean length of the corrections of the frames' turn rates, if they are learned."""


@dataclass(frozen=True)
class GaussianSchedule:
    """Length of the training of a scene of Gaussians, and its growth."""

    steps: int
    """Number of steps, each on one image or one sweep."""
    max_gaussians: int
    """Number of Gaussians up to which the scene grows."""
    rates: LearningRates = field(default_factory=LearningRates)
    weights: GaussianWeights = field(default_factory=GaussianWeights)
    images_per_sweep: int = 1
    """Number of steps on images for each step on a sweep."""
    beam_stride: int = 1
    """Stride of the beams used from a sweep."""
    shrink_steps: tuple[int, ...] = ()
    """Steps until which images are shrunk. With two entries: by 4 until the first step, by 2 until the
    second."""
    grow_from: int = 500
    """Step after which the scene grows: dead Gaussians are relocated and new ones added."""
    grow_until: int = 15_000
    """Last step in which the scene may grow."""
    grow_every: int = 100
    """Steps between those in which the scene grows."""
    growth: float = 0.05
    """New Gaussians of each growth, as a share of those there are."""
    walk: float = 5e5
    """λ_noise: noise of the centres in units of their learning rate."""
    mirror_share: float = 0.5
    """Probability that a left-right symmetric actor is mirrored in a step."""
    before_hit_m: float = 0.8
    """Light that is stopped more than this distance before a lidar return is penalised, m."""
    lidar_losses: Literal["ours", "published"] = "ours"
    """Losses of sweeps: ours, or those of SplatAD's reference implementation, `published_lidar_losses`."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""
    seed: int = 0
    """Seed of the initial scene, of the order of views and of random numbers."""

    def __post_init__(self) -> None:
        """Check the numbers' ranges."""
        check_at_least(self, steps=0, max_gaussians=1, images_per_sweep=1, beam_stride=1, shrink_steps=0)
        check_at_least(self, grow_from=0, grow_until=0, grow_every=1, growth=0, walk=0, before_hit_m=0)
        check_at_least(self, checkpoint_every=1)
        check_shares(self, "mirror_share")

    def shrink_at(self, step: int) -> int:
        """Return the factor by which images are shrunk at a step."""
        return int(2 ** sum(step < end for end in self.shrink_steps))


class GaussianTraining:
    """The `SceneTraining` of a scene of Gaussians.

    Args:
        scene: trained in place.
        views: training data.
        schedule: length, rates, losses and growth.

    Raises:
        InputError: there are neither images nor sweeps.
    """

    def __init__(self, scene: GaussianScene, views: SensorViews, schedule: GaussianSchedule) -> None:
        self.scene, self.views, self.schedule = scene, views, schedule
        self.steps, self.checkpoint_every, self.seed = (
            schedule.steps,
            schedule.checkpoint_every,
            schedule.seed,
        )
        self._order = ViewOrder(
            len(views.cameras), len(views.sweeps), schedule.images_per_sweep, schedule.seed
        )
        # Sweeps are thinned and prepared once
        self._sweeps: dict[int, tuple[SweepView, PreparedSweep]] = {}

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return one group per kind of parameter, named as in `LearningRates`."""
        groups, scene, rates = [], self.scene, self.schedule.rates
        for rate in dataclasses.fields(rates):
            if rate.name == "decoders":
                parameters = [*scene.camera_decoder.parameters(), *scene.lidar_decoder.parameters()]
            elif (learned := getattr(scene, rate.name)) is None:
                continue
            else:
                parameters = list(learned.parameters()) if isinstance(learned, nn.Module) else [learned]
            groups.append(ParameterGroup(rate.name, parameters, getattr(rates, rate.name)))
        return groups

    def losses(self, step: int, generator: torch.Generator) -> StepLosses:
        """Return the losses of an image or a sweep, some actors mirrored, and of the regularisers."""
        kind, number = self._order.at(step)
        # Each symmetric actor is mirrored at random, so that both of its sides are learned from either
        drawn = torch.rand(len(self.scene.track_id), generator=generator) < self.schedule.mirror_share
        mirror = drawn.to(self.scene.device) & self.scene.tracks.mirrored
        if kind == "image":
            random = self.scene.config.background == "after_decoder"
            # A random background cannot be imitated, so the scene has to cover what is opaque
            background_rgb = torch.rand(3, generator=generator) if random else None
            losses = self._image(number, self.schedule.shrink_at(step), mirror, background_rgb)
        else:
            losses = self._sweep(number, mirror)
        losses["loss"] = losses["loss"] + self._regularisers()
        return StepLosses(f"{kind} {number}", losses)

    @torch.no_grad()
    def evolve(self, step: int, optimizer: Optimizer, generator: torch.Generator) -> None:
        """Relocate, grow and walk."""
        schedule, scene = self.schedule, self.scene
        # Relocation and growth at intervals within a window of steps
        if schedule.grow_from < step + 1 <= schedule.grow_until and (step + 1) % schedule.grow_every == 0:
            relocate(scene, optimizer, generator)
            grow(scene, optimizer, schedule.max_gaussians, schedule.growth, generator)
        # The noise shrinks with the learning rate of the centres
        rate = schedule.rates.mean_m.at(step, schedule.steps)
        scene.mean_m.add_(random_walk_m(scene.gaussians, schedule.walk * rate, generator))

    def _image(
        self, number: int, shrink: int, mirror: Tensor, background_rgb: Tensor | None
    ) -> dict[str, Tensor]:
        view = self.views.cameras[number].shrunk(shrink).to(self.scene.device)
        assert view.image is not None
        real = view.image.float() / 255
        rgb = self.scene.camera(self.scene.graph, view, mirror, number, background_rgb).rgb
        loss = photometric_loss(rgb, real, self.schedule.weights.ssim)
        # PSNR in dB for values up to 1
        psnr = -10 * ((rgb.detach().clamp(0, 1) - real) ** 2).mean().log10()
        return {"loss": loss, "photometric": loss, "psnr_db": psnr}

    def _sweep(self, number: int, mirror: Tensor) -> dict[str, Tensor]:
        if number not in self._sweeps:
            stride = self.schedule.beam_stride
            view = self.views.sweeps[number]
            # Another offset for each sweep, so that all beams of the pattern are used over the drive
            view = dataclasses.replace(view, beams=view.beams[number % stride :: stride])
            self._sweeps[number] = (view, self.scene.prepare_sweep(view))
        view, points = self._sweeps[number]
        beams = view.beams.to(self.scene.device)
        # Light stopped well before the return is penalised; lost beams have no such limit
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
        # The drop is learned only where the log records lost beams
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
        # Small scales and low opacities keep Gaussians from covering what others explain
        small = self.scene.log_scale.exp().mean()
        loss = weights.scale * small + weights.opacity * self.scene.opacity_logit.sigmoid().mean()
        for name in ("frame_velocity", "frame_turn"):
            if (correction := getattr(self.scene, name)) is not None:
                loss = loss + getattr(weights, name) * correction.norm(dim=-1).mean()
        return loss
