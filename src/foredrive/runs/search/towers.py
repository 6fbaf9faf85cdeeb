"""Load towers by name."""

import functools
from pathlib import Path

from foredrive.search.embedded import CARD, SHIPPED, load_towers
from foredrive.search.pretrained import PretrainedTowers
from foredrive.search.towers import Towers

EMBEDDED = "embedded"
"""Name of the towers that come with the package."""


@functools.lru_cache(maxsize=1)
def find_towers(name: str) -> Towers:
    """Load towers, and keep them in memory for the next call.

    Args:
        name: `EMBEDDED`; a CLIP or SigLIP model's name on the Hugging Face hub, or its folder; or a folder of
            towers that `train_towers` made.

    Raises:
        InputError: there are no such towers, or they cannot be loaded.
    """
    folder = SHIPPED if name == EMBEDDED else Path(name).absolute()
    if (folder / CARD).is_file():
        return load_towers(folder)
    return PretrainedTowers(str(folder) if folder.is_dir() else name)
