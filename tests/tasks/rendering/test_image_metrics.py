"""PSNR and SSIM over the pixels that were rendered."""

import math

import pytest
import torch

from foredrive.tasks.rendering.image_scores import psnr_db, ssim


def test_psnr_by_hand() -> None:
    real = torch.full((2, 3, 12, 12), 0.5)
    rendered = real + torch.tensor([0.1, 0.01])[:, None, None, None]
    known = torch.ones(2, 12, 12, dtype=torch.bool)
    # Mean squared errors of 1e-2 and 1e-4 on a range of 1: 20 and 40 dB.
    assert psnr_db(rendered, real, known).tolist() == pytest.approx([20.0, 40.0], abs=1e-3)


def test_unknown_pixels_do_not_count() -> None:
    generator = torch.Generator().manual_seed(0)
    real = torch.rand(1, 3, 24, 32, generator=generator)
    rendered = (real + 0.05).clamp(0, 1)
    known = torch.ones(1, 24, 32, dtype=torch.bool)
    known[:, :, :10] = False
    spoilt = torch.where(known[:, None], rendered, torch.zeros_like(rendered))
    torch.testing.assert_close(psnr_db(spoilt, real, known), psnr_db(rendered, real, known))
    torch.testing.assert_close(ssim(spoilt, real, known), ssim(rendered, real, known))
    assert psnr_db(spoilt, real, torch.ones_like(known)) < psnr_db(spoilt, real, known)
    assert ssim(spoilt, real, torch.ones_like(known)) < ssim(spoilt, real, known)


def test_an_image_is_like_itself_and_less_like_its_negative() -> None:
    real = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(1))
    known = torch.ones(2, 16, 16, dtype=torch.bool)
    torch.testing.assert_close(ssim(real, real, known), torch.ones(2))
    assert torch.isinf(psnr_db(real, real, known)).all()
    assert (ssim(1 - real, real, known) < 0.1).all()


def test_no_known_pixel_is_no_number() -> None:
    image = torch.rand(1, 3, 16, 16)
    nothing = torch.zeros(1, 16, 16, dtype=torch.bool)
    assert math.isnan(psnr_db(image, image, nothing).item())
    assert math.isnan(ssim(image, image, nothing).item())
    assert psnr_db(image[:0], image[:0], nothing[:0]).shape == (0,)
    assert ssim(image[:0], image[:0], nothing[:0]).shape == (0,)
