"""A process and all its descendants: their memory, open files and threads; the processes of a session."""

import os
from pathlib import Path
from typing import NamedTuple


class TreeUse(NamedTuple):
    """The memory, descriptors, threads and processes of a process and all its descendants."""

    memory_mib: float
    """See `resident_mib`."""
    descriptors: int
    threads: int
    processes: int


def tree_use(root: int) -> TreeUse:
    """Return what a process and all its descendants hold now."""
    family = descendants(root)
    return TreeUse(
        sum(resident_mib(pid) for pid in family),
        sum(_entries(pid, "fd") for pid in family),
        sum(_entries(pid, "task") for pid in family),
        len(family),
    )


def descendants(root: int) -> set[int]:
    """Return a process and all its descendants."""
    parents = {pid: int(fields[1]) for pid, fields in _all_processes().items()}
    family = {root}
    while more := {pid for pid, parent in parents.items() if parent in family} - family:
        family |= more
    return family


def in_session(session: int) -> set[int]:
    """Return the living processes of a session. They may have lost their parent."""
    return {
        pid for pid, fields in _all_processes().items() if int(fields[3]) == session and fields[0] not in "ZX"
    }


def cpu_s(session: int) -> float:
    """Return the CPU time of a session's processes, s, and of those of their children that have ended."""
    spent = (
        sum(map(int, fields[11:15])) for fields in _all_processes().values() if int(fields[3]) == session
    )
    return sum(spent) / os.sysconf("SC_CLK_TCK")


def resident_mib(pid: int) -> float:
    """Return a process's memory without pages of files, swapped out or not, MiB; shared pages count in parts.

    The parts make the sum over processes equal to the machine's use. Workers share the modules of the process
    that they are forked from. A worker that writes to such a page gets its own copy. That is growth, although
    the memory of each single process (RssAnon) does not change.
    """
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    held = {line.split(":")[0]: int(line.split()[1]) for line in lines[1:]}
    return sum(held.get(kind, 0) for kind in ("Pss_Anon", "Pss_Shmem", "SwapPss")) / 1024


def _all_processes() -> dict[int, list[str]]:
    """Return the fields of each process's stat file from its state on: state, parent, group, session, …"""
    found = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            found[int(stat.parent.name)] = stat.read_text().rpartition(")")[2].split()
        except OSError:  # the process has ended
            continue
    return found


def _entries(pid: int, folder: str) -> int:
    try:
        return len(os.listdir(f"/proc/{pid}/{folder}"))
    except OSError:
        return 0
