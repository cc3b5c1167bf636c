# cython: language_level=3
"""What the strapdown transform uses of the errors of straight lines."""

cdef enum:
    # Spans over which errors are measured, 2, 4, ... ticks, and the longest of them.
    SPANS = 6
    LONGEST = 1 << SPANS
    # Accelerations north, east and down, and body rates; behind them what the attitude turns otherwise than these.
    SIGNALS = 6
    ERRORS = 9


cdef inline double spread_between(double change) noexcept:
    """Return the variance of what lies between two samples: their mean, give or take a quarter of their difference."""
    return (1.0 / 48.0) * change * change


cdef class LineErrors:
    cdef double _dt
    # Of the latest ticks: values of the signals, their integrals, and those of the attitude less the gyros'.
    cdef double[LONGEST + 1][ERRORS] _value
    cdef double[LONGEST + 1][ERRORS] _integral
    # Means of squares by span; of the acceleration down those of the line, of its product with the integral, of that.
    cdef double[SPANS][ERRORS] _variance
    cdef double[SPANS][3] _down
    cdef long long[SPANS] _count
    # Sums of what the attitude turned otherwise times the change of the rate, and of the square of that.
    cdef double[2] _early
    # The newest tick, and for how many ticks before it all was measured; -1: it was not itself.
    cdef long long _tick, _measured
    cdef void restart(self) noexcept
    cdef void follow(self, const double* value, const double* turned, bint lined) noexcept
    cdef double change(self, int i, double value) noexcept
    cdef double early_s(self) noexcept
    cdef double variance(self, int i, double ticks) noexcept
    cdef double steep(self, int i, double value, double ticks) noexcept
    cdef double down(self, double ticks, double* variance) noexcept
