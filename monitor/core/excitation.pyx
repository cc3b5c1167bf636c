# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""How many times larger than at rest the errors of a model are expected to be, row after row.

:mod:`monitor.estimation.excitation` tells what it is for, in the same symbols.
"""

from libc.math cimport fabs, sqrt
from libc.stdint cimport uint8_t

import numpy as np


cdef class Excitation:
    """The largest output and the largest change of a command over the last rows, and the scale that follows.

    Parameters
    ----------
    outputs : ndarray
        Indices of the outputs that are judged.
    variance : ndarray
        c_0, c_1, c_2, b_1, b_2, R and D (7,).
    hold : int
        Rows over which the largest counts.
    inputs : int
        Number of inputs.
    """

    cdef Py_ssize_t[::1] outputs
    cdef double[::1] variance, rate, moved, last
    cdef Py_ssize_t hold, known, row

    def __init__(self, outputs, variance, hold, inputs):
        self.outputs, self.variance = np.asarray(outputs, np.intp), np.ascontiguousarray(variance, float)
        self.hold = max(1, hold)
        self.rate, self.moved, self.last = np.zeros(self.hold), np.zeros(self.hold), np.zeros(inputs)
        self.known = self.row = 0

    def run(self, const double[:, :] u, const double[:, :] y, const uint8_t[:] restart, const double[:] level):
        """Return r, d and s of n rows (n, 3)."""
        cdef Py_ssize_t k, i, count = u.shape[0]
        cdef double rate, moved, square
        cdef double* c = &self.variance[0]
        result = np.empty((count, 3))
        cdef double[:, ::1] columns = result
        for k in range(count):
            if restart[k]:
                self.known = 0
            self.row = (self.row + 1) % self.hold
            rate = moved = 0.0
            for i in range(self.outputs.shape[0]):
                rate = max(rate, fabs(y[k, self.outputs[i]]))
            for i in range(self.last.shape[0]):
                if self.known:
                    moved = max(moved, fabs(u[k, i] - self.last[i]))
                self.last[i] = u[k, i]
            self.rate[self.row], self.moved[self.row] = rate, moved
            self.known = min(self.known + 1, self.hold)
            for i in range(1, self.known):
                rate = max(rate, self.rate[(self.row - i + self.hold) % self.hold])
                moved = max(moved, self.moved[(self.row - i + self.hold) % self.hold])
            columns[k, 0], columns[k, 1] = rate, moved
            # s^2 = max(1, lambda (c_0 + c_1 r^2 + c_2 d^2) + b_1 (r^2 - R^2)+ + b_2 (d^2 - D^2)+)
            square = level[k] * (c[0] + c[1] * rate * rate + c[2] * moved * moved)
            square += c[3] * max(0.0, rate * rate - c[5] * c[5]) + c[4] * max(0.0, moved * moved - c[6] * c[6])
            columns[k, 2] = sqrt(max(1.0, square))
        return result
