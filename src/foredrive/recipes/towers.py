"""Towers by name."""

import functools
from importlib.resources import files
from pathlib import Path

from foredrive.search.embedded import CARD, load_towers
from foredrive.search.pretrained import PretrainedTowers
from foredrive.search.towers import Towers

EMBEDDED = "embedded"
"""The pair of towers that comes with the package (docs/search.md has its figures)."""
SHIPPED = Path(str(files("foredrive.search"))) / "shipped"


@functools.lru_cache(maxsize=1)
def find_towers(name: str) -> Towers:
    """Towers, kept for the next call.

    Args:
        name: `EMBEDDED`; that of a CLIP or SigLIP model on Hugging Face's hub, or its folder; or a folder of
            towers that were trained here.

    Raises:
        InputError: there are none, or they cannot be loaded.
    """
    if name == EMBEDDED:
        return load_towers(SHIPPED, name)
    folder = Path(name).absolute()
    if (folder / CARD).is_file():
        return load_towers(folder)
    return PretrainedTowers(str(folder) if folder.is_dir() else name)
