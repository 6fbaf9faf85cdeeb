"""The kernels against the plain reference in float64: values, and gradients against autograd.

Where an opacity or a transmittance lies next to a cut-off, or a range next to the hit, rounding decides what
counts: such points are left out.
"""

import math

import pytest
import torch
from torch import Tensor

from foredrive.ops import splatting
from foredrive.ops.splat_points import TiledPoints, beam_points, pixel_points
from foredrive.ops.splatting import (
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    Splats,
    composite_splats,
    composite_splats_reference,
    list_splats,
)

WRAP = 2 * math.pi


def cloud(count: int, low: Tensor, high: Tensor, size: float, features: int, seed: int) -> Splats:
    """Splats of all shapes over a part of the plane, in motion; sizes are about `size`."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng)

    angle = math.pi * uniform(count)
    long, short = size * (3 * uniform(2, count) - 1.5).exp()
    cos, sin = angle.cos(), angle.sin()
    a, b = long**-2, short**-2
    inverse = torch.stack([a * cos**2 + b * sin**2, (a - b) * cos * sin, a * sin**2 + b * cos**2], -1)
    return Splats(
        mean=low + (high - low) * uniform(count, 2),
        inverse_covariance=inverse,
        opacity=uniform(count) ** 0.3,
        range_m=2 + 50 * uniform(count),
        range_slope=(uniform(count, 2) - 0.5) / size,
        velocity=10 * size * (uniform(count, 2) - 0.5),
        range_rate_mps=10 * uniform(count) - 5,
        feature=uniform(count, features),
    )


def image(seed: int = 0, count: int = 400) -> tuple[Splats, TiledPoints]:
    """An image of 37×53 px, read within 0.2 s."""
    return cloud(count, torch.tensor([-5.0, -5]), torch.tensor([58.0, 42]), 2.0, 5, seed), pixel_points(
        (37, 53), 0.2
    )


def sweep(seed: int = 0, count: int = 500) -> tuple[Splats, TiledPoints]:
    """A full turn of 12 uneven channels within 0.1 s, and splats that cross ±180°."""
    steps = torch.arange(160) / 160
    elevation = torch.tensor([-0.4, -0.2, -0.1, -0.08, -0.06, -0.04, -0.02, -0.01, 0, 0.01, 0.05, 0.2])
    azimuth = (math.pi - WRAP * steps)[:, None] + torch.linspace(-0.05, 0.05, 12)
    points = beam_points(
        azimuth.flatten(), elevation.repeat(160), (0.1 * steps - 0.1)[:, None].expand(-1, 12).flatten()
    )
    return cloud(count, torch.tensor([-3.3, -0.4]), torch.tensor([3.3, 0.2]), 0.05, 3, seed), points


def clear_of_cuts(splats: Splats, points: TiledPoints, hit_range_m: Tensor) -> Tensor:
    """Points at which nothing that counts lies next to a cut-off; computed without tiles."""
    position = torch.zeros(points.count, 2, dtype=torch.float64)
    time_s = torch.zeros(points.count, dtype=torch.float64)
    index = points.index.flatten()
    position[index[index >= 0]] = points.position.flatten(0, 1)[index >= 0].double()
    time_s[index[index >= 0]] = points.time_s.flatten()[index >= 0].double()
    splats = Splats(*(field.double()[splats.range_m.argsort()] for field in splats))
    offset = position[:, None] - splats.mean - splats.velocity * time_s[:, None, None]
    if points.period:
        offset[..., 0] -= WRAP * (offset[..., 0] / WRAP).round()
    dx, dy = offset.unbind(-1)
    xx, xy, yy = splats.inverse_covariance.unbind(-1)
    raw = splats.opacity * (-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy)).exp()
    alpha = torch.where(raw >= MIN_ALPHA, raw.clamp(max=MAX_ALPHA), 0.0)
    passed = (1 - alpha).cumprod(-1)
    range_m = splats.range_m + (splats.range_slope * offset).sum(-1) + splats.range_rate_mps * time_s[:, None]
    counts = alpha > 0
    risky = (raw / MIN_ALPHA - 1).abs() < 1e-3
    risky |= (raw / MAX_ALPHA - 1).abs() < 1e-4
    risky |= counts & ((passed / MIN_TRANSMITTANCE - 1).abs() < 1e-2)
    risky |= counts & ((range_m - hit_range_m[:, None]).abs() < 1e-3)
    risky |= counts & ((passed - 0.5).abs() < 1e-4)
    return ~risky.any(-1)


SCENES = pytest.mark.parametrize("scene", [image, sweep])


@SCENES
@pytest.mark.parametrize(("seed", "before_hit"), [(0, "weights"), (1, "weights"), (0, "opacities")])
def test_values_and_gradients_are_those_of_the_reference(  # type: ignore[no-untyped-def]
    scene, seed: int, before_hit: splatting.BeforeHit
) -> None:
    splats, points = scene(seed)
    rng = torch.Generator().manual_seed(seed + 10)
    hits = 50 * torch.rand(points.count, generator=rng)
    clear = clear_of_cuts(splats, points, hits.double())
    assert clear.float().mean() > 0.6
    fast = Splats(*(field.clone().requires_grad_() for field in splats))
    exact = Splats(*(field.double().requires_grad_() for field in splats))
    seen, truth = (
        composite_splats(some, points, hits.to(some.mean), before_hit=before_hit) for some in (fast, exact)
    )
    assert truth.alpha.dtype == torch.float64
    loss, true_loss = torch.zeros(()), torch.zeros((), dtype=torch.float64)
    for name in ("feature", "expected_range_m", "alpha", "alpha_before_hit", "median_range_m"):
        value, true_value = getattr(seen, name)[clear], getattr(truth, name)[clear]
        torch.testing.assert_close(value.double(), true_value, rtol=2e-4, atol=2e-4)
        if name != "median_range_m":
            upstream = torch.randn(value.shape, generator=rng)
            loss = loss + (upstream * value).sum()
            true_loss = true_loss + (upstream.double() * true_value).sum()
    found = torch.autograd.grad(loss, list(fast))
    expected = torch.autograd.grad(true_loss, list(exact))
    for name, grad, true_grad in zip(Splats._fields, found, expected, strict=True):
        assert true_grad.abs().max() > 0, name
        scale = float(true_grad.abs().mean())
        torch.testing.assert_close(
            grad.double(), true_grad, rtol=2e-3, atol=2e-3 * scale, msg=lambda m, name=name: f"{name}: {m}"
        )


@SCENES
def test_tiles_lose_nothing(scene) -> None:  # type: ignore[no-untyped-def]
    """The same as with every splat on every tile's list."""
    splats, points = scene()
    exact = Splats(*(field.double() for field in splats))
    seen = composite_splats_reference(exact, points)
    everything = torch.arange(len(splats.mean))[splats.range_m.argsort()]
    tiles = len(points.index)
    full = splatting.SplatLists(everything.repeat(tiles), len(everything) * torch.arange(tiles + 1))
    again = composite_splats_reference(exact, points, lists=full)
    for name in ("feature", "expected_range_m", "alpha", "median_range_m"):
        torch.testing.assert_close(getattr(seen, name), getattr(again, name))
    listed = list_splats(exact, points).first[-1]
    assert listed < 0.8 * tiles * len(everything)


