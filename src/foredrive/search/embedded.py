"""Towers trained in Foredrive: images with a sentence encoder, lidar with any image towers."""

import functools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from foredrive.devices import chosen_device
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.methods.blocks.text_encoder import TextEncoder
from foredrive.methods.lidarclip import LidarEncoder, LidarEncoderConfig, PointCloud
from foredrive.methods.lidarclip.image_tower import ImageTower, ImageTowerConfig
from foredrive.scene import LidarSweep
from foredrive.search.crops import Crop
from foredrive.search.pretrained import PretrainedTowers
from foredrive.search.towers import Towers, weights_digest

CARD, IMAGE, LIDAR = "towers.json", "image.safetensors", "lidar.safetensors"
TEXT_MEAN = "text_mean"
SENTENCE = "sentence-"
"""Beginning of the fingerprints of towers whose image tower was trained here."""
SHIPPED = Path(__file__).parent / "shipped"
"""Folder of the towers that come with the package."""
AT_ONCE = 8
"""Number of sectors embedded together. More do not fit into the cache of a core."""


@dataclass(frozen=True)
class TowerCard:
    """Description of a folder of towers."""

    dim: int
    text: str
    """Name of the sentence encoder, or of the CLIP or SigLIP model that the lidar tower belongs to."""
    image: ImageTowerConfig | None
    """Size of the image tower. None if the image tower is that of the model `text`."""
    base_fingerprint: str
    """Fingerprint of the towers that the lidar tower was trained with."""
    lidar: LidarEncoderConfig | None
    trained: dict[str, object]
    """Training data, duration and quality, for people to read."""

    @property
    def datasets(self) -> frozenset[str]:
        """Return the data sets of the training logs, as splits name them; empty if the card has no logs."""
        logs = self.trained.get("logs")
        return frozenset(map(dataset_of, map(str, logs))) if isinstance(logs, list) else frozenset()


class SentenceTowers:
    """An image tower trained with a frozen sentence encoder. See `Towers`.

    The mean embedding of all training captions is subtracted from every text. The remainder separates the
    texts better.
    """

    has_lidar, crop = False, Crop.WHOLE

    def __init__(
        self, name: str, tower: ImageTower, text_mean: Float[Tensor, "D"], size: ImageTowerConfig, text: str
    ) -> None:
        self.name, self.text_mean = name, text_mean
        self.size, self.text = size, text
        self.dim, self.image_side_px = len(text_mean), size.side_px
        self.fingerprint = f"{SENTENCE}{weights_digest({TEXT_MEAN: text_mean, **tower.state_dict()})}"
        self._device = chosen_device()
        self.tower = tower.eval().to(self._device)

    @torch.no_grad()
    def embed_images(self, images: UInt8[Tensor, "n 3 H W"]) -> Float[Tensor, "n D"]:
        """Embed images, see `Towers`."""
        parts = [images[start : start + AT_ONCE] for start in range(0, len(images), AT_ONCE)]
        return torch.cat([self.tower(part.to(self._device)).cpu() for part in parts])

    def embed_sweeps(self, sweeps: LidarSweep) -> None:
        """Return None, because there is no lidar tower."""
        return

    def embed_text(self, texts: Sequence[str]) -> Float[Tensor, "n D"]:
        """Embed texts, see `Towers`."""
        return self._encoder(texts) - self.text_mean

    @functools.cached_property
    def _encoder(self) -> TextEncoder:
        """Load the sentence encoder at the first use. Building an index does not need it."""
        return TextEncoder(self.text)


class LidarTowers:
    """Any towers with a lidar tower that was trained from their image embeddings. See `Towers`."""

    has_lidar = True

    def __init__(self, name: str, base: Towers, encoder: LidarEncoder) -> None:
        self.name, self.base = name, base
        self.dim, self.image_side_px, self.crop = base.dim, base.image_side_px, base.crop
        self.fingerprint = f"{base.fingerprint}-lidar-{weights_digest(encoder.state_dict())}"
        self._device = chosen_device()
        self.encoder = encoder.eval().to(self._device)

    def embed_images(self, images: UInt8[Tensor, "n 3 H W"]) -> Float[Tensor, "n D"]:
        """Embed images, see `Towers`."""
        return self.base.embed_images(images)

    @torch.no_grad()
    def embed_sweeps(self, sweeps: LidarSweep) -> Float[Tensor, "n D"]:
        """Embed sweeps, see `Towers`."""
        rows = len(sweeps.valid)
        parts = [sweeps[start : start + AT_ONCE] for start in range(0, rows, AT_ONCE)]
        clouds = [(PointCloud.from_sweeps(part).to(self._device), len(part.valid)) for part in parts]
        return torch.cat([self.encoder(cloud, count).cpu() for cloud, count in clouds])

    def embed_text(self, texts: Sequence[str]) -> Float[Tensor, "n D"]:
        """Embed texts, see `Towers`."""
        return self.base.embed_text(texts)


