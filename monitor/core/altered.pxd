# cython: language_level=3
"""What sampling uses of the watch for altered messages."""

cdef enum:
    # Limits of outputs that are remembered. Chosen: two at either end, in idle and in flight.
    STOPS = 4
    # Decades of the rates' variance that are told apart, from 1e-12 (rad/s)^2 on. Chosen: the largest a wild flight has
    # is some, and a vehicle that stands still has less than any.
    DECADES = 16


cdef class Stands:
    cdef int _width, _next_stop
    cdef bint _flies
    cdef double[::1] _values, _stopped
    cdef long long[::1] _since, _moved
    cdef double[STOPS] _stops
    cdef double _low, _high
    cdef long long _longest

    cdef bint take(self, long long stamp, const double* row, bint flies) noexcept
    cdef bint is_limit(self, int which, double value) noexcept


cdef class Pace:
    cdef long long _first, _first_received, _last, _last_received, _span
    cdef int _steps, _changed
    cdef double _usual, _usual_pace
    # Of the delays at the usual pace the least and the most of this mean, and how much they vary.
    cdef double _least, _most, _spread
    # The latest mean period in usual ones.
    cdef double ratio

    cdef bint take(self, long long stamp, long long received) noexcept
    cdef void begin(self, long long stamp, long long received) noexcept


cdef class Fixes:
    cdef long long _first, _first_received, _last, _last_received
    cdef int _count
    # Of the fixes their number of periods, the latest stamp since the first, and sums of arrivals x and stamps y.
    cdef double _periods, _y, _sum_x, _sum_y, _sum_xx, _sum_xy, _sum_yy
    # The latest pace.
    cdef double pace

    cdef bint take(self, long long stamp, long long received) noexcept
    cdef void begin(self, long long stamp, long long received) noexcept


cdef class Response:
    cdef int _inputs, _outputs, _lags, _width, _window, _known, _count, _acted, _not
    # The mean of the commands, and whether it changed in the window.
    cdef double _mean
    cdef bint _moved
    # Of a window the products of its rows with themselves (the lower triangle) and with the changes of the outputs.
    cdef double[:, ::1] _squares, _products
    # The newest row: 1 and the differences of commands, the latest first; the outputs before.
    cdef double[::1] _row, _before
    # Sum of squares of the changes of each output in the window.
    cdef double[::1] _energies
    # Evidence in nats that commands have ceased to act. By the decade of the rates' changes: number of windows in this
    # flight, sums of the shares explained and of their squares, number in which commands act; and those since there is
    # such evidence.
    cdef double _nats
    cdef double[:, ::1] _usual, _since

    cdef bint take(self, const double* vector, bint is_usable) noexcept
    cdef bint judge(self) noexcept
    cdef void forget(self) noexcept
    cdef void begin(self) noexcept
