"""One channel's alarm over a stretch of samples: rows in which nothing happens are passed over at once.

While an alarm is idle, evidence inside all of its sizes does nothing but move the mean of the slow path, by a
recursion over all rows; while it stands, few rows make an event. A test holds this and
:meth:`monitor.alarms.alarm.Alarm.update`, sample by sample, together to the last bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from monitor.alarms.alarm import Alarm, Standing
from monitor.sampling.stretch import first_order

_FIRST_LOOK = 64


class AlarmStretch:
    """Where in a stretch of n samples an alarm has to look at its evidence.

    Parameters
    ----------
    alarm : Alarm
        The alarm, as the sample before the stretch left it.
    times_ns : NDArray[np.int64]
        Vehicle times of the samples (n,).
    restart : NDArray[np.bool_]
        Samples at which the observer started afresh (n,).
    evidence : NDArray[np.float64]
        The channel's evidence (n,).
    speaking : NDArray[np.bool_]
        Rows in which it speaks (n,), the others being a pause.

    Attributes
    ----------
    row : int
        Next row to be looked at; n at the end.
    due : bool
        Whether :meth:`monitor.alarms.alarm.Alarm.update` has to be asked at that row.
    """

    def __init__(
        self,
        alarm: Alarm,
        times_ns: NDArray[np.int64],
        restart: NDArray[np.bool_],
        evidence: NDArray[np.float64],
        speaking: NDArray[np.bool_],
    ) -> None:
        self.alarm = alarm
        self._times = times_ns
        self._restart = restart
        self._evidence = evidence
        self._speaking = speaking
        self._size = np.abs(evidence)
        self._done = 0
        self._ahead = _FIRST_LOOK
        self._means = np.empty(0)
        self._moving = np.empty(0, np.intp)
        self._standing: Standing | None = None
        self.row = 0
        self.due = False
        self._look()

    def __len__(self) -> int:
        return len(self._times)

    def update_done(self) -> None:
        """Note that the alarm took the row that was due."""
        self._done = self.row + 1
        self._ahead = _FIRST_LOOK
        self._look()

    def go_on(self) -> None:
        """Pass over the rows before ``row``, none of which was due, and look further."""
        self.pass_to(self.row)
        self._look()

    def pass_to(self, row: int) -> None:
        """Pass over the rows before one that lies no further than ``row``."""
        alarm, start = self.alarm, self._done
        if row <= start:
            return
        self._done = row
        if self._standing is not None:
            alarm.go_on_from(self._standing if row == self.row else self._stand(start, row)[1])
            self._standing = None
            return
        count = int(np.searchsorted(self._moving, row))
        mean = float(self._means[count - 1]) if count else alarm.mean
        alarm.rest(mean, int(self._times[row - 1]) if self._speaking[row - 1] else None)
        self._means, self._moving = self._means[count:], self._moving[count:]

    def change(self, speaking: NDArray[np.bool_], row: int) -> None:
        """Let the channel speak in these rows from ``row`` on, which is not passed yet."""
        self.pass_to(row)
        self._speaking = np.concatenate((self._speaking[:row], speaking))
        self._look()

    def _look(self) -> None:
        """Find the next row that is due, or how far it is certain that none is."""
        start, count = self._done, len(self._times)
        stop = min(count, start + self._ahead)
        self._ahead *= 4
        speaking = self._speaking[start:stop]
        self._means, self._moving = np.empty(0), np.empty(0, np.intp)
        self._standing = None
        rule = self.alarm.rule
        if self.alarm.active and len(speaking) and speaking[0]:
            due = ~speaking | self._restart[start:stop]
            calm = int(np.argmax(due)) if due.any() else len(due)
            count, standing = self._stand(start, start + calm)
            self.due, self.row = count < calm or calm == 0, start + count
            self._standing = standing if count else None
            return
        if not self.alarm.idle:
            due = speaking
        else:
            # Also what is no number.
            due = speaking & (~(self._size[start:stop] < min(rule.threshold, rule.fast)) | self._restart[start:stop])
            if rule.slow < math.inf:
                due = self._follow_mean(start, stop, speaking, due)
        first = int(np.argmax(due)) if len(due) else 0
        self.due = bool(len(due)) and bool(due[first])
        self.row = start + first if self.due else stop

    def _stand(self, start: int, stop: int) -> tuple[int, Standing]:
        """Return how many rows from ``start`` on cause nothing while the alarm stands, and what it remembers then."""
        return self.alarm.stand(self._times[start:stop].tolist(), self._evidence[start:stop].tolist())

    def _follow_mean(
        self, start: int, stop: int, speaking: NDArray[np.bool_], due: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Follow the mean over rows that are not due; return those that are, the ones at which it reaches its size."""
        rule, times = self.alarm.rule, self._times[start:stop]
        elapsed = np.zeros(stop - start, np.int64)
        elapsed[1:] = np.where(speaking[:-1], np.diff(times), 0)
        if len(times) and self.alarm.last_ns is not None:
            elapsed[0] = times[0] - self.alarm.last_ns
        moving = np.flatnonzero(speaking & (elapsed > 0))
        if not len(moving):
            return due
        step = int(elapsed[moving[0]])
        # Samples come at one rate; where the grid is no whole number of nanoseconds each row is looked at.
        odd = elapsed[moving] != step
        if odd.any():
            due = due.copy()
            due[moving[odd]] = True
        keep = math.exp(-step / (rule.slow_s * 1e9))
        first = int(np.argmax(due)) if due.any() else len(due)
        moving = moving[moving < first]
        limited = np.clip(self._evidence[start + moving], -2.0 * rule.slow, 2.0 * rule.slow)
        means = first_order(keep, (1.0 - keep) * limited, self.alarm.mean)
        reached = np.abs(means) >= rule.slow
        if reached.any():
            due = due.copy()
            due[moving[int(np.argmax(reached))]] = True
        self._means, self._moving = means, start + moving
        return due
