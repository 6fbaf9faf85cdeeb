"""A small transformer that turns an embedding into a sentence, after ClipCap (Mokady et al. 2021)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

PAD, END = 0, 1
"""Token numbers of the padding after a sentence and of its end. Words follow."""
FIRST_WORD = 2


class CaptionDecoder(nn.Module):
    """A decoder of sentences from a small vocabulary, word by word, given the direction of an embedding.

    Args:
        dim: D of the towers.
        words: the vocabulary.
        longest: T, number of words of the longest sentence, including its end.
        prefix: number of tokens made from an embedding.
        width, heads, layers: sizes of the transformer.
    """

    def __init__(
        self,
        dim: int,
        words: Sequence[str],
        longest: int,
        *,
        prefix: int = 4,
        width: int = 128,
        heads: int = 4,
        layers: int = 3,
    ) -> None:
        super().__init__()
        self.words, self.longest, self.prefix = tuple(words), longest, prefix
        self.to_prefix = nn.Linear(dim, prefix * width)
        self.embed = nn.Embedding(FIRST_WORD + len(self.words), width)
        self.place = nn.Parameter(0.02 * torch.randn(prefix + longest, width))
        layer = nn.TransformerEncoderLayer(
            width, heads, 4 * width, dropout=0.1, activation="gelu", batch_first=True, norm_first=True
        )
        self.layers = nn.TransformerEncoder(layer, layers, nn.LayerNorm(width), enable_nested_tensor=False)
        self.out = nn.Linear(width, FIRST_WORD + len(self.words))

    def forward(
        self, embedding: Float[Tensor, "n D"], said: Int[Tensor, "n S"]
    ) -> Float[Tensor, "n S_plus_1 V"]:
        """Return the logits of each next word given S words; the first ones are given no word.

        Embeddings have length 1.
        """
        # The embedding becomes the first tokens of the sequence
        before = self.to_prefix(embedding).unflatten(1, (self.prefix, -1))
        tokens = torch.cat([before, self.embed(said)], dim=1)
        length = tokens.shape[1]
        mask = nn.Transformer.generate_square_subsequent_mask(length, tokens.device)
        # Causal mask: a token attends to itself and to those before it
        seen = self.layers(tokens + self.place[:length], mask=mask, is_causal=True)
        # The last token of the prefix predicts the first word
        return self.out(seen[:, self.prefix - 1 :])

    @torch.no_grad()
    def say(self, embedding: Float[Tensor, "n D"]) -> list[str]:
        """Return a sentence for each embedding of length 1, by greedy decoding."""
        said = torch.zeros(len(embedding), 0, dtype=torch.int64, device=embedding.device)
        # The sentence grows by its most probable next word
        for _ in range(self.longest):
            said = torch.cat([said, self(embedding, said)[:, -1:].argmax(-1)], dim=1)
        return [self._sentence(row) for row in said.tolist()]

    def numbers(self, sentence: str) -> list[int]:
        """Return the token numbers of a sentence, followed by its end.

        Raises:
            KeyError: a word is not in the vocabulary.
        """
        number = {word: n for n, word in enumerate(self.words, FIRST_WORD)}
        return [*(number[word] for word in sentence.split()), END]

    def _sentence(self, numbers: Sequence[int]) -> str:
        spoken = numbers[: numbers.index(END)] if END in numbers else numbers
        return " ".join(self.words[number - FIRST_WORD] for number in spoken if number >= FIRST_WORD)
