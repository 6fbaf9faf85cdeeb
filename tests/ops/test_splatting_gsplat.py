"""Images on a GPU by gsplat, and what is said where it is missing."""

from importlib.util import find_spec

import pytest
import torch

from foredrive.ops.splat_points import pixel_points
from foredrive.ops.splatting import Splats, composite_splats, composite_splats_reference
from foredrive.ops.splatting_gsplat import gsplat_compiles


def some_splats(count: int = 300) -> Splats:
    rng = torch.Generator().manual_seed(0)
    spread = torch.randn(count, 2, 2, generator=rng) * 3
    inverse = torch.linalg.inv(spread @ spread.transpose(1, 2) + 0.3 * torch.eye(2))
    return Splats(
        mean=torch.rand(count, 2, generator=rng) * torch.tensor([70.0, 50.0]),
        inverse_covariance=torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1),
        opacity=torch.rand(count, generator=rng),
        range_m=1 + 50 * torch.rand(count, generator=rng),
        range_slope=torch.zeros(count, 2),
        velocity=torch.zeros(count, 2),
        range_rate_mps=torch.zeros(count),
        feature=torch.rand(count, 5, generator=rng),
    )


@pytest.mark.skipif(find_spec("gsplat") is not None, reason="gsplat is installed")
def test_its_absence_is_said_in_one_line(caplog: pytest.LogCaptureFixture) -> None:
    gsplat_compiles.cache_clear()
    assert not gsplat_compiles()
    assert not gsplat_compiles()
    (line,) = caplog.messages
    assert "foredrive[gsplat]" in line
    assert "plain PyTorch" in line


@pytest.mark.skipif(
    not torch.cuda.is_available() or find_spec("gsplat") is None, reason="needs a GPU and gsplat"
)
def test_it_gives_what_the_reference_gives() -> None:
    points = pixel_points((45, 66))
    exact = Splats(*(field.double().requires_grad_() for field in some_splats()))
    fast = Splats(*(field.cuda().requires_grad_() for field in some_splats()))
    truth = composite_splats_reference(exact, points)
    seen = composite_splats(fast, points.to("cuda"), median=False)
    assert seen.median_range_m.isnan().all()
    rng = torch.Generator().manual_seed(1)
    upstream = torch.rand(truth.feature.shape, generator=rng, dtype=torch.float64)
    for name in ("feature", "expected_range_m", "alpha"):  # a few pixels lie next to a cut-off
        error = (getattr(seen, name).cpu().double() - getattr(truth, name)).abs()
        assert error.flatten().quantile(0.99) < 1e-3 * getattr(truth, name).abs().max()
    chosen = ["mean", "inverse_covariance", "opacity", "range_m", "feature"]
    true_loss = (truth.feature * upstream).sum() + truth.expected_range_m.sum() + truth.alpha.sum()
    loss = (seen.feature * upstream.cuda()).sum() + seen.expected_range_m.sum() + seen.alpha.sum()
    found = torch.autograd.grad(loss, [getattr(fast, name) for name in chosen])
    expected = torch.autograd.grad(true_loss, [getattr(exact, name) for name in chosen])
    for grad, true_grad in zip(found, expected, strict=True):
        error = (grad.cpu().double() - true_grad).abs().flatten()
        assert error.quantile(0.95) < 2e-2 * true_grad.abs().max()


def test_what_is_not_asked_for_is_not_a_number() -> None:
    seen = composite_splats(some_splats(), pixel_points((20, 20)), median=False)
    assert seen.median_range_m.isnan().all()
    assert seen.alpha.max() > 0
