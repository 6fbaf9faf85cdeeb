"""Training of a scene that is a neural field: patches of images and beams of sweeps in every step."""

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.optim import Optimizer

from foredrive.engine.learning_rates import Rate
from foredrive.engine.ranges import check_at_least, check_shares
from foredrive.errors import InputError
from foredrive.methods.blocks.losses import ImageFeatures
from foredrive.methods.blocks.vgg import VggFeatures
from foredrive.methods.neurad.decoders import UPSAMPLING
from foredrive.methods.neurad.losses import (
    beam_depth_loss,
    carving_loss,
    distortion_loss,
    hit_loss,
    interlevel_loss,
    weighted_feature_loss,
)
from foredrive.methods.neurad.rays import FieldRays
from foredrive.methods.neurad.render import Intervals, SeenAlongRays
from foredrive.methods.neurad.scene import FieldScene, tables_of
from foredrive.methods.reconstruction.perceptual import feature_distance
from foredrive.methods.reconstruction.training import ParameterGroup, SensorViews, StepLosses
from foredrive.methods.splatad.losses import drop_loss, intensity_loss

PULSES = (0.03, 0.003)
"""Half widths of the blur for the first and for further proposals, in positions on the ray (Zip-NeRF)."""


@dataclass(frozen=True)
class FieldWeights:
    """Weights of the losses. The defaults are those of NeuRAD's reference implementation."""

    rgb: float = 5.0
    """Weight of the mean squared error of colours."""
    perceptual: float = 0.05
    """Weight of the distance of image features; needs `FieldSchedule.perceptual`."""
    depth: float = 0.01
    """Weight of the error of expected ranges of beams, L1 in m."""
    carving: float = 0.01
    """Weight of the squared weights of a beam's samples where nothing should be."""
    hit: float = 0.0
    """Weight of the negative logarithm of the share of a beam that ends near its return; not in the paper."""
    intensity: float = 0.1
    """Weight of the mean squared error of intensities."""
    drop: float = 0.01
    """Weight of the cross-entropy of lost beams."""
    interlevel: float = 0.001
    """Weight of what the proposals' weights lack to cover the field's (Zip-NeRF)."""
    distortion: float = 0.002
    """Weight of the spread of the weights along a ray (Mip-NeRF 360, eq. 15)."""
    proposal: float = 0.1
    """Factor of depth, carving and hit for the proposals."""
    lost: float = 0.1
    """Factor of depth for beams that did not return."""


@dataclass(frozen=True)
class FieldRates:
    """Learning rates. The defaults are those of NeuRAD's reference implementation."""

    grids: Rate = field(default_factory=lambda: Rate(1e-2, warmup_steps=500))
    """Rate of the tables of the hash grids."""
    layers: Rate = field(default_factory=lambda: Rate(1e-2, warmup_steps=500))
    """Rate of the field's layers, the decoder of beams and the appearance codes."""
    decoder: Rate = field(default_factory=lambda: Rate(1e-3, warmup_steps=2_500))
    """Rate of the CNN for images; appearance codes are among the layers, as in the reference
    implementation."""
    actor_offset: Rate = field(default_factory=lambda: Rate(1e-3, warmup_steps=2_500))
    """Rate of the offsets of the actors' poses."""
    camera_offset: Rate = field(default_factory=lambda: Rate(0.0))
    """Rate of the offsets of the cameras' mounts."""
    camera_twist: Rate = field(default_factory=lambda: Rate(0.0))
    """Rate of the corrections of the cameras' velocities and turn rates."""
    camera_late_s: Rate = field(default_factory=lambda: Rate(0.0))
    """Rate of the delays of the cameras' exposures."""


