# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
# cython: auto_pickle=False
"""Errors of straight lines over lost measurements of an IMU, measured on its own samples.

Where measurements are lost for a time T, a signal s is integrated along the straight line between its neighbours. The
error of the integral is

    e(T) = integral of s over T - T (s(0) + s(T)) / 2,

whose variance depends on how s varies within T: it grows with T^6 where s bends slowly, with T^3 where s is a random
walk (q T^3 / 12), with T^2 beyond the correlation time of s. So it is measured, not modelled: wherever all of T was
measured e(T) is known, for T of 2, 4, 8, ... ticks, and the mean of its square is followed. Between these T the
variance is interpolated linearly in logarithms.

For body rates w the attitude is a second source: at both ends it tells by how much the vehicle turned in between, but
for the corrections of its estimator, and for its time, which is earlier than that of the gyros by tau, as autopilots
filter these (12 ms in ArduPilot at 100 Hz):

    turn of the attitude = integral of w over T + tau (w(T) - w(0)) + error.

tau is the regression over the whole flight; the variance of the error is measured in the same way.
"""

from libc.math cimport exp, fmax, fmin, log
from libc.string cimport memcpy, memset

# Memory of the means, seconds. Chosen: some manoeuvres, the next of which may fall into a gap.
cdef double _REMEMBERED_S = 60.0
# Assumed errors before anything was measured: factor and power of the time T in seconds, of velocities (m/s), of angles
# by gyros and of angles by the attitude (rad). Measured on five flights of two autopilots (root mean square in 0.08 s,
# the quietest and the most agile): 0.0015 to 0.09 m/s, 0.2 to 3.3 mrad, 0.2 to 0.4 mrad.
cdef double[3] _AT_FIRST = [1.0, 0.3, 0.03]
cdef double[3] _POWER = [1.5, 1.5, 1.0]
# Weight of the assumption, in spans. Chosen: one first span with a small error by chance must not count as certainty.
cdef double _ASSUMED = 2.0
# Before anything was measured a line tells nothing of the acceleration down, whose integral has this error, m/s, times
# the square root of the time in seconds: twice the largest on four healthy flights, over 0.1 to 1 s (0.04 to 0.42).
cdef double _DOWN_AT_FIRST = 1.0
# Index of the span by which tau is measured, 4 ticks: results over 2 to 32 ticks are alike. Initial sum of squared
# changes of rates (rad/s)^2, with tau = 0. Chosen: a turn at half a radian per second, in which 12 ms make 6 mrad.
cdef int _EARLY_SPAN = 1
cdef double _TURNS = 0.25
# Power of T with which variances grow beyond the longest span: that of a random walk.
cdef double _BEYOND = 3.0

cdef enum:
    # Index of the acceleration down, of the first rate, and of the first error of the attitude.
    _DOWN = 2
    _RATE = 3
    _TURNED = 6


