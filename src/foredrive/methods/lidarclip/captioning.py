"""Training of a caption decoder from image embeddings only."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from foredrive.methods.lidarclip.caption_decoder import PAD, CaptionDecoder
from foredrive.scene.record import Record

NOISE = 0.4
"""Length of the noise on embeddings of length 1, about the distance between the embeddings of a sweep and its
image. With it a decoder trained on images can read sweeps (as CapDec's decoder, trained on texts, reads
images; Nukrai et al. 2022)."""


@dataclass(frozen=True)
class CaptionedEmbeddings(Record):
    """Unit embeddings of views' images, original and mirrored, and a true sentence for each."""

    embedding: Float[Tensor, "*n 2 D"]
    words: Int[Tensor, "*n S"]
    """Token numbers of `CaptionDecoder`, with `PAD` after the end."""
    key: tuple[str, ...]


class CaptionObjective(nn.Module):
    """Cross-entropy of each next word."""

    def __init__(self, decoder: CaptionDecoder) -> None:
        super().__init__()
        self.decoder = decoder

    def forward(self, batch: CaptionedEmbeddings, generator: torch.Generator) -> dict[str, Tensor]:
        """Return losses for one of the two images, drawn, with noise. "hits" is the top-1 accuracy."""
        rows = len(batch.words)
        drawn = torch.randint(2, (rows,), generator=generator).to(batch.words.device)
        image = batch.embedding[torch.arange(rows, device=drawn.device), drawn]
        # Expected length 1 after the division, so NOISE is the length of the noise
        noise = torch.randn(image.shape, generator=generator).to(image.device) / math.sqrt(image.shape[1])
        logits = self.decoder(F.normalize(image + NOISE * noise, dim=-1), batch.words[:, :-1])
        # Padding has no loss; the end of the sentence has one
        valid = batch.words != PAD
        return {
            "loss": F.cross_entropy(logits[valid], batch.words[valid]),
            "hits": (logits.argmax(-1) == batch.words)[valid].float().mean(),
        }
