"""The program `foredrive`: its verbs, and the messages when a verb cannot continue."""

import ctypes
import errno
import inspect
import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import tyro

import foredrive
from foredrive.cli.arguments import rank
from foredrive.cli.bench import bench
from foredrive.cli.check import check
from foredrive.cli.compare import compare
from foredrive.cli.convert import convert
from foredrive.cli.demo import demo
from foredrive.cli.drive import drive
from foredrive.cli.evaluate import evaluate
from foredrive.cli.export import export, export_mcap, export_ncore, export_nuscenes, export_rerun
from foredrive.cli.fetch import fetch_av2
from foredrive.cli.imagine import imagine
from foredrive.cli.improve import improve
from foredrive.cli.ncap import ncap
from foredrive.cli.pseudo import pseudo
from foredrive.cli.recipes import models, recipes
from foredrive.cli.reconstruct import reconstruct
from foredrive.cli.record import record
from foredrive.cli.render import render
from foredrive.cli.score import score
from foredrive.cli.search import search, search_page
from foredrive.cli.search_caption import search_caption, search_train_captions
from foredrive.cli.search_evaluate import search_evaluate
from foredrive.cli.search_index import search_index, search_train
from foredrive.cli.serve import serve
from foredrive.cli.train import train
from foredrive.cli.trust import trust
from foredrive.cli.view import view
from foredrive.debugging import debugging, is_verbose, take_debugging
from foredrive.devices import take_device
from foredrive.errors import InputError
from foredrive.files import WHILE_WRITING
from foredrive.interrupts import LastingInterrupt

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's `mallopt`."""
KEPT_BYTES = 1 << 30


def keep_freed_memory() -> None:
    """Let the C library keep freed memory for the next tensors, and PyTorch use large pages.

    By default glibc returns freed blocks of megabytes to the system at once. Each step of a training then
    faults in hundreds of megabytes page by page, which takes a sixth of a training step of `nemo_town`. The
    peak memory stays the same. Other C libraries are left as they are.
    """
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # PyTorch reads it before its first tensor
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # Not glibc
        return
    mallopt(M_MMAP_THRESHOLD, KEPT_BYTES)
    mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)


VERBS: dict[str, Callable[..., Any]] = {
    "demo": demo,
    "record": record,
    "fetch av2": fetch_av2,
    "convert": convert,
    "check": check,
    "recipes": recipes,
    "models": models,
    "train": train,
    "evaluate": evaluate,
    "drive": drive,
    "compare": compare,
    "improve": improve,
    "ncap": ncap,
    "pseudo": pseudo,
    "serve": serve,
    "score": score,
    "search": search,
    "search index": search_index,
    "search page": search_page,
    "search train": search_train,
    "search caption": search_caption,
    "search train-captions": search_train_captions,
    "search evaluate": search_evaluate,
    "reconstruct": reconstruct,
    "render": render,
    "trust": trust,
    "imagine": imagine,
    "export": export,
    "export mcap": export_mcap,
    "export ncore": export_ncore,
    "export nuscenes": export_nuscenes,
    "export rerun": export_rerun,
    "view": view,
    "bench": bench,
}
SERVERS = ("view", "serve", "search page")
"""Verbs that send large messages from many threads for hours: memory kept by each thread would add up."""
DESCRIPTION = (
    "The learning loop of autonomous driving: logs in, 3-D world models and plans out, judged honestly. "
    "--version says which version this is. With every verb, --verbose logs what is done and shows where "
    "errors come from, --profile FILE.json.gz records a trace that ui.perfetto.dev opens, and --device cpu "
    "or cuda:1 says where it computes; by default on a GPU, if there is one."
)
# OpenMP threads spin while they wait, which would take the cores from kernels and data workers
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# DDP warns in each process when it has searched for unused parameters in vain
if rank() is not None:
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")

