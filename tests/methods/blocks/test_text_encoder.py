"""Text encoders: by local folder, whatever their kind, and the one that comes as a package."""

from pathlib import Path

import pytest
import torch
from transformers import BertConfig, BertModel, BertTokenizerFast, CLIPConfig, CLIPModel

from foredrive.errors import InputError
from foredrive.methods.blocks.text_encoder import PACKAGED_MODEL, TextEncoder

WORDS = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "the", "car", "stops", "at", "night", "rain"]
SMALL = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}


def save_tokenizer(folder: Path) -> None:
    folder.mkdir()
    (folder / "vocab.txt").write_text("\n".join(WORDS))
    BertTokenizerFast(str(folder / "vocab.txt")).save_pretrained(folder)


def test_a_bert_is_averaged_over_its_tokens(tmp_path: Path) -> None:
    folder = tmp_path / "bert"
    save_tokenizer(folder)
    torch.manual_seed(0)
    bert = BertModel(BertConfig(vocab_size=len(WORDS), **SMALL)).eval()
    bert.save_pretrained(folder)
    encoded = TextEncoder(str(folder))(["the car stops", "rain"])
    assert encoded.shape == (2, 16)
    torch.testing.assert_close(encoded.norm(dim=-1), torch.ones(2))
    tokens = torch.tensor([[WORDS.index(word) for word in ("[CLS]", "rain", "[SEP]")]])
    with torch.no_grad():
        alone = bert(tokens).last_hidden_state.mean(dim=1)  # the padding of a batch changes nothing
    torch.testing.assert_close(encoded[1:], torch.nn.functional.normalize(alone, dim=-1), atol=1e-5, rtol=0)


def test_a_clip_says_itself_what_a_sentence_is(tmp_path: Path) -> None:
    folder = tmp_path / "clip"
    save_tokenizer(folder)
    torch.manual_seed(0)
    text = {**SMALL, "vocab_size": len(WORDS), "eos_token_id": 3, "bos_token_id": 2, "pad_token_id": 0}
    vision = {**SMALL, "image_size": 16, "patch_size": 8}
    model = CLIPModel(CLIPConfig(text_config=text, vision_config=vision, projection_dim=8)).eval()
    model.save_pretrained(folder)
    encoded = TextEncoder(str(folder))(["the car stops", "rain"])
    assert encoded.shape == (2, 8)
    assert not torch.allclose(encoded[0], encoded[1])


def test_what_cannot_be_had_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be loaded"):
        TextEncoder(str(tmp_path))(["rain"])


def test_the_packaged_one_knows_what_sentences_mean(capfd: pytest.CaptureFixture[str]) -> None:
    rain, wet, car = TextEncoder(PACKAGED_MODEL)(["It is raining.", "The weather is wet.", "A red car."])
    assert float(rain @ wet) > 0.5 > float(rain @ car)
    assert capfd.readouterr().err == ""  # no progress bar of a library
