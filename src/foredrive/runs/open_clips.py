"""Open clips for a model with camera input."""

from collections.abc import Sequence
from pathlib import Path

from foredrive.data import ClipConfig, ClipDataset, LogPath
from foredrive.errors import InputError


def open_clips(logs: Sequence[LogPath], config: ClipConfig, cache_dir: Path) -> ClipDataset:
    """Open clips that have at least one camera; cameras that some of the logs lack are masked.

    Raises:
        InputError: none of the logs has a camera.
    """
    dataset = ClipDataset(logs, config, cache_dir)
    if not dataset.camera_names:
        others = f" and {len(logs) - 1} more logs" if len(logs) > 1 else ""
        raise InputError(f"{logs[0].folder}{others}: no pinhole camera, which agents need")
    return dataset
