"""Ctrl-C handling that is not lost in code that drops exceptions."""

import _thread
import signal
import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

PATIENCE_S = 0.2
"""Time after which an interruption without effect is raised again."""


class LastingInterrupt:
    """A handler of SIGINT that raises KeyboardInterrupt, and raises it again if it was lost.

    Some code drops exceptions from signal handlers. Python does so in destructors and in callbacks from C.
    NumPy does so when it looks up attributes of operands, which runs Python code for enumeration members.
    While an exception is being handled (e.g. cleaning up half-written files), it is not raised again.

    As a context manager it is the SIGINT handler inside the block, if Python's own handler is active outside.

    Args:
        wanted: returns whether there is something to interrupt.
    """

    def __init__(self, wanted: Callable[[], bool] = lambda: True) -> None:
        self.pressed = False
        self._wanted = wanted
        self._over = threading.Event()
        self._asks_again = False
        self._installed = False

    def __call__(self, number: int, frame: "FrameType | None") -> None:
        """Handle SIGINT."""
        again, self._asks_again = self._asks_again, False
        if again and sys.exc_info()[1] is not None:
            return
        if not self.pressed:
            self.pressed, self._main = True, threading.get_ident()
            threading.Thread(target=self._ask_again, daemon=True).start()
        if self._wanted():
            raise KeyboardInterrupt

    def _ask_again(self) -> None:
        is_blocked = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())  # as in the main thread
        while not self._over.wait(PATIENCE_S):
            self._asks_again = True
            if is_blocked:
                _thread.interrupt_main()
            else:  # also wakes a sleeping main thread
                signal.pthread_kill(self._main, signal.SIGINT)

    def __enter__(self) -> "LastingInterrupt":
        self._hook = sys.unraisablehook
        in_main_thread = threading.current_thread() is threading.main_thread()
        if in_main_thread and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self)
            sys.unraisablehook = self._ignored
            self._installed = True
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._installed:
            sys.unraisablehook = self._hook
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _ignored(self, unraisable: "sys.UnraisableHookArgs") -> None:
        """Report exceptions that Python ignores, except KeyboardInterrupt, which will be raised again."""
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            self._hook(unraisable)


def raises_interrupts() -> bool:
    """Return whether Ctrl-C raises KeyboardInterrupt here: in the main thread, without a foreign handler."""
    handler = signal.getsignal(signal.SIGINT)
    in_main_thread = threading.current_thread() is threading.main_thread()
    return in_main_thread and (handler is signal.default_int_handler or isinstance(handler, LastingInterrupt))
