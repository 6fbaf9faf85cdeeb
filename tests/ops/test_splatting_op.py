"""Compositing of splats against results worked out by hand."""

import math

import pytest
import torch

from foredrive.ops.splat_points import beam_points, pixel_points
from foredrive.ops.splatting import Splats, composite_splats, list_splats


def splats(
    mean: list[list[float]],
    *,
    opacity: list[float],
    range_m: list[float],
    inverse: list[float] | None = None,
    slope: list[float] | None = None,
    velocity: list[float] | None = None,
    rate: float = 0.0,
    dtype: torch.dtype = torch.float32,
) -> Splats:
    """Splats whose features are the unit vectors."""
    n = len(mean)
    return Splats(
        mean=torch.tensor(mean, dtype=dtype).reshape(n, 2),
        inverse_covariance=torch.tensor([inverse or [1.0, 0.0, 1.0]] * n, dtype=dtype).reshape(n, 3),
        opacity=torch.tensor(opacity, dtype=dtype),
        range_m=torch.tensor(range_m, dtype=dtype),
        range_slope=torch.tensor([slope or [0.0, 0.0]] * n, dtype=dtype).reshape(n, 2),
        velocity=torch.tensor([velocity or [0.0, 0.0]] * n, dtype=dtype).reshape(n, 2),
        range_rate_mps=torch.full((n,), rate, dtype=dtype),
        feature=torch.eye(max(n, 1), dtype=dtype)[:n],
    )


BOTH = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


@BOTH
def test_one_splat_at_a_pixel_and_beside_it(dtype: torch.dtype) -> None:
    one = splats([[2.5, 1.5]], opacity=[0.8], range_m=[7.0], inverse=[0.5, 0.1, 1.0], dtype=dtype)
    seen = composite_splats(one, pixel_points((4, 6)))
    alpha = seen.alpha.view(4, 6)
    assert alpha[1, 2].item() == pytest.approx(0.8, rel=1e-6)
    assert alpha[2, 4].item() == pytest.approx(0.8 * math.exp(-0.5 * (0.5 * 4 + 2 * 0.1 * 2 + 1)), rel=1e-5)
    assert seen.feature.shape == (24, 1)
    torch.testing.assert_close(seen.feature[:, 0], seen.alpha)
    torch.testing.assert_close(seen.expected_range_m, 7 * seen.alpha)
    assert seen.median_range_m.view(4, 6)[1, 2] == 7
    assert seen.median_range_m.view(4, 6)[2, 4] == math.inf
    assert seen.alpha_before_hit is None


@BOTH
def test_two_behind_each_other(dtype: torch.dtype) -> None:
    two = splats([[8.5, 8.5], [8.5, 8.5]], opacity=[0.5, 0.25], range_m=[20.0, 10.0], dtype=dtype)
    points = pixel_points((16, 16))
    hit = torch.full((256,), 15.0, dtype=dtype)
    seen = composite_splats(two, points, hit)
    at = 8 * 16 + 8
    torch.testing.assert_close(seen.feature[at], torch.tensor([0.75 * 0.5, 0.25], dtype=dtype))
    assert seen.alpha[at].item() == pytest.approx(0.625)
    assert seen.expected_range_m[at].item() == pytest.approx(0.375 * 20 + 0.25 * 10)
    assert seen.median_range_m[at] == 20  # 0.75 is left behind the first, 0.375 behind the second
    assert seen.alpha_before_hit is not None
    assert seen.alpha_before_hit[at].item() == pytest.approx(0.25)


@BOTH
def test_opacities_before_the_hit_ignore_what_hides_a_splat(dtype: torch.dtype) -> None:
    """Three on one ray, opacities .25, .5, .8 at 10, 20, 40 m; the first slopes by 9 m a pixel.

    At the pixel beside the centre, exp(-1/2) = 0.607 of each opacity is left and the first lies at 19 m. With
    a hit at 15 m its weight does not count, and its opacity does, because its centre is at 10 m.
    """
    three = splats(
        [[7.5, 8.5]] * 3,
        opacity=[0.25, 0.5, 0.8],
        range_m=[10.0, 20.0, 40.0],
        slope=[9.0, 0.0],
        dtype=dtype,
    )
    left, opacity = math.exp(-0.5), three.opacity.requires_grad_()
    for hit_m, weight, alphas in ((15.0, 0.0, 0.25), (30.0, 0.25 + 0.5 * (1 - 0.25 * left), 0.75)):
        hit, at = torch.full((256,), hit_m, dtype=dtype), 8 * 16 + 8
        weights = composite_splats(three, pixel_points((16, 16)), hit).alpha_before_hit
        opacities = composite_splats(
            three, pixel_points((16, 16)), hit, before_hit="opacities"
        ).alpha_before_hit
        assert weights is not None
        assert opacities is not None
        assert weights[at].item() == pytest.approx(left * weight, rel=1e-5)
        assert opacities[at].item() == pytest.approx(left * alphas, rel=1e-5)
        (grad,) = torch.autograd.grad(opacities[at], opacity)
        expected = [left if range_m < hit_m else 0.0 for range_m in (10.0, 20.0, 40.0)]
        torch.testing.assert_close(grad, torch.tensor(expected, dtype=dtype))


