# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Finds values of noisy sensors that come again: part of a recording, or one reading that does not change any more.

Noisy sensors never give two rows that are equal in every value, still less many in the same order. Rows of an IMU, or
of rates and angles, are remembered by a hash of their values, with the index of its first row. Stamps are not
compared: who sends a recording again may change them.
"""

import numpy as np

from libc.string cimport memcmp, memcpy

cdef enum:
    # Rows that are remembered: five minutes at 100 Hz.
    KEPT = 1 << 15

# Length of a run of repeated rows that is no chance. Chosen: of a sensor at rest with coarse steps, two rows may be
# equal once in ten.
cdef int CERTAIN = 20
# Least time without a row of the recording after which it has ended, ns. Chosen: half of the two seconds within which
# an alarm's end is to be known.
cdef long long ENDED = 1_000_000_000
# Least time since the first sending, ns: duplicates over two radios come within less (link_alarms.py).
cdef long long APART = 10_000_000_000

# The multiplier of MurmurHash3's last step, as its shifts of 33 bits.
cdef unsigned long long MIX = 0xff51afd7ed558ccdULL


cdef class Repeats:
    """The hashes of a stream's last rows."""

    def __cinit__(self, int senses):
        self._senses = min(senses, SENSES)
        self._hashes, self._first = np.zeros((2, KEPT), np.uint32)
        self._received = np.zeros(KEPT, np.int64)

    cdef bint take(self, long long received, const double* row) noexcept:
        """Process a row; return whether it is one of many in a row that came before."""
        cdef unsigned long long bits, code = 0
        cdef unsigned int found, slot
        cdef int i
        for i in range(self._senses):
            memcpy(&bits, row + i, sizeof(bits))
            code = (code ^ bits ^ (bits >> 33)) * MIX
            code ^= code >> 33
        # The last bit of a stored hash says that the row had not come before: rows that come often prove nothing.
        found = <unsigned int>code | 1
        if self._count and self._hashes[(self._count - 1) % KEPT] | 1 == found:
            # A held value, or that of a sensor without noise.
            return False
        slot = found // 2 % KEPT
        if self._run and self._hashes[(self._place + 1) % KEPT] == found:
            self._place, self._run = (self._place + 1) % KEPT, self._run + 1
        else:
            self._place = self._first[slot]
            self._run = self._hashes[self._place] == found
        if self._run and received - self._received[self._place] < APART:
            self._run = 0
        if self._run == 1 and not self._told:
            self.since = received
        i = self._count % KEPT
        self._received[i] = received
        if self._hashes[self._first[slot]] == found:
            self._hashes[i] = found - 1
            self._new = 0
        else:
            self._hashes[i], self._first[slot] = found, i
            self._new += 1
        self._count += 1
        if self._run < CERTAIN:
            return False
        self._told, self._last = True, received
        return True

    cdef bint ends(self, long long received) noexcept:
        """Return, once, whether a recording has ended: as many rows are new as proved that they came again."""
        if not self._told or self._new < CERTAIN or 0 <= received - self._last < ENDED:
            return False
        self._told = False
        return True


cdef class Frozen:
    """Sensors that repeat one reading for longer than chance allows, while others go on.

    Parameters
    ----------
    first, width : Sequence[int]
        Columns of each of m sensors.
    hold, reading : Sequence[int]
        Ticks for which each may repeat a reading, and for which one lasts. Where they last longer, so do repeats.
    noisy : int
        The first columns, which never repeat all together unless the whole telemetry is frozen.
    """

    def __init__(self, first, width, hold, reading, int noisy):
        self._first, self._width = np.array(first, np.intp), np.array(width, np.intp)
        self._hold, self._reading, self._noisy = np.array(hold, np.int64), np.array(reading, np.int64), noisy
        # For how many ticks each reading has been the same, and the one before was; -1: not known.
        self._last = np.zeros(0)
        self._age, self._step = np.full((2, len(self._hold)), -1, np.int64)

    def run(self, const double[:, ::1] signals, const unsigned char[:, ::1] lost, const unsigned char[:] restart):
        """Return where each sensor is frozen (n, m)."""
        cdef Py_ssize_t count = signals.shape[0], row, i, k
        cdef bint missing, whole
        cdef const double* now
        found = np.zeros((count, self._hold.shape[0]), np.bool_)
        cdef unsigned char[:, ::1] frozen = found.view(np.uint8)
        if not self._last.shape[0]:
            self._last = np.full(signals.shape[1], np.nan)
        for row in range(count):
            now = &signals[row, 0]
            whole = memcmp(now, &self._last[0], self._noisy * sizeof(double)) == 0
            for i in range(self._hold.shape[0]):
                missing = restart[row]
                for k in range(self._width[i]):
                    missing |= lost[row, self._first[i] + k]
                if missing:
                    self._age[i] = self._step[i] = -1
                elif memcmp(now + self._first[i], &self._last[self._first[i]], self._width[i] * sizeof(double)):
                    # The first change ends a reading of which the beginning is not known.
                    self._step[i] = self._age[i]
                    self._age[i] = 0
                elif self._age[i] >= 0:
                    self._age[i] += 1
                    frozen[row, i] = (
                        self._step[i] >= 0 and not whole
                        and self._age[i] * self._reading[i] >= self._hold[i] * max(self._reading[i], self._step[i] + 1))
            memcpy(&self._last[0], now, signals.shape[1] * sizeof(double))
        return found