EXIT_INPUT, EXIT_INTERRUPTED, EXIT_PIPE = 2, 130, 141
DISK_ERRORS = {
    errno.ENOSPC: "no space left on the disk",
    errno.EDQUOT: "disk quota exceeded",
    errno.EFBIG: "larger than files may be here",
    errno.EROFS: "the disk is read-only",
    errno.EACCES: "permission denied",
    errno.EPERM: "nothing can be written there",
    errno.EEXIST: "there is a file of that name",
    errno.ENOTDIR: "a part of this path is a file",
    errno.EISDIR: "there is a folder of that name",
    errno.ENAMETOOLONG: "this name is too long",
    errno.ELOOP: "its symbolic links lead in a circle",
}
ERROR_NUMBER = re.compile(r"\[Errno (\d+)\]|\(os error (\d+)\)")
"""Matches the number of an operating system's error in a message of Python or Rust."""
ASKED_MEMORY = re.compile(r"can't allocate memory: you tried to allocate (\d+) bytes")
"""Matches the size in PyTorch's error, which is a RuntimeError."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one verb; return the exit code.

    Bad input and full disks print one line on stderr and return 2; Ctrl-C prints one line and returns 130.
    Any other error is an error of the program, and its traceback is shown. Errors of the command line itself
    end in SystemExit(2), `--help` and nothing at all end in SystemExit(0).
    """
    args = (sys.argv[1:] if args is None else list(args)) or ["--help"]
    if args == ["--version"]:
        print(f"foredrive {foredrive.__version__}")
        return 0
    interrupt = LastingInterrupt()
    for verb in VERBS.values():
        verb.__doc__ = _reflowed(verb.__doc__ or "")
    try:
        _check_flags(args)
        args = take_device(take_debugging(args))
        if " ".join(args[:2]) in VERBS:  # A verb of two words, such as `search index`
            args = [" ".join(args[:2]), *args[2:]]
        if not args or args[0] not in SERVERS:
            keep_freed_memory()
        with interrupt, debugging():
            tyro.extras.subcommand_cli_from_dict(VERBS, prog="foredrive", description=DESCRIPTION, args=args)
    except InputError as error:
        return _give_up(_last_words(error))
    except BrokenPipeError:  # The reader of the output, such as `head`, has ended
        # Python flushes stdout at its exit, which must not fail again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_PIPE
    except KeyboardInterrupt:
        return _end_interrupted()
    except Exception as error:
        if interrupt.pressed:  # The interrupted code has turned the interrupt into another error
            return _end_interrupted()
        reason = _disk_reason(error) or _memory_reason(error)
        if reason is None:
            raise
        return _give_up(reason)
    return 0


def _reflowed(docstring: str) -> str:
    """Return a docstring with each paragraph and each argument in one line.

    The parser of the command line would keep most of the line breaks in its help.
    """
    # Arguments continue at an indent of 8. tyro joins lines of a paragraph, unless a line begins with a sign
    return re.sub(r"(?<=\S)\n(?: {8}(?=\S)|(?=[^\s\w]))", " ", inspect.cleandoc(docstring))


def _check_flags(args: Sequence[str]) -> None:
    """Check that no flag is given twice. The parser would silently take the last one.

    Raises:
        InputError: a flag is given twice.
    """
    flags = [arg.partition("=")[0].replace("_", "-") for arg in args if arg.startswith("--")]
    for flag in flags:
        if flags.count(flag) > 1:
            raise InputError(f"{flag} is given twice; several values of a flag follow it: {flag} A B")


def _end_interrupted() -> int:
    # An interrupt between the opening of a file and its `with` leaves the file to the garbage collector
    warnings.simplefilter("ignore", ResourceWarning)
    _give_up("interrupted")
    return EXIT_INTERRUPTED


def _give_up(reason: str) -> int:
    if is_verbose():
        traceback.print_exc()
    own = "foredrive" if rank() is None else f"foredrive (rank {rank()})"
    print(f"{own}: {' '.join(reason.split())}", file=sys.stderr)
    return EXIT_INPUT


def _last_words(error: BaseException) -> str:
    """Return an error's message; if it contains the traceback of a worker process, only the last line."""
    lines = str(error).strip().splitlines()
    if lines and lines[0].startswith("Caught "):
        return lines[-1].partition(": ")[2]
    return str(error)


def _disk_reason(error: BaseException) -> str | None:
    """Return the disk error and its path; None if the disk is not the cause.

    Libraries wrap the operating system's error in their own, and some keep only its text.
    """
    for cause in _causes(error):
        number, where = None, None
        if isinstance(cause, OSError):
            # `filename2` is the destination of a rename
            number, where = cause.errno, cause.filename2 or cause.filename
        if number is None and (match := ERROR_NUMBER.search(str(cause))):
            number = int(match[1] or match[2])
        if number in DISK_ERRORS:
            where = _written(error) or where
            return f"{where}: {DISK_ERRORS[number]}" if where else DISK_ERRORS[number]
    return None


def _memory_reason(error: BaseException) -> str | None:
    """Return a message about a failed allocation of memory; None if that is not the cause."""
    for cause in _causes(error):
        asked = ASKED_MEMORY.search(str(cause))
        if asked is not None or isinstance(cause, MemoryError):
            size = "" if asked is None else f": {int(asked[1]) / 2**30:,.1f} GiB were asked for"
            return f"not enough memory{size}; smaller images, models or batches need less"
    return None


def _written(error: BaseException) -> str | None:
    """Return the final path of the file that was being written; None if it is unknown.

    `files.naming` adds the path as a note; the error of a worker has it in its text.
    """
    for cause in _causes(error):
        for line in (*getattr(cause, "__notes__", ()), *str(cause).splitlines()):
            if line.startswith(WHILE_WRITING):
                return line.removeprefix(WHILE_WRITING)
    return None


def _causes(error: BaseException) -> Iterator[BaseException]:
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__ or cause.__context__
