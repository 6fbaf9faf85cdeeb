"""123D logs to clips and back: reading, labels, datasets, writing."""

from typing import TYPE_CHECKING

from foredrive.lazy import defer_imports, on_demand

if TYPE_CHECKING:
    from foredrive.data.batches import collate
    from foredrive.data.clips import ClipConfig, ClipDataset
    from foredrive.data.log_paths import LogPath, find_all_logs, find_logs, find_one_log

__all__ = ["ClipConfig", "ClipDataset", "LogPath", "collate", "find_all_logs", "find_logs", "find_one_log"]

__getattr__ = on_demand(
    __name__,
    {
        "batches": ("collate",),
        "clips": ("ClipConfig", "ClipDataset"),
        "log_paths": ("LogPath", "find_all_logs", "find_logs", "find_one_log"),
    },
)

# py123d.api imports its executors for their types alone, and Ray with them: most of its time and memory.
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
