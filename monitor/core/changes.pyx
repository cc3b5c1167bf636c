# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Likelihood ratio of a fault that began lately against health, on whitened innovations, row after row.

The rule itself; :mod:`monitor.estimation.changes` tells what it is for, in the same symbols.
"""

from libc.math cimport fabs, rint, sqrt
from libc.stdint cimport int64_t, uint8_t

import numpy as np

# Nats by which a name has to be ahead of every other: odds of e^7, one wrong name in a thousand (theory 5.1 (3)).
cdef double MARGIN = 7.0
# Nats against an actuator that delivers more than commanded: those fail towards less. As much as gain_penalty = 25 of
# the bank takes off J, which is twice a log-likelihood.
cdef double AGAINST_GAIN = 12.5
# A hypothesis has to explain half of what there is to explain since its onset, beyond noise: twice the mean of
# |z|^2 / 2, which is 1 / 2 for an axis and a row. Measured on seven faults of three quadcopters: with a third instead
# of a half a name comes up to 0.4 s later, as the first rows of a loss fit the model's lag badly.
cdef double UNEXPLAINED_SHARE = 1.0
cdef double NOISE_OF_AXIS = 1.0
# Largest square with which a row counts in the noise's own level: a fault begins with larger ones, and must not hide
# itself. Chosen: three deviations.
cdef double LEVEL_CLIP = 9.0
# Losses that can be one. Chosen: a quarter more than everything, for sizes of the first samples are rough.
cdef double LARGEST_LOSS = 1.25
# Smallest determinant of two onsets' information, as a share of the product of its diagonal, with which both are fitted
# together: below it they are one and the difference is rounding.
cdef double SMALLEST_DETERMINANT = 1e-9


cdef struct Fitted:
    # how well a hypothesis explains the window at its best onset: nats, size with its variance and growth a second, and
    # the onset's age
    double nats, size, variance, growth
    Py_ssize_t age


cdef inline Py_ssize_t back(Py_ssize_t newest, Py_ssize_t age, Py_ssize_t length) noexcept:
    """Return the index in a ring of what is so many rows older than the newest, fewer than it has."""
    return newest - age if newest >= age else newest - age + length


cdef class ChangeTest:
    """State of the test of one observer.

    An observer of n outputs that are its states, s inputs and p outputs that are judged; H = 3 m + S hypotheses:
    m actuators that lose effectiveness at once before their lag, as many behind it (a broken propeller), as many whose
    loss grows by so much a second, and S additions to what is measured, of sensors that jump or drift.

    Parameters
    ----------
    dynamics : ndarray
        [A B_v c], the judged rows of the one-step prediction from y, the lagged v and 1 (p, n + s + 1).
    curves : ndarray
        Coefficients of the input curves (s, degree).
    taps : ndarray
        Lag of the inputs (L,).
    judged : ndarray
        Index of each judged output (p,).
    actuators : ndarray
        Index of the input of each actuator fault (m,).
    additions, grown : ndarray
        What each addition, so many rows after its onset, makes of the whitened innovations (D, S, p), and the size that
        it then has (D, S); from row D - 1 on they stay as they are.
    owner : ndarray
        The fault that each addition stands for (S,); those of actuators are the first m.
    sudden : ndarray of bool
        Which additions are there at once: they may begin between two rows (S,).
    faults : ndarray
        Index among the observer's faults of those that are named, the first of all; others only keep a name from being
        given.
    driven : bool
        Whether r is what the inputs make of each output in a row, instead of the output itself.
    largest, rate_hz : float
        Largest input that can be one, and rows in a second.
    whitening : ndarray
        Phi_1 ... Phi_P (P, p, p).
    variance : ndarray
        c_0, c_1 and c_2 of each judged output (p, 3).
    hold, window : int
        Rows over which rates and changes of commands are held, and of the onsets that are tried.
    clip : float
        Largest |z| that counts.
    level_rows : float
        Time constant in rows with which the noise's own level is followed.
    """

    cdef double[:, ::1] dynamics, curves, variance
    cdef double[::1] taps
    cdef Py_ssize_t[::1] judged, actuators, owner, faults
    cdef double[:, :, ::1] whitening, impulse, direct, additions
    cdef double[:, ::1] grown
    cdef Py_ssize_t n, s, p, m, S, H, L, P, D, depth, length, hold, window
    cdef double clip, follow, limit, rate_hz, step_ns
    cdef bint driven
    # what is kept from row to row: v, innovations, |y| and |B dv|, newest at ``at`` of rings
    cdef double[:, ::1] v, acting, innovation, excited
    cdef double[::1] last_y, whitened, sigma, certainty, level
    # of each actuator: what a loss before the lag, behind it, and one before it by its rows makes of e; s one row ago
    cdef double[:, ::1] partial, behind, delayed, later
    cdef double[::1] growing, along, square, cross
    cdef uint8_t[::1] is_sudden
    # onsets that are tried: sums of s'z and s's by hypothesis, of s's with the onset a row later, and of |z|^2 / 2; the
    # onset begun last is at ``newest``
    cdef double[:, ::1] moment, information, mixed
    cdef double[::1] energy
    # nats of each actuator's sudden loss
    cdef double[::1] sudden
    cdef Py_ssize_t begun, newest, known, commands
    cdef int64_t row
    cdef bint has_y

    def __init__(self, dynamics, curves, taps, judged, actuators, additions, grown, owner, sudden, faults, driven,
                 largest, rate_hz, whitening, variance, hold, window, clip, level_rows):
        self.dynamics, self.curves = np.ascontiguousarray(dynamics, float), np.ascontiguousarray(curves, float)
        self.taps, self.variance = np.ascontiguousarray(taps, float), np.ascontiguousarray(variance, float)
        self.judged, self.actuators = np.asarray(judged, np.intp), np.asarray(actuators, np.intp)
        self.whitening = np.ascontiguousarray(whitening, float)
        self.p, self.m, self.L, self.P = len(judged), len(actuators), len(taps), len(whitening)
        self.s = len(curves)
        self.n = dynamics.shape[1] - self.s - 1
        self.additions, self.grown = np.ascontiguousarray(additions, float), np.ascontiguousarray(grown, float)
        self.D, self.S = self.grown.shape[0], self.grown.shape[1]
        self.owner = np.concatenate([np.arange(self.m)] * 3 + [np.asarray(owner)]).astype(np.intp)
        self.faults = np.asarray(faults, np.intp)
        self.driven, self.limit, self.rate_hz, self.step_ns = driven, largest, rate_hz, 1e9 / rate_hz
        self.H, self.depth = 3 * self.m + self.S, self.P + self.L
        self.hold, self.window, self.clip = max(1, hold), max(2, window), clip
        # The ring of v holds what the deepest lag needs, that of innovations what the whitening needs.
        self.length = max(self.depth + 2, self.P + 1)
        self.v, self.acting = np.zeros((2, self.length, self.s))
        self.innovation = np.zeros((self.length, self.p))
        self.excited = np.zeros((self.hold, 2 * self.p))
        self.last_y = np.zeros(self.n)
        self.whitened, self.sigma, self.certainty = np.zeros(self.p), np.ones(self.p), np.ones(self.p)
        self.level, self.follow = np.ones(self.p), 1.0 / level_rows
        self.partial, self.behind, self.delayed = np.zeros((3, self.m, self.p))
        self.later, self.sudden, self.growing = np.zeros((self.H, self.p)), np.zeros(self.m), np.zeros(self.p)
        self.along, self.square, self.cross = np.zeros((3, self.H))
        self.is_sudden = np.repeat([1, 0], [2 * self.m, self.m]).astype(np.uint8)
        self.is_sudden = np.concatenate([self.is_sudden, np.asarray(sudden)]).astype(np.uint8)
        self.moment, self.information, self.mixed = np.zeros((3, self.H, self.window))
        self.energy = np.zeros(self.window)
        self.impulse = self._impulse(np.asarray(dynamics), np.asarray(taps), np.asarray(whitening))
        self.direct = self._impulse(np.asarray(dynamics), np.ones(1), np.asarray(whitening))
        self.row = 0
        self.clear()

    def _impulse(self, dynamics, taps, whitening):
        """Return F (P + taps, m, p): what a whole loss makes of v_j, n rows later, of the whitened innovation."""
        lost = np.zeros((self.P + len(taps), self.m, self.p))
        columns = -dynamics[:, self.n + np.asarray(self.actuators)].T
        for lag, tap in enumerate(taps):
            lost[lag] += tap * columns
            for i, phi in enumerate(whitening):
                lost[lag + i + 1] -= tap * columns @ phi.T
        return np.ascontiguousarray(lost)

    cdef void clear(self) noexcept:
        """Forget what came before a restart."""
        self.has_y = False
        self.level[:] = 1.0
        self.known = self.commands = 0
        self.drop_onsets()

    cdef void drop_onsets(self) noexcept:
        self.begun, self.newest = 0, self.window - 1

    def innovations(self, const double[:, :] u, const double[:, :] y, const uint8_t[:] usable,
                    const uint8_t[:] restart):
        """Return what the noise is fitted to: innovations (N, p), r and d (N, 2 p), and where they are known (N,)."""
        cdef Py_ssize_t k, i, count = u.shape[0]
        results = np.zeros((count, self.p)), np.zeros((count, 2 * self.p)), np.zeros(count, np.bool_)
        cdef double[:, ::1] found = results[0], excited = results[1]
        cdef uint8_t[::1] known = results[2]
        for k in range(count):
            self.take(u, y, k, usable[k], restart[k])
            known[k] = self.known > 0
            for i in range(self.p):
                found[k, i] = self.innovation[self.row % self.length, i]
                excited[k, i] = self.largest(i)
                excited[k, self.p + i] = self.largest(self.p + i)
        return results

    def run(self, const double[:, :] u, const double[:, :] y, const uint8_t[:] usable, const uint8_t[:] restart,
            const int64_t[:] times_ns, const uint8_t[:] armed, const double[:, :] believed):
        """Return the named fault (N,), -1 for none, with nats, size, its growth a second, sd and time of onset (N,).

        The size of an actuator's fault is the share of its effect, negative where it lost; that of a sensor is given as
        it is.

        Parameters
        ----------
        u, y : float64 (N, s), (N, n)
            Samples.
        times_ns : int64 (N,)
            Vehicle times.
        usable, restart, armed : bool (N,)
            Samples that are measured and complete, at which the observer starts afresh, that are evidence.
        believed : float64 (N, a)
            Signed size of each of the observer's faults as it believes it.
        """
        cdef Py_ssize_t k, owner, count = u.shape[0]
        cdef double sign = -1.0 if self.m else 1.0
        results = np.empty(count, np.intp), *np.zeros((4, count)), np.empty(count, np.int64)
        cdef Py_ssize_t[::1] named = results[0]
        cdef double[::1] nats = results[1], size = results[2], growth = results[3], sd = results[4]
        cdef int64_t[::1] onset_ns = results[5]
        cdef Fitted found
        for k in range(count):
            self.take(u, y, k, usable[k], restart[k])
            named[k], onset_ns[k] = -1, times_ns[k]
            if self.known <= self.P or self.commands <= self.depth or not armed[k]:
                self.drop_onsets()
                continue
            self.whiten()
            self.accumulate()
            owner = self.judge(believed[k], &found)
            if owner >= 0:
                named[k], nats[k], sd[k] = self.faults[owner], found.nats, sqrt(found.variance)
                size[k], growth[k] = sign * found.size, sign * found.growth
                onset_ns[k] -= <int64_t>rint(found.age * self.step_ns)
        return results

    cdef void take(self, const double[:, :] u, const double[:, :] y, Py_ssize_t k, bint usable, bint restart) noexcept:
        """Follow one row: v, the innovation nu = y - (A y- + B v- + c), and what excites the model's errors."""
        cdef Py_ssize_t i, j, d, row, before
        cdef double value, power, moved, command
        if restart:
            self.clear()
        self.row += 1
        row = self.row % self.length
        before = back(row, 1, self.length)
        for j in range(self.s):
            value, power, command = 0.0, 1.0, u[k, j]
            if not fabs(command) < self.limit:
                # What was commanded is not known as long as lag and whitening remember it.
                self.commands, command = -1, 0.0
            for d in range(self.curves.shape[1]):
                power *= command
                value += self.curves[j, d] * power
            self.v[row, j] = value
            # What the lag lets through: it acts on this row.
            self.acting[row, j] = 0.0
            for d in range(min(self.L, self.commands)):
                self.acting[row, j] += self.taps[d] * self.v[back(row, d + 1, self.length), j]
        for i in range(self.p):
            value = y[k, self.judged[i]]
            if not self.has_y or not usable:
                self.innovation[row, i] = 0.0
            else:
                moved = self.dynamics[i, self.n + self.s]
                for j in range(self.n):
                    moved += self.dynamics[i, j] * self.last_y[j]
                for j in range(self.s):
                    moved += self.dynamics[i, self.n + j] * self.acting[row, j]
                self.innovation[row, i] = value - moved
            moved = 0.0
            if self.driven:
                value = 0.0
            for j in range(self.s):
                if self.commands:
                    moved += self.dynamics[i, self.n + j] * (self.v[row, j] - self.v[before, j])
                if self.driven:
                    value += self.dynamics[i, self.n + j] * self.v[row, j]
            self.excited[self.row % self.hold, i] = fabs(value)
            self.excited[self.row % self.hold, self.p + i] = fabs(moved)
        self.known = self.known + 1 if self.has_y and usable and self.commands >= self.L else 0
        self.commands += 1
        self.has_y = usable
        for j in range(self.n):
            self.last_y[j] = y[k, j]

    cdef double largest(self, Py_ssize_t column) noexcept:
        """Return the largest of the last rows: as many as there were since the restart, ``hold`` at most."""
        cdef Py_ssize_t i, newest = self.row % self.hold
        cdef double most = 0.0
        for i in range(min(self.hold, self.commands)):
            most = max(most, self.excited[back(newest, i, self.hold), column])
        return most

    cdef void whiten(self) noexcept:
        """z = (nu - sum_i Phi_i nu(k - i)) / sigma, at most ``clip``; sigma^2 = (c_0 + c_1 r^2 + c_2 d^2) lambda."""
        cdef Py_ssize_t i, j, lag, newest = self.row % self.length
        cdef double e, rate, moved, square, length = 0.0, weight
        for i in range(self.p):
            e = self.innovation[newest, i]
            for lag in range(self.P):
                for j in range(self.p):
                    e -= self.whitening[lag, i, j] * self.innovation[back(newest, lag + 1, self.length), j]
            rate, moved = self.largest(i), self.largest(self.p + i)
            self.sigma[i] = sqrt(
                self.variance[i, 0] + self.variance[i, 1] * rate * rate + self.variance[i, 2] * moved * moved)
            square = e * e / (self.sigma[i] * self.sigma[i])
            # Gusts that the fitted flights did not have; never below what they had.
            self.sigma[i] *= sqrt(max(1.0, self.level[i]))
            self.level[i] += self.follow * (min(square, LEVEL_CLIP) - self.level[i])
            self.whitened[i] = e / self.sigma[i]
            length += self.whitened[i] * self.whitened[i]
        # A row that no noise explains counts as one of larger noise: for and against every hypothesis alike.
        weight = min(1.0, self.clip / sqrt(length)) if length > 0.0 else 1.0
        for i in range(self.p):
            self.whitened[i] *= weight
            self.certainty[i] = weight / self.sigma[i]

    cdef void accumulate(self) noexcept:
        """Begin an onset at this row, and add s'z, s's and |z|^2 / 2 of the row to every onset in the window."""
        cdef Py_ssize_t age, i, j, h, place, newest = self.row % self.length
        cdef double half = 0.0, value, since
        self.newest = (self.newest + 1) % self.window
        self.begun = min(self.begun + 1, self.window)
        for h in range(self.H):
            self.moment[h, self.newest] = self.information[h, self.newest] = self.mixed[h, self.newest] = 0.0
        self.energy[self.newest] = 0.0
        for i in range(self.p):
            half += 0.5 * self.whitened[i] * self.whitened[i]
        self.partial[:, :] = 0.0
        self.behind[:, :] = 0.0
        self.delayed[:, :] = 0.0
        self.later[:, :] = 0.0
        for age in range(self.begun):
            place = back(self.newest, age, self.window)
            since = age / self.rate_hz
            self.energy[place] += half
            for j in range(self.m):
                if age < self.depth:
                    # The response to a loss since ``age`` rows: v that came before it is not missing.
                    for i in range(self.p):
                        value = self.impulse[age, j, i] * self.v[back(newest, age + 1, self.length), self.actuators[j]]
                        self.partial[j, i] += value
                        self.delayed[j, i] += since * value
                        if age <= self.P:
                            self.behind[j, i] += (
                                self.direct[age, j, i]
                                * self.acting[back(newest, age, self.length), self.actuators[j]])
                # Of onsets that lie further back than lag and whitening remember the response is the same.
                if age <= self.depth:
                    self.respond(j, &self.partial[j, 0])
                    self.respond(self.m + j, &self.behind[j, 0])
                for i in range(self.p):
                    self.growing[i] = since * self.partial[j, i] - self.delayed[j, i]
                self.respond(2 * self.m + j, &self.growing[0])
            if age <= self.D:
                for h in range(self.S):
                    self.respond(3 * self.m + h, &self.additions[min(age, self.D - 1), h, 0])
            for h in range(self.H):
                self.moment[h, place] += self.along[h]
                self.information[h, place] += self.square[h]
                self.mixed[h, place] += self.cross[h]

    cdef void respond(self, Py_ssize_t h, const double* response) noexcept:
        """Take what a hypothesis makes of a row: along s = response / sigma, its square, and s times that of before."""
        cdef Py_ssize_t i
        cdef double s, along = 0.0, square = 0.0, cross = 0.0
        for i in range(self.p):
            s = response[i] * self.certainty[i]
            along += s * self.whitened[i]
            square += s * s
            cross += s * self.later[h, i]
            self.later[h, i] = s
        self.along[h], self.square[h], self.cross[h] = along, square, cross

    cdef Fitted fit(self, Py_ssize_t h) noexcept:
        """Return how well a hypothesis explains the window: g = (s'z)^2 / (2 s's), the largest of all onsets.

        A sudden fault begins between two rows: that is a (1 - f) s of the earlier and f s of the later one, whose
        shares are fitted together. So the variance of its size has that of its onset in it.
        """
        cdef Fitted best = Fitted(0.0, 0.0, 0.0, 0.0, 0)
        cdef Py_ssize_t age, place
        cdef double along, square, mixed, determinant, explained, early, late
        # of the onset a row later
        cdef double next_along = 0.0, next_square = 0.0
        for age in range(self.begun):
            place = back(self.newest, age, self.window)
            along, square = self.moment[h, place], self.information[h, place]
            if along * along > 2.0 * best.nats * square:
                best = Fitted(0.5 * along * along / square, along / square, 1.0 / square, 0.0, age)
            if age and self.is_sudden[h]:
                mixed = self.mixed[h, place]
                determinant = square * next_square - mixed * mixed
                early = along * next_square - mixed * next_along
                late = square * next_along - mixed * along
                explained = early * along + late * next_along
                if (
                    explained > 2.0 * best.nats * determinant
                    and determinant > SMALLEST_DETERMINANT * square * next_square
                    and early * late > 0.0
                ):
                    best = Fitted(
                        0.5 * explained / determinant, (early + late) / determinant,
                        (square + next_square - 2.0 * mixed) / determinant, 0.0, age)
            next_along, next_square = along, square
        return best

    cdef Py_ssize_t judge(self, const double[:] believed, Fitted* chosen) noexcept:
        """Return the fault whose change explains the window best, beyond doubt, else -1."""
        cdef Py_ssize_t h, owner, best = -1, place
        cdef double prior, first = -1e300, second = -1e300, unexplained
        cdef Fitted found
        cdef double grown = 1.0
        for owner in range(self.m):
            self.sudden[owner] = 0.0
        for h in range(self.H):
            found, owner = self.fit(h), self.owner[h]
            # A loss that ends is no actuator that delivers more.
            prior = 0.0
            if h < 3 * self.m and found.size < 0.0 and not believed[self.faults[owner]] < 0.0:
                prior = AGAINST_GAIN
            if h < 2 * self.m:
                self.sudden[owner] = max(self.sudden[owner], found.nats - prior)
            elif h < 3 * self.m and (
                not self.depth <= found.age < self.window - 1 or found.nats - prior < self.sudden[owner] + MARGIN
            ):
                # What may as well have come at once, through a lag that is not quite that of the model, does not grow.
                # What began before the window grows more slowly than from there.
                continue
            if found.nats - prior > first:
                if best < 0 or owner != self.owner[best]:
                    second = first
                first, best, chosen[0] = found.nats - prior, h, found
            elif found.nats - prior > second and owner != self.owner[best]:
                second = found.nats - prior
        if best < 0 or self.owner[best] >= self.faults.shape[0] or first - second < MARGIN:
            return -1
        place = back(self.newest, chosen.age, self.window)
        unexplained = self.energy[place] - chosen.nats
        if unexplained > UNEXPLAINED_SHARE * chosen.nats + NOISE_OF_AXIS * self.p * (chosen.age + 1):
            return -1
        # What the fit leaves says how well the signature is known: where it is more than noise, so is the size's error.
        chosen.variance *= max(1.0, 2.0 * unexplained / (self.p * (chosen.age + 1)))
        if best >= 3 * self.m:
            grown = self.grown[min(chosen.age, self.D - 1), best - 3 * self.m]
        elif best >= 2 * self.m:
            chosen.growth, grown = chosen.size, chosen.age / self.rate_hz
        chosen.size *= grown
        chosen.variance *= grown * grown
        if best < 3 * self.m and chosen.size > LARGEST_LOSS:
            return -1
        return self.owner[best]
