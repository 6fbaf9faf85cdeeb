"""LPIPS and FID's Inception with random weights in files, against the formulas."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import nn

from foredrive.errors import InputError
from foredrive.methods.blocks.inception import InceptionFeatures, resized
from foredrive.methods.blocks.lpips import Lpips
from foredrive.methods.reconstruction.perceptual import (
    PerceptualMetrics,
    PerceptualWeights,
    feature_distance,
)
from foredrive.runs.reconstruction.reconstruct import shipped_tower

ALEXNET = {0: (3, 64, 11), 3: (64, 192, 5), 6: (192, 384, 3), 8: (384, 256, 3), 10: (256, 256, 3)}
"""Convolutions of AlexNet: inputs, outputs, kernel."""


def alexnet() -> dict[str, torch.Tensor]:
    rng = torch.Generator().manual_seed(0)
    state = {"classifier.1.weight": torch.zeros(4, 4)}
    for number, (inputs, outputs, kernel) in ALEXNET.items():
        weight = torch.randn(outputs, inputs, kernel, kernel, generator=rng)
        state[f"features.{number}.weight"] = weight / (inputs * kernel**2) ** 0.5
        state[f"features.{number}.bias"] = 0.1 * torch.randn(outputs, generator=rng)
    return state


def tapped(image: torch.Tensor) -> list[torch.Tensor]:
    """The five layers of AlexNet after their ReLUs, each feature of length 1."""
    state, taps = alexnet(), []
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x = ((2 * image - 1).movedim(1, -1) - shift).div(scale).movedim(-1, 1)
    for number in ALEXNET:
        if number in (3, 6):
            x = F.max_pool2d(x, 3, 2)
        weight, bias = (state[f"features.{number}.{name}"] for name in ("weight", "bias"))
        x = F.conv2d(x, weight, bias, 4 if number == 0 else 1, 2 if number < 6 else 1).relu()
        taps.append(x / (x.square().sum(1, keepdim=True) + 1e-8).sqrt())
    return taps


@pytest.mark.parametrize("suffix", ["pth", "safetensors"])
def test_lpips_weighs_the_squared_differences_of_five_layers(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"alexnet.{suffix}"
    if suffix == "pth":
        torch.save(alexnet(), file)
    else:
        save_file(alexnet(), file)
    lpips = Lpips(file)
    assert not lpips.training
    a, b = torch.rand(2, 2, 3, 64, 80, generator=torch.Generator().manual_seed(1))
    expected = torch.zeros(2)
    for head, one, other in zip(lpips.heads, tapped(a), tapped(b), strict=True):
        assert isinstance(head, nn.Conv2d)
        assert bool((head.weight >= 0).all())  # the published layers
        expected += ((one - other) ** 2 * head.weight[0]).sum(1).mean((1, 2))
    torch.testing.assert_close(lpips(a, b), expected, rtol=1e-4, atol=1e-6)
    assert lpips(a, a).tolist() == [0.0, 0.0]


def test_weights_that_are_not_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file of AlexNet weights"):
        Lpips(tmp_path / "alexnet.pth")
    with pytest.raises(InputError, match="no such file of FID's Inception weights"):
        PerceptualMetrics(PerceptualWeights(inception=tmp_path / "inception.pth"))
    (tmp_path / "alexnet.pth").write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match="not AlexNet weights"):
        Lpips(tmp_path / "alexnet.pth")
    state = alexnet()
    state["features.3.weight"] = state["features.3.weight"][:, :, :3].contiguous()
    save_file(state, tmp_path / "alexnet.safetensors")
    with pytest.raises(
        InputError, match=r"features\.3\.weight is \(192, 64, 3, 5\) instead of \(192, 64, 5, 5\)"
    ):
        Lpips(tmp_path / "alexnet.safetensors")


def test_inception_has_the_layers_of_the_published_file(tmp_path: Path) -> None:
    """Names, shapes and number of parameters are those of pt_inception-2015-12-05 without its classifier."""
    shapes = {name: tuple(value.shape) for name, value in InceptionFeatures().state_dict().items()}
    assert shapes["Conv2d_4a_3x3.conv.weight"] == (192, 80, 3, 3)
    assert shapes["Mixed_5b.branch_pool.conv.weight"] == (32, 192, 1, 1)
    assert shapes["Mixed_6c.branch7x7dbl_4.conv.weight"] == (160, 160, 7, 1)
    assert shapes["Mixed_7a.branch7x7x3_4.conv.weight"] == (192, 192, 3, 3)
    assert shapes["Mixed_7c.branch3x3dbl_3b.conv.weight"] == (384, 384, 3, 1)
    assert shapes["Mixed_7c.branch_pool.bn.running_var"] == (192,)
    assert sum(parameter.numel() for parameter in InceptionFeatures().parameters()) == 21_785_568


def test_images_are_resized_as_tensorflow_did() -> None:
    """Output pixel k of a row of 598 is input pixel 2k; of 299 / 2 columns, it is the mean of neighbours."""
    row = torch.arange(598.0).expand(1, 3, 299, 598)
    torch.testing.assert_close(resized(row)[0, 0, 7], torch.arange(0.0, 598, 2))
    up = resized(torch.arange(3.0).expand(1, 3, 299, 3))[0, 0, 0]
    assert up[[0, 50, 100, 299 - 1]].tolist() == pytest.approx([0, 150 / 299, 300 / 299, 2.0], abs=1e-5)


def test_distance_of_features_by_hand() -> None:
    """Two places of two channels: equal directions are 0 apart, opposite ones 4, right angles 2."""
    a = torch.tensor([[3.0, 1.0], [0.0, 0.0]])[None, :, None]
    b = torch.tensor([[5.0, -2.0], [0.0, 0.0]])[None, :, None]
    c = torch.tensor([[0.0, 1.0], [2.0, 0.0]])[None, :, None]
    assert float(feature_distance([a], [b])) == pytest.approx(2.0)
    assert float(feature_distance([a], [c])) == pytest.approx(1.0)
    assert float(feature_distance([a, a], [b, a])) == pytest.approx(1.0)


def test_the_shipped_tower_finds_more_damage_farther() -> None:
    """A photograph's stand-in: stripes and blobs. Noise and blur move it away, the more the farther."""
    tower = shipped_tower()
    v, u = torch.meshgrid(torch.arange(96.0), torch.arange(160.0), indexing="ij")
    real = torch.stack([(u / 7).sin(), (v / 11).cos(), (u * v / 900).sin()]).add(1).div(2)[None]
    noise = torch.randn(real.shape, generator=torch.Generator().manual_seed(0))
    blurred = [real] + [torch.nn.functional.avg_pool2d(real, k, 1, k // 2) for k in (3, 9)]
    noisy = [(real + amount * noise).clamp(0, 1) for amount in (0.0, 0.05, 0.2)]
    for images in (blurred, noisy):
        same, less, more = (float(feature_distance(*map(tower.features, (image, real)))) for image in images)
        assert same == 0.0
        assert 0.0 < less < more