cdef class LineErrors:
    """Variances of the errors of lines, followed over a flight.

    Parameters
    ----------
    dt : float
        Time between ticks, seconds.
    """

    def __init__(self, double dt):
        cdef double span_s
        cdef int k, i
        self._dt = dt
        for k in range(SPANS):
            span_s = dt * (2 << k)
            for i in range(ERRORS):
                self._variance[k][i] = (_AT_FIRST[i // 3] * span_s ** _POWER[i // 3]) ** 2
            self._down[k][0] = self._down[k][1] = 0.0
            self._down[k][2] = _DOWN_AT_FIRST ** 2 * span_s
        memset(self._count, 0, sizeof(self._count))
        self._early[0], self._early[1] = 0.0, _TURNS
        self.restart()

    cdef void restart(self) noexcept:
        """Begin anew after a gap, and keep the variances."""
        self._tick, self._measured = 0, -1

    cdef void follow(self, const double* value, const double* turned, bint lined) noexcept:
        """Process a tick: signals, and the angles by which the attitude turned; ``lined``: the signals lie on a
        line."""
        cdef double* last
        cdef double* total
        cdef double* before
        cdef double error, weight, mean, line, change
        cdef int i, k, span, newest, first
        self._tick += 1
        newest, first = self._tick % (LONGEST + 1), (self._tick - 1) % (LONGEST + 1)
        last, before, total = self._value[first], self._integral[first], self._integral[newest]
        memcpy(self._value[newest], value, SIGNALS * sizeof(double))
        for i in range(SIGNALS):
            mean = 0.5 * (last[i] + value[i]) * self._dt
            total[i] = before[i] + mean if self._measured >= 0 else 0.0
            if i >= _RATE:
                total[3 + i] = before[3 + i] + turned[i - _RATE] - mean if self._measured >= 0 else 0.0
        self._measured = -1 if lined else self._measured + 1
        for k in range(SPANS):
            span = 2 << k
            if self._measured < span or self._tick % (span // 2):
                continue
            first = (self._tick - span) % (LONGEST + 1)
            self._count[k] += 1
            weight = fmax(1.0 / (self._count[k] + _ASSUMED), 0.5 * span * self._dt / _REMEMBERED_S)
            for i in range(ERRORS):
                error = total[i] - self._integral[first][i]
                if i < SIGNALS:
                    line = 0.5 * span * self._dt * (value[i] + self._value[first][i])
                else:
                    change = value[i - 3] - self._value[first][i - 3]
                    line = self.early_s() * change
                    if k == _EARLY_SPAN:
                        self._early[0] += error * change
                        self._early[1] += change * change
                if i == _DOWN:
                    self._down[k][0] += weight * (line * line - self._down[k][0])
                    self._down[k][1] += weight * (line * error - self._down[k][1])
                    self._down[k][2] += weight * (error * error - self._down[k][2])
                self._variance[k][i] += weight * ((error - line) ** 2 - self._variance[k][i])

    cdef double change(self, int i, double value) noexcept:
        """Return the change of a signal since the tick before, to a new value."""
        return value - self._value[self._tick % (LONGEST + 1)][i] if self._tick else 0.0

    cdef double early_s(self) noexcept:
        """Return tau, by which the attitude is earlier than the gyros, seconds."""
        return self._early[0] / self._early[1]

    cdef double variance(self, int i, double ticks) noexcept:
        """Return the variance of an error over a line of so many ticks."""
        cdef double share
        cdef int k = _between(ticks, &share)
        return _grown(self._variance[k][i], self._variance[k + 1][i], share)

    cdef double steep(self, int i, double value, double ticks) noexcept:
        """Return the same, at least that of the step to ``value``, as the line may be steeper than any measured
        before."""
        return fmax(self.variance(i, ticks), spread_between(self.change(i, value) * ticks * ticks * self._dt))

    cdef double down(self, double ticks, double* variance) noexcept:
        """Return the factor of a line that gives the expected integral of the acceleration down; fill in the variance
        left.

        It is the regression of the integral on the line: where the ends of a line are mostly noise it is small.
        """
        cdef double[2] slope
        cdef double[2] left
        cdef double share
        cdef int k = _between(ticks, &share), i
        for i in range(2):
            slope[i] = self._down[k + i][1] / self._down[k + i][0] if self._down[k + i][0] > 0.0 else 0.0
            slope[i] = fmin(fmax(slope[i], 0.0), 1.0)
            left[i] = self._down[k + i][2] + slope[i] * (slope[i] * self._down[k + i][0] - 2.0 * self._down[k + i][1])
        variance[0] = _grown(fmax(left[0], 0.0), fmax(left[1], 0.0), share)
        share = fmin(share, 1.0)
        return (1.0 - share) * slope[0] + share * slope[1]


cdef inline int _between(double ticks, double* share) noexcept:
    """Return the index of the span below so many ticks, and fill in the position between it and the next one."""
    cdef int k = 0
    while k < SPANS - 2 and ticks > (4 << k):
        k += 1
    share[0] = fmax(log(ticks / (2 << k)) / log(2.0), 0.0)
    return k


cdef inline double _grown(double shorter, double longer, double share) noexcept:
    """Return a variance interpolated in logarithms; beyond the longest span it grows as that of a random walk."""
    cdef double beyond = fmax(share - 1.0, 0.0)
    share = fmin(share, 1.0)
    return exp((1.0 - share) * log(shorter + 1e-30) + share * log(longer + 1e-30) + beyond * _BEYOND * log(2.0))
