"""Settings of the process' memory."""

import ctypes
import os

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's `mallopt`."""
KEPT_BYTES = 1 << 30


def keep_freed_memory() -> None:
    """Let the C library keep freed memory for the next tensors, and PyTorch use large pages.

    By default glibc gives freed blocks of megabytes back to the system at once. Each step of a training then
    faults in hundreds of megabytes page by page, which takes a sixth of a training step of `nemo_town`. The
    memory at its peak stays the same. Other C libraries are left as they are.
    """
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # PyTorch reads it before its first tensor
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not glibc
        return
    mallopt(M_MMAP_THRESHOLD, KEPT_BYTES)
    mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
