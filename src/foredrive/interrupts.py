"""Ctrl-C and SIGTERM. Both interrupt, and neither is lost in code that drops exceptions."""

import _thread
import signal
import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from types import FrameType

STOPPING: dict[signal.Signals, Any] = {
    signal.SIGINT: signal.default_int_handler,
    signal.SIGTERM: signal.SIG_DFL,
}
"""Signals that interrupt a program, with Python's own handlers. Containers and schedulers send SIGTERM."""
PATIENCE_S = 0.2
"""Time after which an interruption without effect is raised again."""


class LastingInterrupt:
    """A handler of signals that raises KeyboardInterrupt, and raises it again if it was lost.

    Some code drops exceptions from signal handlers. Python does so in destructors and in callbacks from C.
    NumPy does so when it looks up attributes of operands, which runs Python code for enumeration members.
    While an exception is being handled (e.g. cleaning up half-written files), it is not raised again.

    As a context manager it handles, inside the block, those of `STOPPING` that have Python's own handler.

    Args:
        wanted: returns whether there is something to interrupt.
        once: whether a second signal does not interrupt the cleaning up either.
    """

    def __init__(self, wanted: Callable[[], bool] = lambda: True, *, once: bool = False) -> None:
        self.pressed = False
        self._wanted, self._once = wanted, once
        self._over = threading.Event()
        self._asks_again = False
        self._installed = list[signal.Signals]()

    def __call__(self, number: int, frame: "FrameType | None") -> None:
        """Handle a signal."""
        # Repetitions, and with `once` further signals too, do not interrupt the handling of an exception
        again, self._asks_again = self._asks_again, False
        if (again or (self._once and self.pressed)) and sys.exc_info()[1] is not None:
            return
        # From the first signal on, a thread repeats it in case that its exception is dropped
        if not self.pressed:
            self.pressed, self._number, self._main = True, number, threading.get_ident()
            threading.Thread(target=self._ask_again, daemon=True).start()
        if self._wanted():
            raise KeyboardInterrupt

    def _ask_again(self) -> None:
        # A thread inherits the signal mask of the thread that starts it, here the main thread
        is_blocked = self._number in signal.pthread_sigmask(signal.SIG_BLOCK, ())
        while not self._over.wait(PATIENCE_S):
            self._asks_again = True
            # A blocked signal is not delivered, so Python's handler is called without one. A real signal
            # is better where possible: it also wakes a main thread that sleeps or waits
            if is_blocked:
                _thread.interrupt_main(signal.Signals(self._number))
            else:
                signal.pthread_kill(self._main, self._number)

    def __enter__(self) -> "LastingInterrupt":
        self._hook = sys.unraisablehook
        if threading.current_thread() is threading.main_thread():
            self._installed = [
                number for number, usual in STOPPING.items() if signal.getsignal(number) is usual
            ]
        for number in self._installed:
            signal.signal(number, self)
            # Python reports an exception that it drops here. A dropped KeyboardInterrupt is repeated instead
            sys.unraisablehook = self._ignored
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for number in self._installed:
            sys.unraisablehook = self._hook
            signal.signal(number, STOPPING[number])

    def _ignored(self, unraisable: "sys.UnraisableHookArgs") -> None:
        """Report exceptions that Python ignores, except KeyboardInterrupt, which will be raised again."""
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            self._hook(unraisable)


def interrupting_signals() -> list[signal.Signals]:
    """Return the signals that raise KeyboardInterrupt here: in the main thread, without a foreign handler."""
    if threading.current_thread() is not threading.main_thread():
        return []
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    return [
        number
        for number, handler in handlers.items()
        if handler is signal.default_int_handler or isinstance(handler, LastingInterrupt)
    ]
