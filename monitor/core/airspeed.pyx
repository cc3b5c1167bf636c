# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""The airspeed expected from GPS and wind (wind triangle), sample by sample, and the estimate of that wind.

With the GPS's velocity v, the climb rate c and the wind w, all as true speeds,

    s = sqrt((v_north - w_north)^2 + (v_east - w_east)^2 + c^2),     airspeed = s + b + gusts.

A Kalman filter estimates the wind and the sensor's small error b. They are told apart when the plane turns: b turns
with the plane, the wind does not. The first wind comes from the heading; the compass is not used later. The expected
airspeed uses the wind of some seconds ago, so that a fault is seen before the filter takes it for wind. Once the
difference exceeds its level, the error b may become large and the wind may have changed too ("free").
"""

import numpy as np

from libc.math cimport M_PI, cos, fabs, fmax, fmin, isfinite, pow, sin, sqrt
from libc.string cimport memset

# Standard deviations at the start. Wind, as a share of the speed: the effect of sideslip and of a heading 11 degrees
# off. Sensor's error, m/s: half of what its zero set on the ground may be off by at the slowest flight.
cdef double _WIND = 0.2
cdef double _ERROR = 0.5
# Random walk of that error, m/s per root of a second: 0.1 m/s in a flight of some minutes.
cdef double _ERROR_WALK = 0.005
# The same for a free error: its least standard deviation, m/s, and its standard deviation as a multiple of the
# difference; by how much the wind may have changed, m/s; the random walk. Chosen: a pitot tube may read nothing or far
# too much, and the wind must not absorb part of that. With 2 m/s the wind absorbed a third of a leak of 8 m/s in 16 s;
# with 0.5 m/s a front that had been followed raised its alarm again. A leak grows and falls with the speed within a
# turn.
cdef double _FREE_ERROR = 10.0
cdef double _FREE_TIMES = 4.0
cdef double _FREE_WIND = 1.0
cdef double _FREE_WALK = 0.3
# Age of the wind used for the expected airspeed, seconds: three times _MEAN_S, plus the debounce of the alarm.
cdef double _AGE_S = 5.0
# Duration of a gust, seconds (160 m at 20 m/s): the samples of so long a time count as one.
cdef double _GUST_S = 8.0
# Random walk of the wind, m/s per root of a second, and, as wind grows with height, per root of a metre of climb.
# Chosen: 1 m/s in 100 s; 3 m/s in 100 m, as a wind of 5 m/s grows from 10 m above the ground.
cdef double _WALK = 0.1
cdef double _SHEAR = 0.3
# Time constant of the mean difference that frees the error, and of the climb rate, seconds.
cdef double _MEAN_S = 1.0
# How long that mean has to stay below half its level until the fault is over, seconds: gusts cross zero sooner.
cdef double _OVER_S = 3.0
# Time by which GPS and airspeed may be apart, seconds: half of the delay of a 1 Hz filter plus the time between two
# fixes at 5 Hz. The change of speed within this time is no difference.
cdef double _TIMING_S = 0.15
# Time constant of that change of speed, seconds.
cdef double _CHANGE_S = 0.3
# Time over which the present size of gusts is measured, seconds, and the largest size, as a multiple of that in the
# fitted flights. A difference beyond that is no gust.
cdef double _ROUGH_S = 10.0
cdef double _ROUGHEST = 3.0
# The wind along the flight is known up to this standard deviation, m/s, or up to the level if that is more: half of the
# smallest difference that raises an alarm at 20 m/s.
cdef double _KNOWN = 1.0
# How long the difference has to stay below half its level until a first estimate of the wind is used, and the longest
# wait for that, seconds. Chosen: in its first turn an unknown wind was off by 7 m/s for 9 s; with a covered pitot tube
# the difference never gets small.
cdef double _AGREED_S = 5.0
cdef double _WAITED_S = 60.0
# Steepest climb or dive, as a share of the speed: beyond 30 degrees the delay of GPS altitudes is too large.
cdef double _STEEPEST = 0.5
# Standard atmosphere: lapse rate over the temperature at sea level, per metre; half the exponent of the density.
LAPSE = 2.25577e-5
EXPONENT = 2.12794
cdef double _LAPSE = LAPSE, _EXPONENT = EXPONENT, _HIGHEST = 2e4

cdef enum:
    # Values of a tick in the delay line: true airspeed, velocity north, east, climb rate, whether they are measured.
    _WAITING = 5


cdef class AirspeedCore:
    """State of the comparison.

    Parameters
    ----------
    dt : float
        Time between samples, seconds.
    scale : float
        True airspeed over the indicated one at sea level.
    noise : float
        Standard deviation of the difference in the fitted flights, m/s.
    level : float
        Mean difference from which the sensor's error is let free, m/s.
    minimum : float
        Speed below which a plane does not fly, m/s.
    """

    cdef double _dt, _scale, _noise, _level, _minimum
    cdef double[:, ::1] _line
    cdef Py_ssize_t _ticks, _count, _next
    cdef double[3] _x
    cdef double[3][3] _P
    cdef double _offset, _mean, _rough, _altitude, _speed, _change, _over_s, _measured, _agreed_s, _waited_s
    cdef bint _begun, _flies, _free, _known

    def __cinit__(self, double dt, double scale, double noise, double level, double minimum):
        self._dt, self._scale, self._noise, self._level, self._minimum = dt, scale, noise, level, minimum
        self._ticks = max(1, round(_AGE_S / dt))
        self._line = np.empty((self._ticks, _WAITING))
        self.restart()

    cdef void restart(self) noexcept:
        """Forget all samples."""
        memset(self._x, 0, sizeof(self._x))
        memset(self._P, 0, sizeof(self._P))
        self._P[2][2] = _ERROR * _ERROR
        self._count = self._next = 0
        self._rough = 1.0
        self._offset = self._mean = self._change = self._over_s = self._agreed_s = self._waited_s = 0.0
        self._speed = self._measured = 0.0
        self._begun = self._flies = self._free = self._known = False

    def run(self, samples):
        """Process raw samples (airspeed, GPS speed, course in degrees and altitude, yaw).

        Parameters
        ----------
        samples : Samples
            One marked ``restart`` begins anew.

        Returns
        -------
        tuple
            For each sample, (n,): the expected true airspeed; the measured one of the sample before (its own at a
            start); whether one of them was not measured or is not known; how many times larger gusts are than in the
            fitted flights.
        """
        cdef const double[:, ::1] raw = np.ascontiguousarray(samples.u)
        cdef const unsigned char[:] restart = samples.restart.view(np.uint8)
        cdef const unsigned char[:, :] lost = samples.lost.view(np.uint8)
        cdef Py_ssize_t row, i, n = raw.shape[0]
        cdef bint lacks, known
        cdef double off = 0.0, before
        found, lacking = np.zeros((3, n)), np.zeros(n, np.bool_)
        cdef double[:, ::1] given = found
        cdef unsigned char[::1] without = lacking.view(np.uint8)
        for row in range(n):
            if restart[row]:
                self.restart()
            lacks = False
            for i in range(5):
                lacks |= lost[row, i] or not isfinite(raw[row, i])
            off = 0.0
            known = not lacks and self.tick(&raw[row, 0], &off)
            if lacks:
                self.follow(NULL)
            given[0, row] = self._speed + self._offset
            before, self._measured = self._measured, given[0, row] + off
            given[1, row] = self._measured if restart[row] else before
            without[row] = not (known and (self._known or restart[row]))
            self._known = known
            given[2, row] = sqrt(fmax(1.0, self._rough))
        return found[0], found[1], lacking, found[2]

    cdef bint tick(self, const double* raw, double* off) noexcept:
        """Process a sample and fill in the difference. Return whether the wind is known and the plane flies."""
        cdef double[_WAITING] now
        cdef double[3] H
        cdef double course = raw[2] * M_PI / 180.0, altitude = raw[3]
        cdef double before = self._speed, difference, variance, slack, beyond
        cdef bint agrees
        if not self._begun:
            self._altitude = altitude
        self._altitude += fmin(1.0, self._dt / _MEAN_S) * (altitude - self._altitude)
        now[0] = self._scale * raw[0] * pow(1.0 - _LAPSE * fmin(fmax(altitude, -_HIGHEST), _HIGHEST), -_EXPONENT)
        now[1], now[2], now[3] = raw[1] * cos(course), raw[1] * sin(course), (altitude - self._altitude) / _MEAN_S
        now[4] = 1.0
        if not self._flies and raw[1] > self._minimum:
            self.start(now, raw[4])
        self.follow(now)
        self._speed = self.triangle(now, H)
        if not self._free:
            self._offset = self._x[2]
        difference = now[0] - self._speed - self._offset
        if self._begun:
            self._change += fmin(1.0, self._dt / _CHANGE_S) * ((self._speed - before) / self._dt - self._change)
        self._begun = True
        slack = _TIMING_S * fabs(self._change)
        off[0] = difference - slack if difference > slack else difference + slack if difference < -slack else 0.0
        variance = self.variance(H)
        if not self._flies or self._speed < self._minimum or fabs(now[3]) > _STEEPEST * self._speed:
            return False
        if not self._free and variance > fmax(_KNOWN, self._level) ** 2:
            self._agreed_s = self._waited_s = 0.0
            return False
        self._mean += fmin(1.0, self._dt / _MEAN_S) * (off[0] - self._mean)
        beyond = self._level * sqrt(fmax(1.0, self._rough))
        agrees = fabs(self._mean) < 0.5 * beyond
        if self._free:
            self._over_s = self._over_s + self._dt if agrees else 0.0
            if self._over_s > _OVER_S:
                self.hold()
            return True
        self._rough += self._dt / _ROUGH_S * (fmin((off[0] / self._noise) ** 2, _ROUGHEST * _ROUGHEST) - self._rough)
        self._waited_s += self._dt
        if self._agreed_s < _AGREED_S and self._waited_s < _WAITED_S:
            self._agreed_s = self._agreed_s + self._dt if agrees else 0.0
            return False
        if fabs(self._mean) > beyond:
            self.release(difference)
        return True

    cdef void start(self, const double* now, double yaw) noexcept:
        """Begin with the wind from airspeed and heading; with no wind where the airspeed is below that of flight."""
        cdef double spread = _WIND * now[0]
        self._flies = True
        if now[0] > self._minimum:
            self._x[0], self._x[1] = now[1] - now[0] * cos(yaw), now[2] - now[0] * sin(yaw)
        else:
            spread = _WIND * sqrt(now[1] * now[1] + now[2] * now[2])
        self._P[0][0] = self._P[1][1] = spread * spread

    cdef void release(self, double difference) noexcept:
        """Free the sensor's error, and drop the delay line, whose samples contain that error already."""
        if not self._free:
            self._free, self._over_s = True, 0.0
            self._count = self._next = 0
            self._P[0][0] += _FREE_WIND * _FREE_WIND
            self._P[1][1] += _FREE_WIND * _FREE_WIND
        self._P[2][2] += fmax(_FREE_ERROR, _FREE_TIMES * fabs(difference)) ** 2

    cdef void hold(self) noexcept:
        """End the fault: the sensor's error is again what it was before."""
        cdef int i
        self._free = False
        for i in range(2):
            self._P[i][2] = self._P[2][i] = 0.0
        self._x[2], self._P[2][2] = self._offset, _ERROR * _ERROR

    cdef double triangle(self, const double* now, double* H) noexcept:
        """Return the speed through the air; fill in the derivatives of the airspeed with respect to the state."""
        cdef double north = now[1] - self._x[0], east = now[2] - self._x[1]
        cdef double speed = sqrt(north * north + east * east + now[3] * now[3])
        H[0] = -north / speed if speed > 0.0 else 0.0
        H[1] = -east / speed if speed > 0.0 else 0.0
        H[2] = 1.0
        return speed

    cdef double variance(self, const double* H) noexcept:
        """Return the variance of the expected airspeed."""
        cdef double found = 0.0
        cdef int i, j
        for i in range(3):
            for j in range(3):
                found += H[i] * self._P[i][j] * H[j]
        return found

    cdef void follow(self, const double* now) noexcept:
        """Predict the state by a sample and correct it by the one of some seconds ago; a free error by the present
        one."""
        cdef double[_WAITING] measured
        cdef double[3] H
        cdef double* place = &self._line[self._next, 0]
        cdef double walk = _FREE_WALK if self._free else _ERROR_WALK
        cdef double wind = _WALK * _WALK + (_SHEAR * _SHEAR * fabs(now[3]) if now != NULL else 0.0)
        cdef double off
        cdef int i
        self._P[0][0] += self._dt * wind
        self._P[1][1] += self._dt * wind
        self._P[2][2] += self._dt * walk * walk
        if self._free:
            # A sample that fits the error before the fault better says nothing of the free error, nor of the wind.
            if now != NULL:
                off = fabs(now[0] - self.triangle(now, H) - self._offset)
                if 2.0 * off > fabs(self._x[2] - self._offset):
                    self.meet(now)
            return
        measured[4] = 0.0
        if self._count == self._ticks:
            for i in range(_WAITING):
                measured[i] = place[i]
        else:
            self._count += 1
        place[4] = 0.0
        if now != NULL:
            for i in range(_WAITING):
                place[i] = now[i]
        self._next = (self._next + 1) % self._ticks
        if measured[4] != 0.0:
            self.meet(measured)

    cdef void meet(self, const double* now) noexcept:
        """Correct the state by a measured airspeed.

        An innovation beyond three standard deviations is cut there; if the error is free, it frees the error anew.
        """
        cdef double[3] H
        cdef double[3] gain
        cdef double e, S, most
        cdef int i, j
        e = now[0] - self.triangle(now, H) - self._x[2]
        if self.triangle(now, H) < self._minimum and not self._free:
            return
        S = self.variance(H)
        most = 3.0 * sqrt(S + self._noise * self._noise)
        if self._free and fabs(e) > most:
            self.release(e)
            S = self.variance(H)
        else:
            e = fmax(-most, fmin(e, most))
        for i in range(3):
            gain[i] = 0.0
            for j in range(3):
                gain[i] += self._P[i][j] * H[j]
        S += self._noise * self._noise * fmax(1.0, _GUST_S / self._dt)
        for i in range(3):
            self._x[i] += gain[i] / S * e
        for i in range(3):
            for j in range(3):
                self._P[i][j] -= gain[i] * gain[j] / S