@BOTH
def test_order_is_that_of_ranges_and_then_of_the_list(dtype: torch.dtype) -> None:
    ranges = [3.0, -2.0, 3.0, 0.5, -7.0]
    all_here = splats([[0.5, 0.5]] * 5, opacity=[0.5] * 5, range_m=ranges, dtype=dtype)
    seen = composite_splats(all_here, pixel_points((1, 1)))
    expected = torch.tensor([0.0625, 0.25, 0.03125, 0.125, 0.5], dtype=dtype)
    torch.testing.assert_close(seen.feature[0], expected)


@BOTH
def test_opacity_saturates_and_rays_end(dtype: torch.dtype) -> None:
    """Three of opacity 1: each takes 0.999; the second would leave 1e-6, so the ray ends before it."""
    three = splats([[0.5, 0.5]] * 3, opacity=[1.0] * 3, range_m=[1.0, 2.0, 3.0], dtype=dtype)
    seen = composite_splats(three, pixel_points((1, 1)))
    torch.testing.assert_close(seen.feature[0], torch.tensor([0.999, 0, 0], dtype=dtype))
    assert seen.alpha[0].item() == pytest.approx(0.999)


@BOTH
def test_what_adds_less_than_one_of_255_is_skipped(dtype: torch.dtype) -> None:
    faint = splats([[0.5, 0.5], [0.5, 0.5]], opacity=[0.0039, 0.004], range_m=[1.0, 2.0], dtype=dtype)
    seen = composite_splats(faint, pixel_points((1, 1)))
    torch.testing.assert_close(seen.feature[0], torch.tensor([0.0, 0.004], dtype=dtype))


@BOTH
def test_splats_move_and_tilt_while_a_sensor_looks(dtype: torch.dtype) -> None:
    """An image of 20 rows read in 2 s: its row v is seen at (v + 0.5) / 10 - 1 s."""
    moving = splats(
        [[2.5, 10.0]],
        opacity=[0.9],
        range_m=[5.0],
        slope=[0.5, 0.25],
        velocity=[4.0, 0.0],
        rate=2.0,
        dtype=dtype,
    )
    seen = composite_splats(moving, pixel_points((20, 8), readout_s=2.0))
    alpha = seen.alpha.view(20, 8)
    t_s = 11.5 / 10 - 1
    d = torch.tensor([3.5 - (2.5 + 4 * t_s), 1.5])
    expected = 0.9 * math.exp(-0.5 * float(d @ d))
    assert alpha[11, 3].item() == pytest.approx(expected, rel=1e-5)
    range_m = 5 + 0.5 * float(d[0]) + 0.25 * float(d[1]) + 2 * t_s
    assert seen.expected_range_m.view(20, 8)[11, 3].item() == pytest.approx(expected * range_m, rel=1e-5)


@BOTH
def test_nothing_to_see(dtype: torch.dtype) -> None:
    none = splats([], opacity=[], range_m=[], dtype=dtype)
    points = pixel_points((5, 20))
    seen = composite_splats(none, points)
    assert seen.feature.shape == (100, 1)
    assert not seen.alpha.any()
    assert seen.median_range_m.isinf().all()
    beside = splats([[2.0, 2.0]], opacity=[0.9], range_m=[1.0], dtype=dtype)
    lists = list_splats(beside, points)
    assert lists.first.tolist() == [0, 1, 1]  # the second of two tiles is empty
    assert not composite_splats(beside, points).alpha.view(5, 20)[:, 16:].any()
    no_beams = beam_points(torch.zeros(0), torch.zeros(0), torch.zeros(0))
    assert composite_splats(beside, no_beams).alpha.shape == (0,)


def test_what_is_not_finite_is_named() -> None:
    bad = splats([[1.0, math.nan], [math.inf, 1.0], [1.0, 1.0]], opacity=[0.5] * 3, range_m=[1.0] * 3)
    with pytest.raises(ValueError, match="mean of 2 of 3 splats is not finite"):
        composite_splats(bad, pixel_points((4, 4)))
    good = splats([[1.0, 1.0]], opacity=[0.5], range_m=[1.0])
    with pytest.raises(ValueError, match="hit_range_m of 1 points is NaN"):
        composite_splats(good, pixel_points((1, 2)), torch.tensor([1.0, math.nan]))
    with pytest.raises(ValueError, match="3 hits for 2 points"):
        composite_splats(good, pixel_points((1, 2)), torch.ones(3))


@BOTH
def test_azimuth_comes_round(dtype: torch.dtype) -> None:
    """A splat at 180° looks the same from both sides, as if it were at 0°."""
    azimuth = torch.linspace(-math.pi, math.pi, 721, dtype=dtype)[:-1]
    elevation = torch.zeros_like(azimuth)
    points = beam_points(azimuth, elevation, torch.zeros_like(azimuth))
    inverse = [1 / 0.03**2, 0.0, 1 / 0.01**2]
    ahead = splats([[0.0, 0.0]], opacity=[0.9], range_m=[5.0], inverse=inverse, slope=[2.0, 0], dtype=dtype)
    seen = composite_splats(ahead, points)
    for at in (math.pi, -math.pi, 3 * math.pi):
        behind = ahead._replace(mean=torch.tensor([[at, 0.0]], dtype=dtype))
        back = composite_splats(behind, points)
        torch.testing.assert_close(back.alpha.roll(360), seen.alpha, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(
            back.expected_range_m.roll(360), seen.expected_range_m, rtol=1e-4, atol=1e-4
        )
    assert seen.alpha.count_nonzero() == pytest.approx(
        2 * 0.03 * math.sqrt(2 * math.log(0.9 * 255)) * 720 / 6.283, abs=2
    )
