# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
# distutils: extra_compile_args = -ftree-vectorize -fvect-cost-model=dynamic
# Sums of different onsets are independent: two are added at a time, to the same bits.
"""Likelihood ratio of a fault that began lately against health, on whitened innovations, row after row.

:mod:`monitor.estimation.changes` explains the rule, in the same symbols.
"""

from libc.math cimport exp, fabs, rint, sqrt
from libc.stdint cimport int64_t, uint8_t

import numpy as np

# The best fault is named if it is this many nats ahead of every other: odds of e^7, one wrong name in a thousand
# (theory 5.1 (3)).
cdef double MARGIN = 7.0
# Nats taken from an actuator that delivers more than commanded, as actuators fail towards less: as much as gain_penalty
# = 25 of the bank, whose J is twice a log-likelihood.
cdef double AGAINST_GAIN = 12.5
# A hypothesis has to explain half of the energy since its onset beyond that of noise: twice the mean of |z|^2 / 2,
# which is 1 / 2 for an axis and a row. Measured on seven faults of three quadcopters: with a third instead of a half a
# name comes up to 0.4 s later, as the first rows of a loss fit the model's lag badly.
cdef double UNEXPLAINED_SHARE = 1.0
cdef double NOISE_OF_AXIS = 1.0
# Largest square with which a row counts in the level of the noise: a fault begins with larger ones, which must not hide
# it. Chosen: three deviations. For sensors, whose faults step once and not in every row, these are deviations of the
# present level: another stream of a sensor (less filtered, of another rate or rounding) may have any noise, and the
# level follows it.
cdef double LEVEL_CLIP = 9.0
# Largest size of a loss. Chosen: a quarter more than everything, as sizes from the first samples are rough.
cdef double LARGEST_LOSS = 1.25
# Two onsets are fitted together if the determinant of their information, as a share of the product of its diagonal, is
# at least this: below it the two are the same up to rounding.
cdef double SMALLEST_DETERMINANT = 1e-9
# Share of the nats by which another onset or course of the fault may explain less and still be right, by a factor of e.
# Measured: in the first three rows of a loss 5 % of what it explains is left, as its lag differs from the fitted one.
cdef double SIGNATURE_SHARE = 0.05
# Share of the nats, and of the sums common to all settled onsets, that is rounding: an onset with less information than
# that is skipped. Sums over ROOM rows are exact to 1e-14; chosen: a hundred times that.
cdef double NEARLY = 1e-12
# Rows between two moves of the sums of all onsets. Chosen: a move then costs a fraction of a row's work, and sums over
# so few rows lose no digit that counts.
cdef enum:
    ROOM = 64


cdef struct Fitted:
    # The fit of a hypothesis to the window at its best onset: nats, size, variance of the size, its growth a second,
    # age of the onset in rows.
    double nats, size, variance, growth
    Py_ssize_t age


cdef inline Py_ssize_t back(Py_ssize_t newest, Py_ssize_t age, Py_ssize_t length) noexcept:
    """Return the ring index of the element that is ``age`` rows older than the newest (age < length)."""
    return newest - age if newest >= age else newest - age + length


cdef void add(double* moment, double* information, const double* course, Py_ssize_t count, double pull, double weight,
              double along, double square) noexcept:
    """Add s'z and s's of one output to the sums of ``count`` onsets, less the parts added to settled onsets."""
    cdef Py_ssize_t age
    for age in range(count):
        moment[age] += pull * course[age] - along
        information[age] += weight * course[age] * course[age] - square


cdef void add_mixed(double* mixed, const double* course, Py_ssize_t count, double weight, double square) noexcept:
    """Add s's of an onset with the onset one row later to the sums of ``count`` onsets, as :func:`add` does."""
    cdef Py_ssize_t age
    mixed[0] -= square
    for age in range(1, count):
        mixed[age] += weight * course[age] * course[age - 1] - square


cdef void add_growing(double* moment, double* information, const double* since, Py_ssize_t count, const double* start,
                      const double* slope, const double* pull, const double* weight, Py_ssize_t outputs) noexcept:
    """Add s'z and s's of outputs whose response is a straight line over the age of the onset."""
    cdef Py_ssize_t i, age
    cdef double along = 0.0, along_slope = 0.0, square = 0.0, inner = 0.0, square_slope = 0.0
    for i in range(outputs):
        along += pull[i] * start[i]
        along_slope += pull[i] * slope[i]
        square += weight[i] * start[i] * start[i]
        inner += 2.0 * weight[i] * start[i] * slope[i]
        square_slope += weight[i] * slope[i] * slope[i]
    for age in range(count):
        moment[age] += along + since[age] * along_slope
        information[age] += square + since[age] * (inner + since[age] * square_slope)


