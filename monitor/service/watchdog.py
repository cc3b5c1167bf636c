"""End a process whose main loop is blocked, so that the service manager starts another one."""

from __future__ import annotations

import faulthandler
import os
import sys
import threading
from collections.abc import Callable

_TICK_S = 1.0
"""Length of a tick. Chosen: ten of them are counted accurately enough, and waking once a second costs nothing."""
LIMIT = 10
"""Ticks in which the loop finished its turn for no vehicle. Chosen: as long as the unit's own watchdog waits, twice as
long as ``/healthz`` does; one vehicle's part of a turn takes no hundredth of it."""
_SAY_S = 1.0
"""Time for writing the tracebacks: standard error may be a pipe that nobody reads."""


def _end() -> None:
    os._exit(1)


class Watchdog:
    """Watches one loop from a thread; ``end`` is called after ``LIMIT`` ticks without a call of :meth:`feed`.

    Time is counted in ticks of the thread: if the whole process was stopped, or the machine slept, nothing was missed.
    """

    def __init__(self, end: Callable[[], None] = _end, tick_s: float = _TICK_S) -> None:
        self._end = end
        self._tick_s = tick_s
        self._fed = True
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._thread.start()

    def feed(self) -> None:
        """Report that the loop has finished a turn."""
        self._fed = True

    def close(self) -> None:
        """Stop watching; a second call does nothing."""
        self._closed.set()

    def _watch(self) -> None:
        missed = 0
        while not self._closed.wait(self._tick_s):
            missed = 0 if self._fed else missed + 1
            self._fed = False
            if missed >= LIMIT:
                # the log has to show where the loop is blocked
                say = threading.Thread(target=_say, daemon=True)
                say.start()
                say.join(_SAY_S)
                self._end()
                return


def _say() -> None:
    stream = sys.__stderr__
    if stream is not None:
        os.write(stream.fileno(), b"the main loop has not run for 10 s: ending, so that it is started again\n")
        faulthandler.dump_traceback(stream)
