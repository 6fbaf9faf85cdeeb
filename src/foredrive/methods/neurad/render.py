"""Rendering of features, distances and opacities along rays from a neural field."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from foredrive.methods.neurad.config import FieldConfig
from foredrive.methods.neurad.network import ActorSamples, FieldLayers, Grids, ProposalDensity
from foredrive.methods.neurad.rays import FieldRays
from foredrive.methods.neurad.sampling import first_borders, resampled_borders, to_distance
from foredrive.methods.reconstruction.tracks import MAX_HOLD_S, ActorTracks
from foredrive.ops.compositing import composite
from foredrive.ops.ray_boxes import Crossings, MovingBoxes, cross_boxes


class FieldActors(NamedTuple):
    """The actors of a scene, and where each one is found in the grid of actors."""

    tracks: ActorTracks
    slot: Int[Tensor, "A"]
    """Place of each actor in the grid. A copy has the place of its original."""
    mirror: Bool[Tensor, "A"] | None = None
    """Actors whose left and right sides are swapped; None: none."""


class Intervals(NamedTuple):
    """The intervals of S samples on each ray, with their weights."""

    border: Float[Tensor, "R S1"]
    """Positions from 0 to 1 (see `sampling`)."""
    border_m: Float[Tensor, "R S1"]
    """Distances along the ray."""
    weight: Float[Tensor, "R S"]
    """Probability that the ray ends in the interval; what is left at the end is not included."""

    @property
    def middle_m(self) -> Float[Tensor, "R S"]:
        """Return the distances of the samples: the middles of the intervals."""
        return 0.5 * (self.border_m[:, 1:] + self.border_m[:, :-1])

    @property
    def depth_m(self) -> Float[Tensor, "R"]:
        """Return the expected distance, to which the last interval (the sky) adds nothing."""
        return (self.weight * self.middle_m)[:, :-1].sum(-1)


class SeenAlongRays(NamedTuple):
    """What R rays see."""

    feature: Float[Tensor, "R D"]
    # What the ray has left counts for the sky
    depth_m: Float[Tensor, "R"]
    """Expected distance; the sky adds nothing."""
    alpha: Float[Tensor, "R"]
    """Probability that the ray ends before the sky."""
    median_m: Float[Tensor, "R"]
    """Distance at which a ray has ended with probability 0.5; infinite where alpha is below 0.5."""
    intervals: Intervals
    proposals: list[Intervals]


class NeuralField(nn.Module):
    """A field of features in space, with a grid for what stands and one for all actors.

    Args:
        config: parts of the field.
        actors: number of places in the grid of actors.
        middle_m: the middle of the part of the scene that is not contracted.
        scale_m: half side of that part; None: that of `config`.

    Raises:
        ValueError: neither gives the half side.
    """

    middle_m: Tensor

    def __init__(
        self, config: FieldConfig, actors: int, middle_m: Float[Tensor, "3"], scale_m: float | None = None
    ) -> None:
        super().__init__()
        scale_m = config.scale_m if scale_m is None else scale_m
        if scale_m is None:
            raise ValueError("a field whose scale_m follows from the path has to be given it")
        self.config = config
        self.register_buffer("middle_m", middle_m)
        self.register_buffer("scale_m", torch.tensor(scale_m), persistent=config.scale_m is None)
        self.grids = Grids(config.grids, config, actors, scale_m)
        self.layers = FieldLayers(config, self.grids.features)
        self.proposals = nn.ModuleList(
            ProposalDensity(grids, config, actors, scale_m) for grids in config.proposals
        )

    def forward(
        self,
        rays: FieldRays,
        actors: FieldActors,
        generator: torch.Generator | None = None,
        learn_proposals: bool = True,
    ) -> SeenAlongRays:
        """Render rays.

        Args:
            rays: in the scene's frame.
            actors: the actors of the scene.
            generator: for the random places of samples in training; None takes their middles.
            learn_proposals: whether the proposals' weights get gradients.
        """
        config = self.config
        # Boxes of actors along the rays, at each ray's own time
        crossings = self.crossings(rays, actors.tracks)
        border = first_borders(len(rays.origin), config.proposal_samples[0], generator, rays.origin)
        proposals: list[Intervals] = []
        # Rounds of proposals: each places the samples of the next one
        for i, proposal in enumerate(self.proposals):
            border_m = to_distance(border, config.spacing_m, config.sky_m)
            # Poses get gradients from the field only, not from proposals
            points, footprint, moving = self._samples(rays, border_m, crossings, actors, learn_poses=False)
            with torch.set_grad_enabled(learn_proposals and torch.is_grad_enabled()):
                opacity = proposal(points, footprint, moving, border_m.diff(dim=-1))
                # Only the weights are read: the second argument stands in for distances
                weight = composite(opacity, opacity.detach()).weights
            proposals.append(Intervals(border, border_m, weight))
            last = i + 1 == len(self.proposals)
            count = config.samples if last else config.proposal_samples[i + 1]
            border = resampled_borders(border, weight, count, generator, config.resampling)
        # The last interval is the sky.
        border = torch.cat([border[:, :-1], torch.ones_like(border[:, :1])], dim=-1)
        border_m = to_distance(border, config.spacing_m, config.sky_m)
        points, footprint, moving = self._samples(rays, border_m, crossings, actors, learn_poses=True)
        grid = self.grids(points, footprint, moving)
        opacity, embedding = self.layers.surface(grid, border_m.diff(dim=-1))
        seen = composite(opacity, opacity.detach())
        intervals = Intervals(border, border_m, seen.weights)
        # What is left of a ray sees its last sample, the sky.
        weight = torch.cat(
            [seen.weights[:, :-1], (seen.weights[:, -1] + seen.transmittance)[:, None]], dim=-1
        )
        return SeenAlongRays(
            feature=self.layers.seen(embedding, weight, rays.direction, moving).T,
            depth_m=intervals.depth_m,
            alpha=seen.weights[:, :-1].sum(-1),
            median_m=median_distance(intervals),
            intervals=intervals,
            proposals=proposals,
        )

    def crossings(self, rays: FieldRays, tracks: ActorTracks) -> Crossings:
        """Return the boxes of actors that rays pass through, with this field's margins."""
        half = 0.5 * tracks.size_lwh + tracks.size_lwh.new_tensor(self.config.actor_margin_m)
        boxes = MovingBoxes(tracks.t_s, tracks.T_scene_actor, half, tracks.present, MAX_HOLD_S)
        return cross_boxes(rays.origin, rays.direction, rays.t_s, boxes)

    def _samples(
        self,
        rays: FieldRays,
        border_m: Float[Tensor, "R S1"],
        crossings: Crossings,
        actors: FieldActors,
        learn_poses: bool,
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"], ActorSamples | None]:
        """Return the samples' positions and footprints, and which of them lie in boxes."""
        with torch.set_grad_enabled(learn_poses and torch.is_grad_enabled()):
            middle_m = 0.5 * (border_m[:, 1:] + border_m[:, :-1])
            # The static grid is about the middle of the scene
            origin = rays.origin - self.middle_m
            points = origin[:, None] + rays.direction[:, None] * middle_m[..., None]
            footprint = footprints(rays.area, border_m).flatten()
            moving = _in_boxes(crossings, middle_m, footprint, actors) if len(crossings.ray) else None
            return points.flatten(0, 1), footprint, moving


def footprints(area: Float[Tensor, "R"], border_m: Float[Tensor, "R S1"]) -> Float[Tensor, "R S"]:
    """Return the sides of the volumes that samples stand for, from the cones' areas at 1 m."""
    middle_m = 0.5 * (border_m[:, 1:] + border_m[:, :-1])
    # Half of the interval, as in the reference implementation.
    volume = area[:, None] * middle_m**2 * (0.5 * border_m.diff(dim=-1))
    return volume.detach().pow(1 / 3)


def _in_boxes(
    crossings: Crossings, middle_m: Float[Tensor, "R S"], footprint: Float[Tensor, "N"], actors: FieldActors
) -> ActorSamples:
    """Return the samples inside boxes. Where boxes overlap, a sample belongs to the one entered last."""
    # Pairs of a crossing and a sample that lies between its entry and exit
    samples = middle_m.shape[1]
    along = middle_m[crossings.ray]
    inside = (along > crossings.enter_m.detach()[:, None]) & (along < crossings.leave_m.detach()[:, None])
    pair, place = inside.nonzero(as_tuple=True)
    sample = crossings.ray[pair] * samples + place
    # Of several boxes at one sample, the crossing with the largest index wins
    owner = torch.full((middle_m.numel(),), -1, device=sample.device)
    owner = owner.scatter_reduce(0, sample, pair, "amax")
    mine = owner[sample] == pair
    pair, place, sample = pair[mine], place[mine], sample[mine]
    box = crossings.box[pair]
    direction = crossings.direction_box.index_select(0, pair)
    point = crossings.origin_box.index_select(0, pair) + direction * along[pair, place][:, None]
    # Mirroring swaps left and right in the frame of the box: y changes its sign
    if actors.mirror is not None:
        sign = torch.ones_like(point)
        sign[:, 1] = torch.where(actors.mirror[box], -1.0, 1.0)
        point, direction = point * sign, direction * sign
    return ActorSamples(sample, actors.slot[box], point, direction, footprint[sample])


@torch.no_grad()
def median_distance(intervals: Intervals) -> Float[Tensor, "R"]:
    """Return the distance at which half of each ray's weight is reached, linear within an interval."""
    # The sky is left out: a ray that is mostly sky has no median
    passed = intervals.weight[:, :-1].cumsum(-1)
    index = torch.searchsorted(passed.contiguous(), torch.full_like(passed[:, :1], 0.5))
    reached = index[:, 0] < passed.shape[1]
    index = index.clamp_max(passed.shape[1] - 1)
    weight = intervals.weight.gather(1, index)
    # Share of the interval before the half is reached
    part = 1 - (passed.gather(1, index) - 0.5) / weight.clamp_min(1e-9)
    low, high = intervals.border_m.gather(1, index), intervals.border_m.gather(1, index + 1)
    return torch.where(reached, (low + part.clamp(0, 1) * (high - low))[:, 0], torch.inf)
