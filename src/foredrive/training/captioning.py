"""Teaching a decoder to say what an embedding shows, from images' embeddings alone."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from foredrive.models.caption_decoder import PAD, CaptionDecoder
from foredrive.scene.record import Record

NOISE = 0.4
"""Length of the noise on embeddings of length 1, about that of what parts a sweep's from its image's: with it
a decoder of images reads sweeps (as CapDec's reads images, Nukrai et al. 2022)."""


@dataclass(frozen=True)
class CaptionedEmbeddings(Record):
    """Unit embeddings of views' images, as they are and mirrored, and a sentence that is true of each."""

    embedding: Float[Tensor, "*n 2 D"]
    words: Int[Tensor, "*n S"]
    """Numbers of `CaptionDecoder`, `PAD` behind the end."""
    key: tuple[str, ...]


class CaptionObjective(nn.Module):
    """Cross-entropy of each next word."""

    def __init__(self, decoder: CaptionDecoder) -> None:
        super().__init__()
        self.decoder = decoder

    def forward(self, batch: CaptionedEmbeddings, generator: torch.Generator) -> dict[str, Tensor]:
        """Of either image, with noise; "hits" is the share of words that come first."""
        rows = len(batch.words)
        drawn = torch.randint(2, (rows,), generator=generator).to(batch.words.device)
        given = batch.embedding[torch.arange(rows, device=drawn.device), drawn]
        noise = torch.randn(given.shape, generator=generator).to(given.device) / math.sqrt(given.shape[1])
        logits = self.decoder(F.normalize(given + NOISE * noise, dim=-1), batch.words[:, :-1])
        there = batch.words != PAD
        return {
            "loss": F.cross_entropy(logits[there], batch.words[there]),
            "hits": (logits.argmax(-1) == batch.words)[there].float().mean(),
        }
