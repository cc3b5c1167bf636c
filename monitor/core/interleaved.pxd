# cython: language_level=3
"""The declarations of the watch for two senders of one stream, for sampling."""

cdef enum:
    # So many findings close together are an attack.
    FINDINGS = 8


cdef class Interleaved:
    cdef int _width, _count
    cdef bint _plural
    cdef double _usual
    cdef long long _taken
    cdef long long[FINDINGS] _found
    cdef long long[FINDINGS] _found_at
    cdef long long _intruded
    cdef long long[::1] _stamps
    cdef double[:, ::1] _rows
    cdef double[::1] _periods, _typical

    cdef bint take(self, long long stamp, long long received, const double* row) noexcept
    cdef void clear(self) noexcept
    cdef int first_rows(self) noexcept
    cdef void follow(self, int at) noexcept
    cdef bint find(self, long long received) noexcept
    cdef bint lately(self, int which, long long received) noexcept
    cdef bint contradicts(self, int at) noexcept
    cdef bint intrude(self, int before, int after, long long stamp, const double* row, long long received) noexcept
    cdef int period_rows(self, int before, int after, int* own) noexcept
    cdef double usual(self, int column, int lag) noexcept
    cdef double off(self, int at, int lag, int column) noexcept
    cdef double step(self, int first, int second, int column) noexcept
