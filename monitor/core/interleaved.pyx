# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Finds two senders of one stream of messages: values come more often than before and contradict each other.

A value far from its two neighbours, which agree, is noise, a jolt, or another sender's. With noise and jolts the stream
keeps its period: the neighbours are two periods apart. If another sender's value comes in between, they are one period
apart. So a row is another sender's if its neighbours are at most one and a half usual periods apart and it differs from
both by more than they differ from each other, and by much more than rows usually differ from the line between their
neighbours. "Usually" is over the last seconds and in the present rows, where the neighbours are those one to four rows
away, as senders may take turns. Two different rows with one stamp are another sender's, too.

A single forged value is found by the rows that keep their period: a value between two of them is another sender's if it
is several times further from the line between these than any of them is from the line between its own neighbours. One
such value is enough: damage and jolts change a row that comes anyway, and a second radio or another rate brings no
value that contradicts (none in 94 recordings, nor in 564 runs of them with loss, bursts, jitter or pauses).

The usual period (a median) and the usual differences (a mean of those that are not zero, as values may be held or
rounded) are followed slowly, and not while there are findings. A link that changes its rate, or two radios that bring
the same vehicle's values, bring no values that contradict each other. Where the first rows are two groups that take
turns and lie far apart, the larger group gives the usual values.
"""

import numpy as np

from libc.math cimport INFINITY, fabs, fmod
from libc.string cimport memcpy, memmove

cdef enum:
    # Rows that are kept. Chosen: up to six of 16 may be jumps to another sender's value before their median is one.
    ROWS = 16
    # Index of the judged row, two before the newest: a row may come so late and still be sorted in.
    JUDGED = 13
    # Fewest rows of the smaller of two groups among the first rows. Chosen: one or two of them may be a jolt.
    FEWEST = 3
    # Largest distance of neighbours: one forged value per one to three true ones.
    LAGS = 4

# A row contradicts if it is this many times further from the line between its neighbours than usual. Of white noise the
# median distance is 0.83 standard deviations, so these are 6.6 of them; the distance itself has 1.22.
cdef double FAR = 8.0
# Neighbours agree if they differ by less than this share of the row's distance from their line. Where a value jumps and
# stays they differ by twice that distance; chosen: a quarter of that, so that those of an agile vehicle still agree.
cdef double AGREE = 0.5
# Longest time between the neighbours, in periods: with an attack it is one, with a single sender two.
cdef double EXTRA = 1.5
# Share of a period by which the steps of a regular stream differ: PX4's loop of 4 ms turns 10 ms into 8 to 12.
cdef double JITTER = 0.25
# Fewest rows that keep the period around an intruder. Chosen: four of them have been compared with their neighbours.
cdef int KEPT = 6
# Time constant of the usual period and differences, nanoseconds. Chosen: as long as the window of findings.
cdef double FOLLOW = 1e10
# Largest difference with which a row counts in the usual one, as a multiple of it. Chosen: few forged rows move it
# little.
cdef double MOST = 4.0
cdef long long WINDOW = 10_000_000_000
# FINDINGS findings within so many rows are an attack: an eighth of all. Measured on links that become up to twenty
# times as fast, lose or hold back (tests/test_monitor_interleaved.py): noise made four within 10 s, never eight in 64
# rows.
cdef long long SHARE = 64


cdef class Interleaved:
    """The last rows of a stream.

    Parameters
    ----------
    periods : Sequence[float]
        For each value the range after which it wraps; 0 where it does not wrap.
    """

    def __cinit__(self, periods):
        self._width = len(periods)
        self._stamps, self._rows = np.zeros(ROWS, np.int64), np.zeros((ROWS, self._width))
        self._periods, self._typical = np.array(periods, float), np.zeros(self._width)

    cdef void clear(self) noexcept:
        self._count = 0

    cdef bint take(self, long long stamp, long long received, const double* row) noexcept:
        """Process a row (NaN: a missing value); return whether it shows two senders."""
        cdef int place = self._count, later, i
        cdef bint other = False
        if self._plural:
            return False
        while place and self._stamps[place - 1] > stamp:
            place -= 1
        if place and self._stamps[place - 1] == stamp:
            for i in range(self._width):
                other |= fabs(row[i] - self._rows[place - 1, i]) > 0.0
            if other and self._usual == 0.0:
                # This stream always brings several rows with one stamp: several devices send under one name.
                self._plural = True
            if not other or self._plural:
                return False
            other = self.intrude(place - 1, place - 1, stamp, row, received)
            return self.find(received) or other
        if place == 0 and self._count == ROWS:
            return False
        self._taken += 1
        if self._count == ROWS:
            place -= 1
            memmove(&self._stamps[0], &self._stamps[1], place * sizeof(long long))
            memmove(&self._rows[0, 0], &self._rows[1, 0], place * self._width * sizeof(double))
        else:
            later = self._count - place
            memmove(&self._stamps[place + 1], &self._stamps[place], later * sizeof(long long))
            memmove(&self._rows[place + 1, 0], &self._rows[place, 0], later * self._width * sizeof(double))
            self._count += 1
        self._stamps[place] = stamp
        memcpy(&self._rows[place, 0], row, self._width * sizeof(double))
        # A row that is so late leaves the judged row in its position, where it was judged before.
        if self._count < ROWS or place < JUDGED:
            return False
        if self._usual == 0.0:
            self._usual = <double>(self._stamps[ROWS - 1] - self._stamps[0]) / (self.first_rows() - 1)
        other = self.intrude(JUDGED - 1, JUDGED + 1, self._stamps[JUDGED], &self._rows[JUDGED, 0], received)
        if self.contradicts(JUDGED):
            return self.find(received) or other
        if other:
            return True
        if not self.lately(FINDINGS // 2, received) and not 0 <= received - self._intruded < WINDOW:
            self.follow(JUDGED)
        return False

    cdef int first_rows(self) noexcept:
        """Return how many of the first rows one sender sent; find the usual differences where two senders take
        turns."""
        cdef double largest, spread, apart, size
        cdef int[2] last, count
        cdef int i, at, k, before, turns
        for i in range(self._width):
            largest, spread, apart = 0.0, 0.0, INFINITY
            for at in range(1, ROWS):
                largest = max(largest, fabs(self.step(at - 1, at, i)))
            # The first row begins a group; the first row far from the newest of that group begins another one. Each
            # further row goes to the group whose newest row is nearer.
            last[0], last[1], count[0], count[1], before, turns = 0, -1, 1, 0, 0, 0
            for at in range(1, ROWS):
                size = fabs(self.step(last[0], at, i))
                if last[1] < 0:
                    k = size > 0.5 * largest
                else:
                    k = fabs(self.step(last[1], at, i)) < size
                if count[k]:
                    spread = max(spread, fabs(self.step(last[k], at, i)))
                last[k] = at
                count[k] += 1
                turns += k != before
                before = k
                if last[1] >= 0:
                    apart = min(apart, fabs(self.step(last[0], last[1], i)))
            if apart > FAR * spread > 0.0 and min(count[0], count[1]) >= FEWEST and turns >= KEPT:
                self._typical[i] = spread
                return max(count[0], count[1])
        return ROWS

    cdef void follow(self, int at) noexcept:
        """Update the usual period and differences."""
        cdef double share = min(self._usual / FOLLOW, 0.5), off
        cdef int i
        self._usual *= 1.0 + (share if <double>(self._stamps[at] - self._stamps[at - 1]) > self._usual else -share)
        for i in range(self._width):
            off = self.off(at, 1, i)
            if self._typical[i] == 0.0 and off > 0.0:
                self._typical[i] = off
            elif off > 0.0:
                self._typical[i] += share * (min(off, MOST * self._typical[i]) - self._typical[i])

    cdef bint find(self, long long received) noexcept:
        """Count a finding; return whether the findings are an attack."""
        memmove(self._found, self._found + 1, (FINDINGS - 1) * sizeof(long long))
        memmove(self._found_at, self._found_at + 1, (FINDINGS - 1) * sizeof(long long))
        self._found[FINDINGS - 1], self._found_at[FINDINGS - 1] = received, self._taken
        return self.lately(0, received)

    cdef bint lately(self, int which, long long received) noexcept:
        """Return whether the finding with an index is recent."""
        cdef long long gone = received - self._found[which]
        return self._found[which] != 0 and self._taken - self._found_at[which] < SHARE and 0 <= gone < WINDOW

    cdef bint contradicts(self, int at) noexcept:
        """Return whether an additional row contradicts its neighbours."""
        cdef double apart, off
        cdef int i, lag
        if <double>(self._stamps[at + 1] - self._stamps[at - 1]) > EXTRA * self._usual:
            return False
        for i in range(self._width):
            apart = fabs(self.step(at - 1, at + 1, i))
            off = self.off(at, 1, i)
            if not (off > FAR * self._typical[i] > 0.0 and apart <= AGREE * off):
                continue
            for lag in range(1, LAGS + 1):
                if off > FAR * self.usual(i, lag):
                    return True
        return False

    cdef bint intrude(self, int before, int after, long long stamp, const double* row, long long received) noexcept:
        """Return whether a row between two others is an intruder: an additional one far from the line between them."""
        cdef int[ROWS] own
        cdef double span = <double>(self._stamps[after] - self._stamps[before]), share, most, off
        cdef int i, k, count
        if self._usual == 0.0 or (before < after and fabs(span - self._usual) > JITTER * self._usual):
            return False
        # Where additional rows come in every period the link became faster.
        if before and self._stamps[before] - self._stamps[before - 1] < (1.0 - JITTER) * self._usual:
            return False
        if after + 1 < self._count and self._stamps[after + 1] - self._stamps[after] < (1.0 - JITTER) * self._usual:
            return False
        count = self.period_rows(before, after, own)
        if count < KEPT:
            return False
        share = <double>(stamp - self._stamps[before]) / span if before < after else 0.0
        for i in range(self._width):
            most = self._typical[i]
            for k in range(1, count - 1):
                most = max(most, 0.5 * fabs(self.step(own[k], own[k - 1], i) + self.step(own[k], own[k + 1], i)))
            off = fabs(turned(row[i] - self._rows[before, i], self._periods[i])
                       - share * self.step(before, after, i))
            if off > FAR * most > 0.0:
                self._intruded = received
                return True
        return False

    cdef int period_rows(self, int before, int after, int* own) noexcept:
        """Write the indices of the rows, one period apart, before two of them, newest first; return how many there
        are."""
        cdef double period = self._usual, apart, nearest
        cdef int count = 1, at, next_own
        own[0] = after
        if before < after:
            own[1], count, period = before, 2, <double>(self._stamps[after] - self._stamps[before])
        while count < ROWS:
            next_own, nearest = -1, JITTER * period
            for at in range(own[count - 1]):
                apart = fabs(<double>(self._stamps[own[count - 1]] - self._stamps[at]) - period)
                if apart <= nearest:
                    next_own, nearest = at, apart
            if next_own < 0:
                break
            own[count] = next_own
            count += 1
        return count

    cdef double usual(self, int column, int lag) noexcept:
        """Return the median of :meth:`off` over the rows."""
        cdef double[ROWS] sizes
        cdef double size
        cdef int count = ROWS - 2 * lag, i, k
        for i in range(count):
            size = self.off(i + lag, lag, column)
            k = i
            while k and sizes[k - 1] > size:
                sizes[k] = sizes[k - 1]
                k -= 1
            sizes[k] = size
        return sizes[count // 2]

    cdef double off(self, int at, int lag, int column) noexcept:
        """Return how far a value is from the line between those ``lag`` rows before and after it."""
        cdef double gone = <double>(self._stamps[at] - self._stamps[at - lag])
        cdef double span = <double>(self._stamps[at + lag] - self._stamps[at - lag])
        return fabs(self.step(at - lag, at, column) - gone / span * self.step(at - lag, at + lag, column))

    cdef double step(self, int first, int second, int column) noexcept:
        """Return the step from one row to another; of a value that wraps, the shorter way round."""
        return turned(self._rows[second, column] - self._rows[first, column], self._periods[column])


cdef inline double turned(double step, double period) noexcept:
    """Return a step of a value that wraps, the shorter way round; period 0: it does not."""
    if period == 0.0:
        return step
    step = fmod(step + 0.5 * period, period)
    return step + (0.5 * period if step < 0.0 else -0.5 * period)
