# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Strapdown navigation with an attitude and biases of its own, and the sensor that broke if it leaves the GPS.

Attitude R and horizontal velocity v are integrated from gyros and accelerometers less their biases, and a Kalman filter
corrects them by the velocity of the GPS and the direction of the magnetic field m. With d the error of the attitude
about north, east and down and f the specific force,

    d' = -R b_gyro,    v' = d x R f - R b_accel + R (w x f) tau,    b_gyro and b_accel random walks as slow as those of
    healthy sensors.

Gyros are later than accelerometers by tau, a constant: autopilots filter both, and not alike (ArduPilot's rover at 4
and 10 Hz: 0.04 s). As the vehicle turns at w its force f then points elsewhere. In steady turns a GPS that is later
than fitted does the same, and is followed there.

The field R m lies h west of north, by the declination and by what the vehicle itself adds, a random walk as well. An
error of the attitude turns it by d_down - (m_down / m_horizontal^2) (m_north d_north + m_east d_east). A gyro z that is
wrong turns it steadily, a magnetometer that is wrong at once. By how much it is later than these gyros is a constant
(the fitted delay is that against the autopilot's attitude, too, which is not as late as they are) that shows as the
vehicle turns. The autopilot's heading follows both and is no witness: where no magnetic field is measured it keeps R
from drifting, and gyro z is not judged.

A fault of size theta since t_0 adds theta s(t; t_0) to the innovations, where the signature s is known from the
filter's own gains (Willsky and Jones 1976): a bias of a gyro tilts the attitude and bends the velocity away by the
square of time, one of an accelerometer at once in proportion to it, and both turn with the body, which an error of the
GPS's velocity does not. For every hypothesis and onset of the latest seconds

    l = (sum s' S^-1 nu)^2 / (2 (sum s' S^-1 s + 1 / sigma^2))

is how much likelier the innovations are with that fault, whose size has the standard deviation sigma, than without
(natural logarithm). A hypothesis is believed when its largest l is beyond a level and beyond those of all others; its
fault is then put into the state, with its uncertainty, and is followed there until it is small. Its size f^ = b^(t) -
b^(t_0) is the bias less that at the onset: what the filter has followed of the fault before it was believed is a part
of it, and both biases are uncertain,

    var f^ = P_b(t) + P_b(t_0) - 2 cov <= P_b(t) + P_b(t_0),

as errors of a bias that walks slowly have one sign (cov >= 0); the bound is what is given out.

An autopilot learns the bias of a gyro and takes it off what it sends, which looks like the fault's end. The end itself
then comes unannounced, is learned as well, and leaves a tilt that looks like any fault of these. So what looks like one
first after a gyro's accuses nothing, and all begins anew from the autopilot's attitude: a fault is still there then.

A velocity of the GPS that ramps is followed as such, with what the filter had learned from it taken back, until a step
leads back: position and velocity of a receiver that was led away are then right at once.

