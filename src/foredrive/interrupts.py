"""Ctrl-C that nothing swallows."""

import _thread
import signal
import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

PATIENCE_S = 0.2
"""How long an interruption may seem lost until it is raised again."""


class LastingInterrupt:
    """A handler of SIGINT that raises KeyboardInterrupt, and again where it was lost on its way.

    Code may drop an exception that comes from outside: Python does in destructors and in callbacks from C,
    NumPy does where it looks for attributes of operands, which runs Python code for members of enumerations.
    Whoever handles an exception (clears away what is half-written) is left alone.

    As a context it is the handler of SIGINT inside of it, if that is Python's own outside.

    Args:
        wanted: whether there is something to be interrupted.
    """

    def __init__(self, wanted: Callable[[], bool] = lambda: True) -> None:
        self.pressed = False
        self._wanted = wanted
        self._over = threading.Event()
        self._asks_again = False
        self._installed = False

    def __call__(self, number: int, frame: "FrameType | None") -> None:
        """SIGINT has come."""
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
            else:  # wakes the main thread where it sleeps, too
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
        """What Python ignores it tells of, but not of an interruption, which comes again."""
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            self._hook(unraisable)


def raises_interrupts() -> bool:
    """Whether Ctrl-C raises KeyboardInterrupt here: in the main thread, with nobody else's handler."""
    handler = signal.getsignal(signal.SIGINT)
    in_main_thread = threading.current_thread() is threading.main_thread()
    return in_main_thread and (handler is signal.default_int_handler or isinstance(handler, LastingInterrupt))
