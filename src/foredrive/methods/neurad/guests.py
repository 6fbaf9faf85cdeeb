"""Actors of one neural field, inserted into the scene of another.

The features of two fields have nothing in common, so each ray is rendered in both fields, with the decoders
of each. The two results are blended by the probability that the ray ends in the one or the other. Within the
box of an inserted actor, nothing but that actor stops a ray.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.methods.neurad.content import FieldContent, FieldParts
from foredrive.methods.neurad.decoders import UPSAMPLING
from foredrive.methods.neurad.network import ActorSamples, ProposalDensity
from foredrive.methods.neurad.rays import FieldRays
from foredrive.methods.neurad.render import (
    FieldActors,
    Intervals,
    NeuralField,
    SeenAlongRays,
    footprints,
    median_distance,
)
from foredrive.methods.neurad.sampling import first_borders, interpolated, resampled_borders
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.ops.compositing import composite
from foredrive.ops.ray_boxes import Crossings

_FIRST_SAMPLES = 32
"""Equal intervals of a ray in a guest's box, in which its field proposes where to sample."""
_LEAST_SHARE = 1e-4


class Guest(NamedTuple):
    """An actor of another field."""

    parts: FieldParts
    tracks: ActorTracks
    """Of this actor alone."""
    slot: Int[Tensor, "1"]


class SeenOfGuest(NamedTuple):
    """What R rays see of a guest."""

    share: Float[Tensor, "R"]
    """Probability that the ray ends in the guest."""
    feature: Float[Tensor, "R D"]
    """Feature in the guest's field of a ray that ends in the guest; 0 where its share is 0."""


class _Curve(NamedTuple):
    """The probability that Q rays have not ended, linear between borders and constant beyond them."""

    border_m: Float[Tensor, "Q B"]
    passed: Float[Tensor, "Q B"]

    def at(self, distance_m: Float[Tensor, "Q M"]) -> Float[Tensor, "Q M"]:
        return interpolated(distance_m, self.border_m, self.passed)


def split_guests(tracks: ActorTracks, content: FieldContent) -> tuple[FieldActors, list[Guest]]:
    """Return the actors of the scene's own field, and the guests."""
    guests = content.owner.nonzero()[:, 0].tolist()
    if not guests:
        return FieldActors(tracks, content.slot), []
    own = content.owner == 0
    return FieldActors(tracks.only(own), content.slot[own]), [
        Guest(
            content.fields[int(content.owner[row])],
            tracks.only(torch.tensor([row], device=tracks.t_s.device)),
            content.slot[row : row + 1],
        )
        for row in guests
    ]


def look_with_guests(
    host: NeuralField, rays: FieldRays, own: FieldActors, guests: list[Guest]
) -> tuple[SeenAlongRays, list[SeenOfGuest]]:
    """Render rays in a field with guests.

    Returns:
        What is seen: distances and opacity with the guests, the feature without them. And what is seen of
        each guest.
    """
    # Crossings of each guest's box by the rays
    crossings = [guest.parts.network.crossings(rays, guest.tracks) for guest in guests]
    # In the host's field, nothing stops a ray inside the boxes of guests
    seen = host(rays, own, None, False, torch.stack([_span(one, len(rays.t_s)) for one in crossings]))
    looks = [_look(guest, rays, one) for guest, one in zip(guests, crossings, strict=True)]
    # All rays that cross any guest; the others need no mixing
    ray = torch.cat([one.ray for one in crossings]).unique()
    behind = _curve(seen.intervals, ray)
    curves = [_widened(look, one.ray, ray) for look, one in zip(looks, crossings, strict=True)]
    looks_of_beams = []
    # Share of a guest: its weight at each sample, times the
    # probability that nothing else stopped the ray before
    for look, one, guest in zip(looks, crossings, guests, strict=True):
        # Rows of this guest's rays among all crossing rays (both ascend)
        place = torch.searchsorted(ray, one.ray.contiguous())
        # The host and the other guests, each by its curve of what passes
        others = [behind, *(curve for other, curve in zip(looks, curves, strict=True) if other is not look)]
        middle_m = look.intervals.middle_m
        free = torch.ones_like(middle_m)
        for curve in others:
            free = free * _Curve(curve.border_m[place], curve.passed[place]).at(middle_m)
        share = rays.t_s.new_zeros(len(rays.t_s))
        share[one.ray] = (look.intervals.weight * free).sum(-1)
        feature = look.feature.new_zeros(len(rays.t_s), guest.parts.network.config.width)
        feature[one.ray] = look.feature
        looks_of_beams.append(SeenOfGuest(share, feature))
    return _together(seen, ray, [behind, *curves]), looks_of_beams