def dataset_of(log: str) -> str:
    """Return the data set of a log's name: town of town_train/Town01_seed3, and of town-egos_train/…."""
    return log.partition("/")[0].rpartition("_")[0].partition("-")[0]


def save_towers(
    folder: Path,
    card: TowerCard,
    image: tuple[ImageTower, Float[Tensor, "D"]] | None,
    lidar: LidarEncoder | None,
) -> None:
    """Write towers to a folder, with weights in half precision.

    Args:
        image: image tower and mean of the texts. None if the image tower is that of the model `card.text`.
    """
    with atomic_path(folder) as temporary:
        temporary.mkdir()
        if image is not None:
            state = _halved(image[0])
            save_file({**state, TEXT_MEAN: image[1]}, temporary / IMAGE)
        if lidar is not None:
            save_file(_halved(lidar), temporary / LIDAR)
        (temporary / CARD).write_text(json.dumps(asdict(card), indent=1))


def load_towers(folder: Path) -> Towers:
    """Load towers from a folder of `save_towers`.

    Raises:
        InputError: there are no towers, they are damaged, or the base model has other weights or looks at
            another crop than in training.
    """
    card = read_card(folder)
    base = _load_base(folder, card)
    if card.lidar is None:
        return base
    # A lidar tower fits only the embeddings of the image tower that it was trained with
    if base.fingerprint != card.base_fingerprint:
        raise InputError(
            f"{folder}: the lidar tower was trained beside {card.text} with other weights or another crop of "
            f"its images; train it again: foredrive search train --beside {card.text}"
        )
    encoder = LidarEncoder(card.lidar, dim=card.dim)
    _load_weights(encoder, folder / LIDAR)
    return LidarTowers(str(folder), base, encoder)


def load_image_tower(folder: Path) -> ImageTower:
    """Load the image tower alone from a folder of `save_towers`.

    Raises:
        InputError: there are no towers, they are damaged, or the image tower is that of another model.
    """
    card = read_card(folder)
    if card.image is None:
        raise InputError(f"{folder}: the image tower is that of {card.text}")
    return _load_image_tower(folder, card.image, card.dim)[0]


def read_card(folder: Path) -> TowerCard:
    """Read the description of towers.

    Raises:
        InputError: there is none, or it is damaged.
    """
    try:
        return TypeAdapter(TowerCard).validate_json((folder / CARD).read_bytes())
    except (OSError, ValidationError) as error:
        raise InputError(
            f"{folder / CARD}: does not describe towers: {str(error).splitlines()[0]}"
        ) from error


def _load_base(folder: Path, card: TowerCard) -> Towers:
    if card.image is None:
        return PretrainedTowers(card.text)
    tower, text_mean = _load_image_tower(folder, card.image, card.dim)
    return SentenceTowers(str(folder), tower, text_mean, card.image, card.text)


def _load_image_tower(
    folder: Path, size: ImageTowerConfig, dim: int
) -> tuple[ImageTower, Float[Tensor, "D"]]:
    """Return the image tower and the mean of the texts."""
    tower = ImageTower(size, dim=dim)
    text_mean = _load_weights(tower, folder / IMAGE).get(TEXT_MEAN)
    if text_mean is None:
        raise InputError(f"{folder / IMAGE}: no {TEXT_MEAN} in it")
    return tower, text_mean


def _halved(model: nn.Module) -> dict[str, Tensor]:
    state = model.state_dict()
    return {
        name: (value.half() if value.is_floating_point() else value).contiguous()
        for name, value in state.items()
    }


def _load_weights(model: nn.Module, file: Path) -> dict[str, Tensor]:
    """Load weights into a model. Return the other entries of the file."""
    try:
        state = load_file(file)
        # Entries that are not the model's own, such as the mean of the texts; the rest has to fit exactly
        rest = {name: state.pop(name) for name in state.keys() - model.state_dict().keys()}
        model.load_state_dict(state)
    except (OSError, SafetensorError, RuntimeError) as error:
        raise InputError(f"{file}: not the weights of these towers: {str(error).splitlines()[0]}") from error
    return rest
