"""The photometric loss: against torchmetrics, and the kernels against plain PyTorch."""

import pytest
import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from foredrive.ops.photometric import photometric_loss, photometric_loss_reference


def images(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Two images that resemble each other, with a flat part, and places where both are equal."""
    rng = torch.Generator().manual_seed(seed)
    a, b = torch.rand(2, 3, height, width, generator=rng)
    b = 0.7 * a + 0.3 * b
    a[:, : height // 3, : width // 2] = 0.4
    b[1, -2:] = a[1, -2:]
    return a, b


def test_it_is_l1_and_the_ssim_of_torchmetrics() -> None:
    a, b = images(24, 40)
    ssim = structural_similarity_index_measure(a[None], b[None], data_range=1.0)
    assert isinstance(ssim, Tensor)
    expected = 0.8 * float((a - b).abs().mean()) + 0.2 * (1 - float(ssim))
    for loss in (photometric_loss, photometric_loss_reference):
        assert float(loss(a, b)) == pytest.approx(expected, abs=1e-5)
        assert float(loss(a, a)) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("size_hw", [(6, 6), (6, 50), (33, 7), (97, 41)])
@pytest.mark.parametrize("ssim_share", [0.0, 0.2, 1.0])
def test_kernels_give_value_and_gradient_of_the_reference(
    size_hw: tuple[int, int], ssim_share: float
) -> None:
    a, b = images(*size_hw, seed=1)
    rendered, exact = a.clone().requires_grad_(), a.double().requires_grad_()
    found = photometric_loss(rendered, b, ssim_share)
    expected = photometric_loss_reference(exact, b.double(), ssim_share)
    torch.testing.assert_close(found.double(), expected, atol=1e-6, rtol=1e-5)
    (3 * found).backward()
    (3 * expected).backward()
    assert rendered.grad is not None
    assert exact.grad is not None
    largest = float(exact.grad.abs().max())
    torch.testing.assert_close(rendered.grad.double(), exact.grad, atol=1e-4 * largest, rtol=1e-3)


@pytest.mark.parametrize("size_hw", [(5, 20), (20, 5)])
def test_images_smaller_than_the_window_are_refused(size_hw: tuple[int, int]) -> None:
    a, b = images(*size_hw)
    with pytest.raises(RuntimeError, match="adding"):
        photometric_loss(a, b)


def test_views_of_images_and_many_threads_give_the_same() -> None:
    a, b = images(160, 40)
    rendered = a.transpose(1, 2).contiguous().transpose(1, 2).requires_grad_()
    alone = torch.autograd.grad(photometric_loss(a.requires_grad_(), b), a)[0]
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        (together,) = torch.autograd.grad(photometric_loss(rendered, b), rendered)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(alone, together)
