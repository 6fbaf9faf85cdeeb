"""Load towers by name."""

import functools
from collections.abc import Iterable
from pathlib import Path

from foredrive.search.embedded import CARD, SHIPPED, dataset_of, load_towers, read_card
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
    folder = _folder_of(name)
    if (folder / CARD).is_file():
        return load_towers(folder)
    return PretrainedTowers(str(folder) if folder.is_dir() else name)


def unseen_text(name: str, lidar: bool, logs: Iterable[str]) -> str | None:
    """Return one line about data sets of logs that towers were not trained on; None if there are none.

    Args:
        name: as for `find_towers`.
        lidar: whether the lidar tower is asked; it may be trained beside the image tower of another program,
            about whose training nothing is known here.
        logs: names of logs, with their splits.
    """
    folder = _folder_of(name)
    if not (folder / CARD).is_file():
        return None
    card = read_card(folder)
    if not card.datasets or (card.image is None and not lidar):
        return None
    unseen = sorted({*map(dataset_of, logs)} - card.datasets)
    if not unseen:
        return None
    learned = ", ".join(sorted(card.datasets))
    return f"the towers never saw data of {', '.join(unseen)}: they learned from {learned}"


def _folder_of(name: str) -> Path:
    return SHIPPED if name == EMBEDDED else Path(name).absolute()
