# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""The factor by which a model's errors are expected to be larger than at rest, row after row.

:mod:`monitor.estimation.excitation` explains the rule, in the same symbols.
"""

from libc.math cimport acos, cos, fabs, sqrt
from libc.stdint cimport uint8_t

import numpy as np


cdef class Excitation:
    """The largest output and the largest change of a command over the last rows, and the scale that follows.

    The mean command and the strength of gusts, the root of the residuals' level, are compared with the fitted flights.

    Parameters
    ----------
    outputs : ndarray
        Indices of the judged outputs.
    variance : ndarray
        c_0, c_1, c_2, b_1, b_2, R, D, c_3, and the largest mean command and gusts of the fitted flights (10,).
    hold : int
        Rows over which the maximum is taken.
    inputs : int
        Number of inputs.
    outside : float
        Multiple of the fitted flights' largest from which a row counts as outside.

    Attributes
    ----------
    newest : tuple
        r, d, mean command, gusts and s of the last row.
    furthest : tuple
        Largest r, d, mean command and gusts of all rows.
    rows : int
        How many rows were outside.
    """

    cdef Py_ssize_t[::1] outputs
    cdef double[::1] variance, rate, moved, last
    cdef Py_ssize_t hold, known, row
    cdef double outside
    cdef readonly tuple newest, furthest
    cdef readonly Py_ssize_t rows

    def __init__(self, outputs, variance, hold, inputs, outside):
        self.outside, self.newest, self.furthest = outside, (0.0,) * 4 + (1.0,), (0.0,) * 4
        self.outputs, self.variance = np.asarray(outputs, np.intp), np.ascontiguousarray(variance, float)
        self.hold = max(1, hold)
        self.rate, self.moved, self.last = np.zeros(self.hold), np.zeros(self.hold), np.zeros(inputs)
        self.known = self.row = 0

    def run(self, const double[:, :] u, const double[:, :] y, const uint8_t[:] restart, const double[:] level):
        """Return r, d, s of n rows and how many times further than in the fitted flights r or d is, 1 inside (n, 4)."""
        cdef Py_ssize_t k, i, count = u.shape[0]
        cdef double rate, moved, square, beyond
        cdef double[4] now, most
        cdef bint out
        most[0], most[1], most[2], most[3] = self.furthest
        cdef double* c = &self.variance[0]
        cdef double[4] fitted
        fitted[0], fitted[1], fitted[2], fitted[3] = c[5], c[6], c[8], c[9]
        result = np.empty((count, 4))
        cdef double[:, ::1] columns = result
        for k in range(count):
            if restart[k]:
                self.known = 0
            self.row = (self.row + 1) % self.hold
            rate = moved = now[2] = 0.0
            for i in range(self.outputs.shape[0]):
                rate = max(rate, fabs(y[k, self.outputs[i]]))
            for i in range(self.last.shape[0]):
                now[2] += u[k, i] / self.last.shape[0]
                if self.known:
                    moved = max(moved, fabs(u[k, i] - self.last[i]))
                self.last[i] = u[k, i]
            self.rate[self.row], self.moved[self.row] = rate, moved
            self.known = min(self.known + 1, self.hold)
            for i in range(1, self.known):
                rate = max(rate, self.rate[(self.row - i + self.hold) % self.hold])
                moved = max(moved, self.moved[(self.row - i + self.hold) % self.hold])
            columns[k, 0], columns[k, 1] = rate, moved
            square = max(1.0, level[k]) * (c[0] + c[1] * rate * rate + c[2] * moved * moved) + c[7] * level[k]
            square += c[3] * max(0.0, rate * rate - c[5] * c[5]) + c[4] * max(0.0, moved * moved - c[6] * c[6])
            columns[k, 2] = sqrt(max(1.0, square))
            beyond = max(1.0, rate / c[5]) if c[5] > 0.0 else 1.0
            beyond = max(beyond, moved / c[6]) if c[6] > 0.0 else beyond
            columns[k, 3] = beyond
            now[0], now[1], now[3] = rate, moved, sqrt(level[k])
            out = False
            for i in range(4):
                out |= fitted[i] > 0.0 and now[i] > self.outside * fitted[i]
                most[i] = max(most[i], now[i])
            self.rows += out
        if count:
            self.newest, self.furthest = tuple(now) + (columns[count - 1, 2],), tuple(most)
        return result


cdef class Beyond:
    """How far raw signals lie beyond what they reached in the flights that were fitted, and did lately.

    Parameters
    ----------
    fitted : ndarray
        Largest tilt (rad), body rate (rad/s) and speed (m/s) of those flights (3,); 0: not known.
    columns : ndarray
        Of roll, pitch, three body rates and the speed among the signals (6,); -1: not there.
    keep : float
        Factor by which the excess decays per row.
    outside : float
        Multiple of the fitted value from which a row counts as outside.

    Attributes
    ----------
    factor : float
        Factor by which tilt or rates exceed those of the fitted flights.
    reached : tuple
        Largest tilt, rate and speed lately, which decay as the factor does.
    rows : int
        How many rows were outside.
    furthest : tuple
        Largest tilt, rate and speed of all rows.
    """

    cdef double[3] fitted, most, far
    cdef Py_ssize_t[::1] columns
    cdef double keep, outside
    cdef readonly double factor
    cdef readonly Py_ssize_t rows

    def __init__(self, fitted, columns, keep, outside):
        self.fitted, self.columns, self.keep, self.outside = fitted, np.asarray(columns, np.intp), keep, outside
        self.far[0] = self.far[1] = self.far[2] = 0.0
        self.rows = 0
        self.clear()

    cdef void clear(self) noexcept:
        self.factor = 1.0
        self.most[0] = self.most[1] = self.most[2] = 0.0

    @property
    def reached(self):
        return tuple(self.most)

    @property
    def furthest(self):
        return tuple(self.far)

    def run(self, const double[:, :] signals, const uint8_t[:] restart, const Py_ssize_t[:] ends):
        """Return the factor after some of n rows, whose indices ascend (m,); at a restart all is forgotten."""
        cdef Py_ssize_t k, i, done = 0
        cdef double excess
        cdef double[3] now
        cdef bint out
        result = np.empty(ends.shape[0])
        cdef double[:] factors = result
        for k in range(signals.shape[0]):
            if restart[k]:
                self.clear()
            now[0] = now[1] = now[2] = 0.0
            if self.columns[0] >= 0 and self.columns[1] >= 0:
                now[0] = acos(cos(signals[k, self.columns[0]]) * cos(signals[k, self.columns[1]]))
            for i in range(2, 5):
                if self.columns[i] >= 0:
                    now[1] = max(now[1], fabs(signals[k, self.columns[i]]))
            if self.columns[5] >= 0:
                now[2] = signals[k, self.columns[5]]
            excess, out = 0.0, False
            for i in range(3):
                # NaN counts as 0.
                now[i] = now[i] if now[i] > 0.0 else 0.0
                self.far[i] = max(now[i], self.far[i])
                out |= self.fitted[i] > 0.0 and now[i] > self.outside * self.fitted[i]
                self.most[i] = max(now[i], self.keep * self.most[i])
                # The speed comes from the GPS, which must not decide how far it is believed.
                if i < 2 and self.fitted[i] > 0.0:
                    excess = max(excess, now[i] / self.fitted[i] - 1.0)
            self.rows += out
            self.factor = 1.0 + max(excess, self.keep * (self.factor - 1.0))
            if done < ends.shape[0] and ends[done] == k:
                factors[done] = self.factor
                done += 1
        return result
