# cython: language_level=3
"""The declarations of the errors of straight lines, for the strapdown transform."""

cdef enum:
    # Number of spans, of 2, 4, ... ticks, and the longest.
    SPANS = 6
    LONGEST = 1 << SPANS
    # Signals: accelerations north, east and down, and body rates. Errors: theirs, and those of the attitude's turns.
    SIGNALS = 6
    ERRORS = 9


cdef inline double spread_between(double change) noexcept:
    """Return the variance of the mean between two samples, if it may differ from theirs by a quarter of their
    difference."""
    return (1.0 / 48.0) * change * change


cdef class LineErrors:
    cdef double _dt
    # Of the latest ticks: the signals; their integrals, and the turns of the attitude less the integrals of the rates.
    cdef double[LONGEST + 1][ERRORS] _value
    cdef double[LONGEST + 1][ERRORS] _integral
    # Mean squares of the errors by span; for the acceleration down those of line, line times integral, and integral.
    cdef double[SPANS][ERRORS] _variance
    cdef double[SPANS][3] _down
    cdef long long[SPANS] _count
    # Sums of (turn of the attitude - integral of the rate) times the change of the rate, and of the square of that
    # change.
    cdef double[2] _early
    # The newest tick, and the number of measured ticks before it; -1: it was not measured itself.
    cdef long long _tick, _measured
    cdef void restart(self) noexcept
    cdef void follow(self, const double* value, const double* turned, bint lined) noexcept
    cdef double change(self, int i, double value) noexcept
    cdef double early_s(self) noexcept
    cdef double variance(self, int i, double ticks) noexcept
    cdef double steep(self, int i, double value, double ticks) noexcept
    cdef double down(self, double ticks, double* variance) noexcept
