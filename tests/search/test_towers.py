"""CLIP and SigLIP as towers, of small random configurations; prompts in several wordings."""

import shutil
import socket
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from huggingface_hub import constants
from transformers import BertConfig, CLIPModel, SiglipModel

from foredrive.errors import InputError
from foredrive.search.pretrained import CLIP_MEAN, CLIP_STD, PretrainedTowers
from foredrive.search.towers import embed_prompt, unit


def test_clip_sees_the_middle_square_as_its_model_does(clip_folder: Path) -> None:
    towers = PretrainedTowers(str(clip_folder))
    images = torch.randint(0, 256, (2, 3, 16, 28), dtype=torch.uint8)
    left, top, right, bottom = towers.crop.box_px((16, 28))
    assert (left, top, right, bottom) == (6, 0, 22, 16)
    middle = (images[..., 6:22].float() / 255 - torch.tensor(CLIP_MEAN).view(3, 1, 1)) / torch.tensor(
        CLIP_STD
    ).view(3, 1, 1)
    with torch.no_grad():
        expected = CLIPModel.from_pretrained(clip_folder).eval().get_image_features(pixel_values=middle)
    expected = expected if isinstance(expected, torch.Tensor) else expected.pooler_output
    seen = towers.embed_images(images[..., top:bottom, left:right])
    torch.testing.assert_close(seen, expected, atol=1e-5, rtol=1e-4)
    assert (towers.dim, towers.image_side_px) == (12, 16)


def test_siglip_sees_all_of_an_image(siglip_folder: Path) -> None:
    towers = PretrainedTowers(str(siglip_folder))
    assert towers.crop.box_px((16, 28)) == (0, 0, 28, 16)
    images = torch.randint(0, 256, (1, 3, 16, 28), dtype=torch.uint8)
    squeezed = F.interpolate(images.float() / 255, size=(16, 16), mode="bicubic", antialias=True).clamp(0, 1)
    with torch.no_grad():
        model = SiglipModel.from_pretrained(siglip_folder).eval()
        expected = model.get_image_features(pixel_values=squeezed * 2 - 1)
    expected = expected if isinstance(expected, torch.Tensor) else expected.pooler_output
    torch.testing.assert_close(towers.embed_images(images), expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", ["clip_folder", "siglip_folder"])
def test_a_text_is_the_same_alone_and_beside_a_longer_one(kind: str, request: pytest.FixtureRequest) -> None:
    towers = PretrainedTowers(str(request.getfixturevalue(kind)))
    together = towers.embed_text(["rain", "a photo of the crossing car " * 30])
    assert together.shape == (2, towers.dim)
    torch.testing.assert_close(towers.embed_text(["rain"]), together[:1], atol=1e-5, rtol=1e-4)
    assert not torch.allclose(together[0], together[1], atol=1e-3)


def test_there_is_no_lidar_tower(clip_folder: Path) -> None:
    assert not PretrainedTowers(str(clip_folder)).has_lidar


def test_the_fingerprint_is_that_of_the_weights_and_the_crop(clip_folder: Path, tmp_path: Path) -> None:
    towers = PretrainedTowers(str(clip_folder))
    assert towers.fingerprint.startswith("clip-middle-square-")  # without a crop, it was clip-DIGEST
    moved = tmp_path / "moved"
    shutil.copytree(clip_folder, moved)
    assert PretrainedTowers(str(moved)).fingerprint == towers.fingerprint
    model = CLIPModel.from_pretrained(moved)
    with torch.no_grad():
        model.visual_projection.weight[0, 0] += 1e-3
    model.save_pretrained(moved)
    assert PretrainedTowers(str(moved)).fingerprint != towers.fingerprint


def test_random_weights_are_said_aloud_and_are_the_same_every_time(clip_folder: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(clip_folder, bare)
    (bare / "model.safetensors").unlink()
    with pytest.warns(UserWarning, match="RANDOM weights"):
        first = PretrainedTowers(str(bare))
    torch.rand(3)
    with pytest.warns(UserWarning, match="RANDOM weights"):
        assert PretrainedTowers(str(bare)).fingerprint == first.fingerprint


def test_what_is_no_tower_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be loaded"):
        PretrainedTowers(str(tmp_path))
    BertConfig().save_pretrained(tmp_path)
    with pytest.raises(InputError, match="a bert model; only CLIP and SigLIP"):
        PretrainedTowers(str(tmp_path))


def test_a_hub_that_does_not_answer_is_asked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]  # nobody listens there once it is closed
    monkeypatch.setattr(constants, "ENDPOINT", f"http://127.0.0.1:{port}")
    with pytest.raises(InputError, match=f"'nobody/nothing' cannot be .*:{port} cannot be reached"):
        PretrainedTowers("nobody/nothing")


def test_a_model_that_is_not_here_is_said_at_once_offline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(InputError, match="HF_HUB_OFFLINE"):
        PretrainedTowers("nobody/nothing")


def test_an_ensemble_is_the_direction_between_its_wordings(clip_folder: Path) -> None:
    towers = PretrainedTowers(str(clip_folder))
    alone = embed_prompt(towers, " rain ", ("{}",))
    torch.testing.assert_close(alone, unit(towers.embed_text(["rain"]))[0])
    both = embed_prompt(towers, "rain", ("{}", "a photo of {}"))
    torch.testing.assert_close(float(both.norm()), 1.0)
    photo = embed_prompt(towers, "rain", ("a photo of {}",))
    torch.testing.assert_close(float(both @ alone), float(both @ photo), atol=1e-5, rtol=0)
    with pytest.raises(InputError, match="empty text"):
        embed_prompt(towers, "  ")
