"""123D logs to clips and back: reading, labels, datasets, writing."""

from foredrive.data.clips import ClipConfig, ClipDataset
from foredrive.data.collate import collate
from foredrive.data.logs import LogPath, find_logs

__all__ = ["ClipConfig", "ClipDataset", "LogPath", "collate", "find_logs"]