cdef void compare(const double* moment, const double* information, const double* mixed, double settled_along,
                  double settled_square, Py_ssize_t first, Py_ssize_t end, Fitted* found) noexcept:
    """Replace the best fit where an onset, or with ``mixed`` a time between it and the next one, is better."""
    cdef Py_ssize_t age
    cdef double along, square, cross, determinant, explained, early, late, nats = found.nats
    cdef double least = NEARLY * settled_square
    # Those of the onset a row later.
    cdef double next_along = 0.0, next_square = 0.0
    for age in range(max(first - 1, 0), end):
        along, square = moment[age] + settled_along, information[age] + settled_square
        if square <= least:
            next_along = next_square = 0.0
            continue
        if age < first:
            next_along, next_square = along, square
            continue
        if along * along > 2.0 * nats * square:
            nats = 0.5 * along * along / square
            found[0] = Fitted(nats, along / square, 1.0 / square, 0.0, age)
        if mixed and age > 0:
            cross = mixed[age] + settled_square
            determinant = square * next_square - cross * cross
            early = along * next_square - cross * next_along
            late = square * next_along - cross * along
            explained = early * along + late * next_along
            if (
                explained > 2.0 * nats * determinant
                and determinant > SMALLEST_DETERMINANT * square * next_square
                and early * late > 0.0
            ):
                nats = 0.5 * explained / determinant
                found[0] = Fitted(
                    nats, (early + late) / determinant, (square + next_square - 2.0 * cross) / determinant, 0.0, age)
        next_along, next_square = along, square


cdef void move(double* total, Py_ssize_t count, Py_ssize_t start, double constant) noexcept:
    """Add a constant to ``count`` sums and move them so that they begin at ``start``."""
    cdef Py_ssize_t i
    for i in range(count - 1, -1, -1):
        total[start + i] = total[i] + constant


def _nonzero(matrix):
    """Return the indices of the nonzero columns, row after row, and where those of each row begin."""
    used = np.asarray(matrix) != 0.0
    return np.nonzero(used)[1].astype(np.intp), np.concatenate([[0], np.cumsum(used.sum(axis=1))]).astype(np.intp)


