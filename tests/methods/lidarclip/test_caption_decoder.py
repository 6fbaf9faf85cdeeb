"""A decoder that says sentences of embeddings: what it learns, and what it looks at."""

import pytest
import torch
import torch.nn.functional as F

from foredrive.methods.lidarclip.caption_decoder import END, FIRST_WORD, PAD, CaptionDecoder
from foredrive.methods.lidarclip.captioning import CaptionedEmbeddings, CaptionObjective

WORDS = ("a", "car", "in", "night", "rain", "the")


def small() -> CaptionDecoder:
    torch.manual_seed(0)
    return CaptionDecoder(4, WORDS, longest=6, prefix=2, width=16, heads=2, layers=1)


def test_it_says_what_it_has_learned() -> None:
    decoder = small()
    sentences = ["a car in the rain", "night", "the rain"]
    numbers = [decoder.numbers(sentence) for sentence in sentences]
    words = torch.tensor([row + [PAD] * (6 - len(row)) for row in numbers])
    embedding = F.normalize(torch.eye(3, 4), dim=-1)[:, None].expand(-1, 2, -1)
    batch = CaptionedEmbeddings(embedding, words, ("a", "b", "c"))
    objective, generator = CaptionObjective(decoder), torch.Generator().manual_seed(0)
    optimizer = torch.optim.AdamW(decoder.parameters(), lr=1e-2)
    for _ in range(100):
        optimizer.zero_grad()
        objective(batch, generator)["loss"].backward()
        optimizer.step()
    assert decoder.eval().say(embedding[:, 0]) == sentences


def test_a_next_word_depends_on_those_before_it_alone() -> None:
    decoder = small().eval()
    embedding = F.normalize(torch.randn(2, 4), dim=-1)
    said = torch.randint(FIRST_WORD, FIRST_WORD + len(WORDS), (2, 4))
    other = said.clone()
    other[:, 2:] = torch.where(said[:, 2:] == FIRST_WORD, FIRST_WORD + 1, FIRST_WORD)
    logits, changed = decoder(embedding, said), decoder(embedding, other)
    torch.testing.assert_close(changed[:, :3], logits[:, :3], atol=1e-6, rtol=1e-5)
    assert not torch.allclose(changed[:, 3], logits[:, 3], atol=1e-3)
    assert not torch.allclose(decoder(-embedding, said)[:, 0], logits[:, 0], atol=1e-3)


def test_a_sentence_ends_at_its_end() -> None:
    decoder = small()
    assert decoder.numbers("rain in a") == [FIRST_WORD + 4, FIRST_WORD + 2, FIRST_WORD, END]
    assert decoder._sentence([FIRST_WORD + 3, PAD, END, FIRST_WORD]) == "night"
    with pytest.raises(KeyError, match="snow"):
        decoder.numbers("snow")


def test_what_stands_behind_a_sentence_teaches_nothing() -> None:
    decoder = small().eval()
    short = torch.tensor([[FIRST_WORD, END]])
    padded = F.pad(short, (0, 3), value=PAD)
    embedding = F.normalize(torch.randn(1, 2, 4), dim=-1)
    objective = CaptionObjective(decoder)
    losses = [
        objective(CaptionedEmbeddings(embedding, words, ("a",)), torch.Generator().manual_seed(0))["loss"]
        for words in (short, padded)
    ]
    torch.testing.assert_close(*losses)
