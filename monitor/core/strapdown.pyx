# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Strapdown kinematics tick by tick: the vehicle's motion by each of its raw signals, delayed to equal age.

:mod:`monitor.vehicles.inertial.strapdown` explains inputs and outputs. Sines, roots and powers are those of the C
library, one tick after the other, so results do not depend on how a stream is cut into batches.
"""

import numpy as np

from adapters.channels import STANDARD_GRAVITY
from adapters.sample import Given, Samples

from cpython.mem cimport PyMem_Free, PyMem_Malloc
from libc.math cimport INFINITY, M_PI, atan2, cos, fabs, fmod, hypot, pow, sin, sqrt
from libc.string cimport memcmp, memcpy, memset

from monitor.core.lines cimport LineErrors
from monitor.core.navigation cimport Navigation, along, field_rate, is_steep, wrapped

cdef double _GRAVITY = STANDARD_GRAVITY
# WGS-84: semi-major axis in metres and square of the first eccentricity.
cdef double _WGS84_A = 6_378_137.0
cdef double _WGS84_E2 = 6.694_379_990_14e-3
cdef double _DEGREE = M_PI / 180.0
# Chosen: an attitude that turns faster than the gyros by this much (rad/s, well above a gyro's bias) was reset, as by a
# change of the estimator. That takes a few ticks at most: if it lasts longer it is believed.
cdef double _RESET_RATE = 1.0
cdef int _RESET_TICKS = 3
# Chosen: twice the smallest error of a position that is worth an alarm. A fix that was constant for long and then moves
# by less was that of a vehicle at rest without noise, as in simulators.
cdef double _STUCK_METRES = 1.0
# A change above rounding, of the slope of a straight line or of a fix, relative to the velocity or the fix: some
# thousand times double precision.
cdef double _BENT = 1e-12
# Time for which a position may be further than that from its velocity's integral as both jump back, s: a jump of the
# velocity is known after three comparisons, at most 1 s apart.
cdef double _JUMPS_S = 4.0
# Speed of a receiver at rest, m/s: the noise of its velocity, as the navigation assumes it at the start.
cdef double _STANDS = 0.1
# For how long gyro or attitude may be missing before all begins anew, seconds. Chosen: as long as a gap of the samples.
cdef double _LONGEST_S = 1.5
# Motion that may go unnoticed while a sensor is missing: by a tilt of 30 mrad and a gyro's error of 1 degree/s.
# Measured on four healthy flights: after 1 to 2.5 s the position is 0.05 to 0.16 m off (root mean square).
cdef double _UNSEEN_ACCELERATION = 0.3
cdef double _UNSEEN_RATE = 0.02
# Position error between two known velocities while GPS and IMU are both missing, m, times the time in seconds to the
# power of 2.5: twice sqrt(12 / 720), the standard deviation for accelerations that change the velocity by 1 m/s in a
# second (a random walk with known ends, of 12 m^2/s^5). A GPS drift of 0.5 m/s exceeds it in every gap up to 1.5 s;
# with three standard deviations it would not from 1.2 s on.
cdef double _UNSEEN_WAY = 0.26
# Rotation of the magnetic field about the vertical from which it is not compared, rad/s: half of the step of delays
# that a fit tries, 0.02 s, then makes half of the smallest compass fault that is worth an alarm, 0.09 rad.
cdef double _WHIRLING = 4.5
# Random walk of the vertical velocity while its acceleration is measured, m/s per root of a second: as in the
# navigation.
cdef double _WALK = 0.05
# Longest line over lost measurements of the magnetic field that gives a heading, s: a turn that changes by 10 rad/s^2
# makes an error of 3 mrad in it, three times the noise of a quiet field; in 0.1 s 12 mrad.
cdef double _FIELD_LINE_S = 0.05
# Noise of a height, m, and correlation time of its errors, s. Chosen: those of barometers in wind; the smaller
# innovation of two heights counts, so a better height is not taken for worse.
cdef double _HEIGHT_NOISE = 0.1
cdef double _HEIGHT_LASTS_S = 0.1
# Longest time for which a magnetic field may stay the same, as a multiple of the time between two fields, where these
# are slower than in the fitted flights: two in a row may be lost. A log has 2 fields a second, the fitted link 100.
cdef int _HELD_STEPS = 3
# Most ticks that are counted: their product with _HELD_STEPS fits an int.
cdef int _LONGEST_STEP = 1 << 28
# Standard deviation below which a vertical velocity is known again, m/s: without a gap the filter has 0.05.
cdef double _SPEED_KNOWN = 0.075
# Largest innovation of a height that is the only one, in standard deviations. Time in which two heights drift apart, s.
# Chosen: longer than a gap, shorter than the washout of heights.
cdef double _OUTLIER = 3.0
cdef double _APART_S = 3.0
# For how long the attitude is no evidence against the gyros after a gyro's fault, seconds. Chosen: estimators of two
# autopilots took 10 to 20 s to learn that a bias had ended.
cdef double _LEARNING_S = 30.0
# Difference of the verticals of autopilot and navigation from which one is wrong, rad. Measured: 0.003 to 0.008 (root
# mean square) in eight healthy flights of two autopilots, 0.03 to 0.6 after faults of gyros.
cdef double _TILTED = 0.03
# The same of their headings, rad: the noise of an autopilot's heading in the navigation.
cdef double _HEADING_APART = 0.1

# Groups of signals that are measured together.
cdef enum:
    _IMU
    _GPS
    _BARO
    _MAG
    _GROUPS

cdef enum:
    # Most signals, and most u or y, with room to spare.
    _WIDEST = 24
    # What the navigation reads at a tick: force, rate and attitude, whether they are missing, the field, whether any is
    # on a line, variances hidden by lines, and the mean rate.
    _SENSED = 29


cdef class _Delay:
    """A delay line of some ticks."""

    cdef double* _line
    cdef int _width
    cdef Py_ssize_t _ticks, _count, _next

    def __cinit__(self, Py_ssize_t ticks, int width):
        self._ticks, self._width = ticks, width
        self._line = <double*>PyMem_Malloc((ticks + 1) * width * sizeof(double))
        if self._line == NULL:
            raise MemoryError

    def __dealloc__(self):
        PyMem_Free(self._line)

    cdef void clear(self) noexcept:
        self._count = self._next = 0

    cdef double* push(self, const double* values) noexcept:
        """Append values; return those of `ticks` ago, NULL while the line fills."""
        memcpy(self._line + self._next * self._width, values, self._width * sizeof(double))
        self._next = (self._next + 1) % (self._ticks + 1)
        self._count = min(self._count + 1, self._ticks + 1)
        return self._line + self._next * self._width if self._count > self._ticks else NULL


cdef class _Vertical:
    """The vehicle's vertical velocity: a Kalman filter of height and its rate.

    With acceleration a,  d+ = d + T (w + a T / 2),  w+ = w + T a,  heights d + their own offsets + noise.
    """

    cdef double _dt, depth, speed, _noise
    # Variance of the height, covariance, variance of its rate.
    cdef double[3] _P
    cdef double[2] _offset
    cdef bint[2] _lacked
    cdef bint _begun
    # Whether the speed is unknown after a gap.
    cdef bint unknown

    def __init__(self, double dt):
        self._dt, self._noise = dt, _HEIGHT_NOISE * _HEIGHT_NOISE
        self.restart()

    cdef void restart(self) noexcept:
        self._begun = self.unknown = False
        memset(self._lacked, 0, sizeof(self._lacked))
        self.depth = self.speed = 0.0
        self._P[0], self._P[1], self._P[2] = self._noise, 0.0, 1.0

    cdef double predict(self, double acceleration, double hidden) noexcept:
        """Predict by a tick; ``hidden`` is the velocity's variance that a line hides. Return the change of height."""
        cdef double T = self._dt, change = T * (self.speed + 0.5 * T * acceleration)
        cdef double q = T * _WALK * _WALK + hidden
        self.depth += change
        self.speed += T * acceleration
        self._P[0] += T * (2.0 * self._P[1] + T * self._P[2])
        self._P[1] += T * self._P[2] + 0.5 * T * q
        self._P[2] += q
        self.unknown |= hidden > 0.0 and self._P[2] > _SPEED_KNOWN * _SPEED_KNOWN
        return change

    cdef void meet(self, int count, const double* heights, const bint* lacks, double* correction) noexcept:
        """Fill in the corrections of height and speed by those of ``count`` heights that are not missing.

        Of two heights the smaller innovation counts, as the other one may have jumped; a single one of two must be
        near. After a gap the first height tells where the vehicle is; otherwise errors last for some ticks.
        """
        cdef double[2] off
        cdef double S, p
        cdef bint back = False
        cdef int i, there = 0
        correction[0] = correction[1] = 0.0
        for i in range(count):
            if not self._begun:
                self._offset[i] = heights[i]
            back |= self._lacked[i] and not lacks[i]
            self._lacked[i] = lacks[i]
            if not lacks[i]:
                off[there] = heights[i] - self._offset[i] - self.depth
                there += 1
                if not self.unknown and count > 1:
                    self._offset[i] += self._dt / _APART_S * off[there - 1]
        self._begun = True
        S = self._P[0] + self._noise * (1.0 if back else max(1.0, _HEIGHT_LASTS_S / self._dt))
        if there == 2 and fabs(off[1]) < fabs(off[0]):
            off[0] = off[1]
        if there == 0 or there < count and fabs(off[0]) > _OUTLIER * sqrt(S):
            return
        correction[0] = off[0] if back and self.unknown else self._P[0] / S * off[0]
        correction[1] = self._P[1] / S * off[0]
        p = self._P[1]
        self._P[2] -= p * p / S
        self._P[1] -= p * self._P[0] / S
        self._P[0] -= self._P[0] * self._P[0] / S
        self.unknown &= self._P[2] > _SPEED_KNOWN * _SPEED_KNOWN


