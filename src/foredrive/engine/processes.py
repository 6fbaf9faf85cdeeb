"""Processes that train together: a common result in all, and a one-line error if one of them is lost."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, TypeVar

import torch

from foredrive.errors import InputError

if TYPE_CHECKING:  # Slow to import
    from types import FrameType

    from lightning_fabric import Fabric

T = TypeVar("T")
_GO_ON = "another process of this training has ended; the same command goes on from the last checkpoint"


def processes_of_launcher() -> tuple[int, int] | None:
    """Return the number of machines and the processes of each as torchrun started them; None without it."""
    if not torch.distributed.is_torchelastic_launched():
        return None
    per_machine = int(os.environ["LOCAL_WORLD_SIZE"])
    return int(os.environ["WORLD_SIZE"]) // per_machine, per_machine


def gathered(value: T, fabric: "Fabric") -> list[T]:
    """Return the values of all processes, in the order of their ranks."""
    if fabric.world_size == 1:
        return [value]
    values = [value] * fabric.world_size
    torch.distributed.all_gather_object(values, value)
    return values


@contextlib.contextmanager
def entered_by_first(context: AbstractContextManager[None], fabric: "Fabric") -> Iterator[None]:
    """Enter a context in the first process only. The others continue when it has been entered.

    Raises:
        InputError: the context raised it; every process does.
    """
    with contextlib.ExitStack() as stack:
        refusal = None
        if fabric.is_global_zero:
            try:
                stack.enter_context(context)
            except InputError as error:
                refusal = str(error)
        # The first process reports failure as well as success, so that no process waits in vain
        refusal = fabric.broadcast(refusal)
        if refusal is not None:
            raise InputError(refusal)
        yield


class _ProcessLost(BaseException):
    """Ends this process. It is no `Exception`, so that no handler of damaged files takes it for damage."""


@contextlib.contextmanager
def naming_lost_processes(fabric: "Fabric") -> Iterator[None]:
    """Replace errors of the connection to a process that has ended by one line.

    torchrun ends the other processes by SIGTERM, which raises the same error here.

    Raises:
        InputError: another process of the training has ended.
    """
    if fabric.world_size == 1:
        yield
        return

    def end(number: int, frame: "FrameType | None") -> None:
        # A further SIGTERM must not interrupt the clean-up
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise _ProcessLost

    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, end) if in_main_thread else None
    try:
        yield
    except _ProcessLost:
        raise InputError(_GO_ON) from None
    except RuntimeError as error:
        # Errors of gloo have no class of their own
        if isinstance(error, torch.distributed.DistError) or "gloo" in str(error):
            raise InputError(_GO_ON) from error
        raise
    finally:
        if in_main_thread and signal.getsignal(signal.SIGTERM) is end:
            signal.signal(signal.SIGTERM, before)