@dataclass(frozen=True)
class FieldSchedule:
    """Length of the training of a field, and what a step looks at."""

    steps: int
    """Number of steps, each on patches of images and beams of sweeps."""
    patches: int = 40
    """Patches of images in a step, of any of the images."""
    patch: int = 32
    """Rays along a side of a patch; fewer where the image is smaller."""
    beams: int = 16_384
    """Beams in a step."""
    sweeps: int = 4
    """Sweeps that the beams of a step are from."""
    perceptual: str | None = None
    """Network of the perceptual loss: a file of torchvision's VGG-19, "download", or "tower", the image tower
    that comes with the package; None: there is no such loss. The loss is L1 of VGG-19's features, or LPIPS's
    distance of the tower's (`feature_distance`)."""
    weights: FieldWeights = field(default_factory=FieldWeights)
    rates: FieldRates = field(default_factory=FieldRates)
    margin_m: float = 0.1
    """Samples within this distance of a return count as surface, for carving."""
    hit_m: float = 0.5
    """Distance from a return that counts as near, for `FieldWeights.hit`."""
    free_m: float | None = None
    """Beams that did not return are free up to this distance; None: up to the lidar's reach."""
    depth_quantile: float = 0.95
    """Share of the depth errors that count. The worst hit something thin or moving."""
    poses_every: int = 1
    """Steps between those that learn poses of actors and cameras: without them a step is cheaper."""
    proposals_every: int = 1
    """Steps between those that learn proposals."""
    mirror_share: float = 0.5
    """Probability that a left-right symmetric actor is mirrored in a step."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""
    seed: int = 0
    """Seed of the weights, of the views and of random numbers."""

    def __post_init__(self) -> None:
        """Check the numbers' ranges, and that a step looks at something."""
        check_at_least(self, steps=0, patches=0, beams=0, sweeps=0, patch=1, margin_m=0, hit_m=0, free_m=0)
        check_at_least(self, poses_every=1, proposals_every=1, checkpoint_every=1)
        check_shares(self, "depth_quantile", "mirror_share")
        if not self.patches and not (self.beams and self.sweeps):
            raise InputError("a step needs patches, or beams of sweeps")


