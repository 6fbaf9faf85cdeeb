"""CLIP (Radford et al. 2021) and SigLIP (Zhai et al. 2023) as towers, with the transformers library."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from foredrive.devices import chosen_device
from foredrive.errors import InputError
from foredrive.scene import LidarSweep
from foredrive.search.crops import Crop
from foredrive.search.towers import weights_digest

CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
SIGLIP_MEAN, SIGLIP_STD = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)
"""RGB statistics of the training of the released models."""
SIGLIP_TOKENS = 64
"""Length to which texts are padded in SigLIP's training. Its text tower reads the last token."""
HUB_ANSWERS_S = 5.0
KINDS = ("clip", "siglip", "siglip2")


class PretrainedTowers:
    """The towers of a CLIP or SigLIP model. There is no lidar tower.

    CLIP takes the middle square of an image. SigLIP resizes the whole image to a square. Both match their
    training.

    Args:
        model: a name on the Hugging Face hub, or a local folder. A folder with a configuration but without
            weights gives random weights with a fixed seed, and a warning.

    Raises:
        InputError: the model is not available, or it is of another kind.
    """

    has_lidar = False

    def __init__(self, model: str) -> None:
        self.name = model
        self.model, self.tokenizer = _load(model)
        config = self.model.config
        self.is_clip = config.model_type == "clip"
        self.image_side_px = int(config.vision_config.image_size)
        self.dim = int(config.projection_dim if self.is_clip else config.vision_config.hidden_size)
        self.crop = Crop.MIDDLE_SQUARE if self.is_clip else Crop.WHOLE
        # Embeddings depend on the crop as well as on the weights
        kind = f"clip-{self.crop}" if self.is_clip else config.model_type
        self.fingerprint = f"{kind}-{weights_digest(self.model.state_dict())}"
        mean, std = (CLIP_MEAN, CLIP_STD) if self.is_clip else (SIGLIP_MEAN, SIGLIP_STD)
        self._device = chosen_device()
        self.model.to(self._device)
        self._mean, self._std = (
            torch.tensor(values, device=self._device).view(3, 1, 1) for values in (mean, std)
        )

    @torch.no_grad()
    def embed_images(self, images: UInt8[Tensor, "n 3 H W"]) -> Float[Tensor, "n D"]:
        """Embed images, see `Towers`."""
        side = self.image_side_px
        pixels = images.to(self._device).float() / 255
        if images.shape[-2:] != (side, side):
            pixels = F.interpolate(pixels, size=(side, side), mode="bicubic", antialias=True).clamp(0, 1)
        features = self.model.get_image_features(pixel_values=(pixels - self._mean) / self._std)
        return _features(features)

    def embed_sweeps(self, sweeps: LidarSweep) -> None:
        """Return None, because there is no lidar tower."""
        return

    @torch.no_grad()
    def embed_text(self, texts: Sequence[str]) -> Float[Tensor, "n D"]:
        """Embed texts, see `Towers`. Texts longer than the tower's maximum are cut."""
        longest = int(self.model.config.text_config.max_position_embeddings)
        padded = {"padding": True, "max_length": longest} if self.is_clip else {
            "padding": "max_length", "max_length": min(SIGLIP_TOKENS, longest)
        }  # fmt: skip
        tokens = self.tokenizer(list(texts), truncation=True, return_tensors="pt", **padded)
        kept = {key: tokens[key].to(self._device) for key in ("input_ids", "attention_mask") if key in tokens}
        if not self.is_clip:
            kept.pop("attention_mask", None)  # SigLIP is trained to read the padding too
        return _features(self.model.get_text_features(**kept))


def _features(output: Any) -> Float[Tensor, "n D"]:
    return (output if isinstance(output, Tensor) else output.pooler_output).float().cpu()


def _not_loaded(model: str, error: Exception) -> InputError:
    reason = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
    return InputError(f"the towers {model!r} cannot be loaded: {reason}. --towers takes a local folder, too")


def _load(model: str) -> tuple[Any, Any]:
    """Load a model and its tokenizer from local files, or else from the hub if it can be reached."""
    try:
        return _from_files(model, local_files_only=True)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        if Path(model).is_dir():
            raise _not_loaded(model, error) from error
    _reach_hub(model)
    try:
        return _from_files(model, local_files_only=False)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise _not_loaded(model, error) from error


def _reach_hub(model: str) -> None:
    """Contact the hub once. The library itself would retry for 20 s.

    Raises:
        InputError: the hub does not answer.
    """
    from huggingface_hub import constants
    from huggingface_hub.utils import get_session

    if constants.is_offline_mode():
        raise _not_loaded(model, OSError("it is not here, and HF_HUB_OFFLINE forbids to look elsewhere"))
    try:
        get_session().head(constants.ENDPOINT, timeout=HUB_ANSWERS_S)
    except Exception as error:  # The type depends on the library's HTTP client
        reason = f"it is not here, and {constants.ENDPOINT} cannot be reached ({error})"
        raise _not_loaded(model, OSError(reason)) from error


def _from_files(model: str, *, local_files_only: bool) -> tuple[Any, Any]:
    from transformers import AutoConfig, AutoModel, AutoTokenizer  # The import takes seconds

    config = AutoConfig.from_pretrained(model, local_files_only=local_files_only)
    if config.model_type not in KINDS:
        raise InputError(f"{model}: a {config.model_type} model; only CLIP and SigLIP models can be towers")
    tokenizer = AutoTokenizer.from_pretrained(model, local_files_only=local_files_only)
    if Path(model).is_dir() and not any(Path(model).glob("*.safetensors")):
        warnings.warn(f"towers start from RANDOM weights: {model} has none", stacklevel=3)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            return AutoModel.from_config(config).eval(), tokenizer
    model_files = AutoModel.from_pretrained(model, use_safetensors=True, local_files_only=local_files_only)
    return model_files.eval(), tokenizer