def test_threads_change_nothing() -> None:
    splats, points = image(count=3000)
    threads = torch.get_num_threads()
    results = []
    try:
        for n in (1, 3):
            torch.set_num_threads(n)
            fast = Splats(*(field.clone().requires_grad_() for field in splats))
            seen = composite_splats(fast, points)
            grads = torch.autograd.grad(seen.feature.square().sum() + seen.expected_range_m.sum(), list(fast))
            results.append([*seen[:4], *grads])
    finally:
        torch.set_num_threads(threads)
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_a_splat_wider_than_half_a_turn_is_seen_once() -> None:
    """It reaches beams that look ahead from both sides."""
    azimuth = torch.linspace(-0.5, 0.5, 40)
    points = beam_points(azimuth, torch.zeros(40), torch.zeros(40))
    wide = Splats(
        mean=torch.tensor([[3.0, 0.0]]),
        inverse_covariance=torch.tensor([[0.25, 0.0, 100.0]]),
        opacity=torch.tensor([0.5]),
        range_m=torch.tensor([9.0]),
        range_slope=torch.zeros(1, 2),
        velocity=torch.zeros(1, 2),
        range_rate_mps=torch.zeros(1),
        feature=torch.ones(1, 1),
    )
    truth = composite_splats(Splats(*(field.double() for field in wide)), points)
    assert truth.alpha.max() < 0.5
    torch.testing.assert_close(composite_splats(wide, points).alpha.double(), truth.alpha, rtol=1e-4, atol=0)


def test_many_features_and_none() -> None:
    splats, points = image()
    wide = torch.rand(len(splats.mean), 37)
    whole = composite_splats(splats._replace(feature=wide), points)
    part = composite_splats(splats._replace(feature=wide[:, 30:]), points)
    torch.testing.assert_close(whole.feature[:, 30:], part.feature)
    bare = composite_splats(splats._replace(feature=wide[:, :0]), points)
    assert torch.equal(bare.alpha, whole.alpha)
    assert bare.feature.shape == (points.count, 0)
