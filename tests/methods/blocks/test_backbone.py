"""Backbone and VGG features: levels, and weights that are there or are not."""

import dataclasses
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from foredrive.errors import InputError
from foredrive.methods.blocks.backbone import BackboneConfig, ImageBackbone, normalise_images
from foredrive.methods.blocks.vgg import VggFeatures

CONFIG = BackboneConfig(
    embedding_size=8,
    hidden_sizes=(8, 16, 24, 32),
    depths=(1, 1, 1, 1),
    layer_type="basic",
    stages=("stage1", "stage3"),
)


def test_levels_have_the_strides_of_their_stages() -> None:
    levels = ImageBackbone(CONFIG, channels=12)(torch.zeros(2, 3, 64, 96, dtype=torch.uint8))
    assert [tuple(level.shape) for level in levels] == [(2, 16, 24, 12), (2, 4, 6, 12)]


def test_a_stem_without_pooling_halves_the_strides() -> None:
    config = dataclasses.replace(CONFIG, stem_stride=2)
    levels = ImageBackbone(config, channels=12)(torch.zeros(2, 3, 64, 96, dtype=torch.uint8))
    assert [tuple(level.shape) for level in levels] == [(2, 32, 48, 12), (2, 8, 12, 12)]


def test_white_is_normalised_as_imagenet_does() -> None:
    white = normalise_images(torch.full((1, 3, 1, 1), 255, dtype=torch.uint8)).flatten()
    torch.testing.assert_close(white, torch.tensor([2.2489, 2.4286, 2.6400]), atol=1e-3, rtol=0)


def test_saved_resnet_weights_are_loaded(tmp_path: Path) -> None:
    original = ImageBackbone(CONFIG, channels=12)
    original.resnet.save_pretrained(tmp_path)
    loaded = ImageBackbone(dataclasses.replace(CONFIG, weights=str(tmp_path)), channels=12)
    assert loaded.pretrained
    torch.testing.assert_close(loaded.resnet.state_dict(), original.resnet.state_dict())


def test_missing_weights_are_said_loudly(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, weights=str(tmp_path / "nothing_here"))
    with pytest.warns(UserWarning, match="RANDOM weights"):
        backbone = ImageBackbone(config, channels=12)
    assert not backbone.pretrained


def step(backbone: ImageBackbone) -> dict[str, torch.Tensor]:
    """The state after one step of training on random images."""
    backbone.train()
    images = torch.randint(0, 256, (2, 3, 32, 64), generator=torch.Generator().manual_seed(0)).byte()
    optimizer = torch.optim.SGD([p for p in backbone.parameters() if p.requires_grad], lr=0.1)
    torch.cat([level.square().flatten() for level in backbone(images)]).mean().backward()
    optimizer.step()
    return {name: value.clone() for name, value in backbone.state_dict().items()}


@pytest.mark.parametrize("pretrained", [True, False])
def test_norms_are_frozen_where_weights_were_loaded_and_live_from_scratch(
    pretrained: bool, tmp_path: Path
) -> None:
    original = ImageBackbone(CONFIG, channels=12)
    original.resnet.save_pretrained(tmp_path)
    weights = str(tmp_path) if pretrained else None
    backbone = ImageBackbone(dataclasses.replace(CONFIG, weights=weights), channels=12)
    before = {name: value.clone() for name, value in backbone.state_dict().items()}
    after = step(backbone)
    changed = {name for name in after if not torch.equal(before[name], after[name])}
    norms = {name for name in after if "normalization" in name and ".stages.3." not in name}
    assert norms
    assert norms & changed == (set() if pretrained else norms)
    filters = {name for name in after if name.endswith("convolution.weight") and ".stages.3." not in name}
    assert filters <= changed


def test_only_the_levels_that_are_read_are_returned_and_trained() -> None:
    torch.manual_seed(0)
    whole = ImageBackbone(CONFIG, channels=12).eval()
    torch.manual_seed(0)
    finest = ImageBackbone(CONFIG, channels=12, levels=1).eval()
    images = torch.randint(0, 256, (2, 3, 32, 64), generator=torch.Generator().manual_seed(0)).byte()
    (level,) = finest(images)
    torch.testing.assert_close(level, whole(images)[0], atol=0, rtol=0)
    assert finest.state_dict().keys() == whole.state_dict().keys()
    still = {name for name, p in finest.named_parameters() if not p.requires_grad}
    assert still == {"smooth.1.weight", "smooth.1.bias"}
    with pytest.raises(InputError, match="has 2 levels, of which 3"):
        ImageBackbone(CONFIG, channels=12, levels=3)


def vgg_state() -> dict[str, torch.Tensor]:
    widths = [3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512]
    index = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21]
    rng = torch.Generator().manual_seed(0)
    state = {}
    for layer, source, target in zip(index, widths[:-1], widths[1:], strict=True):
        state[f"features.{layer}.weight"] = torch.randn(target, source, 3, 3, generator=rng) * 0.05
        state[f"features.{layer}.bias"] = torch.zeros(target)
    return state | {"classifier.0.weight": torch.zeros(1)}


def test_vgg_loads_torchvisions_names_and_taps_four_layers(tmp_path: Path) -> None:
    save_file(vgg_state(), tmp_path / "vgg.safetensors")
    vgg = VggFeatures(tmp_path / "vgg.safetensors").train()
    assert not vgg.training
    taps = vgg(torch.rand(1, 3, 32, 48))
    assert [tuple(tap.shape[1:]) for tap in taps] == [(64, 32, 48), (128, 16, 24), (256, 8, 12), (512, 4, 6)]
    assert all((tap >= 0).all() for tap in taps)  # after the ReLU
    assert not any(parameter.requires_grad for parameter in vgg.parameters())


def test_vgg_weights_that_are_not(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        VggFeatures(tmp_path / "vgg.safetensors")
    state = vgg_state()
    del state["features.21.weight"]
    save_file(state, tmp_path / "vgg.safetensors")
    with pytest.raises(InputError, match=r"lacks features\.21\.weight"):
        VggFeatures(tmp_path / "vgg.safetensors")


def test_vgg_19_taps_the_first_convolution_of_five_blocks_of_images_as_they_are(tmp_path: Path) -> None:
    """The first tap by hand: a filter that reads the red channel of the pixel itself."""
    rng, state = torch.Generator().manual_seed(0), {}
    widths = [3, 64, 64, 128, 128, *[256] * 4, *[512] * 5]
    for layer, source, target in zip(
        [0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28], widths[:-1], widths[1:], strict=True
    ):
        state[f"features.{layer}.weight"] = torch.randn(target, source, 3, 3, generator=rng) * 0.05
        state[f"features.{layer}.bias"] = torch.zeros(target)
    state["features.0.weight"][5] = 0
    state["features.0.weight"][5, 0, 1, 1] = 1
    save_file(state, tmp_path / "vgg.safetensors")
    image = torch.rand(1, 3, 32, 48)
    taps = VggFeatures(tmp_path / "vgg.safetensors", 19)(image)
    assert [tap.shape[1] for tap in taps] == [64, 128, 256, 512, 512]
    assert [tap.shape[-1] for tap in taps] == [48, 24, 12, 6, 3]
    torch.testing.assert_close(taps[0][0, 5], image[0, 0])
