import platform
import subprocess
import sys

import pytest

COUNT_FAULTS = """
import ctypes
import resource
ctypes.CDLL(None).prctl(41, 1, 0, 0, 0)  # PR_SET_THP_DISABLE: the kernel's huge pages hide most of the faults
import torch
from foredrive.cli.main import keep_freed_memory
if {kept}:
    keep_freed_memory()
for _ in range(3):
    torch.ones(10 << 20)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    torch.ones(10 << 20)  # 40 MB: above the sizes that glibc learns to keep
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(kept: bool) -> int:
    done = subprocess.run(
        [sys.executable, "-c", COUNT_FAULTS.format(kept=kept)], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc alone")
def test_freed_memory_is_used_again() -> None:
    """Twenty arrays of 40 MB, one after another, need the memory of one, or of two on a heap with a gap."""
    assert page_faults(kept=True) < page_faults(kept=False) / 8