In hover a tilt and a bias of an accelerometer cannot be told apart; what tells is that no gyro turned.
"""

from libc.math cimport INFINITY, atan2, cos, fabs, fmax, fmin, hypot, sin, sqrt
from libc.string cimport memcmp, memcpy, memmove, memset
from monitor.core.lines cimport spread_between

from adapters.channels import STANDARD_GRAVITY

from monitor.core.sampling import RAW_LINE_S

cdef double _GRAVITY = STANDARD_GRAVITY

# Errors at the start: of an attitude that an autopilot has, about the horizontal axes and of its heading, rad; of the
# velocity, m/s; of gyros (a degree per second is 0.017) and accelerometers as autopilots have calibrated them; how far
# the magnetic field is from where it was first seen, rad, thrice what one measurement of a noisy one may be off; how
# late the gyros are, s: half of what an autopilot's filters of 4 and 10 Hz make. (How late the field is has its own.)
cdef double[12] _START = [0.02, 0.02, 0.1, 0.1, 0.1, 0.01, 0.01, 0.01, 0.2, 0.2, 0.3, 0.02]
# Random walks per root of a second: of attitude and velocity, the least that vibration and the straight lines between
# samples leave; of the biases, what warms up by 0.01 rad/s and by half a metre per second squared within some hours.
cdef double[4] _WALK = [1e-3, 0.05, 1e-4, 5e-3]
# Noise and vibration make second differences of six times their variance, of which half are below 0.455 times that;
# motion makes large ones, but seldom. Followed by a factor of e within a second, as long as propellers take to change.
cdef double _HALF_BELOW = 6.0 * 0.455
cdef double _NOISE_S = 1.0
# Noise of a GPS's velocity, m/s: the least that is believed, and what is assumed at the start (data sheets say 0.05 to
# 0.1, 50 % circular). It is followed by second differences as that of the gyros, but five fixes a second tell less:
# down by a factor of e within 4 s, and up three times as fast, as a reception that gets worse would look like a fault.
# So a quarter of them is above the level, 1.323 times their variance.
cdef double[2] _SPEED_NOISE = [0.05, 0.1]
cdef double _SCATTER_S = 4.0
cdef double _THREE_QUARTERS_BELOW = 6.0 * 1.323
# How late or early a fix may be against the accelerometers, s: half of the step of the delays that a fit tries (0.02)
# and half of the tick that the fix lies in (0.02 at 25 Hz), as independent errors; on a line over lost fixes a quarter
# of its length.
cdef double _TIMING_S = 0.03
# Noise of the autopilot's heading, rad.
cdef double _HEADING_NOISE = 0.1
# How late or early the field may be against the gyros, s: half of the step of the delays that a fit tries.
cdef double _FIELD_TIMING_S = 0.02
# The same where flights showed no delay, as hovering does not: the deviation of any of those tried (0.28 s).
cdef double _FIELD_UNTOLD_S = 0.08
# How late it may be around lost measurements, s: as long as the longest line that counts as measured.
cdef double _LINE_S = RAW_LINE_S
# Least step of the field's direction, rad, that is a compass at fault: half of the smallest that is worth an alarm.
cdef double _FIELD_LEAST = 0.09
# The same of the GPS's velocity, m/s: the least motion that is worth an alarm.
cdef double _SPEED_LEAST = 1.0
# Standard deviations that no measurement is off by (one in two million).
cdef double _OUTLIER = 5.0
# Share of each measurement in its usual strength: forgotten in 40 s. One that is off by as large a share tells nothing.
cdef double _STRENGTH_SHARE = 0.005
# For how long it has to point as before, and to be as strong, to be a witness again, seconds, and by how much it may
# turn otherwise than the gyros meanwhile, rad. Chosen: a vehicle that turns with a field of its own passes the true
# heading twice in each turn, within less time or by more; after a gyro's fault it is the attitude that still moves.
cdef double _BACK_S = 2.0
cdef double _BACK_LEAST = 0.5 * _FIELD_LEAST
# Share of the accelerations' peak that is left a step later. Chosen: .8 of .2 s forgets a hard stop within a second.
cdef double _PEAK_KEPT = 0.8
# By how much a hypothesis has to be likelier than any other: 20 to 1.
cdef double _MARGIN = 3.0
# By how much less likely a ramp of the GPS's velocity is that goes the way of an accelerometer, before anything is
# measured: a ramp goes anywhere, and a likelihood l tells ways apart by 1 / sqrt(2 l) rad, 0.1 for 50. Within that of
# one of four ways are 0.8 of the 6.3 rad: 1 in 8.
cdef double _COINCIDENCE = 2.0
# By how much it has to be likelier that a fault has just ended than that it goes on: 150 to 1; faults do end.
cdef double _ENDED = 5.0
# Share of what another fault explains that the end of one has to explain. Measured on five flights with a gyro's fault:
# with 1 one end of five is known 2.2 s later; a vehicle that is thrown about by a fault ends it after 7, 20 and 35 of
# 40 s with 0, 0.5 and 0.75.
cdef double _BETTER = 0.75
# Least bias that is believed, of gyros (rad/s) and accelerometers (m/s^2): what healthy ones drift by.
cdef double[2] _LEAST = [0.01, 0.25]
# Least ramp of the GPS's velocity that is believed, m/s^2: what a tilt of 10 mrad makes of gravity.
cdef double _LEAST_RAMP = 0.1
# For how long it has lasted by then, s: within 2.5 s the end of a gyro's or an accelerometer's fault is known, which
# begins like one.
cdef double _RAMPS_S = 3.0
# Largest bias that is believed, rad/s and m/s^2: what is more is no navigation of this flight any more. Chosen: ten and
# six times those of which flights were recorded; with it no autopilot keeps the vehicle in the air.
cdef double[2] _MOST = [1.0, 4.0]
# The largest is so many standard deviations of the sizes that faults have; those of the GPS's ramps are taken as those
# of accelerometers. Where the filter follows a fault as fast as it grows, little is left to tell its size by: 0.1 m/s
# that are off for another reason then look like 2.5 m/s^2, five times the standard deviation of that estimate.
cdef double _SIGMAS = 3.0
# A heading this far off, rad, is that of another start: the autopilot has set its attitude anew, to a right one or to a
# wrong one. It counts again when the way that the vehicle goes agrees with it, within twice its noise.
cdef double _TURNED = 0.5
# Steps with a fault that no hypothesis tells until the filter begins anew: a second set of onsets.
cdef int _HELPLESS = 2 * ONSETS
# Fixes that tell a step from a turn: the line from one measurement to the next may hide it in the first of them.
cdef int _STEPS = 3
# Steps between two onsets. Of the newest steps each is an onset: a jump explains no measurement before its onset, and
# the first one after it best, so that with an onset a step off a fault of a sensor explains it better. Chosen: within
# four steps a jump leaves all else behind.
cdef int _SPACING = 2
cdef int _DENSE = 4
# Level from which a jump of the GPS's velocity is believed, as a touchdown makes one: the least level of a fault
# (_LEAST_LEVEL of the fit). Healthy flights do not raise it, as a jump accuses no sensor.
cdef double _JUMPED = 12.1
# Share of the usual time between two comparisons with the GPS after which the filter compares with a fix, and after
# which with a point of the line between two fixes. Chosen: it compares with each fix of a receiver of 5 Hz and with
# each second one of 10 Hz; on the line only where no fix is seen, as at constant velocity.
cdef double _SOONEST = 0.7
cdef double _LATEST = 1.5

cdef enum:
    # Indices of the states, and of the hypotheses: biases first, as the states are; then jumps of velocity and of the
    # field's direction, and ramps of velocity.
    _V = 3
    _BG = 5
    _BA = 8
    _H = 10
    _LATE = 11
    _FIELD_LATE = 12
    _JUMP = 5
    _TURN = 7
    _RAMP = 8


cdef class Navigation:
    """The filter and its tests.

    Parameters
    ----------
    dt : float
        Time between ticks, seconds.
    every : int
        Ticks between two fixes that are compared: as often as a receiver gives new ones.
    level : float
        Logarithm of the likelihood from which a fault is believed.
    field_delay_s, field_noise, field_walk : float
        By how much the magnetic field is late against the gyros, seconds; noise of its direction, rad, 0: none is
        measured; random walk of that, rad per root of a second.
    """

    def __init__(
        self,
        double dt,
        int every,
        double level,
        double field_delay_s=0.0,
        double field_noise=0.0,
        double field_walk=0.0,
    ):
        self._dt, self._every, self._level = dt, every, level
        self._field_delay_s, self._field_noise, self._field_walk = field_delay_s, field_noise, field_walk
        self._field_timing_s = _FIELD_TIMING_S if field_delay_s > 0.0 else _FIELD_UNTOLD_S
        self.restart()

    @property
    def biases(self):
        """Return what the gyros x, y, z and the accelerometers x, y read too much, as the filter has it (5,)."""
        return tuple(self._bias)

    @property
    def faults(self):
        """Return the same of those that are held responsible for a fault, zero of the others."""
        return tuple([self.fault(which) for which in range(5)])

    cdef void restart(self) noexcept:
        self._begun = False
        self.score = 0.0
        self.strayed = self.returned = self._learned = False
        memset(self._missed, 0, sizeof(self._missed))

    cdef void begin(self, const double* R) noexcept:
        cdef int i
        memcpy(self._R, R, sizeof(self._R))
        memset(self._P, 0, sizeof(self._P))
        memset(self._Q, 0, sizeof(self._Q))
        memset(self._F, 0, sizeof(self._F))
        for i in range(STATES):
            self._F[i][i] = 1.0
            self._P[i][i] = (_START[i] if i < _FIELD_LATE else self._field_timing_s) ** 2
        memset(self._bias, 0, sizeof(self._bias))
        memset(self._faulty, 0, sizeof(self._faulty))
        memset(self._offset, 0, sizeof(self._offset))
        memset(self._drift, 0, sizeof(self._drift))
        memset(self._led, 0, sizeof(self._led))
        memset(self._stepped, 0, sizeof(self._stepped))
        memset(self._held, 0, sizeof(self._held))
        memset(self._missed, 0, sizeof(self._missed))
        memset(self._field, 0, sizeof(self._field))
        memset(self._tilting, 0, sizeof(self._tilting))
        self._declined = self._back_s = self._back_off = self._whirl = self._sharp = self._late_s = 0.0
        self._lined_s = 0.0
        self._field_late_s = self._field_delay_s
        self._pointed = self._aimed = False
        memset(self._off, 0, sizeof(self._off))
        self._speed_noise = _SPEED_NOISE[1] * _SPEED_NOISE[1]
        self._ticks = self._count = self._helpless = 0
        self._turned = False

    cdef void go_on(
        self, const double* force, const double* rate, const double* mean, const double* R, const double* field,
        const double* hidden, bint lined, double ahead, double* acceleration
    ) noexcept:
        """Go on by a tick; fill in the acceleration north, east, down.

        ``mean`` is the rate over the tick, ``hidden`` are variances of what a straight line hides of the velocity
        north, east and down in it, and of the angles about the body's axes. ``ahead`` is the newest horizontal
        acceleration, of a later time than ``force``: a fix that is late against it may hold a part of its motion.
        """
        cdef double[9] turned
        cdef double[3] turn
        cdef double[3] a
        cdef double[3] specific
        cdef double[3] between
        cdef double[3] aligned
        cdef double[3] swing
        cdef double change, walk
        cdef bint first = not self._begun
        cdef int i, j, k
        if first:
            self.begin(R)
            self._velocity[0] = self._velocity[1] = 0.0
            memcpy(self._rate, rate, sizeof(self._rate))
            self.align(force, rate, self._aligned, swing)
            memset(self._change, 0, sizeof(self._change))
            for i in range(3):
                self._noise[i], self._noise[3 + i] = _WALK[0] * _WALK[0] / self._dt, _WALK[1] * _WALK[1] / self._dt
            memcpy(self._force, force, sizeof(self._force))
        for i in range(3):
            if hidden[i] == 0.0:
                self.shake(i, rate[i] - self._rate[i])
                self.shake(3 + i, force[i] - self._force[i])
            turn[i] = (mean[i] - self._bias[i]) * self._dt
            between[i] = (rate[i] - self._rate[i]) * self._dt
            self._whirl = fmax(fabs(rate[i]), self._whirl)
        if first:
            memset(turn, 0, sizeof(turn))
        _turned(self._R, turn, turned)
        # Means over the tick: of the rotation and of the specific force in it.
        self.align(force, rate, aligned, swing)
        for i in range(3):
            a[i], self._swing[i], specific[i] = along(turned, aligned, i), along(turned, swing, i), 0.0
            for j in range(3):
                specific[i] += 0.5 * (turned[3 * i + j] * aligned[j] + self._R[3 * i + j] * self._aligned[j])
            # what it is at the tick's end, and by how much it changed over the tick
            acceleration[i] = a[i] + (_GRAVITY if i == 2 else 0.0)
        if first:
            self._begun = True
            self.point(field, R)
            return
        for i in range(2):
            self._velocity[i] += specific[i] * self._dt
        self._sharp = fmax(fmax(hypot(specific[0], specific[1]), ahead), self._sharp)
        # F <- F_tick F and Q <- F_tick Q F_tick' + q.
        for k in range(STATES):
            self.advance(&self._F[0][k], STATES, specific)
            self.advance(&self._Q[0][k], STATES, specific)
        for k in range(STATES):
            self.advance(self._Q[k], 1, specific)
        for i in range(3):
            walk = along(self._R, between, i)
            self._Q[i][i] += self.shaken(i, 0) + spread_between(walk)
            for j in range(3):
                self._Q[i][i] += self._R[3 * i + j] ** 2 * hidden[3 + j]
        for i in range(2):
            change = 2.0 * (a[i] - specific[i]) * self._dt
            self._Q[_V + i][_V + i] += self.shaken(i, 3) + spread_between(change) + hidden[i]
            self._Q[_BA + i][_BA + i] += _WALK[3] * _WALK[3] * self._dt
        for i in range(3):
            self._Q[_BG + i][_BG + i] += _WALK[2] * _WALK[2] * self._dt
        self._Q[_H][_H] += self._field_walk * self._field_walk * self._dt
        memcpy(self._R, turned, sizeof(self._R))
        memcpy(self._rate, rate, sizeof(self._rate))
        memcpy(self._force, force, sizeof(self._force))
        memcpy(self._aligned, aligned, sizeof(aligned))
        self._lined_s = _LINE_S if lined else fmax(0.0, self._lined_s - self._dt)
        self._ticks += 1
        self.point(field, R)

    cdef bint due(self, double measured) noexcept:
        """Return whether to compare with the GPS now: ``measured`` is 1 at a fix, 0 on the line between two fixes.

        On the line the velocity is a mean of two fixes and hides the motion between them. 0.5 says that fixes follow
        each other as fast as ticks.
        """
        if self._ticks == 0:
            return True
        return self._ticks >= self._every * (_SOONEST if measured == 1.0 else 1.0 if measured else _LATEST)

    cdef void align(self, const double* force, const double* rate, double* aligned, double* swing) noexcept:
        """Fill in a force less biases, in the body's axes that the gyros have meanwhile, and how these turn it."""
        cdef double[3] w
        cdef double[3] f
        cdef int j
        for j in range(3):
            w[j] = rate[j] - self._bias[j]
            f[j] = force[j] - (self._bias[3 + j] if j < 2 else 0.0)
        cross(w, f, swing)
        for j in range(3):
            aligned[j] = f[j] + self._late_s * swing[j]

    cdef void shake(self, int k, double change) noexcept:
        """Follow the variance of the noise of gyro k or accelerometer k - 3, which changed by so much over the tick."""
        cdef double second = change - self._change[k], walk = _WALK[k >= 3]
        self._change[k] = change
        self._noise[k] *= 1.0 + (self._dt if second * second > _HALF_BELOW * self._noise[k] else -self._dt) / _NOISE_S
        self._noise[k] = fmax(self._noise[k], walk * walk / self._dt)

    cdef void scatter(self, double second, double variance) noexcept:
        """Follow the noise of the GPS's velocity by a second difference of what it was off by.

        ``variance`` is that of noise and timing. Where the latter is the larger part it hides that there is less noise.
        """
        cdef double share = self._step_s / _SCATTER_S
        if second * second > _THREE_QUARTERS_BELOW * variance:
            self._speed_noise *= 1.0 + 3.0 * share
        elif variance < 2.0 * self._speed_noise:
            self._speed_noise *= 1.0 - share
        self._speed_noise = fmax(self._speed_noise, _SPEED_NOISE[0] * _SPEED_NOISE[0])

    cdef double shaken(self, int axis, int first) noexcept:
        """Return what noise of gyros (first 0) or accelerometers (3) adds about an axis over a tick, as a variance."""
        cdef double variance = 0.0
        cdef int j
        for j in range(3):
            variance += self._R[3 * axis + j] * self._R[3 * axis + j] * self._noise[first + j]
        return variance * self._dt * self._dt

    cdef void point(self, const double* field, const double* R) noexcept:
        """Follow where the magnetic field points by the attitude of this tick, or without one the heading R."""
        cdef double[9] then
        cdef double[3] north
        cdef double[3] turned
        cdef double[3] rate
        cdef double square
        cdef int i
        if self._field_noise == 0.0:
            self._direction, self._pointed = wrapped(atan2(R[3], R[0]) - atan2(self._R[3], self._R[0])), True
            return
        if memcmp(field, self._field, sizeof(self._field)) == 0:
            return
        memcpy(self._field, field, sizeof(self._field))
        # the attitude at which it was measured, by what the body turned since
        for i in range(3):
            rate[i] = self._rate[i] - self._bias[i]
            turned[i] = -self._field_late_s * rate[i]
        _turned(self._R, turned, then)
        for i in range(3):
            north[i] = along(then, field, i)
        square = north[0] * north[0] + north[1] * north[1]
        if square > 0.0:
            self._direction, self._pointed = -atan2(north[1], north[0]), True
            self._tilting[0], self._tilting[1] = -north[2] * north[0] / square, -north[2] * north[1] / square
            self._turning = field_rate(then, rate, field)

    cdef void advance(self, double* m, int apart, const double* f) noexcept:
        """Multiply a column of a matrix from the left with the tick's transition, or a row with its transpose."""
        cdef double[2] v
        cdef int i
        v[0] = self._dt * (f[2] * m[apart] - f[1] * m[2 * apart])
        v[1] = self._dt * (f[0] * m[2 * apart] - f[2] * m[0])
        for i in range(2):
            v[i] += self._dt * self._swing[i] * m[_LATE * apart]
            m[(_V + i) * apart] += v[i] - self._dt * (
                self._R[3 * i] * m[_BA * apart] + self._R[3 * i + 1] * m[(_BA + 1) * apart]
            )
        for i in range(3):
            m[i * apart] -= self._dt * (
                self._R[3 * i] * m[_BG * apart]
                + self._R[3 * i + 1] * m[(_BG + 1) * apart]
                + self._R[3 * i + 2] * m[(_BG + 2) * apart]
            )

    cdef void meet(self, const double* velocity, double line_s) noexcept:
        """Compare with a fix, on a line so long over lost ones, and the field's direction; correct and judge."""
        cdef double[3] innovation
        cdef double[3] variance
        cdef Signature* newest
        cdef double off, timing_s
        cdef bint steps = False
        cdef int i, h, older
        if self._ticks == 0:
            # the first tick: nothing to compare yet
            self._velocity[0], self._velocity[1] = velocity[0], velocity[1]
            return
        self._step_s = self._ticks * self._dt
        self.propagate()
        for i in range(2):
            self._offset[i] += self._drift[i] * self._step_s
            innovation[i] = velocity[i] - self._offset[i] - self._velocity[i]
            variance[i] = self._speed_noise + (fmax(_TIMING_S, 0.25 * line_s) * self._sharp) ** 2
            steps |= self.steps(i, innovation[i], variance[i] + self._P[_V + i][_V + i], _SPEED_LEAST)
        for i in range(2):
            if not steps:
                self.scatter(innovation[i] - 2.0 * self._off[i][0] + self._off[i][1], variance[i])
            self._off[i][1], self._off[i][0] = self._off[i][0], innovation[i]
        if steps:
            # north and east are of one device
            for i in range(2):
                if self._held[i] == _STEPS:
                    self.put_off(i, innovation[i])
                variance[i] = INFINITY
        older = self._count - _DENSE
        memmove(
            &self._signatures[1],
            &self._signatures[0],
            (_DENSE - 1 if older > 0 and older % _SPACING else ONSETS - 1) * sizeof(Signature),
        )
        newest = &self._signatures[0]
        memset(newest, 0, sizeof(Signature))
        for h in range(_JUMP):
            newest.state[h][_BG + h] = 1.0
            newest.bias[h] = self._bias[h]
            newest.variance[h] = self._P[_BG + h][_BG + h]
        innovation[2], variance[2] = 0.0, INFINITY
        if self._field_noise == 0.0:
            if self._pointed and not is_steep(hypot(self._R[7], self._R[8])):
                if not self._turned and fabs(self._direction) > _TURNED:
                    self._turned = True
                    self._P[2][2] += self._direction * self._direction
                elif fabs(self._direction) < 2.0 * _HEADING_NOISE:
                    self._turned = False
                if not self._turned:
                    innovation[2], variance[2] = self._direction, _HEADING_NOISE * _HEADING_NOISE
        elif self._pointed and self.believed():
            off = wrapped(self._direction - self._declined)
            timing_s = _LINE_S if self._lined_s > 0.0 else _FIELD_TIMING_S
            variance[2] = self._field_noise * self._field_noise + (timing_s * self._whirl) ** 2
            if not self.steps(2, off, variance[2] + self.field_spread(), _FIELD_LEAST):
                innovation[2] = off
            else:
                variance[2] = INFINITY
                if self._held[2] == _STEPS:
                    self.strayed, self._back_s = True, 0.0
        self._pointed = False
        self._sharp *= _PEAK_KEPT
        self._whirl *= _PEAK_KEPT
        self.update(innovation, variance)
        self._count += 1
        self.judge()
        self._ticks = 0

    cdef bint believed(self) noexcept:
        """Return whether the magnetic field tells the heading, and not that a compass is at fault."""
        cdef double strength = sqrt(self._field[0] ** 2 + self._field[1] ** 2 + self._field[2] ** 2)
        cdef double turned = wrapped(self._direction - self._declined), off
        if not self._aimed:
            self._aimed, self._declined, self._strength = True, self._direction, strength
        off = fabs(strength / self._strength - 1.0)
        if self.strayed:
            if (
                fmax(off, fabs(turned) - 3.0 * sqrt(self.field_spread())) > _FIELD_LEAST
                or (fabs(turned - self._back_off) > _BACK_LEAST and not self._learned)
            ):
                self._back_s, self._back_off = 0.0, turned
            else:
                self._back_s += self._step_s
            self.strayed = self._back_s < _BACK_S
        else:
            self._strength += _STRENGTH_SHARE * (strength - self._strength)
        return not self.strayed and off < _FIELD_LEAST

    cdef double field_spread(self) noexcept:
        """Return the variance of the field's direction by heading, declination and delay."""
        return (
            self._P[2][2] + 2.0 * self._P[2][_H] + self._P[_H][_H]
            + self._turning * self._turning * self._P[_FIELD_LATE][_FIELD_LATE]
        )

    cdef bint steps(self, int m, double off, double variance, double least) noexcept:
        """Return whether a measurement that is so far off may have stepped; the next two tell a step from a turn."""
        cdef double before = self._stepped[m]
        self._stepped[m] = off
        if fabs(off) < fmax(least, _OUTLIER * sqrt(variance)):
            self._held[m] = 0
        elif self._held[m] % _STEPS and fabs(off - before) < 0.5 * fabs(before):
            self._held[m] = _STEPS
        else:
            self._held[m] = (self._held[m] + 1) % _STEPS
        return self._held[m] > 0

    cdef void put_off(self, int m, double size) noexcept:
        """Take a step for one of the GPS's velocity; one that leads back ends what led it away, and it is right."""
        self._offset[m] += size
        if fabs(self._offset[m]) < 0.5 * fabs(size):
            self._velocity[m] += self._offset[m]
            self._offset[m] = self._drift[m] = 0.0
            self.returned |= self._led[m]
            self._led[m] = False
        self._count = 0

    cdef double led(self, int axis) noexcept:
        """Return by how much the GPS's velocity north or east has been led away, which no jump tells."""
        return self._offset[axis] if self._begun and self._led[axis] else 0.0

    cdef void propagate(self) noexcept:
        """Take covariance and signatures from the fix before to this one."""
        cdef double[STATES][STATES] half
        cdef double[STATES] moved
        cdef Signature* signature
        cdef int i, j, k, h, n = self.onsets()
        for i in range(STATES):
            for j in range(STATES):
                half[i][j] = 0.0
                for k in range(STATES):
                    half[i][j] += self._F[i][k] * self._P[k][j]
        for i in range(STATES):
            for j in range(i + 1):
                self._P[i][j] = self._Q[i][j]
                for k in range(STATES):
                    self._P[i][j] += half[i][k] * self._F[j][k]
                self._P[j][i] = self._P[i][j]
        for k in range(n):
            signature = &self._signatures[k]
            signature.age_s += self._step_s
            for h in range(HYPOTHESES):
                for i in range(STATES):
                    moved[i] = 0.0
                    for j in range(STATES):
                        moved[i] += self._F[i][j] * signature.state[h][j]
                memcpy(&signature.state[h][0], moved, sizeof(moved))
        memset(self._F, 0, sizeof(self._F))
        memset(self._Q, 0, sizeof(self._Q))
        for i in range(STATES):
            self._F[i][i] = 1.0

    cdef int onsets(self) noexcept:
        """Return how many onsets there are."""
        return min(self._count, _DENSE + max(0, self._count - _DENSE + 1) // _SPACING, ONSETS)

    cdef void update(self, const double* innovation, const double* variance) noexcept:
        """Go on by the measurements one after the other, the state and each signature."""
        cdef double[STATES] gain
        cdef double[STATES] x
        cdef double[STATES] of_state
        cdef double[STATES] H
        cdef double S, nu, expected
        cdef Signature* signature
        cdef int m, i, j, k, h, n
        self._count += 1
        n = self.onsets()
        self._count -= 1
        memset(x, 0, sizeof(x))
        for m in range(3):
            if variance[m] == INFINITY:
                continue
            # H of v, or of the field's direction
            if m < 2:
                memset(H, 0, sizeof(H))
                H[_V + m] = 1.0
            else:
                self.turn_field(H)
            S, nu = variance[m], innovation[m]
            for i in range(STATES):
                of_state[i] = 0.0
                for j in range(STATES):
                    of_state[i] += self._P[i][j] * H[j]
            for i in range(STATES):
                S += H[i] * of_state[i]
                nu -= H[i] * x[i]
            for i in range(STATES):
                # The field corrects the heading alone: its error of a degree would tilt the attitude by half of that.
                gain[i] = of_state[i] / S if m < 2 or i == 2 or i == _BG + 2 or i in (_H, _FIELD_LATE) else 0.0
            for k in range(n):
                signature = &self._signatures[k]
                for h in range(HYPOTHESES):
                    expected = 0.0
                    for i in range(STATES):
                        expected += H[i] * signature.state[h][i]
                    if h == _JUMP + m:
                        expected += 1.0
                    elif h == _RAMP + m:
                        expected += signature.age_s
                    signature.matched[h] += expected * nu / S
                    signature.energy[h] += expected * expected / S
                    for i in range(STATES):
                        signature.state[h][i] -= gain[i] * expected
            for i in range(STATES):
                x[i] += gain[i] * nu
                for j in range(STATES):
                    self._P[i][j] -= gain[i] * of_state[j] + of_state[i] * gain[j] - gain[i] * S * gain[j]
        self.correct(x)

    cdef void turn_field(self, double* H) noexcept:
        """Fill in how far each error of the state turns the field's direction."""
        memset(H, 0, STATES * sizeof(double))
        H[0], H[1], H[2] = self._tilting[0], self._tilting[1], 1.0
        if self._field_noise > 0.0:
            H[_H], H[_FIELD_LATE] = 1.0, self._turning

    cdef void correct(self, const double* x) noexcept:
        """Put an error of the state into the state."""
        cdef double[9] R
        cdef double[9] E
        cdef double[3] turn
        cdef int i
        for i in range(9):
            E[i] = 1.0 if i % 4 == 0 else 0.0
        memcpy(turn, x, sizeof(turn))
        _turned(E, turn, R)
        _product(R, self._R, E)
        memcpy(self._R, E, sizeof(self._R))
        for i in range(2):
            self._velocity[i] += x[_V + i]
        for i in range(5):
            self._bias[i] += x[_BG + i]
        self._declined += x[_H]
        self._late_s += x[_LATE]
        self._field_late_s += x[_FIELD_LATE]

    cdef void judge(self) noexcept:
        """Believe the fault that is by far the likeliest, or that one has ended."""
        cdef double[HYPOTHESES] best
        cdef double[HYPOTHESES] end
        cdef int[HYPOTHESES] onset, ended
        cdef double likelihood, others, size, least, level
        cdef Signature* signature
        cdef int h, k, which = 0, n = self.onsets()
        cdef bint turning = self._faulty[0] or self._faulty[1] or self._faulty[2]
        self._learned |= turning
        for h in range(HYPOTHESES):
            best[h], onset[h], end[h], ended[h] = 0.0, 0, 0.0, 0
        for k in range(n):
            signature = &self._signatures[k]
            for h in range(HYPOTHESES):
                if signature.energy[h] <= 0.0:
                    continue
                likelihood = 0.5 * signature.matched[h] * signature.matched[h] / (signature.energy[h] + _rarity(h))
                if likelihood > best[h]:
                    best[h], onset[h] = likelihood, k
                if h < 5 and self._faulty[h]:
                    # what the filter has followed of it since is in the signature
                    size = self._before[h] - signature.bias[h]
                    likelihood = size * signature.matched[h] - 0.5 * size * size * signature.energy[h]
                    if likelihood > end[h]:
                        end[h], ended[h] = likelihood, k
        for h in range(5):
            others = _ENDED
            for k in range(HYPOTHESES):
                if k != h:
                    others = fmax(others, _BETTER * best[k])
            # What another fault explains far better is no end.
            if end[h] > others:
                self.end(&self._signatures[ended[h]], h)
                return
        others = 0.0
        for h in range(HYPOTHESES):
            if best[h] > best[which]:
                which = h
        for h in range(HYPOTHESES):
            if h != which:
                others = fmax(others, best[h] - (_COINCIDENCE if h >= _RAMP and which < _RAMP else 0.0))
        level = fmin(self._level, _JUMPED) if _JUMP <= which < _TURN else self._level
        # Jumps accuse no sensor, and magnetometers are judged elsewhere.
        self.score = 0.0 if _JUMP <= which < _RAMP else best[which]
        self._helpless = self._helpless + 1 if which != _TURN and best[which] > level else 0
        if self._learned and not turning and self.score > level:
            self.restart()
            self.returned = True
            return
        if (
            best[which] > level
            and best[which] > others + _MARGIN
            and (which != 2 or self._field_noise > 0.0)
        ):
            signature = &self._signatures[onset[which]]
            size = signature.matched[which] / signature.energy[which]
            least = _LEAST[which >= 3] if which < _JUMP else _LEAST_RAMP if which >= _RAMP else 0.0
            if (
                fabs(size) > least
                and (which >= _JUMP or fabs(size) < _MOST[which >= 3])
                and (which < _RAMP or signature.age_s > _RAMPS_S)
            ):
                if which >= _RAMP and turning:
                    # So does a tilt, which is left where the gyro's fault was another one than is believed.
                    self.restart()
                    self.returned = True
                    return
                self.jump(signature, which, size, 1.0 / signature.energy[which])
                return
        if self._helpless > _HELPLESS:
            self.restart()
        for h in range(5):
            size = fabs(self._bias[h] - self._before[h])
            if self._faulty[h] and size < 0.5 * _LEAST[h >= 3]:
                self._faulty[h] = False
            elif self._faulty[h] and size > _MOST[h >= 3]:
                self.restart()
                return

    cdef void end(self, Signature* signature, int which) noexcept:
        """Take a fault out of the state."""
        cdef double size = self._before[which] - signature.bias[which]
        # When it ended is known to half the time between two onsets.
        cdef double angle = 0.5 * _SPACING * self._step_s * size
        cdef int i
        self.jump(signature, which, size, 0.0)
        self._faulty[which] = False
        if which < 3:
            for i in range(3):
                self._P[i][i] += angle * angle

    cdef void jump(self, Signature* signature, int which, double size, double spread) noexcept:
        """Put a fault into the state, with its uncertainty, and begin to judge anew."""
        cdef double[STATES] x
        cdef int i, j
        for i in range(STATES):
            x[i] = size * signature.state[which][i]
            for j in range(STATES):
                self._P[i][j] += spread * signature.state[which][i] * signature.state[which][j]
        if which < 5:
            if not self._faulty[which]:
                self._faulty[which] = True
                # What the filter has followed of it since its onset is a part of it.
                self._before[which] = signature.bias[which]
                self._doubt[which] = signature.variance[which]
            if which < 3:
                self._missed[which] += size * signature.age_s
        elif which < _TURN:
            self.put_off(which - _JUMP, size)
        elif which >= _RAMP:
            self._offset[which - _RAMP] += size * signature.age_s
            self._drift[which - _RAMP] += size
            self._led[which - _RAMP] = True
        elif fabs(size) < _FIELD_LEAST:
            self._declined += size
        else:
            self.strayed, self._back_s = True, 0.0
        self.correct(x)
        self._count = self._helpless = 0

    cdef void differ(self, const double* R, double* apart) noexcept:
        """Fill in the rotation from this attitude to another, north, east, down."""
        cdef int i, j, k
        for i in range(3):
            for j in range(3):
                apart[3 * i + j] = 0.0
                for k in range(3):
                    apart[3 * i + j] += R[3 * i + k] * self._R[3 * j + k]

    cdef double missed(self, int axis) noexcept:
        """Return what a gyro's faults that began or ended turned meanwhile; once."""
        cdef double angle = self._missed[axis]
        self._missed[axis] = 0.0
        return angle

    cdef double fault(self, int which) noexcept:
        """Return by how much a gyro (0, 1, 2) or an accelerometer (3, 4) reads too much."""
        return self._bias[which] - self._before[which] if self._begun and self._faulty[which] else 0.0

    cdef double spread(self, int which) noexcept:
        """Return the standard deviation of :meth:`fault`: the bias is uncertain now, and was before the fault.

        That of a compass (5) is how far its field may turn while it is right, by the tilt and heading that gyros tell.
        """
        cdef double[STATES] H
        cdef double variance = 0.0
        cdef int i, j
        if not self._begun:
            return 0.0
        if which == _JUMP:
            self.turn_field(H)
            for i in range(STATES):
                for j in range(STATES):
                    variance += H[i] * self._P[i][j] * H[j]
            return sqrt(variance)
        return sqrt(self._P[_BG + which][_BG + which] + (self._doubt[which] if self._faulty[which] else 0.0))


cdef inline double _rarity(int h) noexcept:
    """Return one over the variance of a hypothesis' size before anything is measured; a jump may be of any size."""
    return (_SIGMAS / _MOST[h >= 3]) ** 2 if h < _JUMP or h >= _RAMP else 0.0


cdef inline void _turned(const double* R, const double* turn, double* result) noexcept:
    """Fill in R exp(turn x), by the formula of Rodrigues."""
    cdef double x = turn[0], y = turn[1], z = turn[2], angle = sqrt(x * x + y * y + z * z), s, c
    cdef double[9] E
    # sin(a) / a and (1 - cos(a)) / a^2, by their series where a is too small to divide by
    if angle > 1e-4:
        s, c = sin(angle) / angle, (1.0 - cos(angle)) / (angle * angle)
    else:
        s, c = 1.0 - angle * angle / 6.0, 0.5
    E[0], E[1], E[2] = 1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    E[3], E[4], E[5] = c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x
    E[6], E[7], E[8] = c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)
    _product(R, E, result)


cdef inline void _product(const double* A, const double* B, double* product) noexcept:
    cdef int i, j
    for i in range(3):
        for j in range(3):
            product[3 * i + j] = A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j]