class FieldTraining:
    """The `SceneTraining` of a field.

    Args:
        scene: trained in place.
        views: training data.
        schedule: length, rates and losses.
        tower: loads the features for the perceptual loss "tower".

    Raises:
        InputError: there are neither images nor sweeps that a step looks at, images are too small, or the
            weights for the perceptual loss cannot be read.
    """

    def __init__(
        self,
        scene: FieldScene,
        views: SensorViews,
        schedule: FieldSchedule,
        tower: Callable[[], ImageFeatures] | None = None,
    ) -> None:
        # Beams are prepared once for all steps
        beams = [(view, scene.prepare_sweep(view)) for view in views.sweeps]
        self._sweeps = [(view, rays) for view, rays in beams if len(rays.t_s)] if schedule.beams else []
        if not (views.cameras and schedule.patches) and not (self._sweeps and schedule.sweeps):
            raise InputError("there is nothing to learn from: neither images nor sweeps that a step looks at")
        if any(min(view.size_hw) < UPSAMPLING for view in views.cameras):
            raise InputError(f"images of a field need {UPSAMPLING} pixels a side or more")
        self.scene, self.views, self.schedule = scene, views, schedule
        # Not a part of the scene: it is neither trained nor saved.
        self._features, self._likeness = _perceptual(schedule.perceptual, tower, scene.device)
        self.steps, self.checkpoint_every, self.seed = (
            schedule.steps,
            schedule.checkpoint_every,
            schedule.seed,
        )

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return one group per kind of parameter, named as in `FieldRates`."""
        scene, groups = self.scene, []
        tables = tables_of(scene.field)
        # Three groups: tables of grids, layers and codes, the CNN
        of_table = {id(table) for table in tables}
        layers = [p for p in scene.field.parameters() if id(p) not in of_table]
        by_name = {
            "grids": tables,
            "layers": [*layers, *scene.lidar_decoder.parameters(), scene.camera_decoder.appearance],
            "decoder": [p for n, p in scene.camera_decoder.named_parameters() if n != "appearance"],
        }
        for rate in dataclasses.fields(self.schedule.rates):
            parameters = by_name.get(rate.name) or [getattr(scene, rate.name)]
            # Fused, the moments of a CNN in channels-last order would be read in another order.
            fused, its_rate = rate.name == "grids", getattr(self.schedule.rates, rate.name)
            groups.append(ParameterGroup(rate.name, parameters, its_rate, fused=fused))
        return groups

    def losses(self, step: int, generator: torch.Generator) -> StepLosses:
        """Return the losses of patches and beams, rendered together, some actors mirrored."""
        schedule, scene = self.schedule, self.scene
        propose = step % schedule.proposals_every == 0
        drawn = torch.rand(len(scene.track_id), generator=generator) < schedule.mirror_share
        # Poses in a step without their gradients need no graph through the tracks
        with torch.set_grad_enabled(step % schedule.poses_every == 0):
            graph, patches = scene.graph, self._patches(generator)
        mirror = drawn.to(scene.device) & graph.tracks.mirrored
        beams = self._some_beams(generator)
        # Patches first, then beams, in one batch of rays
        rays = [patch.rays for patch in patches] + [beam.rays for beam in beams]
        # Rays of patches are on the scene's device already, beams are kept on the host
        joined = FieldRays(
            *(torch.cat([part.to(scene.device) for part in parts]) for parts in zip(*rays, strict=True))
        )
        seen = scene.look(graph, joined, mirror, generator, propose)
        losses: dict[str, Tensor] = {}
        first = 0
        if patches:
            first = sum(len(patch.rays.t_s) for patch in patches)
            losses |= self._image_losses(patches, seen.feature[:first])
        if beams:
            losses |= self._beam_losses(beams, seen, first)
        if propose:
            losses["interlevel"] = _interlevel(seen)
        # The sky's interval is huge and would dominate the spread
        losses["distortion"] = distortion_loss(seen.intervals.border[:, :-1], seen.intervals.weight[:, :-1])
        losses["loss"] = torch.stack([self._weight(name) * loss for name, loss in losses.items()]).sum()
        if patches:
            # The mean squared error gives PSNR directly
            losses["psnr_db"] = -10 * losses["rgb"].detach().log10()
        return StepLosses(f"step {step}", losses)

    def evolve(self, step: int, optimizer: Optimizer, generator: torch.Generator) -> None:
        """Do nothing: a field keeps its size."""

    def _weight(self, name: str) -> float:
        weights = self.schedule.weights
        if name.startswith("proposal_"):
            return weights.proposal * float(getattr(weights, name.removeprefix("proposal_")))
        return float(getattr(weights, name))

    def _patches(self, generator: torch.Generator) -> list["_Patch"]:
        """Draw patches of images. The corner may be any pixel from which a patch fits into the image."""
        patches = []
        for _ in range(self.schedule.patches if self.views.cameras else 0):
            view = self.views.cameras[_draw(len(self.views.cameras), generator)]
            assert view.image is not None
            # Small images have smaller patches
            high, wide = (min(self.schedule.patch, side // UPSAMPLING) for side in view.size_hw)
            top = _draw(view.size_hw[0] - UPSAMPLING * high + 1, generator)
            left = _draw(view.size_hw[1] - UPSAMPLING * wide + 1, generator)
            rays = self.scene.rays_of_pixels(
                view.to(self.scene.device), torch.tensor([left, top]), torch.tensor([wide, high])
            )
            image = view.image[:, top : top + UPSAMPLING * high, left : left + UPSAMPLING * wide]
            patches.append(_Patch(rays, image.float() / 255, view.sensor, (high, wide)))
        return patches

    def _some_beams(self, generator: torch.Generator) -> list["_Beams"]:
        schedule, beam_batches = self.schedule, []
        for _ in range(schedule.sweeps if self._sweeps else 0):
            view, rays = self._sweeps[_draw(len(self._sweeps), generator)]
            count = max(schedule.beams // schedule.sweeps, 1)
            chosen = torch.randint(len(rays.t_s), (count,), generator=generator)
            beams = view.beams
            # Where misses are unknown, no beam is known to be lost.
            beam_batches.append(
                _Beams(
                    FieldRays(*(tensor[chosen] for tensor in rays)),
                    beams.range_m[chosen],
                    beams.intensity[chosen],
                    beams.returned[chosen],
                    view.misses_known,
                )
            )
        return beam_batches

    def _image_losses(self, patches: list["_Patch"], feature: Float[Tensor, "R D"]) -> dict[str, Tensor]:
        """Return the mean squared error over all pixels of the patches, and the perceptual loss."""
        parts = feature.split([len(patch.rays.t_s) for patch in patches])
        # Patches of equal size are decoded in one batch
        groups: dict[tuple[int, int], list[tuple[Tensor, _Patch]]] = defaultdict(list)
        for patch, part in zip(patches, parts, strict=True):
            groups[patch.size_hw].append((part.view(*patch.size_hw, -1), patch))
        squares, likeness, count = feature.new_zeros(()), feature.new_zeros(()), 0
        for patches_of_size in groups.values():
            rgb = self._decoded(
                torch.stack([part for part, _ in patches_of_size]),
                torch.tensor([patch.camera for _, patch in patches_of_size], device=feature.device),
            )
            real = torch.stack([patch.rgb for _, patch in patches_of_size]).to(rgb)
            squares, count = squares + ((rgb - real) ** 2).sum(), count + rgb.numel()
            if self._features is not None:
                with torch.no_grad():
                    wanted = self._features(real)
                # Each group counts by its number of patches
                share = len(patches_of_size) / len(patches)
                likeness = likeness + share * self._likeness(self._features(rgb), wanted).mean()
        losses = {"rgb": squares / count}
        return losses if self._features is None else losses | {"perceptual": likeness}

    def _decoded(
        self, feature: Float[Tensor, "n H W D"], camera: Int[Tensor, "n"]
    ) -> Float[Tensor, "n 3 H3 W3"]:
        """Decode the patches of all cameras in one call, as rendering uses one set of statistics for all.

        Batch normalisation counts its statistics here alone, never when a view is seen.
        """
        decoder = self.scene.camera_decoder.train()
        rgb: Tensor = decoder(feature, camera)
        decoder.eval()
        return rgb

    def _beam_losses(self, beams: list["_Beams"], seen: SeenAlongRays, first: int) -> dict[str, Tensor]:
        """Return the losses of the rays from `first` on."""
        device = seen.feature.device
        range_m, real_intensity, returned = (
            torch.cat([getattr(part, name) for part in beams]).to(device)
            for name in ("range_m", "intensity", "returned")
        )
        intensity, drop_logit = self.scene.lidar_decoder(seen.feature[first:])
        losses = {"intensity": intensity_loss(intensity, real_intensity, returned)}
        # Drop is learned only if all sweeps of the step record lost beams
        if all(part.misses_known for part in beams):
            losses["drop"] = drop_loss(drop_logit, returned)
        # Proposals that get gradients in this step have the same losses of distance
        proposals = [("proposal_", proposal) for proposal in seen.proposals if proposal.weight.requires_grad]
        for prefix, intervals in (("", seen.intervals), *proposals):
            terms = self._distance_losses(intervals, first, range_m, returned, quantile=not prefix)
            for name, loss in terms.items():
                losses[prefix + name] = losses.get(prefix + name, 0) + loss
        return losses

    def _distance_losses(
        self,
        intervals: Intervals,
        first: int,
        range_m: Float[Tensor, "P"],
        returned: Bool[Tensor, "P"],
        quantile: bool,
    ) -> dict[str, Tensor]:
        """Return the losses of where beams end. The last interval, the sky, does not count."""
        schedule = self.schedule
        border_m, weight = intervals.border_m[first:, :-1], intervals.weight[first:, :-1]
        middle_m = intervals.middle_m[first:, :-1]
        free_m = self.scene.reach_m if schedule.free_m is None else schedule.free_m
        losses = {
            "depth": beam_depth_loss(
                (weight * middle_m).sum(-1),
                range_m,
                returned,
                free_m,
                schedule.weights.lost,
                schedule.depth_quantile if quantile else 1.0,
            ),
            "carving": carving_loss(middle_m, weight, range_m, returned, schedule.margin_m, free_m),
        }
        if schedule.weights.hit:
            losses["hit"] = hit_loss(border_m, weight, range_m, returned, schedule.hit_m)
        return losses


def _interlevel(seen: SeenAlongRays) -> Float[Tensor, ""]:
    """Return the sum of the interlevel losses of all proposals."""
    own = seen.intervals.border, seen.intervals.weight
    pulses = (*PULSES[:1], *PULSES[1:] * len(seen.proposals))
    losses = [
        interlevel_loss(*own, proposal.border, proposal.weight, pulse)
        for proposal, pulse in zip(seen.proposals, pulses, strict=False)
    ]
    return torch.stack(losses).sum()


@dataclass(frozen=True)
class _Patch:
    rays: FieldRays
    rgb: Float[Tensor, "3 H W"]
    camera: int
    size_hw: tuple[int, int]
    """Numbers of rays."""


@dataclass(frozen=True)
class _Beams:
    rays: FieldRays
    range_m: Float[Tensor, "P"]
    intensity: Float[Tensor, "P"]
    returned: Bool[Tensor, "P"]
    misses_known: bool


def _draw(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))


def _perceptual(
    network: str | None, tower: Callable[[], ImageFeatures] | None, device: torch.device
) -> tuple[ImageFeatures | None, Callable[[Sequence[Tensor], Sequence[Tensor]], Tensor]]:
    """Return the features of the perceptual loss, None for no such loss, and their distance."""
    if network != "tower":
        vgg = VggFeatures(network, 19).to(device) if network else None
        return vgg, weighted_feature_loss
    if tower is None:
        raise InputError("perceptual=tower: there is no image tower here")
    features = tower()
    return features.to(device) if isinstance(features, nn.Module) else features, feature_distance
