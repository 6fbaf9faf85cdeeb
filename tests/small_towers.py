"""Towers of hardly any width: a CLIP and a SigLIP on disk, and plain ones that say what they see."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from transformers import BertTokenizerFast, CLIPConfig, CLIPModel, SiglipConfig, SiglipModel

from foredrive.scene import LidarSweep
from foredrive.search.crops import Crop

WORDS = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "a", "photo", "of", "car", "night", "rain", "crossing", "the"]
SMALL = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
VISION = {**SMALL, "image_size": 16, "patch_size": 8}


class PlainTowers:
    """Mean colour of an image, mean place of a sweep and which words a text has, all in four numbers."""

    name, fingerprint, dim, image_side_px = "plain", "plain-1", 4, 12
    crop, has_lidar = Crop.WHOLE, True

    def embed_images(self, images: Tensor) -> Tensor:
        return torch.cat([images.float().mean((-2, -1)) / 255, torch.full((len(images), 1), 0.1)], dim=-1)

    def embed_sweeps(self, sweeps: LidarSweep) -> Tensor | None:
        share = sweeps.valid.float() / sweeps.valid.sum(-1, keepdim=True).clamp(min=1)
        middle = (sweeps.points_ego * share[..., None]).sum(-2) / 20
        return torch.cat([middle, torch.full((len(middle), 1), 0.1)], dim=-1)

    def embed_text(self, texts: Sequence[str]) -> Tensor:
        words = ("red", "green", "blue", "thing")
        return torch.tensor([[float(word in text) + 0.01 for word in words] for text in texts])


def save_clip(folder: Path) -> Path:
    """Write a CLIP with its tokenizer, the same every time."""
    save_tokenizer(folder)
    torch.manual_seed(0)
    text = {**SMALL, "vocab_size": len(WORDS), "eos_token_id": 3, "bos_token_id": 2, "pad_token_id": 0}
    CLIPModel(CLIPConfig(text_config=text, vision_config=VISION, projection_dim=12)).save_pretrained(folder)
    return folder


def save_siglip(folder: Path) -> Path:
    """Write a SigLIP with its tokenizer, the same every time."""
    save_tokenizer(folder)
    torch.manual_seed(0)
    text = {**SMALL, "vocab_size": len(WORDS), "max_position_embeddings": 16, "pad_token_id": 0}
    SiglipModel(SiglipConfig(text_config=text, vision_config=VISION)).save_pretrained(folder)
    return folder


def save_tokenizer(folder: Path) -> None:
    """Write a BERT tokenizer of `WORDS`."""
    folder.mkdir()
    (folder / "vocab.txt").write_text("\n".join(WORDS))
    BertTokenizerFast(str(folder / "vocab.txt")).save_pretrained(folder)
