# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
# distutils: extra_compile_args = -ftree-vectorize -fvect-cost-model=dynamic
# Signatures of different hypotheses are independent: two are computed at a time, to the same bits.
"""Strapdown navigation with its own attitude and biases, and isolation of the sensor that makes it differ from the GPS.

Attitude R and horizontal velocity v are integrated from gyros and accelerometers minus their biases. A Kalman filter
corrects them by the GPS's velocity and the direction of the magnetic field m. With d the error of the attitude about
north, east and down and f the specific force,

    d' = -R b_gyro,    v' = d x R f - R b_accel + R (w x f) tau,

with b_gyro and b_accel random walks, as slow as those of healthy sensors. tau, a constant, is the delay of the gyros
behind the accelerometers, which autopilots filter differently (ArduPilot's rover at 4 and 10 Hz: 0.04 s): while the
vehicle turns at w, its force f has another direction by then. A GPS that is later than fitted has the same effect in
steady turns, and is covered by tau there.

The field R m points h west of north: declination and the vehicle's own field, a random walk as well. An error of the
attitude turns it by d_down - (m_down / m_horizontal^2) (m_north d_north + m_east d_east). A faulty gyro z turns it
steadily, a faulty magnetometer at once. Its delay behind these gyros is an estimated constant, which shows in turns
(the fitted delay is relative to the autopilot's attitude, which is less late than the gyros). The autopilot's heading
follows gyro and magnetometer, so it is no evidence: without a magnetic field it keeps R from drifting, and gyro z is
not judged.

A fault of size theta since t_0 adds theta s(t; t_0) to the innovations. The signature s follows from the filter's gains
(Willsky and Jones 1976): a gyro's bias tilts the attitude, so the velocity error grows with the square of time; an
accelerometer's bias makes it grow in proportion to time; both turn with the body, an error of the GPS's velocity does
not. For every hypothesis and onset of the last seconds

    l = (sum s' S^-1 nu)^2 / (2 (sum s' S^-1 s + 1 / sigma^2))

is the log-likelihood ratio of that fault, with standard deviation sigma of its size, against health. A hypothesis is
believed if its largest l is above a level and above those of all others. Its fault is then added to the state, with its
uncertainty, and estimated until it is small. Its size f^ = b^(t) - b^(t_0) includes what the filter had estimated of
the fault before it was believed. Its variance is

    var f^ = P_b(t) + P_b(t_0) - 2 C_b(t),    C(t) = E[e(t) e_b(t_0)],

where e are errors of the state. What neither shows nor changes, a bias that a tilt hides, cancels. Innovations are
independent of the error that they leave, so for a constant bias E[e(t) e_b(t_0)] = P(t), its column of b, while no
fault is believed; the size that is added then shares with them the share 1 - s_b of a unit fault that the filter has
followed by then, so that C = P - (1 - s_b) s / sum s' S^-1 s. From there C+ = (I - K H) F C.

An autopilot learns a gyro's bias and subtracts it from its messages, which looks like the end of the fault. The true
end is learned too, and leaves a tilt that looks like any of these faults. So the first apparent fault after a gyro's is
not reported; the navigation begins anew from the autopilot's attitude, where a true fault still shows.

A ramp of the GPS's velocity is estimated too, after removing its effect on the filter, until a step leads back: then
position and velocity of the receiver are right at once. A slow ramp is not seen, and the filter follows it. So two
coasts, the same navigation without the GPS, are remembered with their covariance, as differences e of the filter from
them (e+ = F e + x, x the filter's corrections): a step of the GPS's velocity that leads to a coast ends such a ramp.

Accelerometer z shows as the vehicle tilts. Its bias is a hypothesis without uncertainty before it is believed, so the
filter is the same without it; vertical accelerations are judged elsewhere, and are given out with that bias.

In hover a tilt and an accelerometer's bias look the same; the gyros tell them apart, as a tilt needs a rotation.
"""

from libc.math cimport INFINITY, atan2, cos, exp, fabs, fmax, fmin, hypot, sin, sqrt
from libc.string cimport memcmp, memcpy, memmove, memset
from monitor.core.lines cimport spread_between

from adapters.channels import STANDARD_GRAVITY

from monitor.core.sampling import RAW_LINE_S

cdef double _GRAVITY = STANDARD_GRAVITY

