# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""First-order recursions over rows."""

import numpy as np


def first_order(double keep, double[::1] gained, double start):
    """Return y_k = keep y_{k-1} + gained_k (n,), y_{-1} = ``start``."""
    cdef Py_ssize_t k, count = gained.shape[0]
    found = np.empty(count)
    cdef double[::1] y = found
    cdef double last = start
    for k in range(count):
        last = keep * last + gained[k]
        y[k] = last
    return found