cdef class ChangeTest:
    """State of the test of one observer.

    An observer of n outputs that are its states, s inputs and p judged outputs; H = 3 m + S hypotheses: m actuators
    that lose effectiveness suddenly before their lag, m behind the lag (a broken propeller), m whose loss grows
    steadily, and S additions to the measurements, by sensors that jump or drift.

    Parameters
    ----------
    dynamics : ndarray
        [A B_v c], the judged rows of the one-step prediction from y, the lagged v and 1 (p, n + s + 1). Behind what
        single inputs do, v has what all together add to some states.
    curves : ndarray
        Coefficients of the input curves (s - e, degree).
    bends : ndarray
        Coefficients over v, by input, of what all add to e states (e, s - e, degree).
    taps : ndarray
        Lag of the inputs (L,).
    judged : ndarray
        Index of each judged output (p,).
    actuators : ndarray
        Index of the input of each actuator fault (m,).
    additions, grown : ndarray
        The response of the whitened innovations to each addition, by the rows since its onset (D, S, p), and the size
        that it then has (D, S); both are constant from row D - 1 on.
    owner : ndarray
        The fault that each addition stands for (S,); those of actuators are the first m.
    sudden : ndarray of bool
        Which additions are sudden: they may begin between two rows (S,).
    faults : ndarray
        Index among the observer's faults of those that may be named, the first ones; others only prevent a name.
    driven : bool
        Whether r is the change of each output in a row that the inputs cause, instead of the output itself.
    largest, rate_hz : float
        Largest possible input, and rows per second.
    whitening : ndarray
        Phi_1 ... Phi_P (P, p, p).
    variance : ndarray
        c_0, c_1, c_2 and c_3 of each judged output (p, 4).
    hold, window : int
        Rows over which the maximum of rates and of changes of commands is held, and number of onsets that are tried.
    clip : float
        Largest |z| that counts.
    level_rows : float
        Time constant, in rows, of the level of the noise.
    """

    cdef double[:, ::1] dynamics, curves, variance
    cdef double[:, :, ::1] bends
    cdef double[::1] taps
    cdef Py_ssize_t[::1] judged, actuators, owner, faults
    cdef double[:, :, ::1] whitening, impulse, direct
    cdef double[:, ::1] grown
    cdef Py_ssize_t n, s, p, m, S, H, L, P, D, depth, length, hold, window
    cdef double clip, follow, limit, rate_hz, step_ns
    cdef bint driven
    # Indices of nonzero columns of matrices, row after row, and where those of each row begin.
    cdef Py_ssize_t[::1] from_y, of_y, from_v, of_v, from_nu, of_nu, from_h, of_h
    # Response of e to each hypothesis by the age of its onset; that of losses is for the latest row (H, p, D). It is
    # the same at all ages from the last of ``settling`` on.
    cdef double[:, :, ::1] course
    cdef Py_ssize_t[::1] settling
    # Kept from row to row in rings, the newest at ``row``: v, v after the lag, innovations, |y| and |B dv|.
    cdef double[:, ::1] v, acting, innovation, excited
    cdef double[::1] last_y, most_excited, whitened, sigma, level
    # The noise alone: half of the mean square of the difference between successive e, and the e before. A fault that
    # lasts or grows does not raise it (von Neumann's mean square successive difference, 1941).
    cdef double[::1] noise, last_e
    # z / sigma and 1 / sigma^2; time since an onset; value and slope of responses that grow evenly.
    cdef double[::1] pull, weight, since, start, slope
    cdef uint8_t[::1] is_sudden
    # Sums of the onsets that are tried, by hypothesis: s'z, s's, s's with the onset a row later; and |z|^2 / 2. An
    # onset ``age`` rows older than the newest is at ``newest + age``; the room for new ones is before it.
    cdef double[:, ::1] moment, information, mixed
    cdef double[::1] energy
    # Number of known outputs, summed up as the energy is.
    cdef double[::1] axes
    # Once its response has settled every onset gets the same addend: these sums are to be added to those of every
    # onset.
    cdef double[::1] settled_moment, settled_information
    cdef double settled_energy, settled_axes
    # Upper bound of the nats of each hypothesis; the best one of the row before and the best of another fault.
    cdef double[::1] bound
    cdef Py_ssize_t[::1] best_age
    cdef Py_ssize_t leading[2]
    # The fault that would explain the latest change as well, if actuators failed either way alike; -1 for none.
    cdef Py_ssize_t instead
    cdef Py_ssize_t begun, newest, commands
    # Whether each output was measured in the row before, and for how many rows its innovation has been known.
    cdef uint8_t[::1] has_y
    cdef Py_ssize_t[::1] known
    # For how many rows all outputs of each hypothesis have been known: its onsets are not older than that.
    cdef Py_ssize_t[::1] told
    cdef int64_t row

    def __init__(self, dynamics, curves, bends, taps, judged, actuators, additions, grown, owner, sudden, faults,
                 driven, largest, rate_hz, whitening, variance, hold, window, clip, level_rows):
        self.dynamics, self.curves = np.ascontiguousarray(dynamics, float), np.ascontiguousarray(curves, float)
        self.taps, self.variance = np.ascontiguousarray(taps, float), np.ascontiguousarray(variance, float)
        self.judged, self.actuators = np.asarray(judged, np.intp), np.asarray(actuators, np.intp)
        self.whitening = np.ascontiguousarray(whitening, float)
        self.p, self.m, self.L, self.P = len(judged), len(actuators), len(taps), len(whitening)
        self.bends = np.ascontiguousarray(bends, float)
        self.s = len(curves) + len(bends)
        self.n = dynamics.shape[1] - self.s - 1
        self.grown = np.ascontiguousarray(grown, float)
        self.D, self.S = self.grown.shape[0], self.grown.shape[1]
        self.owner = np.concatenate([np.arange(self.m)] * 3 + [np.asarray(owner)]).astype(np.intp)
        self.faults = np.asarray(faults, np.intp)
        self.driven, self.limit, self.rate_hz, self.step_ns = driven, largest, rate_hz, 1e9 / rate_hz
        self.H, self.depth = 3 * self.m + self.S, self.P + self.L
        self.hold, self.window, self.clip = max(1, hold), max(2, window), clip
        # The ring of v is as long as the deepest lag, that of innovations as the whitening.
        self.length = max(self.depth + 2, self.P + 1)
        self.v, self.acting = np.zeros((2, self.length, self.s))
        self.innovation = np.zeros((self.length, self.p))
        self.excited, self.most_excited = np.zeros((self.hold, 2 * self.p)), np.zeros(2 * self.p)
        self.last_y = np.zeros(self.n)
        self.whitened, self.sigma = np.zeros(self.p), np.ones(self.p)
        self.level, self.follow = np.ones(self.p), 1.0 / level_rows
        self.noise, self.last_e = np.ones(self.p), np.zeros(self.p)
        self.pull, self.weight, self.start, self.slope = np.zeros((4, self.p))
        self.is_sudden = np.repeat([1, 0], [2 * self.m, self.m]).astype(np.uint8)
        self.is_sudden = np.concatenate([self.is_sudden, np.asarray(sudden)]).astype(np.uint8)
        self.moment, self.information, self.mixed = np.zeros((3, self.H, self.window + ROOM))
        self.energy, self.axes = np.zeros((2, self.window + ROOM))
        self.since = np.arange(self.window + self.D) / self.rate_hz
        self.has_y, self.known = np.zeros(self.p, np.uint8), np.zeros(self.p, np.intp)
        self.settled_moment, self.settled_information, self.bound = np.zeros((3, self.H))
        self.leading[0] = self.leading[1] = 0
        self.best_age = np.zeros(self.H, np.intp)
        self.of_y, self.from_y = _nonzero(dynamics[:, : self.n])
        self.of_v, self.from_v = _nonzero(dynamics[:, self.n : self.n + self.s])
        self.of_nu, self.from_nu = _nonzero(np.abs(whitening).sum(axis=0))
        lost = np.ones((self.D, 3 * self.m, self.p))
        self.course = np.ascontiguousarray(np.concatenate([lost, additions], axis=1).transpose(1, 2, 0))
        self.of_h, self.from_h = _nonzero(np.abs(self.course).max(axis=2))
        self.settling = np.repeat([self.depth, self.P + 1, self.D], self.m).astype(np.intp)
        changes = np.abs(additions - additions[self.D - 1 :]) > NEARLY * np.abs(additions).max(axis=0)
        latest = np.max(np.arange(1, self.D + 1)[:, None] * changes.any(axis=2), axis=0)
        self.settling = np.concatenate([self.settling, latest + 1])
        self.told = np.zeros(self.H, np.intp)
        self.impulse = self._impulse(np.asarray(dynamics), np.asarray(taps), np.asarray(whitening))
        self.direct = self._impulse(np.asarray(dynamics), np.ones(1), np.asarray(whitening))
        self.row = 0
        self.clear()

    def _impulse(self, dynamics, taps, whitening):
        """Return F (P + taps, m, p): the response of the whitened innovation, n rows later, to a total loss of v_j."""
        lost = np.zeros((self.P + len(taps), self.m, self.p))
        columns = -dynamics[:, self.n + np.asarray(self.actuators)].T
        for lag, tap in enumerate(taps):
            lost[lag] += tap * columns
            for i, phi in enumerate(whitening):
                lost[lag + i + 1] -= tap * columns @ phi.T
        return np.ascontiguousarray(lost)

    cdef void clear(self) noexcept:
        """Forget the rows before a restart."""
        self.has_y[:] = 0
        self.level[:] = 1.0
        self.noise[:] = 1.0
        self.known[:] = 0
        self.commands = 0
        self.drop_onsets()

    cdef void drop_onsets(self) noexcept:
        self.begun, self.newest = 0, self.window + ROOM
        self.settled_moment[:] = 0.0
        self.settled_information[:] = 0.0
        self.bound[:] = 0.0
        self.told[:] = 0
        self.settled_energy = self.settled_axes = 0.0

    def innovations(self, const double[:, :] u, const double[:, :] y, const uint8_t[:, :] usable,
                    const uint8_t[:] restart):
        """Return the data for fitting the noise: innovations (N, p), r and d (N, 2 p), and where they are known
        (N,)."""
        cdef Py_ssize_t k, i, count = u.shape[0]
        results = np.zeros((count, self.p)), np.zeros((count, 2 * self.p)), np.zeros(count, np.bool_)
        cdef double[:, ::1] found = results[0], excited = results[1]
        cdef uint8_t[::1] known = results[2]
        for k in range(count):
            self.take(u, y, k, usable[k], restart[k], False)
            known[k] = True
            for i in range(self.p):
                known[k] &= self.known[i] > 0
                found[k, i] = self.innovation[self.row % self.length, i]
                excited[k, i], excited[k, self.p + i] = self.most_excited[i], self.most_excited[self.p + i]
        return results

    def run(self, const double[:, :] u, const double[:, :] y, const uint8_t[:, :] usable, const uint8_t[:] restart,
            const int64_t[:] times_ns, const uint8_t[:] armed, const double[:, :] believed, const double[:] asked=None,
            bint ahead=False):
        """Return the named fault (N,), -1 for none, with nats, size, its growth a second, sd and time of onset (N,).

        The size of an actuator's fault is the share of its effect, negative for a loss; that of a sensor is in its
        units. With them the variance of each output's noise relative to that of healthy flights (N, p).

        Parameters
        ----------
        u, y : float64 (N, s), (N, n)
            Samples.
        times_ns : int64 (N,)
            Vehicle times.
        usable : bool (N, p)
            Which judged outputs are measured and complete; the others are no evidence for or against any fault.
        restart, armed : bool (N,)
            Samples at which the observer starts afresh, that are evidence.
        believed : float64 (N, a)
            Signed estimate of each of the observer's faults.
        asked : float64 (N,), optional
            Fewest nats with which a row names a fault; 0 where it is left out.
        ahead : bool
            Whether a row's y is what comes after its u, not with it.
        """
        cdef Py_ssize_t k, i, owner, count = u.shape[0]
        cdef double sign = -1.0 if self.m else 1.0
        cdef bint known
        results = (np.empty(count, np.intp), *np.zeros((4, count)), np.empty(count, np.int64),
                   np.empty((count, self.p)), np.empty(count, np.intp))
        cdef Py_ssize_t[::1] instead = results[7]
        cdef double[:, ::1] noise = results[6]
        cdef Py_ssize_t[::1] named = results[0]
        cdef double[::1] nats = results[1], size = results[2], growth = results[3], sd = results[4]
        cdef int64_t[::1] onset_ns = results[5]
        cdef Fitted found
        for k in range(count):
            self.take(u, y, k, usable[k], restart[k], ahead)
            named[k], onset_ns[k], instead[k] = -1, times_ns[k], -1
            known = False
            for i in range(self.p):
                known |= self.known[i] > self.P
            known &= self.commands > self.depth
            if known and (armed[k] or self.driven):
                # The noise of a sensor's stream is known before its rows are evidence; that of an actuator's belongs to
                # flight.
                self.whiten()
            for i in range(self.p):
                noise[k, i] = self.noise[i]
            if not (known and armed[k]):
                self.drop_onsets()
                continue
            self.accumulate()
            owner = self.judge(believed[k], 0.0 if asked is None else asked[k], &found)
            if owner >= 0:
                named[k], nats[k], sd[k] = self.faults[owner], found.nats, sqrt(found.variance)
                size[k], growth[k] = sign * found.size, sign * found.growth
                onset_ns[k] -= <int64_t>rint(found.age * self.step_ns)
                instead[k] = self.instead
                if self.driven and found.age >= self.window - 2 and 2.0 * found.nats >= self.clip * self.clip:
                    # The onset leaves the window: what the fault left in the rows after it would pass for another one.
                    # An alarm needs some clip^2 nats, so a fault of half as many leaves nothing that could raise one.
                    self.drop_onsets()
        return results

    cdef void take(self, const double[:, :] u, const double[:, :] y, Py_ssize_t k, const uint8_t[:] usable,
                   bint restart, bint ahead) noexcept:
        """Process one row: v, the innovation nu = y - (A y- + B v- + c), and the excitation of the model's errors."""
        cdef Py_ssize_t i, j, d, row, before, inputs = self.curves.shape[0]
        cdef double value, power, moved, command
        if restart:
            self.clear()
        self.row += 1
        row = self.row % self.length
        before = back(row, 1, self.length)
        for j in range(inputs, self.s):
            self.v[row, j] = 0.0
        for j in range(inputs):
            value, power, command = 0.0, 1.0, u[k, j]
            if not fabs(command) < self.limit:
                # An absurd command is not known; nor is v, for as long as lag and whitening reach back to it.
                self.commands, command = -1, 0.0
            for d in range(self.curves.shape[1]):
                power *= command
                value += self.curves[j, d] * power
            self.v[row, j] = value
            for i in range(self.bends.shape[0]):
                power = 1.0
                for d in range(self.bends.shape[2]):
                    power *= value
                    self.v[row, inputs + i] += self.bends[i, j, d] * power
        for j in range(self.s):
            # v after the lag, which acts on this row.
            self.acting[row, j] = 0.0
            for d in range(min(self.L, self.commands + ahead)):
                self.acting[row, j] += self.taps[d] * self.v[back(row, d + 1 - ahead, self.length), j]
        for i in range(self.p):
            value = y[k, self.judged[i]]
            if not self.has_y[i] or not usable[i]:
                self.innovation[row, i] = 0.0
            else:
                moved = self.dynamics[i, self.n + self.s]
                for d in range(self.from_y[i], self.from_y[i + 1]):
                    moved += self.dynamics[i, self.of_y[d]] * self.last_y[self.of_y[d]]
                for d in range(self.from_v[i], self.from_v[i + 1]):
                    moved += self.dynamics[i, self.n + self.of_v[d]] * self.acting[row, self.of_v[d]]
                self.innovation[row, i] = value - moved
            moved = 0.0
            if self.driven:
                value = 0.0
            for d in range(self.from_v[i], self.from_v[i + 1]):
                j = self.of_v[d]
                if self.commands:
                    moved += self.dynamics[i, self.n + j] * (self.v[row, j] - self.v[before, j])
                if self.driven:
                    value += self.dynamics[i, self.n + j] * self.v[row, j]
            self.excited[self.row % self.hold, i] = fabs(value)
            self.excited[self.row % self.hold, self.p + i] = fabs(moved)
        for i in range(self.p):
            self.known[i] = self.known[i] + 1 if self.has_y[i] and usable[i] and self.commands + ahead >= self.L else 0
            self.has_y[i] = usable[i]
        self.commands += 1
        for j in range(self.n):
            self.last_y[j] = y[k, j]
        self.hold_excitation()

    cdef void hold_excitation(self) noexcept:
        """Find the largest excitation of the last ``hold`` rows, or of those since the restart."""
        cdef Py_ssize_t age, i, row, newest = self.row % self.hold
        self.most_excited[:] = 0.0
        for age in range(min(self.hold, self.commands)):
            row = back(newest, age, self.hold)
            for i in range(2 * self.p):
                self.most_excited[i] = max(self.most_excited[i], self.excited[row, i])

    cdef void whiten(self) noexcept:
        """z = (nu - sum_i Phi_i nu(k - i)) / sigma, at most ``clip``.

        sigma^2 = (c_0 + c_1 r^2 + c_2 d^2 + c_3 w^2) lambda.
        """
        cdef Py_ssize_t i, j, d, lag, newest = self.row % self.length
        cdef double e, rate, moved, square, level, length = 0.0, weight, apart, turning = 0.0
        for i in range(self.p):
            turning += self.most_excited[i] * self.most_excited[i]
        for i in range(self.p):
            self.whitened[i] = 0.0
            if self.known[i] <= self.P:
                continue
            e = self.innovation[newest, i]
            for lag in range(self.P):
                for d in range(self.from_nu[i], self.from_nu[i + 1]):
                    j = self.of_nu[d]
                    e -= self.whitening[lag, i, j] * self.innovation[back(newest, lag + 1, self.length), j]
            rate, moved = self.most_excited[i], self.most_excited[self.p + i]
            self.sigma[i] = sqrt(
                self.variance[i, 0] + self.variance[i, 1] * rate * rate + self.variance[i, 2] * moved * moved
                + self.variance[i, 3] * turning * turning)
            square = e * e / (self.sigma[i] * self.sigma[i])
            if self.driven and self.known[i] > self.P + 1:
                apart = 0.5 * (e - self.last_e[i]) * (e - self.last_e[i]) / (self.sigma[i] * self.sigma[i])
                self.noise[i] += self.follow * (min(apart, LEVEL_CLIP * max(1.0, self.noise[i])) - self.noise[i])
            self.last_e[i] = e
            # Gusts that the fitted flights did not have; never below the level of those flights.
            level = max(1.0, self.level[i])
            self.sigma[i] *= sqrt(level)
            self.level[i] += self.follow * (min(square, LEVEL_CLIP * (level if self.driven else 1.0)) - self.level[i])
            self.whitened[i] = e / self.sigma[i]
            length += self.whitened[i] * self.whitened[i]
        # A row too large for noise counts as one with larger noise, for and against every hypothesis alike.
        weight = min(1.0, self.clip / sqrt(length)) if length > 0.0 else 1.0
        for i in range(self.p):
            self.pull[i] = self.weight[i] = 0.0
            if self.known[i] <= self.P:
                continue
            self.whitened[i] *= weight
            self.pull[i] = self.whitened[i] * weight / self.sigma[i]
            self.weight[i] = weight * weight / (self.sigma[i] * self.sigma[i])

    cdef void accumulate(self) noexcept:
        """Begin an onset at this row, and add s'z, s's and |z|^2 / 2 of the row to every onset in the window."""
        cdef Py_ssize_t i, h
        cdef double half = 0.0
        if self.newest == 0:
            self.make_room()
        self.newest -= 1
        self.begun = min(self.begun + 1, self.window)
        for h in range(self.H):
            self.moment[h, self.newest] = -self.settled_moment[h]
            self.information[h, self.newest] = self.mixed[h, self.newest] = -self.settled_information[h]
        self.energy[self.newest], self.axes[self.newest] = -self.settled_energy, -self.settled_axes
        for i in range(self.p):
            half += 0.5 * self.whitened[i] * self.whitened[i]
            self.settled_axes += self.known[i] > self.P
        self.settled_energy += half
        for h in range(self.H):
            # No fit explains more of all rows than the best one of the rows before and all of this row.
            self.bound[h] += half
        self.follow_losses()
        for h in range(self.H):
            self.add_row(h)
            self.told[h] += 1
            for i in range(self.from_h[h], self.from_h[h + 1]):
                if self.known[self.of_h[i]] <= self.P:
                    # Only rows after its onset would be known to a fault, and a little noise would fit any size.
                    self.told[h], self.bound[h] = 0, 0.0

    cdef void make_room(self) noexcept:
        """Move the sums of onsets to the end, without that of the onset that leaves the window."""
        cdef Py_ssize_t h, kept = min(self.begun, self.window - 1), start = self.window + ROOM - kept
        for h in range(self.H):
            move(&self.moment[h, 0], kept, start, self.settled_moment[h])
            move(&self.information[h, 0], kept, start, self.settled_information[h])
            move(&self.mixed[h, 0], kept, start, self.settled_information[h])
        move(&self.energy[0], kept, start, self.settled_energy)
        move(&self.axes[0], kept, start, self.settled_axes)
        self.newest, self.settled_energy, self.settled_axes = start, 0.0, 0.0
        self.settled_moment[:] = 0.0
        self.settled_information[:] = 0.0

    cdef void follow_losses(self) noexcept:
        """Find the response of this row to losses of actuators, by their onset.

        For onsets further back than lag and whitening reach, the response is constant or grows evenly.
        """
        cdef Py_ssize_t age, i, j, source, newest = self.row % self.length
        cdef double value, partial, behind, delayed
        for j in range(self.m):
            source = self.actuators[j]
            for i in range(self.p):
                partial = behind = delayed = 0.0
                for age in range(self.depth):
                    # Response to a loss that began ``age`` rows ago: v from before the loss acts in full.
                    value = self.impulse[age, j, i] * self.v[back(newest, age + 1, self.length), source]
                    partial += value
                    delayed += self.since[age] * value
                    self.course[j, i, age] = partial
                    self.course[2 * self.m + j, i, age] = self.since[age] * partial - delayed
                for age in range(self.depth, self.D):
                    self.course[2 * self.m + j, i, age] = self.since[age] * partial - delayed
                for age in range(self.P + 1):
                    behind += self.direct[age, j, i] * self.acting[back(newest, age, self.length), source]
                    self.course[self.m + j, i, age] = behind

    cdef void add_row(self, Py_ssize_t h) noexcept:
        """Add s'z and s's of a hypothesis to the onsets."""
        cdef Py_ssize_t d, i, last = self.settling[h] - 1, count = min(self.begun, self.settling[h])
        cdef bint grows = 2 * self.m <= h < 3 * self.m
        cdef double along = 0.0, square = 0.0
        cdef double* moment = &self.moment[h, self.newest]
        cdef double* information = &self.information[h, self.newest]
        if last < self.window - 1 and not grows:
            for d in range(self.from_h[h], self.from_h[h + 1]):
                i = self.of_h[d]
                along += self.pull[i] * self.course[h, i, last]
                square += self.weight[i] * self.course[h, i, last] * self.course[h, i, last]
        self.settled_moment[h] += along
        self.settled_information[h] += square
        for d in range(self.from_h[h], self.from_h[h + 1]):
            i = self.of_h[d]
            add(moment, information, &self.course[h, i, 0], count, self.pull[i], self.weight[i], along, square)
            if self.is_sudden[h]:
                add_mixed(&self.mixed[h, self.newest], &self.course[h, i, 0], count, self.weight[i], square)
            along = square = 0.0
        if grows and self.begun > count:
            for i in range(self.p):
                self.start[i] = self.course[h, i, last]
                self.slope[i] = self.course[h - 2 * self.m, i, self.depth - 1]
            add_growing(moment + count, information + count, &self.since[1], self.begun - count, &self.start[0],
                        &self.slope[0], &self.pull[0], &self.weight[0], self.p)

    cdef Fitted fit(self, Py_ssize_t h) noexcept:
        """Return the best fit of a hypothesis to the window: g = (s'z)^2 / (2 s's), the largest of all onsets.

        A sudden fault begins between two rows: its response is (1 - f) times that of the earlier onset plus f times
        that of the later one. Both shares are fitted together, so the variance of the size contains that of the onset.
        """
        cdef Fitted best = Fitted(0.0, 0.0, 0.0, 0.0, 0)
        cdef const double* moment = &self.moment[h, self.newest]
        cdef const double* information = &self.information[h, self.newest]
        cdef const double* mixed = &self.mixed[h, self.newest] if self.is_sudden[h] else NULL
        cdef double along = self.settled_moment[h], square = self.settled_information[h]
        # The best onset of the last fit is likely to be the best again: few others come near.
        cdef Py_ssize_t age = self.best_age[h] + 1, count = min(self.begun, self.told[h])
        if age < count:
            compare(moment, information, mixed, along, square, age, age + 1, &best)
            best.nats *= 1.0 - NEARLY
        compare(moment, information, mixed, along, square, 0, count, &best)
        self.bound[h], self.best_age[h] = best.nats, best.age
        return best

    cdef void weigh(self, Py_ssize_t owner, Fitted* chosen) noexcept:
        """Replace size and variance by those over all onsets and hypotheses of a fault that explain nearly as much.

        Where a signature is off by some per cent, as in the first rows of a lag, a right onset may explain less than
        the best one: each counts with e^(-difference of nats / width).
        """
        cdef Py_ssize_t h, age
        cdef double narrow = 1.0 / max(1.0, SIGNATURE_SHARE * chosen.nats), most = chosen.nats
        cdef double along, square, next_along, next_square, cross, determinant, early, late, least
        cdef double size, nats, variance, divisor, weight, grown, total = 0.0, first = 0.0, second = 0.0
        cdef double growing = 0.0, growth = 0.0
        for h in range(self.H):
            if self.owner[h] != owner:
                continue
            next_along = next_square = 0.0
            least = NEARLY * self.settled_information[h]
            for age in range(min(self.begun, self.told[h])):
                along = self.moment[h, self.newest + age] + self.settled_moment[h]
                square = self.information[h, self.newest + age] + self.settled_information[h]
                if square <= least:
                    next_along = next_square = 0.0
                    continue
                # Size, twice the nats and variance times what they are divided by.
                size, nats, variance, divisor = along, along * along, 1.0, square
                if self.is_sudden[h] and age > 0:
                    cross = self.mixed[h, self.newest + age] + self.settled_information[h]
                    determinant = square * next_square - cross * cross
                    early = along * next_square - cross * next_along
                    late = square * next_along - cross * along
                    if determinant > SMALLEST_DETERMINANT * square * next_square and early * late > 0.0:
                        size, nats, divisor = early + late, early * along + late * next_along, determinant
                        variance = square + next_square - 2.0 * cross
                next_along, next_square = along, square
                divisor, grown = 1.0 / divisor, self.grows_to(h, age)
                size *= divisor * grown
                if size * chosen.size > 0.0 and (h >= 3 * self.m or fabs(size) <= LARGEST_LOSS):
                    weight = exp((0.5 * nats * divisor - most) * narrow)
                    total, first = total + weight, first + weight * size
                    if 2 * self.m <= h < 3 * self.m:
                        growing, growth = growing + weight, growth + weight * along * divisor
                    second += weight * (size * size + variance * divisor * grown * grown)
        if total > 0.0:
            chosen.size = first / total
            chosen.variance = max(chosen.variance, second / total - chosen.size * chosen.size)
        if growing > 0.0:
            chosen.growth = growth / growing

    cdef double grows_to(self, Py_ssize_t h, Py_ssize_t age) noexcept:
        """Return the fault's size at an age of its onset, per unit of the fitted size."""
        if h >= 3 * self.m:
            return self.grown[min(age, self.D - 1), h - 3 * self.m]
        return age / self.rate_hz if h >= 2 * self.m else 1.0

    cdef double prior(self, Py_ssize_t h, const Fitted* found, const double[:] believed) noexcept:
        """Return the nats taken from a hypothesis: those of an actuator that delivers more, unless it is the end of a
        loss."""
        if h < 3 * self.m and found.size < 0.0 and not believed[self.faults[self.owner[h]]] < 0.0:
            return AGAINST_GAIN
        return 0.0

    cdef bint may_reach(self, double asked) noexcept:
        """Return whether any hypothesis has so many nats; for most rows the upper bounds answer that."""
        cdef Py_ssize_t h
        for h in range(self.H):
            if self.bound[h] >= asked:
                if asked > 0.0:
                    self.fit(h)
                if self.bound[h] >= asked:
                    return True
        return False

    cdef bint grows(self, Py_ssize_t actuator, const Fitted* found, double nats, const double[:] believed) noexcept:
        """Return whether a loss grows: then no sudden loss explains the window nearly as well."""
        cdef Py_ssize_t h
        cdef Fitted sudden
        # An onset before the window would have a smaller growth than the fit from the window's begin.
        if not self.depth <= found.age < self.window - 1 or nats < MARGIN:
            return False
        for h in range(actuator, 2 * self.m, self.m):
            # No growth where a sudden loss, through a lag a little off the model's, explains as much.
            if self.bound[h] > nats - MARGIN:
                sudden = self.fit(h)
                if nats < sudden.nats - self.prior(h, &sudden, believed) + MARGIN:
                    return False
        return True

    cdef Py_ssize_t judge(self, const double[:] believed, double asked, Fitted* chosen) noexcept:
        """Return the fault whose change explains the window best, by MARGIN and with the nats asked, else -1."""
        cdef Py_ssize_t k, h, owner, best = -1, runner = -1
        cdef double nats, first = -1e300, second = -1e300, unexplained, axes, grown, nats_of_best
        cdef Fitted found, every
        if not self.may_reach(asked):
            return -1
        for k in range(-2, self.H):
            # First the two best hypotheses of the row before: with their nats most others need not be fitted.
            h = self.leading[k + 2] if k < 0 else k
            owner = self.owner[h]
            if self.bound[h] < (first if best >= 0 and owner == self.owner[best] else second):
                continue
            found = self.fit(h)
            nats = found.nats - self.prior(h, &found, believed)
            if 2 * self.m <= h < 3 * self.m and not self.grows(owner, &found, nats, believed):
                continue
            if nats > first or (nats == first and h < best):
                if best < 0 or owner != self.owner[best]:
                    second, runner = first, best
                first, best, chosen[0] = nats, h, found
            elif nats > second and owner != self.owner[best]:
                second, runner = nats, h
        if best >= 0 and runner >= 0:
            self.leading[0], self.leading[1] = best, runner
        if best < 0 or self.owner[best] >= self.faults.shape[0] or first - second < MARGIN or chosen.nats < asked:
            return -1
        nats_of_best = chosen.nats
        unexplained = self.energy[self.newest + chosen.age] + self.settled_energy - chosen.nats
        axes = self.axes[self.newest + chosen.age] + self.settled_axes
        if unexplained > UNEXPLAINED_SHARE * chosen.nats + NOISE_OF_AXIS * axes:
            return -1
        # Where the fit leaves more than noise, the signature is not well known, and the size's error is as much larger.
        chosen.variance *= max(1.0, 2.0 * unexplained / axes)
        if 2 * self.m <= best < 3 * self.m:
            chosen.growth = chosen.size
        grown = self.grows_to(best, chosen.age)
        chosen.size *= grown
        chosen.variance *= grown * grown
        every = chosen[0]
        self.weigh(self.owner[best], &every)
        if chosen.growth == 0.0:
            chosen[0], chosen.growth = every, 0.0
        else:
            chosen.growth = every.growth
            # The size of a growing fault is that of its own onset; its error includes the distance to the other onsets.
            chosen.variance = every.variance + (every.size - chosen.size) * (every.size - chosen.size)
        if best < 3 * self.m and chosen.size > LARGEST_LOSS:
            return -1
        self.instead = self.find_instead(self.owner[best], nats_of_best - MARGIN)
        return self.owner[best]

    cdef Py_ssize_t find_instead(self, Py_ssize_t named, double least) noexcept:
        """Return the other actuator whose sudden change has so many nats without those taken from it, -1 for none."""
        cdef Py_ssize_t h, other = -1
        cdef Fitted found
        for h in range(2 * self.m):
            if self.owner[h] != named and self.bound[h] >= least:
                found = self.fit(h)
                if found.nats >= least:
                    least, other = found.nats, self.faults[self.owner[h]]
        return other
