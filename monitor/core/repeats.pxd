# cython: language_level=3
"""What sampling uses of the watch for what was sent before."""

cdef enum:
    # Values that are compared, the first of a row: those of an IMU, of which no two rows are alike by chance.
    SENSES = 6


cdef class Repeats:
    cdef unsigned int* _hashes
    cdef unsigned int* _first
    cdef long long* _received
    cdef long long _count
    cdef int _place, _run

    cdef bint take(self, long long received, const double* row) noexcept
