"""Towers by name."""

import functools
from pathlib import Path

import foredrive.search
from foredrive.search.embedded import CARD, load_towers
from foredrive.search.pretrained import PretrainedTowers
from foredrive.search.towers import Towers

EMBEDDED = "embedded"
"""The towers that come with the package."""
SHIPPED = Path(foredrive.search.__file__).parent / "shipped"


@functools.lru_cache(maxsize=1)
def find_towers(name: str) -> Towers:
    """Towers, kept for the next call.

    Args:
        name: `EMBEDDED`, or of a CLIP or SigLIP model on Hugging Face's hub, or its folder, or a folder of
            towers that were trained here.

    Raises:
        InputError: there are none, or they cannot be loaded.
    """
    folder = SHIPPED if name == EMBEDDED else Path(name).absolute()
    if (folder / CARD).is_file():
        return load_towers(folder)
    return PretrainedTowers(str(folder) if folder.is_dir() else name)