# Standard deviations at the start: errors of an autopilot's attitude, about the horizontal axes and in heading, rad; of
# the velocity, m/s; of gyros (1 degree/s is 0.017 rad/s) and accelerometers as calibrated by autopilots; direction of
# the magnetic field against its first measurement, rad, three times the error of one noisy measurement; delay of the
# gyros, s, half of the difference between filters of 4 and 10 Hz. (The delay of the field has its own.)
cdef double[13] _START = [0.02, 0.02, 0.1, 0.1, 0.1, 0.01, 0.01, 0.01, 0.2, 0.2, 0.0, 0.3, 0.02]
# Random walks per root of a second: of attitude and velocity, the least that vibration and lines between samples make;
# of the biases, a change by 0.01 rad/s and 0.5 m/s^2 in some hours of warming up.
cdef double[4] _WALK = [1e-3, 0.05, 1e-4, 5e-3]
# Second differences of noise and vibration have six times its variance; half of their squares are below 0.455 times
# that. Motion makes large ones, but seldom. The estimate changes by a factor of e within a second, as propellers do.
cdef double _HALF_BELOW = 6.0 * 0.455
cdef double _NOISE_S = 1.0
# Noise of a GPS's velocity, m/s: smallest value and first assumption (data sheets: 0.05 to 0.1, 50 % circular). It is
# followed by second differences as that of the gyros; with five fixes a second, down by a factor of e within 4 s, and
# up three times as fast, as worse reception would look like a fault. So three quarters of the squares are below the
# level, 1.323 times the variance.
cdef double[2] _SPEED_NOISE = [0.05, 0.1]
cdef double _SCATTER_S = 4.0
cdef double _THREE_QUARTERS_BELOW = 6.0 * 1.323
# Timing error of a fix against the accelerometers, s: half of the step of delays that a fit tries (0.02) and half of
# the tick that contains the fix (0.02 at 25 Hz), independent; on a line over lost fixes a quarter of its length.
cdef double _TIMING_S = 0.03
# Noise of the autopilot's heading, rad.
cdef double _HEADING_NOISE = 0.1
# Timing error of the field against the gyros, s: half of the step of delays that a fit tries.
cdef double _FIELD_TIMING_S = 0.02
# The same if flights did not show the delay, as in hover: the standard deviation of all delays tried (up to 0.28 s).
cdef double _FIELD_UNTOLD_S = 0.08
# The same around lost measurements, s: the longest line that counts as measured.
cdef double _LINE_S = RAW_LINE_S
# Smallest step of the field's direction, rad, that is a faulty compass: half of the smallest fault worth an alarm.
cdef double _FIELD_LEAST = 0.09
# Smallest step of the GPS's velocity, m/s: the smallest motion worth an alarm, and more than the largest fault of an
# accelerometer that is believed makes between two fixes.
cdef double _SPEED_LEAST = 1.0
# Largest error of a measurement in standard deviations (exceeded once in two million).
cdef double _OUTLIER = 5.0
# Weight of a measurement in the field's usual strength: a memory of 40 s.
cdef double _STRENGTH_SHARE = 0.005
# Time for which the field has to point as before, with its former strength, until it is used again, seconds, and by how
# much it may turn differently from the gyros meanwhile, rad. Chosen: a vehicle that turns with a field of its own
# passes the true heading twice in each turn, for less time or by more; after a gyro's fault the attitude is still
# changing.
cdef double _BACK_S = 2.0
cdef double _BACK_LEAST = 0.5 * _FIELD_LEAST
# Factor by which the held peak of accelerations decays per step. Chosen: 0.8 each 0.2 s forgets a hard stop within a
# second.
cdef double _PEAK_KEPT = 0.8
# Margin of the believed hypothesis above any other, nats: 20 to 1.
cdef double _MARGIN = 3.0
# Prior of a ramp of the GPS's velocity in the direction of an accelerometer's fault, nats: ramps may go anywhere, and a
# likelihood l separates directions by 1 / sqrt(2 l) rad, 0.1 for 50. 0.8 of the 6.3 rad are within that of one of four
# directions: 1 in 8.
cdef double _COINCIDENCE = 2.0
# A fault has ended if that is likelier by this than that it goes on, nats: 150 to 1, as faults do end.
cdef double _ENDED = 5.0
# Share of another fault's likelihood that the end of a fault has to reach. Measured on five flights with a gyro's
# fault: with 1 one end of five is recognised 2.2 s later; in a vehicle that a fault throws about a false end is seen
# after 7, 20 and 35 of 40 s with 0, 0.5 and 0.75.
cdef double _BETTER = 0.75
# Smallest bias that is believed, of gyros (rad/s) and accelerometers (m/s^2): the drift of healthy ones.
cdef double[2] _LEAST = [0.01, 0.25]
# Smallest ramp of the GPS's velocity that is believed, m/s^2: the effect of a tilt of 10 mrad.
cdef double _LEAST_RAMP = 0.1
# Least duration of a believed ramp, s: the end of a gyro's or an accelerometer's fault, which begins alike, is known
# within 2.5 s.
cdef double _RAMPS_S = 3.0
# Largest bias that is believed, rad/s and m/s^2; with a larger one the navigation begins anew. Chosen: ten and six
# times those in recorded flights; no autopilot keeps a vehicle in the air with them.
cdef double[2] _MOST = [1.0, 4.0]
# Largest bias in standard deviations of the sizes of faults; sizes of the GPS's ramps are taken to scatter as those of
# accelerometers. Without this prior, where the filter follows a fault as fast as it grows, an unrelated difference of
# 0.1 m/s would look like 2.5 m/s^2, five times the standard deviation of that estimate.
cdef double _SIGMAS = 3.0
# A heading that differs by more, rad, means that the autopilot has set its attitude anew, rightly or wrongly. It is
# used again when it agrees with the direction of motion within twice its noise.
cdef double _TURNED = 0.5
# Steps with a likely fault, of which no hypothesis can be believed, until the filter begins anew: two sets of onsets.
cdef int _HELPLESS = 2 * ONSETS
# Fixes by which a step is told from a turn: the line between two measurements may hide it in the first of them.
cdef int _STEPS = 3
# Steps between two onsets; each of the newest steps is an onset. A jump explains no measurement before its onset, and
# the first one after it best: with an onset one step off, a sensor's fault would explain it better. Chosen: within four
# steps a jump is clear of all other hypotheses.
cdef int _SPACING = 2
cdef int _DENSE = 4
# Level from which a jump of the GPS's velocity, as at a touchdown, is believed: the least level of a fault
# (_LEAST_LEVEL of the fit). Healthy flights do not raise it, as a jump makes no sensor responsible.
cdef double _JUMPED = 12.1
# Shares of the usual time between two comparisons after which the filter compares with a fix, and, of the time between
# the newest two fixes if that is longer, with a point of the line between two fixes. Chosen: each fix of a receiver at
# 5 Hz or less and each second one at 10 Hz; a point of the line only if no fix is seen, as at constant velocity.
cdef double _SOONEST = 0.7
cdef double _LATEST = 1.5
# Longest time between two fixes that is taken for the receiver's pace, s: slower receivers are not used on vehicles.
cdef double _SLOWEST_S = 1.0

