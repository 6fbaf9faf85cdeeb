"""Kill a command at random moments, start it again, and compare the end with that of an undisturbed run.

A moment is drawn from the CPU time that the undisturbed command takes, so that it does not depend on what
else the machine does. The process is killed alone (SIGKILL), as the kernel does for want of memory: its
workers are not.

Equal means equal bytes, but for what cannot be. Fields of time and memory (`MEASURED`) are left out of
JSON and of metrics.jsonl. Reports (HTML), which show them, have to be there and whole. A LanceDB table,
whose files have random names, has to have equal rows. Lock files are not compared.
"""

import hashlib
import json
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors

from benchmarks.common.process_tree import cpu_s, in_session
from benchmarks.common.program_server import ProgramServer

MEASURED = {
    *("wall_s", "act_s", "plan_ms", "step_s", "cpu_s", "computing_s"),
    *("minutes", "computing_minutes", "peak_memory_gib", "peak_rss_gib"),
    *("camera_mp_per_s", "lidar_mrays_per_s"),
}
"""Fields that differ between any two runs."""
PATIENCE_S = 900.0
ORPHANS_S = 15.0
"""Time for workers whose parent was killed to remove their files and end; they are given ten seconds."""
LOOK_S = 0.1
"""Looking at all processes takes CPU time too."""
LOCKS = (".lock", ".results.lock")


@dataclass(frozen=True)
class Command:
    """A command that is killed."""

    name: str
    arguments: tuple[str, ...]
    out: Path
    """Everything that it writes."""


@dataclass
class Found:
    """Counts over all kills of a command; all but the first two should be 0."""

    kills: int = 0
    runs: int = 0
    """Number of runs that were compared at their end, each killed once or more often."""
    lost: int = 0
    """Files that are missing at the end, are too many, or differ."""
    half_written: int = 0
    """Files under a final name, after a kill, that are neither whole nor growing line by line."""
    scratch_left: int = 0
    """Scratch and temporary files at the end."""
    orphans: int = 0
    """Worker processes that live on after their parent was killed."""
    files: int = 0
    """Files compared, over all runs."""


def kill_and_compare(
    command: Command,
    server: ProgramServer,
    temporary: Path,
    *,
    kills: int,
    kills_a_run: int,
    seed: int,
    say: Callable[[str], None] = print,
) -> Found:
    """Kill a command `kills` times, at most `kills_a_run` times before it may end; return what was found.

    Args:
        temporary: the folder for temporary files of the server's programs.
        say: called with one line for each difference.

    Raises:
        RuntimeError: the command fails, killed before or not.
    """
    draw, found = random.Random(f"{command.name} {seed}"), Found()
    _clear(command.out)
    takes_s = _finish(command, server)
    _clear(command.out)
    takes_s = min(takes_s, _finish(command, server))  # the first has also filled caches of the package
    reference = contents(command.out)
    while found.kills < kills:
        _clear(command.out)
        killed = 0
        for _ in range(min(kills_a_run, kills - found.kills)):
            if _kill(command, server, draw.uniform(0, takes_s), found):
                killed += 1
                _judge_killed(command, reference, found, say)
        if killed:
            _finish(command, server)
            found.runs += 1
            _judge_end(command, reference, temporary, found, say)
    return found


def _clear(out: Path) -> None:
    shutil.rmtree(out, ignore_errors=True)


def _finish(command: Command, server: ProgramServer) -> float:
    """Run the command to its end; return its CPU time, s, of all its processes."""
    process, spent_s = server.start(*command.arguments), 0.0
    until_s = time.monotonic() + PATIENCE_S
    while server.is_running() and time.monotonic() < until_s:
        spent_s = max(spent_s, cpu_s(process))
        time.sleep(LOOK_S)
    code, said = server.finish(PATIENCE_S)
    if code != 0:
        raise RuntimeError(f"{' '.join(command.arguments)} ended with {code}: {said[-3000:]}")
    return spent_s


