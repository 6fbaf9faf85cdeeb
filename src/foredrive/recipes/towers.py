"""Towers by name."""

import functools
from pathlib import Path

from foredrive.search.pretrained import PretrainedTowers
from foredrive.search.towers import Towers


@functools.lru_cache(maxsize=1)
def find_towers(name: str) -> Towers:
    """Towers, kept for the next call.

    Args:
        name: of a CLIP or SigLIP model on Hugging Face's hub, or its folder.

    Raises:
        InputError: there are none, or they cannot be loaded.
    """
    return PretrainedTowers(str(Path(name).absolute()) if Path(name).is_dir() else name)