# Age from which a coast begins anew unless the GPS has led the filter away from it, s. Chosen: of two that begin half
# of it apart, one began before a lead-away of 0.5 m/s^2 and shows 5 m/s of it at that age, twice its deviation.
# Evidence of that from which it goes on, nats. Chosen: 1.4 deviations, which one healthy coast in six exceeds.
cdef double _COAST_S = 20.0
cdef double _COASTS_ON = 1.0

cdef enum:
    # Indices of states and hypotheses: biases first, as in the state; then jumps of the velocity and of the field's
    # direction, and ramps of the velocity.
    _V = 3
    _BG = 5
    _BA = 8
    _BZ = 10
    _H = 11
    _LATE = 12
    _FIELD_LATE = 13
    _JUMP = BIASES
    _TURN = _JUMP + 2
    _RAMP = _TURN + 1


cdef int filled(const double* row, int* columns) noexcept:
    """Write the columns of a row's entries that are not zero; return their number."""
    cdef int i, count = 0
    for i in range(STATES):
        if row[i] != 0.0:
            columns[count] = i
            count += 1
    return count


cdef class Navigation:
    """The filter and its tests.

    Parameters
    ----------
    dt : float
        Time between ticks, seconds.
    every : int
        Ticks between two fixes that are compared: the usual time between two fixes.
    level : float
        Log-likelihood ratio from which a fault is believed.
    field_delay_s, field_noise, field_walk : float
        Delay of the magnetic field behind the gyros, seconds; noise of its direction, rad (0: it is not measured);
        random walk of the direction, rad per root of a second.
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
        """Return the biases of the gyros x, y, z and the accelerometers x, y, z by the filter (6,)."""
        return tuple(self._bias)

    @property
    def faults(self):
        """Return the faults of those that are held responsible, zero for the others (6,)."""
        return tuple([self.fault(which) for which in range(BIASES)])

    cdef void restart(self) noexcept:
        self._begun = False
        self.score = 0.0
        self.strayed = self.returned = self.renewed = self._learned = False
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
        memset(self._shared, 0, sizeof(self._shared))
        memset(self._offset, 0, sizeof(self._offset))
        memset(self._drift, 0, sizeof(self._drift))
        memset(self._led, 0, sizeof(self._led))
        memset(self._stepped, 0, sizeof(self._stepped))
        memset(self._held, 0, sizeof(self._held))
        memset(self._coasts, 0, sizeof(self._coasts))
        memset(self._missed, 0, sizeof(self._missed))
        memset(self._field, 0, sizeof(self._field))
        memset(self._tilting, 0, sizeof(self._tilting))
        self._declined = self._back_s = self._back_off = self._whirl = self._sharp = self._late_s = 0.0
        self._lined_s = 0.0
        self._field_late_s = self._field_delay_s
        self._pointed = self._aimed = False
        memset(self._off, 0, sizeof(self._off))
        self._speed_noise = _SPEED_NOISE[1] * _SPEED_NOISE[1]
        self._ticks = self._count = self._helpless = self._unseen = 0
        self._pace = self._every
        self._turned = False
        for i in range(ONSETS):
            self._order[i] = i

    cdef void go_on(
        self, const double* force, const double* rate, const double* mean, const double* R, const double* field,
        const double* hidden, bint lined, double ahead, double* acceleration
    ) noexcept:
        """Process a tick; fill in the acceleration north, east, down.

        ``mean`` is the rate over the tick. ``hidden`` are the variances that a straight line hides in this tick, of the
        velocity north, east and down, and of the angles about the body's axes. ``ahead`` is the newest horizontal
        acceleration, later than ``force``: a late fix may contain part of its motion.
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
            # At the tick's end.
            acceleration[i] = a[i] + (_GRAVITY if i == 2 else 0.0)
        # The observer names a fault of accelerometer z by this.
        acceleration[2] += turned[8] * self._bias[5]
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
        if self._P[_BZ][_BZ] > 0.0:
            self._Q[_BZ][_BZ] += _WALK[3] * _WALK[3] * self._dt
        for i in range(3):
            self._Q[_BG + i][_BG + i] += _WALK[2] * _WALK[2] * self._dt
        self._Q[_H][_H] += self._field_walk * self._field_walk * self._dt
        memcpy(self._R, turned, sizeof(self._R))
        memcpy(self._rate, rate, sizeof(self._rate))
        memcpy(self._force, force, sizeof(self._force))
        memcpy(self._aligned, aligned, sizeof(aligned))
        self._lined_s = _LINE_S if lined else fmax(0.0, self._lined_s - self._dt)
        self._ticks += 1
        self._unseen += 1
        self.point(field, R)

    cdef bint due(self, double measured) noexcept:
        """Return whether to compare with the GPS now: ``measured`` is 1 at a fix, 0 on the line between two fixes.

        On the line the velocity is a mean of two fixes and hides the motion between them. 0.5 says that fixes follow
        each other as fast as ticks.
        """
        if measured == 1.0:
            self._pace, self._unseen = max(self._every, min(self._unseen, <int>(_SLOWEST_S / self._dt))), 0
        if self._ticks == 0:
            return True
        if measured:
            return self._ticks >= self._every * (_SOONEST if measured == 1.0 else 1.0)
        return self._ticks >= self._pace * _LATEST

    cdef void align(self, const double* force, const double* rate, double* aligned, double* swing) noexcept:
        """Fill in a force minus biases, in the body's axes at the gyros' time, and its change per second of delay."""
        cdef double[3] w
        cdef double[3] f
        cdef int j
        for j in range(3):
            w[j] = rate[j] - self._bias[j]
            f[j] = force[j] - self._bias[3 + j]
        cross(w, f, swing)
        for j in range(3):
            aligned[j] = f[j] + self._late_s * swing[j]

    cdef void shake(self, int k, double change) noexcept:
        """Follow the variance of the noise of gyro k or accelerometer k - 3, which changed by ``change`` over the
        tick."""
        cdef double second = change - self._change[k], walk = _WALK[k >= 3]
        self._change[k] = change
        self._noise[k] *= 1.0 + (self._dt if second * second > _HALF_BELOW * self._noise[k] else -self._dt) / _NOISE_S
        self._noise[k] = fmax(self._noise[k], walk * walk / self._dt)

    cdef void scatter(self, double second, double variance) noexcept:
        """Follow the noise of the GPS's velocity by a second difference of its innovations.

        ``variance`` is that of noise and timing. If timing is the larger part, the noise cannot be told to be less.
        """
        cdef double share = self._step_s / _SCATTER_S
        if second * second > _THREE_QUARTERS_BELOW * variance:
            self._speed_noise *= 1.0 + 3.0 * share
        elif variance < 2.0 * self._speed_noise:
            self._speed_noise *= 1.0 - share
        self._speed_noise = fmax(self._speed_noise, _SPEED_NOISE[0] * _SPEED_NOISE[0])

    cdef double shaken(self, int axis, int first) noexcept:
        """Return the variance that noise of gyros (first 0) or accelerometers (3) adds about an axis over a tick."""
        cdef double variance = 0.0
        cdef int j
        for j in range(3):
            variance += self._R[3 * axis + j] * self._R[3 * axis + j] * self._noise[first + j]
        return variance * self._dt * self._dt

    cdef void point(self, const double* field, const double* R) noexcept:
        """Find the direction of the magnetic field by the attitude of this tick; without a field, that of the heading
        of R."""
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
        # The attitude at which it was measured: the body has turned since.
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
        """Multiply a column of a matrix by the tick's transition from the left, or a row by its transpose."""
        cdef double[2] v
        cdef int i
        v[0] = self._dt * (f[2] * m[apart] - f[1] * m[2 * apart])
        v[1] = self._dt * (f[0] * m[2 * apart] - f[2] * m[0])
        for i in range(2):
            v[i] += self._dt * self._swing[i] * m[_LATE * apart]
            m[(_V + i) * apart] += v[i] - self._dt * (
                self._R[3 * i] * m[_BA * apart] + self._R[3 * i + 1] * m[(_BA + 1) * apart]
                + self._R[3 * i + 2] * m[_BZ * apart]
            )
        for i in range(3):
            m[i * apart] -= self._dt * (
                self._R[3 * i] * m[_BG * apart]
                + self._R[3 * i + 1] * m[(_BG + 1) * apart]
                + self._R[3 * i + 2] * m[(_BG + 2) * apart]
            )

    cdef void meet(self, const double* velocity, double line_s, bint consistent) noexcept:
        """Compare with a fix, on a line of ``line_s`` over lost ones, and with the field's direction; correct and
        judge. ``consistent``: position and velocity of the GPS agreed until just now, as of one that is led away."""
        cdef double[3] innovation
        cdef double[3] variance
        cdef Signature* newest
        cdef double off, timing_s, least
        cdef bint steps = False
        cdef int i, h, older, last, free
        if self._ticks == 0:
            # The first tick: nothing to compare yet.
            self._velocity[0], self._velocity[1] = velocity[0], velocity[1]
            return
        self._step_s = self._ticks * self._dt
        self.propagate()
        least = fmax(_SPEED_LEAST, _MOST[1] * self._step_s)
        for i in range(2):
            self._offset[i] += self._drift[i] * self._step_s
            innovation[i] = velocity[i] - self._offset[i] - self._velocity[i]
            variance[i] = self._speed_noise + (fmax(_TIMING_S, 0.25 * line_s) * self._sharp) ** 2
            steps |= self.steps(i, innovation[i], variance[i] + self._P[_V + i][_V + i], least)
        for i in range(2):
            if not steps:
                self.scatter(innovation[i] - 2.0 * self._off[i][0] + self._off[i][1], variance[i])
            self._off[i][1], self._off[i][0] = self._off[i][0], innovation[i]
        if steps:
            # North and east belong to one receiver.
            for i in range(2):
                if consistent and self._held[i] == _STEPS and self.leads_back(i, innovation[i]):
                    self.restart()
                    self.returned = True
                    return
            for i in range(2):
                if self._held[i] == _STEPS:
                    self.put_off(i, innovation[i])
                variance[i] = INFINITY
        older = self._count - _DENSE
        # The onset that is left out gives its memory to the new one.
        last = _DENSE - 1 if older > 0 and older % _SPACING else ONSETS - 1
        free = self._order[last]
        memmove(&self._order[1], &self._order[0], last * sizeof(int))
        self._order[0] = free
        newest = self.signature(0)
        memset(newest, 0, sizeof(Signature))
        for h in range(BIASES):
            newest.state[_BG + h][h] = 1.0
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
        self.coast()
        self.judge()
        self._ticks = 0

    cdef bint believed(self) noexcept:
        """Return whether the field's direction may correct the heading: no compass fault shows."""
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
        """Return the variance of the field's direction due to heading, declination and delay."""
        return (
            self._P[2][2] + 2.0 * self._P[2][_H] + self._P[_H][_H]
            + self._turning * self._turning * self._P[_FIELD_LATE][_FIELD_LATE]
        )

    cdef bint steps(self, int m, double off, double variance, double least) noexcept:
        """Return whether an innovation may be a step; the next two measurements tell it from a turn."""
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
        """Apply a step of the GPS's velocity; one that leads back ends its fault, and the velocity is right again."""
        self._offset[m] += size
        if fabs(self._offset[m]) < 0.5 * fabs(size):
            self._velocity[m] += self._offset[m]
            self._offset[m] = self._drift[m] = 0.0
            self.returned |= self._led[m]
            self._led[m] = False
        self._count = 0

    cdef bint leads_back(self, int m, double size) noexcept:
        """Return whether a step of the GPS's velocity is the end of a fault that was not seen as it grew.

        The filter has followed that fault. A coast is nearer to the velocity after the step than to the one before.
        """
        cdef double led
        cdef Coast* coast
        cdef int k
        for k in range(2):
            coast = &self._coasts[k]
            led = coast.led[_V + m]
            if (
                self._offset[m] == 0.0
                and coast.age_s > 0.0
                and led * led - (led + size) ** 2 > 2.0 * _ENDED * coast.P[_V + m][_V + m]
            ):
                return True
        return False

    cdef void coast(self) noexcept:
        """Follow the coasts by a step; an old one begins anew unless the GPS has led the filter away from it."""
        cdef Coast* coast
        cdef bint led
        cdef int k, m
        for k in range(2):
            coast, led = &self._coasts[k], False
            for m in range(_V, _V + 2):
                led |= coast.led[m] * coast.led[m] > 2.0 * _COASTS_ON * coast.P[m][m]
            coast.age_s += self._step_s
            if coast.age_s > _COAST_S and not led or coast.age_s == self._step_s:
                memset(coast.led, 0, sizeof(coast.led))
                memcpy(coast.P, self._P, sizeof(self._P))
                coast.age_s = self._step_s + 0.5 * _COAST_S * (k == 0 and self._coasts[1].age_s == 0.0)

    cdef double led(self, int axis) noexcept:
        """Return the error of the GPS's velocity, north or east, by a ramp, which shows no jump."""
        return self._offset[axis] if self._begun and self._led[axis] else 0.0

    cdef void propagate(self) noexcept:
        """Predict covariance and signatures from the fix before to this one."""
        # Most entries of F are zero: the columns of the others of each row, and their number.
        cdef int[STATES][STATES] columns
        cdef int[STATES] used
        cdef int i, k, n = self.onsets()
        for i in range(STATES):
            used[i] = filled(self._F[i], columns[i])
        self.spread_by(self._P, columns, used)
        for k in range(2):
            self.spread_by(self._coasts[k].P, columns, used)
            self.carry(self._coasts[k].led, 1, columns, used)
        self.carry(self._shared, BIASES, columns, used)
        for k in range(n):
            self.signature(k).age_s += self._step_s
            self.carry(self.signature(k).state[0], HYPOTHESES, columns, used)
        memset(self._F, 0, sizeof(self._F))
        memset(self._Q, 0, sizeof(self._Q))
        for i in range(STATES):
            self._F[i][i] = 1.0

    cdef void carry(self, double* x, int count, int (*columns)[STATES], const int* used) noexcept:
        """Predict ``count`` errors of the state, x <- F x, by the columns of the entries of F that are not zero."""
        cdef double[STATES * HYPOTHESES] moved
        cdef double factor
        cdef double* sums
        cdef const double* row
        cdef int i, h, m
        memset(moved, 0, sizeof(moved))
        for i in range(STATES):
            sums = &moved[i * count]
            for m in range(used[i]):
                factor, row = self._F[i][columns[i][m]], x + columns[i][m] * count
                for h in range(count):
                    sums[h] += factor * row[h]
        memcpy(x, moved, STATES * count * sizeof(double))

    cdef void spread_by(self, double (*P)[STATES], int (*columns)[STATES], const int* used) noexcept:
        """Predict a covariance, P <- F P F' + Q, likewise."""
        cdef double[STATES][STATES] half
        cdef double total
        cdef int i, j, k, m
        for i in range(STATES):
            memset(half[i], 0, sizeof(half[i]))
            for m in range(used[i]):
                k = columns[i][m]
                for j in range(STATES):
                    half[i][j] += self._F[i][k] * P[k][j]
        for i in range(STATES):
            for j in range(i + 1):
                total = self._Q[i][j]
                for m in range(used[j]):
                    total += half[i][columns[j][m]] * self._F[j][columns[j][m]]
                P[i][j] = P[j][i] = total

    cdef Signature* signature(self, int k) noexcept:
        """Return the signature of an onset, the newest being 0."""
        return &self._signatures[self._order[k]]

    cdef int onsets(self) noexcept:
        """Return the number of onsets."""
        return min(self._count, _DENSE + max(0, self._count - _DENSE + 1) // _SPACING, ONSETS)

    cdef void update(self, const double* innovation, const double* variance) noexcept:
        """Correct the state and each signature by the measurements, one after the other."""
        cdef double[STATES] gain
        cdef double[STATES] x
        cdef double[STATES] of_state
        cdef double[STATES] H
        cdef double[HYPOTHESES] expected
        cdef int[STATES] columns
        cdef double S, nu, known
        cdef Signature* signature
        cdef int m, i, j, k, h, n, used
        self._count += 1
        n = self.onsets()
        self._count -= 1
        memset(x, 0, sizeof(x))
        for m in range(3):
            if variance[m] == INFINITY:
                continue
            # H of v, or of the field's direction.
            if m < 2:
                memset(H, 0, sizeof(H))
                H[_V + m] = 1.0
            else:
                self.turn_field(H)
            used = filled(H, columns)
            S, nu = variance[m], innovation[m]
            for i in range(STATES):
                of_state[i] = 0.0
                for j in range(used):
                    of_state[i] += self._P[i][columns[j]] * H[columns[j]]
            for i in range(STATES):
                S += H[i] * of_state[i]
                nu -= H[i] * x[i]
            for i in range(STATES):
                # The field corrects the heading only: an error of one degree would tilt the attitude by half a degree.
                gain[i] = of_state[i] / S if m < 2 or i == 2 or i == _BG + 2 or i in (_H, _FIELD_LATE) else 0.0
            for k in range(n):
                signature = self.signature(k)
                memset(expected, 0, sizeof(expected))
                for i in range(used):
                    for h in range(HYPOTHESES):
                        expected[h] += H[columns[i]] * signature.state[columns[i]][h]
                expected[_JUMP + m] += 1.0
                if m < 2:
                    expected[_RAMP + m] += signature.age_s
                for h in range(HYPOTHESES):
                    signature.matched[h] += expected[h] * nu / S
                    signature.energy[h] += expected[h] * expected[h] / S
                for i in range(STATES):
                    for h in range(HYPOTHESES):
                        signature.state[i][h] -= gain[i] * expected[h]
            for h in range(BIASES):
                known = 0.0
                for i in range(used):
                    known += H[columns[i]] * self._shared[columns[i] * BIASES + h]
                for i in range(STATES):
                    self._shared[i * BIASES + h] -= gain[i] * known
            for i in range(STATES):
                x[i] += gain[i] * nu
                for j in range(STATES):
                    self._P[i][j] -= gain[i] * of_state[j] + of_state[i] * gain[j] - gain[i] * S * gain[j]
        self.correct(x)

    cdef void turn_field(self, double* H) noexcept:
        """Fill in the derivatives of the field's direction with respect to the state."""
        memset(H, 0, STATES * sizeof(double))
        H[0], H[1], H[2] = self._tilting[0], self._tilting[1], 1.0
        if self._field_noise > 0.0:
            H[_H], H[_FIELD_LATE] = 1.0, self._turning

    cdef void correct(self, const double* x) noexcept:
        """Apply an error of the state to the state."""
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
        for i in range(STATES):
            self._coasts[0].led[i] += x[i]
            self._coasts[1].led[i] += x[i]
        for i in range(2):
            self._velocity[i] += x[_V + i]
        for i in range(BIASES):
            self._bias[i] += x[_BG + i]
        self._declined += x[_H]
        self._late_s += x[_LATE]
        self._field_late_s += x[_FIELD_LATE]

    cdef void judge(self) noexcept:
        """Believe the fault that is by far the likeliest, or the end of one."""
        cdef double[HYPOTHESES] best
        cdef double[HYPOTHESES] end
        cdef int[HYPOTHESES] onset, ended
        cdef double likelihood, others, size, least, level, apart
        cdef Signature* signature
        cdef int h, k, which = 0, n = self.onsets()
        cdef bint turning = self._faulty[0] or self._faulty[1] or self._faulty[2]
        self._learned |= turning
        for h in range(HYPOTHESES):
            best[h], onset[h], end[h], ended[h] = 0.0, 0, 0.0, 0
        for k in range(n):
            signature = self.signature(k)
            for h in range(HYPOTHESES):
                if signature.energy[h] <= 0.0:
                    continue
                likelihood = 0.5 * signature.matched[h] * signature.matched[h] / (signature.energy[h] + _rarity(h))
                if likelihood > best[h]:
                    best[h], onset[h] = likelihood, k
                if h < BIASES and self._faulty[h]:
                    # The signature contains what the filter has estimated of it since.
                    size = self._before[h] - signature.bias[h]
                    likelihood = size * signature.matched[h] - 0.5 * size * size * signature.energy[h]
                    if likelihood > end[h]:
                        end[h], ended[h] = likelihood, k
        for h in range(BIASES):
            others = _ENDED
            for k in range(HYPOTHESES):
                if k != h:
                    others = fmax(others, _BETTER * best[k])
            # If another fault explains the innovations much better it is no end.
            if end[h] > others:
                self.end(self.signature(ended[h]), h)
                return
        others = 0.0
        for h in range(HYPOTHESES):
            if best[h] > best[which]:
                which = h
        for h in range(HYPOTHESES):
            if h != which:
                others = fmax(others, best[h] - (_COINCIDENCE if h >= _RAMP and which < _RAMP else 0.0))
        level = fmin(self._level, _JUMPED) if _JUMP <= which < _TURN else self._level
        # Jumps make no sensor responsible; magnetometers are judged elsewhere.
        self.score = 0.0 if _JUMP <= which < _RAMP else best[which]
        self._helpless = self._helpless + 1 if which != _TURN and best[which] > level else 0
        if self._learned and not turning and self.score > level:
            self.restart()
            self.renewed = True
            return
        if (
            best[which] > level
            and best[which] > others + _MARGIN
            and (which != 2 or self._field_noise > 0.0)
        ):
            signature = self.signature(onset[which])
            size = signature.matched[which] / signature.energy[which]
            least = _LEAST[which >= 3] if which < _JUMP else _LEAST_RAMP if which >= _RAMP else 0.0
            if (
                fabs(size) > least
                and (which >= _JUMP or fabs(size) < _MOST[which >= 3])
                and (which < _RAMP or signature.age_s > _RAMPS_S)
            ):
                if which >= _RAMP and turning:
                    # A tilt looks the same; it is left if the gyro's fault was not the believed one.
                    self.restart()
                    self.renewed = True
                    return
                apart = self.onset_spread(which, n, size, best[which]) if which < 5 else 0.0
                self.jump(signature, which, size, 1.0 / signature.energy[which])
                if which < 5:
                    self._unsure[which] = apart / self._P[_BG + which][_BG + which]
                return
        if self._helpless > _HELPLESS:
            self.restart()
        for h in range(BIASES):
            size = fabs(self._bias[h] - self._before[h])
            if self._faulty[h] and size < 0.5 * _LEAST[h >= 3]:
                self._faulty[h] = False
            elif self._faulty[h] and size > _MOST[h >= 3]:
                self.restart()
                return

    cdef double onset_spread(self, int which, int n, double size, double best) noexcept:
        """Return the variance of a fault's size that its unknown onset brings, by the likelihoods of n onsets.

        What it has turned or added to the speed until now is known, and divided by its age.
        """
        cdef double weights = 0.0, variance = 0.0, weight, other, matched, energy
        cdef int k
        for k in range(n):
            matched, energy = self.signature(k).matched[which], self.signature(k).energy[which]
            if energy > 0.0:
                other, weight = matched / energy, exp(0.5 * matched * matched / (energy + _rarity(which)) - best)
                weights, variance = weights + weight, variance + weight * (other - size) * (other - size)
        return variance / weights

    cdef void end(self, Signature* signature, int which) noexcept:
        """Remove a fault from the state."""
        cdef double size = self._before[which] - signature.bias[which]
        # The time of its end is known to half the time between two onsets.
        cdef double angle = 0.5 * _SPACING * self._step_s * size
        cdef int i
        self.jump(signature, which, size, 0.0)
        self._faulty[which] = False
        if which < 3:
            for i in range(3):
                self._P[i][i] += angle * angle

    cdef void jump(self, Signature* signature, int which, double size, double spread) noexcept:
        """Add a fault to the state, with its uncertainty, and begin a new set of onsets."""
        cdef double[STATES] x
        cdef double followed = spread * (1.0 - signature.state[_BG + which][which]) if which < BIASES else 0.0
        cdef int i, j
        if which < BIASES and not self._faulty[which]:
            for i in range(STATES):
                self._shared[i * BIASES + which] = self._P[i][_BG + which] - followed * signature.state[i][which]
        for i in range(STATES):
            x[i] = size * signature.state[i][which]
            for j in range(STATES):
                self._P[i][j] += spread * signature.state[i][which] * signature.state[j][which]
        if which < BIASES:
            if not self._faulty[which]:
                self._faulty[which] = True
                # What the filter has estimated of it since its onset belongs to the fault.
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
        # What a believed fault has made of the filter is no error of the GPS.
        memset(self._coasts, 0, sizeof(self._coasts))
        self._count = self._helpless = 0

    cdef void differ(self, const double* R, double* apart) noexcept:
        """Fill in the rotation from this attitude to R, north, east, down."""
        cdef int i, j, k
        for i in range(3):
            for j in range(3):
                apart[3 * i + j] = 0.0
                for k in range(3):
                    apart[3 * i + j] += R[3 * i + k] * self._R[3 * j + k]

    cdef double missed(self, int axis) noexcept:
        """Return the angle turned by a gyro's faults between their onset and now, or their end; once."""
        cdef double angle = self._missed[axis]
        self._missed[axis] = 0.0
        return angle

    cdef double fault(self, int which) noexcept:
        """Return the fault of a gyro (0, 1, 2) or an accelerometer (3, 4, 5): how much too large it reads."""
        return self._bias[which] - self._before[which] if self._begun and self._faulty[which] else 0.0

    cdef double spread(self, int which) noexcept:
        """Return the standard deviation of :meth:`fault`, or of the bias where there is none."""
        cdef double variance
        if not self._begun:
            return 0.0
        variance = self._P[_BG + which][_BG + which]
        if self._faulty[which]:
            # The filter took one onset for true, and is as much too sure of all that it has made of it since.
            variance += self._unsure[which] * variance + self._doubt[which]
            variance -= 2.0 * self._shared[(_BG + which) * BIASES + which]
        return sqrt(fmax(0.0, variance))

    cdef double pointing(self) noexcept:
        """Return the standard deviation of the direction of a healthy field, by the tilt and heading from the gyros."""
        cdef double[STATES] H
        cdef double variance = 0.0
        cdef int i, j
        if not self._begun:
            return 0.0
        self.turn_field(H)
        for i in range(STATES):
            for j in range(STATES):
                variance += H[i] * self._P[i][j] * H[j]
        return sqrt(variance)


cdef inline double _rarity(int h) noexcept:
    """Return one over the prior variance of a hypothesis' size; 0 for jumps, which may have any size."""
    return (_SIGMAS / _MOST[h >= 3]) ** 2 if h < _JUMP or h >= _RAMP else 0.0


cdef inline void _turned(const double* R, const double* turn, double* result) noexcept:
    """Fill in R exp(turn x), by the formula of Rodrigues."""
    cdef double x = turn[0], y = turn[1], z = turn[2], angle = sqrt(x * x + y * y + z * z), s, c
    cdef double[9] E
    # sin(a) / a and (1 - cos(a)) / a^2, by their series if a is too small to divide by.
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