def _kill(command: Command, server: ProgramServer, after_s: float, found: Found) -> bool:
    """Kill the command after this CPU time; return False if it has ended before."""
    process = server.start(*command.arguments)
    while cpu_s(process) < after_s:
        if not server.is_running():
            code, said = server.finish(PATIENCE_S)
            if code != 0:
                raise RuntimeError(f"{' '.join(command.arguments)} ended with {code}: {said[-3000:]}")
            return False
        time.sleep(LOOK_S)
    os.kill(process, signal.SIGKILL)
    code, _ = server.finish(PATIENCE_S)
    until_s = time.monotonic() + ORPHANS_S
    while (left := in_session(process)) and time.monotonic() < until_s:
        time.sleep(LOOK_S)
    found.orphans += len(left)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    found.kills += code == -signal.SIGKILL
    return code == -signal.SIGKILL


def _judge_killed(
    command: Command, reference: dict[str, str], found: Found, say: Callable[[str], None]
) -> None:
    """Count half-written files under final names."""
    for name, digest in contents(command.out).items():
        if ".part/" not in name and reference.get(name) != digest and not _grows(command.out / name, say):
            say(f"{command.name}: {name} is half-written")
            found.half_written += 1


def _grows(file: Path, say: Callable[[str], None]) -> bool:
    """Return whether a file that is not the final one yet is whole: metrics, checkpoints and tables."""
    if file.suffix == ".lance":
        return True
    try:
        if file.name == "metrics.jsonl":
            for line in file.read_text().splitlines()[:-1]:
                json.loads(line)
        elif file.suffix == ".safetensors":
            with safetensors.safe_open(file, "pt") as opened:
                opened.keys()
        elif file.name == "progress.json":
            json.loads(file.read_text())
        else:
            return False
    except (ValueError, safetensors.SafetensorError) as error:
        say(f"{file}: {error}")
        return False
    return True


def _judge_end(
    command: Command, reference: dict[str, str], temporary: Path, found: Found, say: Callable[[str], None]
) -> None:
    there = contents(command.out)
    differ = sorted(
        name for name in reference.keys() | there.keys() if reference.get(name) != there.get(name)
    )
    for name in differ:
        say(f"{command.name}: {name} is {'missing' if name not in there else 'not as it should be'}")
    scratch = [path for path in command.out.rglob("*") if path.name.endswith(".part")]
    scratch += left_temporary(temporary)
    for path in scratch:
        say(f"{command.name}: {path} is left")
    found.files += len(reference)
    found.lost += len(differ)
    found.scratch_left += len(scratch)


def left_temporary(folder: Path) -> list[Path]:
    """Return files, sockets and the folders of sockets. PyTorch keeps an empty folder for its compiler."""
    return [path for path in folder.rglob("*") if not path.is_dir() or path.name.startswith("pymp-")]


def contents(folder: Path) -> dict[str, str]:
    """Return a digest of each file of a folder, and of each table, by its path in it."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        inside_table = any(parent.suffix == ".lance" for parent in path.parents)
        if path.name in LOCKS or inside_table:
            continue
        if path.suffix == ".lance":
            found[name] = _digest(_rows(path))
        elif path.is_file():
            found[name] = _digest(_comparable(path))
    return found


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _comparable(file: Path) -> bytes:
    content = file.read_bytes()
    try:
        if file.suffix == ".json":
            return json.dumps(_unmeasured(json.loads(content))).encode()
        if file.suffix == ".jsonl":
            lines = [_unmeasured(json.loads(line)) for line in content.splitlines()]
            return json.dumps(lines).encode()
    except ValueError:
        return content
    if file.suffix == ".html":
        return content.rstrip()[-7:]
    return content


def _unmeasured(value: Any) -> Any:
    """Return JSON without the fields of time and memory."""
    if isinstance(value, dict):
        return {key: _unmeasured(entry) for key, entry in value.items() if key not in MEASURED}
    return [_unmeasured(entry) for entry in value] if isinstance(value, list) else value


def _rows(table: Path) -> bytes:
    """Return the rows of a LanceDB table in an order of their own; nothing if it is not a table yet."""
    import lancedb

    try:
        rows = lancedb.connect(table.parent).open_table(table.stem).to_arrow().to_pylist()
    except ValueError:
        return b""
    return "\n".join(sorted(map(repr, rows))).encode()
