"""123D logs: reading, voxel labels, datasets of clips, writing."""

from typing import TYPE_CHECKING

from foredrive.lazy import defer_imports, defer_package, on_demand

if TYPE_CHECKING:
    from foredrive.data.batches import collate
    from foredrive.data.camera_streams import CameraSpec
    from foredrive.data.clip_config import ClipConfig
    from foredrive.data.clips import ClipDataset
    from foredrive.data.log_paths import LogPath, find_all_logs, find_logs, find_one_log
    from foredrive.data.own_logs import Box, Points, Vehicle, write_log

__all__ = [
    "Box",
    "CameraSpec",
    "ClipConfig",
    "ClipDataset",
    "LogPath",
    "Points",
    "Vehicle",
    "collate",
    "find_all_logs",
    "find_logs",
    "find_one_log",
    "write_log",
]

__getattr__ = on_demand(
    __name__,
    {
        "batches": ("collate",),
        "camera_streams": ("CameraSpec",),
        "clip_config": ("ClipConfig",),
        "clips": ("ClipDataset",),
        "log_paths": ("LogPath", "find_all_logs", "find_logs", "find_one_log"),
        "own_logs": ("Box", "Points", "Vehicle", "write_log"),
    },
)

# py123d.api imports its executors, and Ray with them, only for type annotations. This takes most of its
# import time and memory, so it is deferred
defer_imports(
    "py123d.common.execution",
    {
        "executor": ("Executor", "ExecutorResources", "Task"),
        "process_pool_executor": ("ProcessPoolExecutor",),
        "ray_executor": ("RayExecutor",),
        "sequential_executor": ("SequentialExecutor",),
        "thread_pool_executor": ("ThreadPoolExecutor",),
        "utils": (
            "chunk_list",
            "executor_map_chunked_list",
            "executor_map_chunked_single",
            "executor_map_queued",
        ),
    },
)
# py123d needs these for single formats only: written maps, raw AV2 and PandaSet logs, LAZ files
for _package in ("pandas", "geopandas", "laspy"):
    defer_package(_package)
