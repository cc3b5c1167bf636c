# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Commands behind the delay and lag of their actuators, and means over groups of samples, row after row."""

import numpy as np

from adapters.sample import Given, Samples

from libc.math cimport cos, exp, sin


def cosines(angles):
    """Return the cosines of angles (n,) in radians, each as the C library rounds it whatever n is."""
    return _each(angles, cos)


def sines(angles):
    """Return the sines of angles (n,) in radians, each as the C library rounds it whatever n is."""
    return _each(angles, sin)


cdef object _each(angles, double (*function)(double) noexcept nogil):
    cdef const double[:] given = angles
    results = np.empty(given.shape[0])
    cdef double[::1] values = results
    cdef Py_ssize_t k
    for k in range(given.shape[0]):
        values[k] = function(given[k])
    return results


def exponential_mean(const double[:, :] values, double keep):
    """Return y(k) = keep y(k-1) + (1 - keep) x(k) of each column of values x (n, m), from y(-1) = 0."""
    result = np.empty((values.shape[0], values.shape[1]))
    cdef double[:, ::1] mean = result
    cdef Py_ssize_t k, i
    for k in range(values.shape[0]):
        for i in range(values.shape[1]):
            mean[k, i] = (1.0 - keep) * values[k, i] + (keep * mean[k - 1, i] if k else 0.0)
    return result


cdef class _Lag:
    """Transport delay (linear between samples) and first-order lag of one signal."""

    cdef double[::1] _past
    cdef Py_ssize_t _size, _newest
    cdef double _part, _keep, _value

    def __cinit__(self, double delay_s, double lag_s, double rate_hz):
        whole, self._part = divmod(delay_s * rate_hz, 1.0)
        self._size = <Py_ssize_t>whole + 2
        self._keep = exp(-1.0 / (lag_s * rate_hz)) if lag_s > 0.0 else 0.0
        self._past = np.zeros(self._size)

    cdef void restart(self, double value) noexcept:
        """Begin as after a long time at ``value``."""
        self._past[:] = value
        self._value = value

    cdef double step(self, double value) noexcept:
        """Return the lagged signal one sample later."""
        cdef double delayed
        self._newest = (self._newest + 1) % self._size
        self._past[self._newest] = value
        # The oldest is one sample older than the whole part of the delay.
        delayed = (1.0 - self._part) * self._past[(self._newest + 2) % self._size] + self._part * self._past[
            (self._newest + 1) % self._size]
        self._value = self._keep * self._value + (1.0 - self._keep) * delayed
        return self._value


cdef class LaggedMeans:
    """Means over groups of consecutive samples, the groups fixed to the grid, the first inputs lagged before.

    The mean of both inputs and outputs keeps a linear relation between them and suppresses what is faster than the new
    grid.

    Parameters
    ----------
    timing : Sequence[tuple[float, float]]
        Delay and lag of each of the first inputs, seconds.
    rate_hz : float
        Incoming samples per second.
    size : int
        Samples of a group.
    inputs, outputs : int
        Widths of u and y.
    """

    cdef list _lags
    cdef Py_ssize_t _size, _inputs, _outputs, _grouped
    cdef double[::1] _sum
    cdef bint _complete, _measured, _evident, _restart

    def __init__(self, timing, double rate_hz, Py_ssize_t size, Py_ssize_t inputs, Py_ssize_t outputs):
        self._lags = [_Lag.__new__(_Lag, delay_s, lag_s, rate_hz) for delay_s, lag_s in timing]
        self._size, self._inputs, self._outputs = size, inputs, outputs
        self._complete = self._measured = self._evident = self._restart = True
        self._sum = np.zeros(inputs + outputs)

    def run(self, samples, columns, evidence):
        """Process samples; return the means, each at the end of its group.

        Parameters
        ----------
        samples : Samples
            Their times and flags; at one marked ``restart`` lag and group begin anew.
        columns : Sequence[NDArray[np.float64]]
            u, then y, one column each (n,).
        evidence : NDArray[np.bool_]
            Which samples are evidence (n,). A mean that contains another one is no evidence: its channels count as
            ``lost``.
        """
        cdef const double[:, ::1] given = np.column_stack(columns)
        cdef const long long[:] index = samples.index, vehicle = samples.vehicle_time_ns
        cdef const long long[:] time = samples.time_ns, known = samples.known_ns
        cdef const unsigned char[:] restart = samples.restart.view(np.uint8)
        cdef const unsigned char[:] complete = samples.complete.view(np.uint8)
        cdef const unsigned char[:] measured = samples.measured.view(np.uint8)
        cdef const unsigned char[:] evident = evidence.view(np.uint8)
        cdef Py_ssize_t row, i, place, count = 0, most = 0, width = self._inputs + self._outputs
        cdef Py_ssize_t lagged = len(self._lags)
        cdef double value
        for row in range(index.shape[0]):
            most += index[row] % self._size == self._size - 1
        whole, marks, ends = np.empty((4, most), np.int64), np.empty((4, most), np.bool_), np.empty(most, np.intp)
        inputs, outputs = np.empty((most, self._inputs)), np.empty((most, self._outputs))
        cdef long long[:, ::1] times = whole
        cdef unsigned char[:, ::1] flags = marks.view(np.uint8)
        cdef Py_ssize_t[::1] rows = ends
        cdef double[:, ::1] u = inputs, y = outputs
        for row in range(index.shape[0]):
            place = index[row] % self._size
            if restart[row]:
                self._restart = True
                for i in range(lagged):
                    (<_Lag>self._lags[i]).restart(given[row, i])
            if restart[row] or place == 0:
                self._grouped = 0
                self._sum[:] = 0.0
                self._complete = self._measured = self._evident = True
            for i in range(width):
                value = given[row, i]
                if i < lagged:
                    value = (<_Lag>self._lags[i]).step(value)
                self._sum[i] = self._sum[i] + value
            self._grouped += 1
            self._complete = self._complete and complete[row]
            self._measured = self._measured and measured[row]
            self._evident = self._evident and evident[row]
            if self._grouped < self._size or place != self._size - 1:
                continue
            for i in range(self._inputs):
                u[count, i] = self._sum[i] / self._grouped
            for i in range(self._outputs):
                y[count, i] = self._sum[self._inputs + i] / self._grouped
            times[0, count] = index[row] // self._size
            times[1, count], times[2, count], times[3, count] = vehicle[row], time[row], known[row]
            flags[0, count], flags[1, count], flags[2, count] = self._restart, self._complete, self._measured
            flags[3, count] = not (self._measured and self._evident)
            self._restart = False
            rows[count] = row
            count += 1
        if count < most:
            whole, marks, ends = whole[:, :count], marks[:, :count], ends[:count]
            inputs, outputs = inputs[:count], outputs[:count]
        lost = np.broadcast_to(marks[3][:, np.newaxis], (count, width))
        return Given(
            Samples(whole[0], whole[1], whole[2], inputs, outputs, marks[0], marks[1], whole[3], marks[2], lost), ends
        )