def with_guests_in_image(
    rgb: Float[Tensor, "3 H3 W3"], guests: list[Guest], seen: list[SeenOfGuest], camera: int
) -> Float[Tensor, "3 H3 W3"]:
    """Return an image into which the images of guests are mixed by their shares.

    Args:
        rgb: image without the guests.
        guests, seen: the guests, and what the image's rays see of them, row by row.
        camera: index of the camera; a guest whose run had no such camera takes its first.
    """
    # One ray stands for 3 x 3 pixels
    high, wide = (side // UPSAMPLING for side in rgb.shape[1:])
    rest, mixed = torch.ones_like(rgb[:1]), torch.zeros_like(rgb)
    for guest, part in zip(guests, seen, strict=True):
        if not bool((part.share > _LEAST_SHARE).any()):
            continue
        share = part.share.view(high, wide)
        # The CNN also sees rays beside the guest, which get the feature of the nearest ray in it
        feature = _filled(part.feature.view(high, wide, -1), share)
        code = camera if camera < len(guest.parts.camera.appearance) else 0
        # The guest's own decoder renders its patch, which is then mixed in by its share
        own = guest.parts.camera(feature[None], torch.tensor([code], device=feature.device))[0]
        alpha = F.interpolate(share[None, None], scale_factor=UPSAMPLING, mode="bilinear")[0]
        rest, mixed = rest - alpha, mixed + alpha * own
    return rest.clamp_min(0) * rgb + mixed


def with_guests_in_sweep(
    intensity: Float[Tensor, "P"],
    drop_logit: Float[Tensor, "P"],
    guests: list[Guest],
    seen: list[SeenOfGuest],
) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
    """Return intensities, and logits of the probability of no return, mixed by the guests' shares."""
    # Intensities and probabilities of loss mix linearly; logits do not
    rest = torch.ones_like(intensity)
    bright, lost = torch.zeros_like(intensity), torch.zeros_like(intensity)
    for guest, part in zip(guests, seen, strict=True):
        own_intensity, own_logit = guest.parts.lidar(part.feature)
        rest = rest - part.share
        bright, lost = bright + part.share * own_intensity, lost + part.share * own_logit.sigmoid()
    rest = rest.clamp(0, 1)
    probability = (rest * drop_logit.sigmoid() + lost).clamp(1e-6, 1 - 1e-6)
    touched = rest < 1  # elsewhere the logit stays as it is
    return rest * intensity + bright, torch.where(touched, probability.logit(), drop_logit)


class _Look(NamedTuple):
    """A guest along the rays that cross its box, as if it were alone."""

    intervals: Intervals
    feature: Float[Tensor, "P D"]


def _look(guest: Guest, rays: FieldRays, crossings: Crossings) -> _Look:
    network, ray = guest.parts.network, crossings.ray
    enter_m, length_m = crossings.enter_m[:, None], (crossings.leave_m - crossings.enter_m)[:, None]
    # A first round of equal intervals within the box, by the last proposal of the guest's field
    border = first_borders(len(ray), _FIRST_SAMPLES, None, rays.origin)
    border_m = enter_m + length_m * border
    proposal = network.proposals[-1]
    assert isinstance(proposal, ProposalDensity)
    opacity = proposal.of_actors(_samples(guest, rays, crossings, border_m), border_m.diff(dim=-1))
    # A second round where the proposal has weight, evaluated by the field itself
    border = resampled_borders(
        border, composite(opacity, opacity).weights, network.config.samples, generator=None
    )
    border_m = enter_m + length_m * border
    moving = _samples(guest, rays, crossings, border_m)
    opacity, embedding = network.layers.surface(network.grids.of_actors(moving), border_m.diff(dim=-1))
    weight = composite(opacity, opacity).weights
    # The feature of a ray that ends in the guest: weights of the samples divided by their sum
    whole = weight / weight.sum(-1, keepdim=True).clamp_min(_LEAST_SHARE)
    feature = network.layers.seen(embedding, whole, rays.direction[ray], moving)
    return _Look(Intervals(border, border_m, weight), feature.T)


def _samples(
    guest: Guest, rays: FieldRays, crossings: Crossings, border_m: Float[Tensor, "P S1"]
) -> ActorSamples:
    """Return samples in the middles of intervals, all in the guest's box."""
    middle_m = 0.5 * (border_m[:, 1:] + border_m[:, :-1])
    # Samples in the frame of the box, along the ray in that frame
    point = crossings.origin_box[:, None] + crossings.direction_box[:, None] * middle_m[..., None]
    count = middle_m.numel()
    return ActorSamples(
        sample=torch.arange(count, device=middle_m.device),
        slot=guest.slot.expand(count),
        point_m=point.flatten(0, 1),
        direction=crossings.direction_box.repeat_interleave(middle_m.shape[1], 0),
        footprint_m=footprints(rays.area[crossings.ray], border_m).flatten(),
    )


def _span(crossings: Crossings, rays: int) -> Float[Tensor, "R 2"]:
    """Return where each ray is in a box; rays that miss it have an empty span."""
    span = crossings.enter_m.new_zeros(rays, 2)
    span[crossings.ray] = torch.stack([crossings.enter_m, crossings.leave_m], dim=-1)
    return span


def _curve(intervals: Intervals, ray: Int[Tensor, "Q"]) -> _Curve:
    weight = intervals.weight[ray]
    # Probability that the ray has not ended before each border
    passed = 1 - torch.cat([torch.zeros_like(weight[:, :1]), weight.cumsum(-1)], dim=-1)
    return _Curve(intervals.border_m[ray], passed)


def _widened(look: _Look, of: Int[Tensor, "P"], ray: Int[Tensor, "Q"]) -> _Curve:
    """Return the curve of a guest for all rays that cross any guest; rays that miss it pass."""
    every = torch.arange(len(of), device=of.device)
    curve, place = _curve(look.intervals, every), torch.searchsorted(ray, of.contiguous())
    borders = curve.border_m.shape[1]
    # Borders of rays that miss the guest are arbitrary, since their curve is 1 everywhere
    border_m = torch.linspace(0, 1, borders).to(curve.border_m).expand(len(ray), -1).clone()
    passed = torch.ones_like(border_m)
    border_m[place], passed[place] = curve.border_m, curve.passed
    return _Curve(border_m, passed)


def _together(seen: SeenAlongRays, ray: Int[Tensor, "Q"], curves: list[_Curve]) -> SeenAlongRays:
    """Return distances and opacities of rays that any of several things may stop."""
    # Borders of all curves together: between two of them, every curve is linear
    border_m = torch.cat([curve.border_m for curve in curves], dim=-1).sort(dim=-1).values
    passed = torch.ones_like(border_m)
    # The probability to pass several things is the product of their curves
    for curve in curves:
        passed = passed * curve.at(border_m)
    # What the product loses between two borders ends there
    both = Intervals(border_m, border_m, -passed.diff(dim=-1))
    return seen._replace(
        depth_m=seen.depth_m.index_copy(0, ray, both.depth_m),
        alpha=seen.alpha.index_copy(0, ray, both.weight[:, :-1].sum(-1)),
        median_m=seen.median_m.index_copy(0, ray, median_distance(both)),
    )


def _filled(feature: Float[Tensor, "H W D"], share: Float[Tensor, "H W"]) -> Float[Tensor, "H W D"]:
    """Give rays that see nothing of a guest the feature of the nearest ray that does: a CNN sees both."""
    from scipy.ndimage import distance_transform_edt  # not on every machine with a GPU

    nowhere = (share <= _LEAST_SHARE).cpu().numpy()
    rows, columns = distance_transform_edt(nowhere, return_distances=False, return_indices=True)
    device = feature.device
    return feature[torch.from_numpy(rows).to(device).long(), torch.from_numpy(columns).to(device).long()]
