"""Slow work of a page in a thread of its own. A newer job replaces an older one with the same name."""

import logging
import threading
from collections.abc import Callable

from foredrive.errors import InputError

_log = logging.getLogger(__name__)


class JobRunner:
    """One thread that runs named jobs. A waiting job is replaced by a newer job with the same name.

    The name that has waited longest runs first, so that no name starves when jobs arrive faster than they
    run. A failure is reported, and the next job runs.

    Args:
        tell: called with the message of a job that failed.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._changed = threading.Condition()
        self._wanted: dict[str, Callable[[], None]] = {}
        self._last_turn: dict[str, int] = {}
        self._turns, self._busy, self._closed = 0, False, False
        self._thread = threading.Thread(target=self._work, name="foredrive-page", daemon=True)
        self._thread.start()

    def submit(self, name: str, job: Callable[[], None]) -> None:
        """Queue a job in place of an older one of this name that has not begun."""
        with self._changed:
            self._wanted[name] = job
            self._changed.notify_all()

    def wait(self) -> None:
        """Wait until no job is left."""
        with self._changed:
            self._changed.wait_for(lambda: not self._wanted and not self._busy)

    def close(self) -> None:
        """Drop queued jobs, and wait for the running one."""
        with self._changed:
            self._wanted.clear()
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _work(self) -> None:
        while (job := self._next()) is not None:
            try:
                job()
            except InputError as error:
                self._tell(str(error))
            except Exception as error:  # An error of the program, after which the page continues
                _log.exception("while drawing")
                self._tell(f"{type(error).__name__}: {error}")

    def _next(self) -> Callable[[], None] | None:
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._wanted or self._closed)
            if self._closed:
                return None
            self._turns, self._busy = self._turns + 1, True
            # The name whose last turn is the longest ago; one that has not run yet comes first
            name = min(self._wanted, key=lambda name: self._last_turn.get(name, 0))
            self._last_turn[name] = self._turns
            return self._wanted.pop(name)
