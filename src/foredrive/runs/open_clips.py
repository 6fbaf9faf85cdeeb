"""Opening clips for a model that sees by cameras."""

from collections.abc import Sequence
from pathlib import Path

from foredrive.data import ClipConfig, ClipDataset, LogPath
from foredrive.errors import InputError


def open_clips(logs: Sequence[LogPath], config: ClipConfig, cache_dir: Path) -> ClipDataset:
    """Clips that a model can see something in; cameras that some of the logs lack are masked.

    Raises:
        InputError: if none of the logs has a camera.
    """
    dataset = ClipDataset(logs, config, cache_dir)
    if not dataset.camera_names:
        others = f" and {len(logs) - 1} more logs" if len(logs) > 1 else ""
        raise InputError(f"{logs[0].folder}{others}: no pinhole camera, and agents see by cameras alone")
    return dataset
