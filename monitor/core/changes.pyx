# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Likelihood ratio of a fault that began lately against health, on whitened innovations, row after row.

The rule itself; :mod:`monitor.estimation.changes` tells what it is for, in the same symbols.
"""

from libc.math cimport fabs, sqrt
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


cdef class ChangeTest:
    """State of the test of one observer.

    An observer of n outputs that are its states, s inputs and p outputs that are judged; H hypotheses, m actuators
    that lose effectiveness and S additions to what is measured, of sensors that jump or drift.

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
        The fault that each hypothesis stands for (H,): those of actuators come first.
    nameable : int
        Faults below it are named; others only keep a name from being given.
    driven : bool
        Whether r is what the inputs make of each output in a row, instead of the output itself.
    largest : float
        Largest input that can be one.
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
    cdef double[::1] taps, answered
    cdef Py_ssize_t[::1] judged, actuators, owner
    cdef double[:, :, ::1] whitening, impulse, additions
    cdef double[:, ::1] grown
    cdef Py_ssize_t n, s, p, m, S, H, L, P, D, depth, length, hold, window, nameable
    cdef double clip, follow, limit
    cdef bint driven
    # what is kept from row to row: v, innovations, |y| and |B dv|, newest at ``at`` of rings
    cdef double[:, ::1] v, innovation, excited
    cdef double[::1] last_y, whitened, sigma, level
    cdef double[:, ::1] partial
    # onsets that are tried: sums of s'z and s's by hypothesis, and of |z|^2 / 2; the onset begun last is at ``newest``
    cdef double[:, ::1] moment, information
    cdef double[::1] energy
    cdef Py_ssize_t begun, newest, known, commands
    cdef int64_t row
    cdef bint has_y

    def __init__(self, dynamics, curves, taps, judged, actuators, additions, grown, owner, nameable, driven, largest,
                 whitening, variance, hold, window, clip, level_rows):
        self.dynamics, self.curves = np.ascontiguousarray(dynamics, float), np.ascontiguousarray(curves, float)
        self.taps, self.variance = np.ascontiguousarray(taps, float), np.ascontiguousarray(variance, float)
        self.judged, self.actuators = np.asarray(judged, np.intp), np.asarray(actuators, np.intp)
        self.whitening = np.ascontiguousarray(whitening, float)
        self.p, self.m, self.L, self.P = len(judged), len(actuators), len(taps), len(whitening)
        self.s = len(curves)
        self.n = dynamics.shape[1] - self.s - 1
        self.additions, self.grown = np.ascontiguousarray(additions, float), np.ascontiguousarray(grown, float)
        self.D, self.S = self.grown.shape[0], self.grown.shape[1]
        self.owner, self.nameable, self.driven, self.limit = np.asarray(owner, np.intp), nameable, driven, largest
        self.H, self.depth = self.m + self.S, self.P + self.L
        self.hold, self.window, self.clip = max(1, hold), max(2, window), clip
        # The ring of v holds what the deepest lag needs, that of innovations what the whitening needs.
        self.length = max(self.depth + 2, self.P + 1)
        self.v, self.innovation = np.zeros((self.length, self.s)), np.zeros((self.length, self.p))
        self.excited = np.zeros((self.hold, 2 * self.p))
        self.last_y = np.zeros(self.n)
        self.whitened, self.sigma = np.zeros(self.p), np.ones(self.p)
        self.level, self.follow = np.ones(self.p), 1.0 / level_rows
        self.partial = np.zeros((self.m, self.p))
        self.moment, self.information = np.zeros((self.window, self.H)), np.zeros((self.window, self.H))
        self.energy = np.zeros(self.window)
        self.impulse = self._impulse(np.asarray(dynamics), np.asarray(taps), np.asarray(whitening))
        # The share of a loss that the lag has let through after so many rows.
        self.answered = np.clip(np.cumsum(np.asarray(taps, float)), 0.0, 1.0)
        self.row = 0
        self.clear()

    def _impulse(self, dynamics, taps, whitening):
        """Return F (P + L, m, p): what a whole loss makes of v_j, n rows later, of the whitened innovation."""
        lost = np.zeros((self.P + self.L, self.m, self.p))
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
            const uint8_t[:] armed, const double[:, :] believed):
        """Return the named fault (N,), -1 for none, with its nats, size and onset in rows ago (N,) each.

        The size of an actuator's fault is the share that it lost.

        Parameters
        ----------
        u, y : float64 (N, s), (N, n)
            Samples.
        usable, restart, armed : bool (N,)
            Samples that are measured and complete, at which the observer starts afresh, that are evidence.
        believed : float64 (N, m)
            Signed size of each actuator's fault as the observer believes it.
        """
        cdef Py_ssize_t k, count = u.shape[0]
        results = np.full(count, -1, np.intp), np.zeros(count), np.zeros(count), np.zeros(count, np.int64)
        cdef Py_ssize_t[::1] named = results[0]
        cdef double[::1] nats = results[1], share = results[2]
        cdef int64_t[::1] age = results[3]
        for k in range(count):
            self.take(u, y, k, usable[k], restart[k])
            if self.known <= self.P or self.commands <= self.depth or not armed[k]:
                self.drop_onsets()
                continue
            self.whiten()
            self.accumulate()
            named[k] = self.judge(believed[k], &nats[k], &share[k], &age[k])
        return results

    cdef void take(self, const double[:, :] u, const double[:, :] y, Py_ssize_t k, bint usable, bint restart) noexcept:
        """Follow one row: v, the innovation nu = y - (A y- + B v- + c), and what excites the model's errors."""
        cdef Py_ssize_t i, j, d, row, before, past
        cdef double value, power, moved, command
        if restart:
            self.clear()
        self.row += 1
        row = self.row % self.length
        before = (self.row - 1) % self.length
        for j in range(self.s):
            value, power, command = 0.0, 1.0, u[k, j]
            if not fabs(command) < self.limit:
                # What was commanded is not known as long as lag and whitening remember it.
                self.commands, command = -1, 0.0
            for d in range(self.curves.shape[1]):
                power *= command
                value += self.curves[j, d] * power
            self.v[row, j] = value
        for i in range(self.p):
            value = y[k, self.judged[i]]
            if not self.has_y or not usable:
                self.innovation[row, i] = 0.0
            else:
                moved = self.dynamics[i, self.n + self.s]
                for j in range(self.n):
                    moved += self.dynamics[i, j] * self.last_y[j]
                for d in range(min(self.L, self.commands)):
                    past = (self.row - 1 - d) % self.length
                    for j in range(self.s):
                        moved += self.taps[d] * self.dynamics[i, self.n + j] * self.v[past, j]
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
        cdef Py_ssize_t i
        cdef double most = 0.0
        for i in range(min(self.hold, self.commands)):
            most = max(most, self.excited[(self.row - i) % self.hold, column])
        return most

    cdef void whiten(self) noexcept:
        """z = (nu - sum_i Phi_i nu(k - i)) / sigma, at most ``clip``; sigma^2 = (c_0 + c_1 r^2 + c_2 d^2) lambda."""
        cdef Py_ssize_t i, j, lag
        cdef double e, rate, moved, square, length = 0.0, weight
        for i in range(self.p):
            e = self.innovation[self.row % self.length, i]
            for lag in range(self.P):
                for j in range(self.p):
                    e -= self.whitening[lag, i, j] * self.innovation[(self.row - 1 - lag) % self.length, j]
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
            self.sigma[i] /= weight

    cdef void accumulate(self) noexcept:
        """Begin an onset at this row, and add s'z, s's and |z|^2 / 2 of the row to every onset in the window."""
        cdef Py_ssize_t age, i, j, h, place, deep
        cdef double s, along, square, half = 0.0
        self.newest = (self.newest + 1) % self.window
        self.begun = min(self.begun + 1, self.window)
        for h in range(self.H):
            self.moment[self.newest, h] = self.information[self.newest, h] = 0.0
        self.energy[self.newest] = 0.0
        for i in range(self.p):
            half += 0.5 * self.whitened[i] * self.whitened[i]
        self.partial[:, :] = 0.0
        for age in range(self.begun):
            place = (self.newest - age + self.window) % self.window
            self.energy[place] += half
            # The response to a loss since ``age`` rows: v that came before it is not missing.
            if age < self.depth:
                for j in range(self.m):
                    for i in range(self.p):
                        self.partial[j, i] += (
                            self.impulse[age, j, i] * self.v[(self.row - 1 - age) % self.length, self.actuators[j]])
            for j in range(self.m):
                along = square = 0.0
                for i in range(self.p):
                    s = self.partial[j, i] / self.sigma[i]
                    along += s * self.whitened[i]
                    square += s * s
                self.moment[place, j] += along
                self.information[place, j] += square
            deep = min(age, self.D - 1)
            for h in range(self.S):
                along = square = 0.0
                for i in range(self.p):
                    s = self.additions[deep, h, i] / self.sigma[i]
                    along += s * self.whitened[i]
                    square += s * s
                self.moment[place, self.m + h] += along
                self.information[place, self.m + h] += square

    cdef Py_ssize_t judge(self, const double[:] believed, double* nats, double* share, int64_t* age) noexcept:
        """Return the fault whose change explains the window best, beyond doubt, else -1.

        g_h = max over onsets of (s'z)^2 / (2 s's), theta_h = s'z / s's there.
        """
        cdef Py_ssize_t h, i, place, best = -1, best_age = 0, at
        cdef double g, most, prior, first = -1e300, second = -1e300, theta, best_theta = 0.0, best_g = 0.0
        for h in range(self.H):
            most, at = 0.0, 0
            for i in range(self.begun):
                place = (self.newest - i + self.window) % self.window
                if self.information[place, h] > 0.0:
                    g = 0.5 * self.moment[place, h] * self.moment[place, h] / self.information[place, h]
                    if g > most:
                        most, at = g, i
            place = (self.newest - at + self.window) % self.window
            theta = self.moment[place, h] / self.information[place, h] if most > 0.0 else 0.0
            # A loss that ends is no actuator that delivers more.
            prior = AGAINST_GAIN if h < self.m and theta < 0.0 and not believed[h] < 0.0 else 0.0
            if most - prior > first:
                if best < 0 or self.owner[h] != self.owner[best]:
                    second = first
                first, best, best_age, best_theta, best_g = most - prior, h, at, theta, most
            elif most - prior > second and self.owner[h] != self.owner[best]:
                second = most - prior
        if best < 0 or self.owner[best] >= self.nameable or first - second < MARGIN:
            return -1
        if best < self.m and best_theta > LARGEST_LOSS:
            return -1
        place = (self.newest - best_age + self.window) % self.window
        if self.energy[place] - best_g > UNEXPLAINED_SHARE * best_g + NOISE_OF_AXIS * self.p * (best_age + 1):
            return -1
        nats[0], age[0] = best_g, best_age
        if best >= self.m:
            share[0] = best_theta * self.grown[min(best_age, self.D - 1), best - self.m]
        else:
            # A loss behind the lag (a broken propeller) looks larger to signatures of one before it, until it has
            # passed.
            share[0] = best_theta * self.answered[min(best_age, self.L - 1)]
        return self.owner[best]
