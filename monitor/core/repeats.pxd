# cython: language_level=3
"""The declarations of the watch for repeated recordings, for sampling."""

cdef enum:
    # Most values that are compared, the first of a row: those of an IMU.
    SENSES = 6


cdef class Repeats:
    cdef unsigned int[::1] _hashes, _first
    cdef long long[::1] _received
    cdef long long _count, _last
    cdef int _place, _run, _senses
    # rows in succession that are new, while the rows before were told to be of a recording
    cdef int _new
    cdef bint _told
    # when the first row of the recording, or of the present run, came
    cdef readonly long long since

    cdef bint take(self, long long received, const double* row) noexcept
    cdef bint ends(self, long long received) noexcept


cdef class Frozen:
    cdef Py_ssize_t[::1] _first, _width
    cdef long long[::1] _hold, _reading, _age, _step
    cdef int _noisy
    cdef double[::1] _last