cdef class StrapdownCore:
    """State of the transform.

    Parameters
    ----------
    gps, baro, mag : bool
        Whether there are GPS, barometer and magnetometer in addition to IMU and attitude.
    speeds : int
        Signals of the GPS's velocity: 2, speed and course; 3, along the body's axes; 0, none.
    hectopascal : bool
        Whether the barometer's signal is its pressure.
    dt : float
        Time between ticks, seconds.
    imu_ticks, gps_ticks, baro_ticks, compass_ticks : int
        Ticks by which to delay acceleration, GPS and barometer, and the attitude that levels the magnetometer.
    gps_hold, compass_hold, imu_hold : int
        Ticks for which a fix, a magnetic field, and the whole IMU with attitude may stay the same (0: for ever). An IMU
        that stays the same for longer counts as missing.
    count : int
        Ticks of one period, from sample to sample of the results.
    inputs : int
        Number of u.
    washouts : Sequence[tuple[float, float]]
        phi and tau (1 - phi) / T of each output.
    twice : Sequence[bool]
        Whether each output is washed out twice.
    navigation : Navigation | None
        Finds faults of gyros and accelerometers by the GPS's velocity; the last two outputs are then the
        accelerometers' faults, which are not washed out.
    attitude_share : float
        Share of the difference between attitude and gyros that counts while the navigation holds none of them
        responsible.
    angles_s : Sequence[float]
        T of each gyro, x, y and z: the observer estimates its fault as T f^' = f - f^; 0: not known.
    learned : bool
        Whether the gyros' rates are replaced by the bias that the autopilot's estimator subtracts from them.

    Attributes
    ----------
    scores : ndarray
        How likely the navigation held its likeliest fault in each of the samples given out last.
    spreads : ndarray
        Standard deviations of the faults of gyros x, y, z, accelerometers x, y and compass as the navigation judges
        them in each of these samples (n, 6); 0 where it does not.
    sizes : ndarray
        Sizes of the faults of gyros and accelerometers that it believes (n, 5); 0 where it believes none.
    frozen_ns : int
        Vehicle time since which IMU and attitude have been the same, if that is longer than ``imu_hold``; otherwise 0.
    """

    cdef bint _gps, _baro, _mag, _hectopascal
    cdef int _speeds
    cdef double _dt
    cdef _Delay _motion, _fixes, _altitudes, _levels, _sensed
    cdef Navigation _navigation
    cdef _Vertical _vertical
    cdef LineErrors _errors
    # Of the acceleration down as it is delayed: the share of it that counts, and what a line hides of the velocity.
    cdef double _down_share, _down_hidden
    # By how much faster the square of what GPS and inertial sensors drift apart grows for what a line hides.
    cdef double _hidden
    cdef readonly object scores, spreads, sizes
    cdef int _washed
    cdef double _biased_s, _attitude_share
    cdef bint _learned
    cdef readonly long long frozen_ns
    cdef long long _changed_ns
    cdef int _gps_hold, _compass_hold, _imu_hold, _imu_age, _count, _inputs, _outputs
    cdef double[9] _imu
    cdef double[_WIDEST] _keep
    cdef double[_WIDEST] _gain
    # For how many ticks a lost measurement is part of the results, and for how many more one of each group is.
    cdef int _longest
    cdef int[_GROUPS] _doubt
    # Outputs of each group: the first, and one after the last.
    cdef int[_GROUPS] _first
    cdef int[_GROUPS] _stop
    # Whether each group was missing at the tick before, as delayed; for how many ticks it has been; offsets that are
    # added to its outputs, now and before it was missing; its outputs at the tick before.
    cdef bint[_GROUPS] _lacked
    # Whether it has been missing since the beginning, so that its offset is not known.
    cdef bint[_GROUPS] _unknown
    # Whether nothing told the acceleration while the GPS was missing.
    cdef bint _blind
    cdef int[_GROUPS] _lacking
    # Mean of :attr:`_hidden` over the memory of the velocity.
    cdef double _unseen
    cdef double[_WIDEST] _added
    cdef double[_WIDEST] _anchor
    cdef double[_WIDEST] _place
    cdef double[2] _speed
    # The error of the GPS's velocity by a ramp, as the period began; the washed-out differences of GPS position and
    # velocity from the inputs, and the first of these four that is void.
    cdef double[2] _led
    cdef double[4] _apart_gps
    # For how long these positions have been apart from the velocity, s.
    cdef double _parted_s
    cdef int _void
    # Whether the rotation was set back in this period, a jump that no sensor made; whether the present y contains it.
    cdef bint _corrected, _moved
    cdef bint _still
    cdef int _stills
    # Attitude of the tick before; the rotation so far; first position, and metres per degree there.
    cdef bint _turning, _placed
    cdef double[9] _attitude
    cdef double[3] _turn_rate
    cdef double[3] _turned
    # T of the observer's estimate of each gyro's fault, and that estimate.
    cdef double[3] _angle_s
    cdef double[3] _estimated
    cdef double[4] _origin
    cdef double _heading, _set_back, _seen
    # The rotation from the navigation's attitude to the autopilot's, north, east, down.
    cdef double[9] _apart
    cdef int _resets
    # Whether a reset moved the vertical; whether no field has been compared since.
    cdef bint _tipped, _unread
    # The newest fix and magnetic field; for how many ticks each has been the same; ticks between the last two fields;
    # the speed.
    cdef double[5] _fix
    cdef double[3] _field
    cdef double[2] _reckoned
    cdef int _fix_age, _field_age, _field_step
    # Where a receiver was stuck; the vehicle's way since then by accelerations; ticks until that is compared with the
    # next fixes; whether all has to begin anew there.
    cdef double[2] _stuck
    # The GPS's velocity of the tick before as received, its change then, and whether the change was another one before.
    cdef double[3] _spoke
    cdef double[3] _slope
    cdef bint _bent
    cdef double[2] _way
    cdef int _loose
    cdef bint _unstuck
    # Whether the magnetic field is on a line too long to give a heading.
    cdef bint _faint
    # For how many ticks neither GPS nor IMU has shown a motion; whether no moving fix has been compared since.
    cdef int _resting
    cdef bint _stood
    # u of the tick before; sum of u since the period's start; time and integrals at that start.
    cdef bint _has_before, _begun, _fresh
    cdef double[_WIDEST] _before
    cdef double[_WIDEST] _sum
    cdef int _summed
    cdef long long _start_index, _start_vehicle, _start_time
    cdef double[_WIDEST] _start
    cdef double[_WIDEST] _y
    cdef double[_WIDEST] _once
    cdef bint[_WIDEST] _twice

    def __init__(
        self,
        bint gps,
        int speeds,
        bint baro,
        bint mag,
        bint hectopascal,
        double dt,
        int imu_ticks,
        int gps_ticks,
        int baro_ticks,
        int compass_ticks,
        int gps_hold,
        int compass_hold,
        int count,
        int inputs,
        washouts,
        twice,
        navigation=None,
        double attitude_share=1.0,
        int imu_hold=0,
        angles_s=(0.0, 0.0, 0.0),
        bint learned=False,
    ):
        cdef int i
        self._gps, self._baro, self._mag, self._hectopascal, self._dt = gps, baro, mag, hectopascal, dt
        self._speeds = speeds
        # After the values: whether their measurements are missing; for fixes the length of a line over lost ones.
        self._motion = _Delay.__new__(_Delay, imu_ticks, 6)
        self._fixes = _Delay.__new__(_Delay, gps_ticks, 8)
        self._altitudes = _Delay.__new__(_Delay, baro_ticks, 2)
        self._levels = _Delay.__new__(_Delay, compass_ticks, 8)
        self._navigation, self._sensed = navigation, _Delay.__new__(_Delay, imu_ticks, _SENSED)
        self._vertical, self._errors = _Vertical(dt), LineErrors(dt)
        self._attitude_share, self._angle_s = attitude_share, angles_s
        self._learned = learned
        self._washed = len(washouts) - (2 if navigation is not None else 0)
        self._gps_hold, self._compass_hold, self._imu_hold = gps_hold, compass_hold, imu_hold
        self._imu_age, self._changed_ns, self.frozen_ns = 0, 0, 0
        memset(self._imu, 0, sizeof(self._imu))
        self._count, self._inputs, self._outputs = count, inputs, len(washouts)
        for i, (keep, gain) in enumerate(washouts):
            self._keep[i], self._gain[i], self._twice[i] = keep, gain, twice[i]
        self._longest = max(imu_ticks, compass_ticks) + count
        i = 0
        for group, outputs in ((_GPS, (5 if speeds else 3) * gps), (_BARO, baro), (_IMU, 3), (_MAG, mag)):
            self._first[group], self._stop[group] = i, i + outputs
            i += outputs
        self.restart()

    cdef void restart(self) noexcept:
        """Forget everything."""
        cdef _Delay delay
        for delay in (self._motion, self._fixes, self._altitudes, self._levels, self._sensed):
            delay.clear()
        if self._navigation is not None:
            self._navigation.restart()
        self._vertical.restart()
        self._errors.restart()
        self._biased_s = self._unseen = 0.0
        self._turning = self._placed = self._has_before = self._begun = False
        self._fresh = True
        self._heading = self._set_back = self._seen = 0.0
        memset(self._apart, 0, sizeof(self._apart))
        self._apart[0] = self._apart[4] = self._apart[8] = 1.0
        self._resets = self._summed = self._stills = self._loose = 0
        self._tipped = self._stood = False
        self._fix_age = self._field_age = self._field_step = self._resting = 0
        self._unread = self._mag
        self._still = self._blind = self._unstuck = False
        memset(self._doubt, 0, sizeof(self._doubt))
        memset(self._lacked, 0, sizeof(self._lacked))
        memset(self._lacking, 0, sizeof(self._lacking))
        memset(self._added, 0, sizeof(self._added))
        memset(self._fix, 0, sizeof(self._fix))
        memset(self._spoke, 0, sizeof(self._spoke))
        memset(self._slope, 0, sizeof(self._slope))
        self._bent = False
        memset(self._field, 0, sizeof(self._field))
        memset(self._way, 0, sizeof(self._way))
        memset(self._turned, 0, sizeof(self._turned))
        memset(self._estimated, 0, sizeof(self._estimated))
        memset(self._y, 0, sizeof(self._y))
        memset(self._once, 0, sizeof(self._once))
        memset(self._led, 0, sizeof(self._led))
        memset(self._apart_gps, 0, sizeof(self._apart_gps))
        self._void = 4
        self._parted_s = 0.0
        self._corrected = self._moved = False

    def run(self, samples):
        """Process raw samples; return the observer's samples, each at the end of its period.

        Their errors (``beyond``) are larger by what lines have hidden within the memory of the velocity.

        Parameters
        ----------
        samples : Samples
            Raw signals in ``u`` (n, number of signals); one marked ``restart`` begins anew.
        """
        cdef const double[:, ::1] raw = np.ascontiguousarray(samples.u)
        cdef const long long[:] index = samples.index, vehicle = samples.vehicle_time_ns
        cdef const long long[:] time = samples.time_ns, known = samples.known_ns
        cdef const unsigned char[:] restart = samples.restart.view(np.uint8)
        cdef const unsigned char[:, :] lost = samples.lost.view(np.uint8)
        cdef const unsigned char[:] complete = samples.complete.view(np.uint8)
        cdef const long long[:, :] lines = (
            samples.lines_ns if samples.lines_ns is not None else np.zeros(samples.lost.shape, np.int64)
        )
        cdef double line_s, fix_line_s
        cdef int field = 9 + (3 + self._speeds) * self._gps + self._baro
        cdef Py_ssize_t row, count = 0, most = 0
        cdef double[_WIDEST] now
        cdef double[_WIDEST] places
        cdef double change, before
        cdef double[_WIDEST] meant
        cdef bint[_GROUPS] lacks
        cdef bint whole_sample, parted
        cdef int i, group
        for row in range(index.shape[0]):
            most += index[row] % self._count == 0
        whole, marks, ends = np.empty((4, most), np.int64), np.ones((4, most), np.bool_), np.empty(most, np.intp)
        inputs, outputs = np.empty((most, self._inputs)), np.empty((most, self._outputs))
        lacking = np.zeros((most, self._inputs + self._outputs), np.bool_)
        cdef unsigned char[:, ::1] without = lacking.view(np.uint8)
        cdef long long[:, ::1] times = whole
        cdef unsigned char[:, ::1] flags = marks.view(np.uint8)
        cdef Py_ssize_t[::1] rows = ends
        later = np.empty((most, self._outputs))
        cdef double[:, ::1] u = inputs, y = outputs, ahead = later
        likeliest = np.zeros(most)
        cdef double[::1] scores = likeliest
        uncertain, believed = np.zeros((most, 6)), np.zeros((most, 5))
        cdef double[:, ::1] spreads = uncertain, sizes = believed
        larger = np.ones(most)
        cdef double[::1] beyond = larger
        cdef double forgotten = (1.0 - self._keep[2]) / self._count
        for row in range(index.shape[0]):
            if restart[row] or self._unstuck:
                self.restart()
            self.find_lacking(&raw[row, 0], &lost[row, 0], lacks)
            self._changed_ns = self._changed_ns if self._imu_age else vehicle[row]
            self.frozen_ns = self._changed_ns if self._imu_age > self._imu_hold > 0 else 0
            line_s = self._stills * self._dt
            # Gyros too slow to be integrated are compared as they are: a line hides nothing of them.
            for i in range(0 if self._learned and not lacks[_IMU] else 6):
                line_s = max(line_s, 1e-9 * lines[row, i])
            fix_line_s = 1e-9 * lines[row, 9] if self._gps else 0.0
            self._faint = self._mag and 1e-9 * lines[row, field] > _FIELD_LINE_S
            if self._faint:
                self._doubt[_MAG] = self._longest + 1
            if not self.tick(&raw[row, 0], lacks, not complete[row], line_s, fix_line_s, now, places, meant):
                continue
            self._unseen += forgotten * (self._hidden - self._unseen)
            if self._has_before and self._begun:
                # The mean over a tick, by the trapezoidal rule, is added to the mean over the period.
                for i in range(self._inputs):
                    self._sum[i] = self._sum[i] + meant[i]
                self._summed += 1
            memcpy(self._before, now, sizeof(now))
            self._has_before = True
            if index[row] % self._count:
                continue
            if self._begun:
                times[0, count] = self._start_index // self._count
                times[1, count], times[2, count] = self._start_vehicle, self._start_time
                times[3, count] = known[row]
                whole_sample = True
                for group in range(_GROUPS):
                    if self._doubt[group]:
                        whole_sample = False
                        for i in range(self._first[group], self._stop[group]):
                            without[count, self._inputs + i] = True
                if self._doubt[_IMU]:
                    # Everything but GPS positions, which have the GPS's velocity, is compared with the IMU; and if the
                    # IMU is missing for long the vehicle is not watched.
                    i = 2 if self._gps and self._speeds and self._stills * self._dt <= _LONGEST_S else 0
                    lacking[count, self._inputs + i :] = True
                flags[0, count], flags[1, count] = self._fresh, whole_sample and not self._corrected
                flags[3, count], self._moved = self._moved, self._corrected
                self._fresh = self._corrected = False
                for i in range(self._inputs):
                    u[count, i] = self._sum[i] / self._summed
                # y(k) is what was known at the period's start: y+ = phi y + tau (1 - phi) d / T.
                beyond[count] = sqrt(1.0 + self._unseen)
                if self._navigation is not None:
                    scores[count] = self._navigation.score
                    for i in range(6):
                        # of gyros and compass the attitude tells, unless it is misled
                        if 3 <= i < 5 or self._biased_s > 0.0:
                            spreads[count, i] = self._navigation.spread(i) if i < 5 else self._navigation.pointing()
                            if i < 5:
                                sizes[count, i] = self._navigation.fault(i)
                for i in range(self._outputs):
                    y[count, i] = self._y[i]
                    if i >= self._washed:
                        self._y[i] = places[i]
                        continue
                    change = places[i] - self._start[i]
                    if self._twice[i]:
                        # A vehicle that begins in motion has been washed out before: the result for its constant speed.
                        before = self._gain[i] / (1.0 - self._keep[i]) * change if flags[0, count] else self._once[i]
                        self._once[i] = self._keep[i] * before + self._gain[i] * change
                        change = self._once[i] - before
                    self._y[i] = self._keep[i] * self._y[i] + self._gain[i] * change
                if self._navigation is not None:
                    for i in range(4):
                        change = places[i] - self._start[i] - u[count, i] * self._count * self._dt
                        self._apart_gps[i] = self._keep[i] * self._apart_gps[i] + self._gain[i] * change
                        if i >= self._void:
                            self._y[i], self._apart_gps[i] = self._y[i] - self._apart_gps[i], 0.0
                        # The known error of the GPS's velocity is not washed out.
                        if i >= 2:
                            y[count, i] += self._led[i - 2]
                            self._led[i - 2] = self._navigation.led(i - 2)
                    self._void = 4
                    parted = hypot(self._apart_gps[0], self._apart_gps[1]) > _STUCK_METRES
                    self._parted_s = self._parted_s + self._count * self._dt if parted else 0.0
                for i in range(self._outputs):
                    ahead[count, i] = self._y[i] + (self._led[i - 2] if self._speeds and 2 <= i < 4 else 0.0)
                rows[count] = row
                count += 1
            self._begun = True
            self._start_index, self._start_vehicle, self._start_time = index[row], vehicle[row], time[row]
            memcpy(self._start, places, sizeof(places))
            memset(self._sum, 0, sizeof(self._sum))
            self._summed = 0
        if count < most:
            whole, marks, ends = whole[:, :count], marks[:, :count], ends[:count]
            inputs, outputs, lacking = inputs[:count], outputs[:count], lacking[:count]
        self.scores, self.spreads, self.sizes = likeliest[:count], uncertain[:count], believed[:count]
        return Given(
            Samples(whole[0], whole[1], whole[2], inputs, outputs, marks[0], marks[1], whole[3], marks[2], lacking),
            ends,
            beyond=larger[:count],
            corrected=marks[3],
            ahead=later[:count],
        )

    cdef void find_lacking(self, const double* signals, const unsigned char* lost, bint* lacks) noexcept:
        """Fill in which groups are missing at a tick, and count for how long that is part of the results."""
        cdef int[_GROUPS] width
        cdef int group, i
        width[_IMU], width[_GPS] = 9, (3 + self._speeds) * self._gps
        width[_BARO], width[_MAG] = self._baro, 3 * self._mag
        for group in range(_GROUPS):
            lacks[group] = False
            for i in range(width[group]):
                lacks[group] |= lost[i]
            if group == _IMU and self._imu_hold:
                # Kept over a restart: a frozen sensor must not look measured by it.
                self._imu_age = self._imu_age + 1 if memcmp(signals, self._imu, sizeof(self._imu)) == 0 else 0
                memcpy(self._imu, signals, sizeof(self._imu))
                lacks[group] |= self._imu_age > self._imu_hold
            lost += width[group]
            self._doubt[group] = self._longest + 1 if lacks[group] else max(self._doubt[group] - 1, 0)
        # After gyro or attitude were missing for long all begins anew.
        if lacks[_IMU]:
            self._stills += 1
        elif self._stills * self._dt > _LONGEST_S:
            self.restart()
        else:
            self._stills = 0

    cdef bint tick(
        self, const double* signals, const bint* lacks, bint lined, double line_s, double fix_line_s,
        double* u, double* y, double* meant
    ) noexcept:
        """Process a tick; return whether every delay line is full.

        Fills in u of this tick, the integrals y before washing, and the means of u since the tick before. ``lined``:
        measurements were lost around the tick, so that some signals are on a line between two of them; ``line_s``:
        length of the IMU's line, 0 if it was measured; ``fix_line_s``: the same of the GPS.
        """
        cdef const double* rate = signals + 3
        cdef const double* sensors = signals + 9
        cdef double[9] R
        cdef double[_SENSED] values
        cdef double[6] hidden
        cdef double[3] early
        cdef double[3] turning
        cdef double* motion
        cdef double* sensed = NULL
        cdef double* level
        cdef double* fix = NULL
        cdef double* altitude = NULL
        cdef double[9] before
        cdef double[3] mean
        cdef double[9] upright
        cdef double biased, course, share
        cdef bint full, first, steep = False, bridged, still
        cdef int i = 0, k = 0, axis
        values[0], values[1] = cos(signals[6]), sin(signals[6])
        values[2], values[3] = cos(signals[7]), sin(signals[7])
        _rotation(values, cos(signals[8]), sin(signals[8]), R)
        first = not self._turning
        memcpy(before, <double*>R if first else <double*>self._attitude, sizeof(before))
        for axis in range(3):
            mean[axis] = rate[axis] if first else 0.5 * (self._turn_rate[axis] + rate[axis])
        bridged = self.hide(signals, R, line_s, hidden, early) or lacks[_IMU]
        still = bridged or self._still
        # The learned bias tells nothing of resets of the attitude.
        self.turn(R, rate, still or self._learned, turning)
        self._still = bridged
        if still:
            # The attitude's lead counts as much as its difference from measured gyros does.
            share = 1.0 if self._navigation is None or self._learned else self.share()
            for axis in range(3):
                turning[axis] -= early[axis]
                self._turned[axis] -= (1.0 - share) * early[axis] * self._dt
            rate = turning
        elif self._learned:
            for axis in range(3):
                turning[axis] += rate[axis]
            rate = turning
        if still or self._learned:
            memcpy(mean, rate, sizeof(mean))
        if self._biased_s > 0.0:
            memcpy(upright, R, sizeof(R))
            self.turn_upright(upright)
            self.turn_upright(before)
            values[2], values[3] = max(hypot(upright[7], upright[8]), 1e-9), -upright[6]
            values[0], values[1] = upright[8] / values[2], upright[7] / values[2]
        # A known fault of gyro y is subtracted; that of gyro z is estimated by the observer.
        biased = 0.0 if self._navigation is None or still else self._navigation.fault(1)
        values[4] = _heading_rate(before, self._dt, mean[0], mean[1] - biased, mean[2])
        values[5] = still
        # Between two measurements on either side of the vertical, a line of roll, pitch and yaw is no attitude.
        values[6] = self._tipped or is_steep(values[2])
        values[7] = values[6] != 0.0 or (
            self._mag and fabs(field_rate(R, rate, sensors + self._gps * (3 + self._speeds) + self._baro)) > _WHIRLING
        )
        level = self._levels.push(values)
        # Acceleration north, east and down: R f + g.
        for axis in range(3):
            values[axis] = along(R, signals, axis)
        values[2], values[3] = values[2] + _GRAVITY, lacks[_IMU]
        values[4], values[5] = 1.0, 0.0
        if line_s > 0.0:
            values[4] = self._errors.down(line_s / self._dt, &values[5])
            values[5] *= self._dt / line_s
        motion = self._motion.push(values)
        if self._navigation is not None:
            memcpy(values, signals, 3 * sizeof(double))
            memcpy(values + 3, rate, 3 * sizeof(double))
            memcpy(values + 6, R, sizeof(R))
            values[15] = lacks[_IMU]
            memset(values + 16, 0, sizeof(self._field))
            if self._mag:
                memcpy(values + 16, sensors + self._gps * (3 + self._speeds) + self._baro, sizeof(self._field))
            values[19] = lined
            memcpy(values + 20, hidden, sizeof(hidden))
            memcpy(values + 26, mean, sizeof(mean))
            sensed = self._sensed.push(values)
        full = motion != NULL and level != NULL
        if self._gps:
            if not self._placed:
                self._placed = True
                self._origin[0], self._origin[1] = sensors[0], sensors[1]
                _metres_per_degree(sensors[0], self._origin + 2)
            values[0] = (sensors[0] - self._origin[0]) * self._origin[2]
            values[1] = (_modulo(sensors[1] - self._origin[1] + 180.0, 360.0) - 180.0) * self._origin[3]
            values[2] = -sensors[2]
            values[3] = values[4] = values[7] = 0.0
            if self._speeds == 2:
                course = sensors[4] * _DEGREE
                values[3], values[4] = sensors[3] * cos(course), sensors[3] * sin(course)
                # The sampler's line is that of the velocity as a vector: its speed and course bend at each tick.
                values[7] = self.bends(values + 3)
            elif self._speeds == 3:
                for axis in range(2):
                    values[3 + axis] = along(R, sensors + 3, axis)
                values[7] = self.bends(sensors + 3)
            values[5], values[6] = lacks[_GPS], fix_line_s
            fix = self._fixes.push(values)
            full = full and fix != NULL
            sensors += 3 + self._speeds
        if self._baro:
            values[0], values[1] = _pressure_altitude(sensors[0]) if self._hectopascal else sensors[0], lacks[_BARO]
            altitude = self._altitudes.push(values)
            full = full and altitude != NULL
            sensors += 1
        if not full:
            return False
        if self._gps:
            if self._navigation is not None:
                self.navigate(sensed, fix, hypot(along(R, signals, 0), along(R, signals, 1)), motion)
                self.follow_rest(sensed + 3, fix, motion)
            self.follow_fix(fix, motion)
            y[0], y[1] = fix[0], fix[1]
            k = 2
            if self._speeds:
                u[0], u[1] = fix[3], fix[4]
                if self.stuck():
                    u[0], u[1] = self._reckoned[0], self._reckoned[1]
                y[2], y[3] = fix[3], fix[4]
                if self._navigation is not None:
                    for axis in range(2):
                        y[2 + axis] -= self._navigation.led(axis)
                i, k = 2, 4
            u[i], u[i + 1] = motion[0], motion[1]
            y[k] = fix[2]
            i, k = i + 2, k + 1
        if self._baro:
            y[k] = -altitude[0]
            k += 1
        if k:
            u[i] = motion[2]
            i += 1
        for axis in range(3):
            # At the tick, also where the attitude tells the mean since the one before.
            u[i + axis], y[k + axis] = signals[3 + axis], self._turned[axis]
        if self._mag:
            u[i + 3] = level[4]
            steep = level[7] != 0.0
            if level[6] != 0.0:
                # The change of the compass meanwhile is not known.
                self._unknown[_MAG] = True
            self.follow_field(level, sensors, steep)
            y[k + 3] = self._heading - self._set_back
        if self._navigation is not None:
            for axis in range(2):
                y[self._washed + axis] = self._navigation.fault(3 + axis)
        # The mean over a tick, by the trapezoidal rule.
        for k in range(self._inputs):
            meant[k] = 0.5 * (self._before[k] + u[k]) if self._has_before else u[k]
        if still or self._learned:
            for axis in range(3):
                meant[i + axis] = rate[axis]
        if self._mag:
            meant[i + 3] = level[4]
        self._down_share, self._down_hidden = motion[4], motion[5]
        self.reckon(
            motion[3] != 0.0,
            # A line over lost fixes hides how the vehicle went: accelerations that give a velocity tell it.
            self._gps and (fix[5] != 0.0 or fix[6] > 0.0 and self._navigation is not None),
            self._baro and altitude[1] != 0.0,
            self._mag and (self._unread or self._faint or (lacks[_MAG] and not still and level[5] == 0.0)),
            y,
            meant,
        )
        return True

    cdef bint hide(
        self, const double* signals, const double* R, double line_s, double* hidden, double* early
    ) noexcept:
        """Fill in the variances that a line hides of velocity and angle in this tick; return whether R is the better
        source.

        That is, whether the attitude rather than the gyros tells the rotation, where both are on a line. ``early`` is
        the rate by which the attitude turns differently because it is earlier than the gyros.
        """
        cdef double[3] angles
        cdef double[6] value
        cdef double[3] by_gyros
        cdef double[3] by_attitude
        cdef double ticks = max(line_s / self._dt, 2.0)
        cdef int axis
        cdef bint better = False, lined = line_s > 0.0
        memset(hidden, 0, 6 * sizeof(double))
        memset(angles, 0, sizeof(angles))
        if self._turning:
            _small_rotation(self._attitude, R, angles)
        for axis in range(3):
            value[axis], value[3 + axis] = along(R, signals, axis), signals[3 + axis]
            early[axis] = self._errors.early_s() * self._errors.change(3 + axis, value[3 + axis]) / self._dt
        value[2] += _GRAVITY
        if lined:
            for axis in range(3):
                by_gyros[axis] = self._errors.steep(3 + axis, value[3 + axis], ticks)
                by_attitude[axis] = self._errors.variance(6 + axis, ticks)
            # An attitude that follows a faulty gyro, or unlearns its bias, is no evidence.
            better = self._biased_s == 0.0 and (
                by_attitude[0] + by_attitude[1] + by_attitude[2] < by_gyros[0] + by_gyros[1] + by_gyros[2]
            )
            for axis in range(3):
                hidden[axis] = self._errors.steep(axis, value[axis], ticks) / ticks
                hidden[3 + axis] = (by_attitude[axis] if better else by_gyros[axis]) / ticks
        self._hidden = (hidden[0] + hidden[1]) / (2.0 * _WALK * _WALK * self._dt)
        self._errors.follow(value, angles, lined)
        return better

    cdef void turn_upright(self, double* R) noexcept:
        """Rotate an attitude of the autopilot to the vertical of the navigation."""
        cdef double[9] turned
        cdef int i
        for i in range(9):
            turned[i] = _product(self._apart, R, i // 3, i % 3)
        memcpy(R, turned, sizeof(turned))

    cdef void navigate(self, const double* sensed, const double* fix, double ahead, double* motion) noexcept:
        """Replace accelerations by the autopilot's attitude by those of the vehicle's own navigation."""
        cdef bint lacks = sensed[15] != 0.0, stands = self.rests(), news
        if not self._navigation._begun and (lacks or fix[5] != 0.0):
            return
        self._navigation.go_on(
            sensed, sensed + 3, sensed + 26, sensed + 6, sensed + 16, sensed + 20, sensed[19] != 0.0, ahead, motion
        )
        self._navigation.differ(sensed + 6, self._apart)
        news = not self.repeats(fix)
        # After a rest the first moving fix is compared when it comes, and so are later fixes, not the lines between
        # them.
        self._stood |= stands
        if not fix[5] and (news and self._stood or (news or stands) and self._navigation.due(fix[7])):
            self._stood = self._stood and not news
            self._navigation.meet(fix + 3, fix[6], self._parted_s < _JUMPS_S)
            # A position is compared with the GPS's own velocity, without accelerations.
            if self._navigation.returned:
                self._void = 0
            elif self._navigation.renewed:
                self._void = min(self._void, 2)
            self._navigation.returned = self._navigation.renewed = False

    cdef double bends(self, const double* speed) noexcept:
        """Return 1 if a fix came since the tick before, which changes the slope of the GPS's velocity, otherwise 0.

        0.5 if the slope changed at the tick before, too: it is the same fix, or fixes come as fast as ticks.
        """
        cdef bint bent = False, before = self._bent
        cdef double slope
        cdef int i
        for i in range(self._speeds):
            slope = speed[i] - self._spoke[i]
            bent |= fabs(slope - self._slope[i]) > _BENT * max(1.0, fabs(speed[i]))
            self._spoke[i], self._slope[i] = speed[i], slope
        self._bent = bent
        return 0.5 * bent if before else bent

    cdef void follow_rest(self, const double* rate, const double* fix, const double* motion) noexcept:
        """Count for how long the vehicle has been at rest: no motion above the errors of the IMU."""
        cdef bint moves = hypot(fix[3], fix[4]) > _STANDS or hypot(motion[0], motion[1]) > _UNSEEN_ACCELERATION
        cdef int axis
        for axis in range(3):
            moves |= fabs(rate[axis]) > _UNSEEN_RATE
        self._resting = 0 if moves else min(self._resting + 1, _LONGEST_STEP)

    cdef bint rests(self) noexcept:
        """Return whether the vehicle is at rest, for as long as a fix may stay the same: then no receiver is stuck."""
        return self._resting > self._gps_hold > 0

    cdef bint repeats(self, const double* fix) noexcept:
        """Return whether a fix is the one before, but for rounding, as a velocity between two fixes is a vector."""
        cdef int i
        for i in range(5):
            if fabs(fix[i] - self._fix[i]) > _BENT * max(1.0, fabs(fix[i])):
                return False
        return True

    cdef void follow_fix(self, const double* fix, const double* motion) noexcept:
        """Follow the GPS's speed, by the accelerations while the fix stays the same.

        A stuck receiver's position is then wrong by the vehicle's way; its velocity follows the accelerations. When it
        goes on, their integral since then is void, and the fix is right.
        """
        cdef double step
        cdef int axis
        if fix[5]:
            return
        if self.repeats(fix) and not self.rests():
            self._fix_age += 1
            for axis in range(2):
                self._reckoned[axis] = self._reckoned[axis] + motion[axis] * self._dt
                # By the speed that is returned, as below.
                step = self._reckoned[axis] if self.stuck() else fix[3 + axis]
                self._way[axis] = self._way[axis] + step * self._dt
            return
        if not self._loose:
            if self.stuck():
                self._stuck[0], self._stuck[1] = self._fix[0], self._fix[1]
                self._loose = self._gps_hold
            else:
                self._way[0] = self._way[1] = 0.0
        if self._loose:
            # Lines from the fix where it was stuck to the next one have ended by then.
            self._loose -= 1
            for axis in range(2):
                self._way[axis] = self._way[axis] + fix[3 + axis] * self._dt
            if self._loose == 0 and hypot(fix[0] - self._stuck[0], fix[1] - self._stuck[1]) > _STUCK_METRES:
                self.believe_fix(fix)
        self._fix_age = 0
        memcpy(self._fix, fix, sizeof(self._fix))
        self._reckoned[0], self._reckoned[1] = fix[3], fix[4]

    cdef void believe_fix(self, const double* fix) noexcept:
        """Go on from a fix after a stuck one: the difference from the accelerations' way is an error of these."""
        cdef int axis
        if not self._speeds:
            self._unstuck = True
            return
        for axis in range(2):
            self._added[axis] = self._added[axis] - (fix[axis] - self._stuck[axis] - self._way[axis])
        if self._navigation is not None:
            self._navigation.restart()

    cdef bint stuck(self) noexcept:
        return self._fix_age > self._gps_hold > 0

    cdef void follow_field(self, const double* level, const double* field, bint steep) noexcept:
        """Follow the heading of the magnetometer, until its next measurement by the body's rates."""
        # The first one may be as old as the compass is slow: the attitude of now does not level it.
        cdef bint same = not self._has_before or memcmp(field, self._field, sizeof(self._field)) == 0
        cdef int hold = self._compass_hold
        self._heading = self._heading + level[4] * self._dt
        if not same:
            self._field_step = self._field_age + 1
        elif self._field_step > max(hold, 1):
            hold = _HELD_STEPS * self._field_step
        self._field_age = min(self._field_age + 1 + (not self._has_before), _LONGEST_STEP) if same else 0
        memcpy(self._field, field, sizeof(self._field))
        if steep:
            self._unread = True
        elif (
            self._field_age >= hold
            or (self._field_age == 1 if self._unread else not same)
            or (not same and self._field_step == 1)
        ):
            # The first one back is used at once: between two samples both would change. So is one that changes at
            # each tick.
            self._heading = self._heading + wrapped(_magnetic_heading(level, field) - self._heading)
            self._unread = False

    cdef void reckon(self, bint imu, bint gps, bint baro, bint mag, double* y, double* meant) noexcept:
        """Let missing signals follow those that are measured.

        A signal that follows makes no difference between u and y, like a step of an observer without that measurement.
        Rates of missing gyros follow the attitude already; missing accelerations follow the GPS. Outputs of the other
        groups follow the inputs, and go on from there unless the sensor returns far from it.
        """
        cdef bint[_GROUPS] now
        cdef bint[_GROUPS] lacks
        cdef bint moves = self._gps and self._speeds
        cdef int speed = 2 * moves, velocity = 2, group, i
        cdef double change
        now[_IMU], now[_GPS], now[_BARO], now[_MAG] = imu, gps, baro, mag
        for group in range(_GROUPS):
            lacks[group] = (now[group] or self._lacked[group]) and self._has_before
            self._lacked[group] = now[group]
            if not self._has_before:
                self._unknown[group] = now[group]
            if lacks[group] and not self._lacking[group]:
                for i in range(self._first[group], self._stop[group]):
                    self._anchor[i] = self._added[i]
            elif self._lacking[group] and not lacks[group]:
                self.come_back(group, self._lacking[group] * self._dt, meant)
            self._lacking[group] = self._lacking[group] + 1 if lacks[group] else 0
        for i in range(self._outputs):
            y[i] = y[i] + self._added[i]
        if self._gps or self._baro:
            self.sink(lacks, y, &meant[speed + 2 * self._gps])
        if lacks[_GPS] and (lacks[_IMU] or self._navigation is None):
            self._blind = True
        if lacks[_IMU] and moves and not lacks[_GPS]:
            for i in range(2):
                meant[speed + i] = (y[velocity + i] - self._place[velocity + i]) / self._dt
        elif lacks[_GPS] and moves:
            for i in range(2):
                if self._lacking[_GPS] == 1:
                    self._speed[i] = self._before[i]
                change = meant[speed + i] * self._dt
                meant[i] = self._speed[i] + 0.5 * change
                self._speed[i] = self._speed[i] + change
                self.follow(y, velocity + i, change)
        elif moves and (self.stuck() or self._loose) and self._has_before:
            for i in range(2):
                self.follow(y, velocity + i, meant[speed + i] * self._dt)
        if lacks[_GPS]:
            if moves:
                for i in range(2):
                    self.follow(y, i, meant[i] * self._dt)
        if lacks[_MAG]:
            self.follow(y, self._first[_MAG], meant[self._inputs - 1] * self._dt)
        memcpy(self._place, y, sizeof(self._place))

    cdef void come_back(self, int group, double lacked_s, double* meant) noexcept:
        """Go on from the assumed value of a sensor unless it returns further away than the vehicle may have moved."""
        cdef double jump, least, turn
        cdef bint moves = group == _GPS and self._speeds, blind = group == _GPS and self._blind
        cdef int i
        if group == _GPS:
            self._blind = False
        if self._unknown[group]:
            self._unknown[group] = False
            return
        for i in range(self._first[group], self._stop[group]):
            if self._vertical.unknown and (group == _BARO or group == _GPS and i == self._stop[_GPS] - 1):
                # :meth:`sink` evaluates its jump.
                self._added[i] = self._anchor[i]
                continue
            jump = self._anchor[i] - self._added[i]
            least = 0.5 * _UNSEEN_ACCELERATION * lacked_s * lacked_s
            if moves and i < 2 and blind:
                # Between two known velocities and accelerations the way is that of a cubic: its velocity error was half
                # of the present one on average; more if it arose at once, less if it arose at the end.
                turn = 0.5 * lacked_s * (self._anchor[2 + i] - self._added[2 + i])
                meant[i] = meant[i] + turn / self._dt
                self._added[i] = self._added[i] + turn
                jump, least = jump - turn, max(_UNSEEN_WAY * pow(lacked_s, 2.5), fabs(turn))
            elif moves and 2 <= i < 4:
                # Without the accelerometer nothing contradicts the velocity.
                least = INFINITY if blind else _UNSEEN_ACCELERATION * lacked_s
            elif group == _MAG:
                least = _UNSEEN_RATE * lacked_s
            # A jump of the sensor counts in full, as does the one at its end.
            if fabs(jump) > least:
                self._added[i] = self._anchor[i]

    cdef void sink(self, const bint* lacks, double* y, double* acceleration) noexcept:
        """Let missing heights follow the vertical velocity, and the velocity follow the heights if it is unknown after
        a gap.

        A gap makes the velocity uncertain, not the accelerometer: until the velocity is as certain as before, its
        corrections by the heights go into the acceleration, and height corrections are taken out of the outputs.
        """
        cdef _Vertical vertical = self._vertical
        cdef int[2] output
        cdef bint[2] lacking
        cdef double[2] heights
        cdef double[2] correction
        cdef double change
        cdef int count = 0, i
        if self._gps:
            output[0], lacking[0] = self._stop[_GPS] - 1, lacks[_GPS]
            count = 1
        if self._baro:
            output[count], lacking[count] = self._first[_BARO], lacks[_BARO]
            count += 1
        acceleration[0] *= self._down_share
        change = vertical.predict(acceleration[0], self._down_hidden)
        vertical.unknown |= lacking[0] and lacking[count - 1]
        for i in range(count):
            heights[i] = y[output[i]]
        vertical.meet(count, heights, lacking, correction)
        vertical.speed += correction[1]
        if vertical.unknown:
            acceleration[0] += correction[1] / self._dt
        else:
            vertical.depth += correction[0]
            change += correction[0]
        for i in range(count):
            if lacking[i] and self._navigation is None and not lacking[count - 1 - i]:
                # Accelerations that give no horizontal velocity give no height either: the other height does.
                self.follow(y, output[i], y[output[count - 1 - i]] - self._place[output[count - 1 - i]])
            elif lacking[i]:
                self.follow(y, output[i], change)
                self._anchor[output[i]] -= correction[0] if vertical.unknown else 0.0
            elif vertical.unknown:
                self._added[output[i]] -= correction[0]
                y[output[i]] -= correction[0]

    cdef inline void follow(self, double* y, int i, double change) noexcept:
        """Change an output by ``change`` since the tick before."""
        change = self._place[i] + change
        self._added[i] = self._added[i] + (change - y[i])
        y[i] = change

    cdef void turn(self, const double* R, const double* rate, bint still, double* turning) noexcept:
        """Add the rotation by the attitude since the tick before; while the attitude is being reset, that by the gyros.

        Fills in the rate of the attitude. While the gyros' measurements are missing it was not reset.
        """
        cdef double[3] angles
        cdef double[3] apart
        cdef double step, largest = 0.0
        cdef bint biased = False, misled = False, tipped
        cdef int axis
        if self._navigation is not None:
            # An attitude follows the compass, too.
            biased = self._navigation.strayed
            # Nor does an attitude that levels itself by accelerometers know the vertical better than the gyros.
            for axis in range(5):
                biased |= self._navigation.fault(axis) != 0.0
            # An attitude with another vertical or heading has not learned yet.
            biased |= self._biased_s > 0.0 and (
                hypot(self._apart[2], self._apart[5]) > _TILTED
                or fabs(atan2(self._apart[3], self._apart[0])) > _HEADING_APART
            )
            misled = biased and self._biased_s == 0.0
            self._biased_s = _LEARNING_S if biased else max(0.0, self._biased_s - self._dt)
        memcpy(turning, rate, 3 * sizeof(double))
        if self._turning:
            _small_rotation(self._attitude, R, angles)
            for axis in range(3):
                apart[axis] = angles[axis] - rate[axis] * self._dt
                largest = max(largest, fabs(apart[axis]))
            self._resets = self._resets + 1 if largest > _RESET_RATE * self._dt and not still else 0
            tipped = hypot(along(R, apart, 0), along(R, apart, 1)) > _RESET_RATE * self._dt
            self._tipped = self._resets > 0 and (tipped or self._tipped)
            for axis in range(3):
                turning[axis] = angles[axis] / self._dt
                step = rate[axis] * self._dt if 0 < self._resets <= _RESET_TICKS else angles[axis]
                if self._navigation is not None and not still:
                    step = self.judged(axis, step, rate[axis], misled)
                self._turned[axis] = self._turned[axis] + step
        self._turning = True
        memcpy(self._attitude, R, sizeof(self._attitude))
        memcpy(self._turn_rate, rate, sizeof(self._turn_rate))

    cdef double share(self) noexcept:
        """Return what counts of the difference of attitude and gyros: none of an attitude that is no evidence."""
        return 0.0 if self._biased_s > 0.0 else self._attitude_share

    cdef double judged(self, int axis, double step, double rate, bint misled) noexcept:
        """Return the rotation about an axis since the tick before, by the attitude and the navigation.

        ``misled``: the attitude has just turned out to be wrong, so that its earlier evidence on the gyro is void.

        If a gyro is faulty the autopilot's attitude follows it, until it learns the bias, and again after the fault's
        end. The observer estimates the difference between this rotation and the gyro as T f^' = f - f^. While the
        navigation knows a fault f, and when it ends, the rotation is set back by T (f - f^), so that the estimate jumps
        to f.
        """
        # The mean over the tick, as that of u.
        cdef double by_gyro = 0.5 * (self._turn_rate[axis] + rate) * self._dt
        cdef double fault = self._navigation.fault(axis), missed = self._navigation.missed(axis)
        step = by_gyro + self.share() * (step - by_gyro)
        if self._biased_s:
            # A constant bias is no fault, but turns the heading all the same.
            step -= (fault if fault != 0.0 else self._navigation._bias[axis]) * self._dt
        if self._angle_s[axis]:
            if axis == 2:
                # The magnetic heading has turned with the vehicle since the onset: only the rest of that angle is
                # missing.
                self._seen += missed
                self._set_back = self._angle_s[axis] * fault - self._seen
            misled |= missed != 0.0
            self._corrected |= misled
            if misled or fault != 0.0:
                missed = self._angle_s[axis] * (fault - self._estimated[axis])
            self._estimated[axis] += (by_gyro - step + missed - self._estimated[axis] * self._dt) / self._angle_s[axis]
        return step - missed


cdef inline void _rotation(const double* level, double cy, double sy, double* R) noexcept:
    """Fill in R (body to north, east, down), row by row; ``level`` are cosine and sine of roll and of pitch."""
    cdef double cr = level[0], sr = level[1], cp = level[2], sp = level[3]
    R[0], R[1], R[2] = cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy
    R[3], R[4], R[5] = cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy
    R[6], R[7], R[8] = -sp, sr * cp, cr * cp


cdef inline double _product(const double* before, const double* after, int i, int j) noexcept:
    """Return an element of R(before)' R(after)."""
    return 0.0 + before[i] * after[j] + before[3 + i] * after[3 + j] + before[6 + i] * after[6 + j]


cdef inline void _small_rotation(const double* before, const double* after, double* angles) noexcept:
    """Fill in the rotation between two attitudes about the body's axes (to third order), radians."""
    cdef double x = 0.5 * (_product(before, after, 2, 1) - _product(before, after, 1, 2))
    cdef double y = 0.5 * (_product(before, after, 0, 2) - _product(before, after, 2, 0))
    cdef double z = 0.5 * (_product(before, after, 1, 0) - _product(before, after, 0, 1))
    # These contain the sine of the angle; angle / sine = 1 + angle^2 / 6 + ...
    cdef double longer = 1.0 + (x * x + y * y + z * z) / 6.0
    angles[0], angles[1], angles[2] = x * longer, y * longer, z * longer


cdef double _heading_rate(const double* R, double dt, double p, double q, double r) noexcept:
    """Return the rate of the heading of a body that turns at mean rates for a tick.

    By the whole rotation of its x axis in the tick (Rodrigues), as rates of Euler angles do not exist near the
    vertical.
    """
    cdef double x = p * dt, y = q * dt, z = r * dt, square = x * x + y * y + z * z, angle = sqrt(square)
    cdef double s = 1.0 - square / 6.0, c = 0.5
    cdef double[3] ahead
    if angle > 1e-4:
        s, c = sin(angle) / angle, (1.0 - cos(angle)) / square
    ahead[0], ahead[1], ahead[2] = 1.0 + c * (x * x - square), s * z + c * x * y, c * x * z - s * y
    return wrapped(
        atan2(
            R[3] * ahead[0] + R[4] * ahead[1] + R[5] * ahead[2], R[0] * ahead[0] + R[1] * ahead[1] + R[2] * ahead[2]
        )
        - atan2(R[3], R[0])
    ) / dt


cdef inline double _magnetic_heading(const double* level, const double* field) noexcept:
    """Return the heading, clockwise from magnetic north, by a field in body axes, with roll and pitch removed."""
    cdef double across = field[1] * level[0] - field[2] * level[1]
    cdef double forward = field[0] * level[2] + (field[1] * level[1] + field[2] * level[0]) * level[3]
    return atan2(-across, forward)


cdef void _metres_per_degree(double latitude, double* lengths) noexcept:
    """Fill in the length of a degree of latitude and of longitude on the WGS-84 ellipsoid."""
    cdef double square = 1.0 - _WGS84_E2 * pow(sin(latitude * _DEGREE), 2.0)
    lengths[0] = _WGS84_A * (1.0 - _WGS84_E2) / (square * sqrt(square)) * _DEGREE
    lengths[1] = _WGS84_A / sqrt(square) * cos(latitude * _DEGREE) * _DEGREE


cdef inline double _pressure_altitude(double pressure_hpa) noexcept:
    """Return the altitude in the standard atmosphere (ISO 2533), metres."""
    return 44_330.77 * (1.0 - pow((0.0 if pressure_hpa < 0.0 else pressure_hpa) / 1013.25, 0.190_263))


cdef inline double _modulo(double value, double period) noexcept:
    """Return the remainder in [0, period)."""
    cdef double remainder = fmod(value, period)
    return remainder + period if remainder < 0.0 else remainder
