# cython: language_level=3
"""The declarations of the watch for repeated recordings, for sampling."""

cdef enum:
    # How many values are compared, the first of a row: those of an IMU, no two rows of which are equal by chance.
    SENSES = 6


cdef class Repeats:
    cdef unsigned int[::1] _hashes, _first
    cdef long long[::1] _received
    cdef long long _count
    cdef int _place, _run
    # when the first row of the present run came
    cdef readonly long long since

    cdef bint take(self, long long received, const double* row) noexcept
