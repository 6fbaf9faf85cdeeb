"""Actors of other fields: shares and distances worked out by hand, in fields of constant density."""

import math

import pytest
import torch

from foredrive.geometry.se3 import exp_se3
from foredrive.methods.neurad import FieldActors, FieldConfig, FieldRays, GridConfig, NeuralField
from foredrive.methods.neurad.config import GridsConfig
from foredrive.methods.neurad.content import FieldParts
from foredrive.methods.neurad.decoders import BeamDecoder, PatchDecoder, PatchDecoderConfig
from foredrive.methods.neurad.guests import (
    Guest,
    SeenOfGuest,
    look_with_guests,
    with_guests_in_image,
    with_guests_in_sweep,
)
from foredrive.methods.reconstruction.tracks import ActorTracks

MARGIN_M = 0.25
"""The boxes are this much longer at each end."""


def field(density: float) -> NeuralField:
    """Return a field of a constant density, 1/m, everywhere and in actors."""
    torch.manual_seed(0)
    grid = GridConfig(levels=2, features=1, coarsest=4, finest=8, log2_rows=10)
    grids = GridsConfig(grid, grid)
    sizes = FieldConfig(
        grids, (grids,), proposal_samples=(128,), samples=128, width=4, surface="density", appearance=2
    )
    made = NeuralField(sizes, 2, torch.zeros(3), scale_m=50.0)
    geometry = made.layers.geometry.linear[-1]
    assert isinstance(geometry, torch.nn.Linear)
    with torch.no_grad():
        geometry.weight[0], geometry.bias[0] = 0, math.log(density / 0.02)
    return made.requires_grad_(False)


def guest(density: float, x_m: float, yaw: float = 0.0) -> Guest:
    """Return a box of 4 × 2 × 2 m about a place on the x axis."""
    network = field(density)
    decoder = PatchDecoder(4, 1, 2, PatchDecoderConfig(4, 4, 3, 1, 1, batch_norm=False))
    tracks = ActorTracks(
        track_id=torch.tensor([3]),
        category=torch.tensor([0]),
        size_lwh=torch.tensor([[4.0, 2.0, 2.0]]),
        t_s=torch.tensor([0.0, 1.0]),
        T_scene_actor=exp_se3(torch.tensor([x_m, 0, 0, 0, 0, 0])).expand(1, 2, 4, 4)
        @ exp_se3(torch.tensor([0.0, 0, 0, 0, 0, yaw])),
        present=torch.ones(1, 2, dtype=torch.bool),
    )
    return Guest(FieldParts(network, decoder, BeamDecoder(4, 2)), tracks, torch.tensor([1]))


def rays() -> FieldRays:
    """Return a ray along x, one beside it that meets no box, and one against x from behind the boxes."""
    origin = torch.tensor([[0.0, 0, 0], [0, 5, 0], [60, 0, 0]])
    direction = torch.tensor([[1.0, 0, 0], [1, 0, 0], [-1, 0, 0]])
    return FieldRays(origin, direction, torch.full((3,), 0.5), torch.full((3,), 1e-6))


def nobody() -> FieldActors:
    none = guest(1.0, 0.0).tracks
    rows = ("track_id", "category", "size_lwh", "T_scene_actor", "present")
    empty = ActorTracks(**{name: getattr(none, name)[:0] for name in rows}, t_s=none.t_s)
    return FieldActors(empty, torch.zeros(0, dtype=torch.int64))


def test_the_share_of_a_guest_is_what_the_scene_lets_through_to_it() -> None:
    """Density 0.02 / m before a solid box at 20 m: exp(-0.02 · 17.75)."""
    host, solid = field(0.02), guest(1e4, 20.0)
    seen, (part,) = look_with_guests(host, rays(), nobody(), [solid])
    to_box_m = 18 - MARGIN_M
    assert part.share.tolist() == pytest.approx(
        [math.exp(-0.02 * to_box_m), 0, math.exp(-0.02 * (40 - 2 - MARGIN_M))], abs=0.01
    )
    assert seen.median_m[0].item() == pytest.approx(to_box_m, abs=0.1)
    assert seen.median_m[1].item() == pytest.approx(math.log(2) / 0.02, rel=0.05)
    assert seen.alpha.tolist() == pytest.approx([1, 1, 1], abs=0.01)
    mean_m = (1 - math.exp(-0.02 * to_box_m)) / 0.02  # ∫ exp(-σ t) dt up to the box
    assert seen.depth_m[0].item() == pytest.approx(mean_m, rel=0.03)


def test_nothing_of_the_scene_is_in_a_guests_box() -> None:
    """A solid scene is cut open by an empty box: the ray from within the box ends at the box' far side."""
    host, empty = field(1e4), guest(1e-9, 0.0)
    seen, (part,) = look_with_guests(host, rays(), nobody(), [empty])
    assert part.share.tolist() == pytest.approx([0, 0, 0], abs=1e-4)
    assert 1.5 < seen.median_m[0].item() < 3.5
    assert seen.median_m[1].item() < 0.5


def test_guests_hide_each_other_and_thin_ones_let_light_through() -> None:
    """Density 0.1 / m in 4.5 m before a solid one: exp(-0.45) reaches it. From behind it is the first."""
    host = field(1e-9)
    thin, solid = guest(0.1, 20.0), guest(1e4, 30.0)
    seen, (of_thin, of_solid) = look_with_guests(host, rays(), nobody(), [thin, solid])
    through = math.exp(-0.1 * 4.5)
    assert of_thin.share.tolist() == pytest.approx([1 - through, 0, 0], abs=0.01)
    assert of_solid.share.tolist() == pytest.approx([through, 0, 1], abs=0.01)
    assert seen.median_m[0].item() == pytest.approx(28 - MARGIN_M, abs=0.2)
    assert seen.alpha[1].item() == pytest.approx(0, abs=1e-3)


def test_a_turned_box_is_entered_at_its_side() -> None:
    _, (part,) = look_with_guests(field(0.02), rays(), nobody(), [guest(1e4, 20.0, yaw=math.pi / 2)])
    assert part.share[0].item() == pytest.approx(math.exp(-0.02 * (19 - 0.25)), abs=0.01)


def test_images_and_beams_are_mixed_by_the_shares() -> None:
    """Half of a beam ends in a guest that never returns, half in a scene that always does."""
    other = guest(1.0, 0.0)
    with torch.no_grad():
        for module, bias in ((other.parts.camera.last, 9.0), (other.parts.lidar.net[-1], 9.0)):
            module.weight[:], module.bias[:] = 0, bias  # type: ignore[index, operator]
    share = torch.tensor([0.0, 0.5, 1.0])
    seen = SeenOfGuest(share, torch.randn(3, 4))
    intensity, logit = with_guests_in_sweep(torch.zeros(3), torch.full((3,), -9.0), [other], [seen])
    assert intensity.tolist() == pytest.approx([0, 0.5, 1], abs=1e-3)
    assert logit.sigmoid().tolist() == pytest.approx([0, 0.5, 1], abs=1e-3)
    assert logit[0].item() == -9
    shares = torch.zeros(4, 6)
    shares[:, 4:] = 1
    seen = SeenOfGuest(shares.flatten(), torch.randn(24, 4))
    black = torch.zeros(3, 12, 18)
    mixed = with_guests_in_image(black, [other], [seen], camera=7)
    assert mixed[:, :, :9].abs().max().item() == 0
    assert mixed[:, :, 15:].min().item() > 0.99
    assert torch.equal(with_guests_in_image(black, [other], [seen._replace(share=0 * seen.share)], 0), black)
