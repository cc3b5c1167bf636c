# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
# distutils: extra_compile_args = -ftree-vectorize -fvect-cost-model=dynamic
# Entries of a row of a matrix are independent: two are computed at a time, to the same bits.
"""Observers as affine maps, the covariance of their errors, and the static input curves, row after row.

Symbols are those of the theory. Sums are taken in one fixed order, so that the result of a row depends only on the rows
before it and never on how many of them came in the same call (BLAS chooses its order by size).
"""

from libc.math cimport NAN, fabs, hypot, sqrt

import numpy as np

cdef enum:
    MEASURED, COASTED, RESUMED
    KINDS

# Slopes and roots of an input curve are at least this: a curve may be flat at zero command.
cdef double SMALLEST_SLOPE = 1e-9
# Newton's method converges quadratically: on the curve of the tests four steps leave less than 1e-6 of full command.
cdef int NEWTON_STEPS = 4


cdef class SparseMatrix:
    """A constant matrix without its zeros, column after column.

    A product adds the columns in order: sums of independent rows overlap in the processor, and NaN spreads only to the
    rows that depend on it.
    """

    cdef Py_ssize_t columns, rows
    cdef Py_ssize_t[::1] starts, row
    cdef double[::1] value

    def __init__(self, matrix):
        self.rows, self.columns = matrix.shape
        column, row = np.nonzero(matrix.T)
        self.starts = np.searchsorted(column, np.arange(self.columns + 1)).astype(np.intp)
        self.row = np.append(row, 0).astype(np.intp)
        self.value = np.append(matrix[row, column], 0.0)

    cdef void multiply(self, const double[::1] z, double[::1] out) noexcept:
        """Write M z, z of at least as many entries as M has columns."""
        cdef Py_ssize_t i, j
        cdef double factor
        for i in range(self.rows):
            out[i] = 0.0
        for j in range(self.columns):
            factor = z[j]
            for i in range(self.starts[j], self.starts[j + 1]):
                out[self.row[i]] += self.value[i] * factor


cdef class AffineMap:
    """K observers of one plant as one affine map with scalar nonlinearities.

        nu = N z,    [c+; x^; f^; yt] = M z,    z = [c; v; past v; y; 1; g(nu); d; f^ before]

    where d, for each observer and bend, is what the bend of v + f^ has more than that of v.

    with one pair (M, N) for each kind of row: measured, coasted, and the first one measured after that. Matrices and
    layout come from :mod:`monitor.estimation.affine`.

    Parameters
    ----------
    maps : sequence of (M, N)
        Of a measured, a coasted and a resumed row.
    initial : ndarray
        c = initial [v; past v; y; 1] at a restart.
    curves : ndarray
        Coefficients of the input curves (s, degree).
    bends : ndarray
        Coefficients over v of the bends of e states, a row for each state and input (e s, degree): v is [v; r] in what
        follows.
    lagged : ndarray
        What acts now of each input, of [v; past v; y; 1] (s, entries).
    newer, source : ndarray
        For each past input, sorted by delay: the entry of [v; past v] whose value it gets after a row, and its input.
    functions, spans : sequences
        The nonlinearities as Python functions, and where the arguments of each begin in nu (one more than functions).
    owner, scaled : ndarray
        For each fault, its observer and the input that it scales, -1 for none (faults,).
    observers, states, outputs : int
        Number of observers, and of one observer's states and outputs.
    """

    cdef list steps, arguments
    cdef SparseMatrix initial, lagged
    cdef double[:, ::1] curves, bends
    cdef Py_ssize_t[::1] newer, source, spans, owner, scaled
    cdef tuple functions
    cdef Py_ssize_t cores, commands, inputs, past, observers, states, outputs, faults
    cdef double[::1] z, w, out, nu, acting, bent
    cdef bint started, coasted

    def __init__(self, maps, initial, curves, bends, lagged, newer, source, functions, spans, owner, scaled, observers,
                 states, outputs):
        cdef Py_ssize_t width, faults = len(owner)
        self.steps = [SparseMatrix(step) for step, _ in maps]
        self.arguments = [SparseMatrix(arguments) for _, arguments in maps]
        self.initial, self.lagged, self.acting = SparseMatrix(initial), SparseMatrix(lagged), np.zeros(len(lagged))
        self.owner, self.scaled = owner.astype(np.intp), scaled.astype(np.intp)
        self.curves, self.bends = np.ascontiguousarray(curves, np.float64), np.ascontiguousarray(bends, np.float64)
        self.newer, self.source = newer.astype(np.intp), source.astype(np.intp)
        self.functions, self.spans = tuple(functions), np.asarray(spans, np.intp)
        self.commands, self.inputs = len(curves), len(curves) + len(bends) // max(len(curves), 1)
        self.cores, self.past, self.outputs = len(initial), len(newer), outputs
        self.observers, self.states, self.faults = observers, states, faults
        width = self.cores + self.inputs + self.past + self.outputs + 1
        self.z = np.zeros(width + len(self.functions) + observers * (self.inputs - self.commands) + faults)
        self.bent = self.z[width + len(self.functions) : self.z.shape[0] - faults]
        self.w = self.z[self.cores : width]
        self.w[self.w.shape[0] - 1] = 1.0
        self.out = np.zeros(self.cores + observers * (states + outputs) + faults)
        self.nu = np.zeros(self.spans[len(self.functions)] + 1)
        self.started = self.coasted = False

    def run(self, const double[:, :] u, const double[:, :] y, const unsigned char[:] measured,
            const unsigned char[:] restart):
        """Return x^ (n, K, states), f^ (n, faults) and yt (n, K, p) after each of n rows.

        u (n, s) and y (n, p) in the order of the gains; the first row ever restarts.
        """
        cdef Py_ssize_t k, i, j, at, count = u.shape[0]
        if u.shape[1] != self.commands or y.shape[1] != self.outputs:
            raise ValueError(f"{u.shape[1]} inputs and {y.shape[1]} outputs, not {self.commands} and {self.outputs}")
        if not count == y.shape[0] == measured.shape[0] == restart.shape[0]:
            raise ValueError("u, y, measured and restart differ in length")
        results = (
            np.empty((count, self.observers, self.states)),
            np.empty((count, self.faults)),
            np.empty((count, self.observers, self.outputs)),
        )
        cdef double[:, :, ::1] x = results[0], residual = results[2]
        cdef double[:, ::1] fault = results[1]
        for k in range(count):
            for i in range(self.commands):
                self.w[i] = effect(self.curves, i, u[k, i])
            for i in range(self.commands, self.inputs):
                self.w[i] = bend(self.bends, (i - self.commands) * self.commands, self.w[: self.commands])
            if restart[k] or not self.started:
                self.set_outputs(y, k)
                self.restart()
                self.step(MEASURED)
            elif not measured[k]:
                self.coasted = True
                self.step(COASTED)
            else:
                self.set_outputs(y, k)
                self.step(RESUMED if self.coasted else MEASURED)
                self.coasted = False
            at = self.cores
            for i in range(self.observers):
                for j in range(self.states):
                    x[k, i, j] = self.out[at]
                    at += 1
            for i in range(self.faults):
                fault[k, i] = self.out[at]
                at += 1
            for i in range(self.observers):
                for j in range(self.outputs):
                    residual[k, i, j] = self.out[at]
                    at += 1
        return results

    cdef void set_outputs(self, const double[:, :] y, Py_ssize_t k) noexcept:
        cdef Py_ssize_t i
        for i in range(self.outputs):
            self.w[self.inputs + self.past + i] = y[k, i]

    cdef void restart(self) noexcept:
        """Start at the states that v and y explain without a fault, as if v had been the input for ever."""
        cdef Py_ssize_t i
        for i in range(self.past):
            self.w[self.inputs + i] = self.w[self.source[i]]
        self.initial.multiply(self.w, self.out)
        for i in range(self.cores):
            self.z[i] = self.out[i]
        for i in range(self.z.shape[0] - self.faults, self.z.shape[0]):
            self.z[i] = 0.0
        self.started, self.coasted = True, False

    cdef int step(self, int kind) except -1:
        cdef Py_ssize_t i
        cdef Py_ssize_t before = self.z.shape[0] - self.faults, estimated = self.cores + self.observers * self.states
        if self.functions:
            self.evaluate(kind)
        if self.bent.shape[0]:
            self.bend_faults()
        (<SparseMatrix> self.steps[kind]).multiply(self.z, self.out)
        for i in range(self.cores):
            self.z[i] = self.out[i]
        for i in range(self.faults):
            self.z[before + i] = self.out[estimated + i]
        # v(k) becomes v(k-1), v(k-1) becomes v(k-2): the oldest first, each takes over an entry that is still old.
        for i in range(self.past - 1, -1, -1):
            self.w[self.inputs + i] = self.w[self.newer[i]]
        return 0

    cdef void bend_faults(self) noexcept:
        """Write d: a motor that delivers less thrust has less of the drag that its thrust bends, too.

        A fault counts as no more than its whole input, whatever is estimated while an observer settles.
        """
        cdef Py_ssize_t a, i, j, bends = self.inputs - self.commands
        cdef double v, faulty
        self.lagged.multiply(self.w, self.acting)
        self.bent[:] = 0.0
        for a in range(self.faults):
            j = self.scaled[a]
            if j < 0:
                continue
            v = self.acting[j]
            faulty = v + at_least(-at_least(-self.z[self.z.shape[0] - self.faults + a], -fabs(v)), -fabs(v))
            for i in range(bends):
                self.bent[self.owner[a] * bends + i] += (
                    effect(self.bends, i * self.commands + j, faulty) - effect(self.bends, i * self.commands + j, v))

    cdef int evaluate(self, int kind) except -1:
        """Write g(nu), nu = N z: Python functions, the one thing here that is not compiled."""
        cdef Py_ssize_t i, j, at = self.cores + self.w.shape[0]
        (<SparseMatrix> self.arguments[kind]).multiply(self.z, self.nu)
        for i in range(len(self.functions)):
            self.z[at + i] = self.functions[i](*[self.nu[j] for j in range(self.spans[i], self.spans[i + 1])])
        return 0


cdef class ErrorCovariance:
    """Covariance of the errors of K observers, P+ = A P A' + Q with A and Q of the kind of row.

    Parameters
    ----------
    A, Q : ndarray
        Of each observer and kind of row (K, 3, d, d).
    steady, start : ndarray
        P while all is measured and after a restart (K, d, d).
    owner, entry : ndarray
        For each fault, the observer and the entry of its error that give the fault's variance (a,).
    scale : ndarray
        Factor of the standard deviation of each fault (a,).
    tolerance : float
        P counts as steady again where every standard deviation is within this share of the steady one.
    """

    cdef double[:, :, :, ::1] A, Q
    # The columns of each row's entries of A and Q that are not zero, before the others, and their number.
    cdef Py_ssize_t[:, :, :, ::1] of_A, of_Q
    cdef Py_ssize_t[:, :, ::1] count_A, count_Q
    # Number of each observer's errors: what follows only fills the matrices up.
    cdef Py_ssize_t[::1] sizes
    cdef double[:, :, ::1] P, start, steady
    cdef double[:, ::1] AP, PA
    cdef Py_ssize_t[::1] owner, entry
    cdef double[::1] steady_sd, scale
    cdef double tolerance
    cdef bint settled, coasted

    def __init__(self, A, Q, steady, start, owner, entry, scale, tolerance):
        self.A, self.Q = np.ascontiguousarray(A), np.ascontiguousarray(Q)
        self.of_A, self.of_Q = (np.argsort(M == 0.0, axis=-1, kind="stable").astype(np.intp) for M in (A, Q))
        self.count_A, self.count_Q = (np.count_nonzero(M, axis=-1).astype(np.intp) for M in (A, Q))
        used = A.any(axis=1) | Q.any(axis=1)
        used = (used | used.swapaxes(1, 2)).any(axis=1) * np.arange(1, A.shape[3] + 1)
        self.sizes = np.max(used, axis=1).astype(np.intp)
        self.steady, self.start = np.ascontiguousarray(steady), np.ascontiguousarray(start)
        self.P = np.array(steady)
        self.AP, self.PA = np.empty((2, *steady.shape[1:]))
        self.owner, self.entry = owner.astype(np.intp), entry.astype(np.intp)
        self.steady_sd = np.sqrt(np.maximum(steady[owner, entry, entry], 0.0))
        self.scale, self.tolerance = np.ascontiguousarray(scale, np.float64), tolerance
        self.settled, self.coasted = True, False

    def run(self, const unsigned char[:] measured, const unsigned char[:] restart):
        """Return one standard deviation of each fault estimate after each of n rows (n, a); a restart is measured."""
        cdef Py_ssize_t k, i, count = measured.shape[0], faults = self.owner.shape[0]
        cdef int kind
        cdef bint seen
        if count != restart.shape[0]:
            raise ValueError("measured and restart differ in length")
        result = np.empty((count, faults))
        cdef double[:, ::1] sd = result
        for k in range(count):
            if restart[k]:
                self.P[:] = self.start
                self.settled = self.coasted = False
            seen = measured[k] or restart[k]
            # While all is measured P stays steady, and nothing has to be computed.
            if not (self.settled and seen):
                kind = COASTED if not seen else RESUMED if self.coasted else MEASURED
                self.coasted = not seen
                self.propagate(kind)
                self.settled = seen
                for i in range(faults):
                    sd[k, i] = self.deviation(i)
                    if not fabs(sd[k, i] - self.steady_sd[i]) <= self.tolerance * self.steady_sd[i]:
                        self.settled = False
                if self.settled:
                    self.P[:] = self.steady
            for i in range(faults):
                sd[k, i] = self.scale[i] * (self.steady_sd[i] if self.settled else sd[k, i])
        return result

    cdef double deviation(self, Py_ssize_t i) noexcept:
        cdef double variance = self.P[self.owner[i], self.entry[i], self.entry[i]]
        return sqrt(variance) if variance > 0.0 else 0.0

    cdef void propagate(self, int kind) noexcept:
        """P = A P A' + Q; A and Q are sparse, and P A' = (A P)' because P is symmetric."""
        cdef Py_ssize_t k, i, j, m, size
        for k in range(self.P.shape[0]):
            size = self.sizes[k]
            self.multiply(k, kind, self.P[k], self.AP)
            for i in range(size):
                for j in range(size):
                    self.PA[i, j] = self.AP[j, i]
            self.multiply(k, kind, self.PA, self.P[k])
            for i in range(size):
                for m in range(self.count_Q[k, kind, i]):
                    j = self.of_Q[k, kind, i, m]
                    self.P[k, i, j] += self.Q[k, kind, i, j]

    cdef void multiply(self, Py_ssize_t k, int kind, const double[:, ::1] B, double[:, ::1] out) noexcept:
        """Write A B."""
        cdef Py_ssize_t i, j, m, size = self.sizes[k]
        cdef double factor
        cdef const double* row
        cdef double* sums
        for i in range(size):
            sums = &out[i, 0]
            for j in range(size):
                sums[j] = 0.0
            for m in range(self.count_A[k, kind, i]):
                row, factor = &B[self.of_A[k, kind, i, m], 0], self.A[k, kind, i, self.of_A[k, kind, i, m]]
                for j in range(size):
                    sums[j] += factor * row[j]


cdef class FlightErrors:
    """How much larger the errors of estimates are in this flight than in the fitted ones, by both in one mean.

    The square of each estimate's error relative to the fitted standard deviation has a mean of which the fit knows as
    much as ``prior_s`` of flight, and which forgets what is older than ``memory_s``.

    Parameters
    ----------
    faults : int
        Number of estimates a.
    dt, prior_s, memory_s : float
        Time between rows, and these times, seconds.
    most : float
        Largest error that counts, in standard deviations.
    """

    cdef double[::1] square
    cdef double dt, known_s, memory_s, most

    def __init__(self, faults, dt, prior_s, memory_s, most):
        self.square = np.ones(faults)
        self.dt, self.known_s, self.memory_s, self.most = dt, prior_s, memory_s, most * most

    def run(self, const double[:, :] sd, const double[:, :] fault, const double[:] level,
            const unsigned char[:] healthy):
        """Return by what factor the deviations of n estimates ``fault`` are those of the fitted flights, ``sd`` (n, a).

        ``level`` is the residuals' mean square relative to that of healthy flight (n,), which counts where it is
        larger. In rows that are ``healthy`` evidence (n,) an estimate is an error; one that is exactly 0 was not made.
        """
        cdef Py_ssize_t k, i, count = sd.shape[0], faults = self.square.shape[0]
        cdef double larger, share, error
        if not same_shape(sd, fault) or sd.shape[1] != faults or not count == level.shape[0] == healthy.shape[0]:
            raise ValueError(f"sd, fault, level and healthy are not of {faults} estimates each")
        result = np.empty((count, faults))
        cdef double[:, ::1] factors = result
        for k in range(count):
            larger = at_least(level[k], 1.0)
            if healthy[k]:
                self.known_s = min(self.known_s + self.dt, self.memory_s)
            share = self.dt / self.known_s
            for i in range(faults):
                factors[k, i] = sqrt(larger * self.square[i])
                error = fault[k, i] * fault[k, i] / (larger * sd[k, i] * sd[k, i])
                if healthy[k] and error > 0.0:
                    self.square[i] += share * (min(error, self.most) - self.square[i])
        return result


cdef class SizeErrors:
    """Standard deviations of the sizes of alarms, by the formula of :mod:`monitor.estimation.uncertainty`.

    Parameters
    ----------
    rows, ahead, apart : ndarray
        Of each fault (a,): rows over which the movement of its size is taken; what is still missing of the size for its
        movement over these rows; and the standard deviation of the movement of a size that only noise moves, for one of
        the size.
    """

    cdef double[:, ::1] before
    cdef double[::1] ahead, apart
    cdef Py_ssize_t[::1] rows
    cdef Py_ssize_t newest

    def __init__(self, rows, ahead, apart):
        self.rows = np.asarray(rows, np.intp)
        self.ahead, self.apart = np.ascontiguousarray(ahead, np.float64), np.ascontiguousarray(apart, np.float64)
        self.before = np.zeros((max(rows) + 1, len(rows)))

    def run(self, const double[:, :] sd, const double[:, :] sizes, const double[:, :] shown, const double[:, :] full):
        """Return the standard deviations of n sizes (n, a) where ``shown`` are the shown ones of their estimates.

        ``sd`` are those of the estimates in the unit of the sizes (n, a). ``full`` is what each size is a share of
        (n, a), 1 of a size that is none.
        """
        cdef Py_ssize_t k, i, then, length = self.before.shape[0], count = sizes.shape[0], faults = self.rows.shape[0]
        cdef double size, way
        if not (same_shape(sd, sizes) and same_shape(shown, sizes) and same_shape(full, sizes)) or (
            sizes.shape[1] != faults
        ):
            raise ValueError(f"sd, sizes, shown and full are not of {faults} faults each")
        result = np.empty((count, faults))
        cdef double[:, ::1] errors = result
        for k in range(count):
            self.newest = (self.newest + 1) % length
            for i in range(faults):
                size = sizes[k, i]
                then = (self.newest + length - self.rows[i]) % length
                way = fabs(size - self.before[then, i] * full[k, i])
                way = self.ahead[i] * at_least(way - 2.0 * self.apart[i] * sd[k, i], 0.0)
                self.before[self.newest, i] = size / full[k, i]
                errors[k, i] = shown[k, i] * (hypot(sd[k, i], way) / sd[k, i])
        return result


cdef class CommandScale:
    """Takes fault estimates of n rows from effect units to those of the command, at the smoothed command.

    Parameters
    ----------
    curves : ndarray
        Coefficients of all input curves (s, degree).
    inputs : ndarray
        The inputs that faults scale, each once.
    channel : ndarray
        For each fault, which of ``inputs`` it scales, -1 where it scales none (a,).
    keep : float
        Weight of the smoothed command before a row.
    """

    cdef double[:, ::1] curves
    cdef Py_ssize_t[::1] inputs, channel
    cdef double[::1] command, before
    # Whether an input has been commanded to both sides: then no fault is given as a share of its command.
    cdef unsigned char[::1] both
    cdef double keep

    def __init__(self, curves, inputs, channel, keep):
        self.curves = np.ascontiguousarray(curves, np.float64)
        self.inputs, self.channel = inputs.astype(np.intp), channel.astype(np.intp)
        self.command, self.before = np.zeros((2, len(inputs)))
        self.both = np.zeros(len(inputs), np.uint8)
        self.keep = keep

    def run(self, const double[:, :] u, const unsigned char[:] restart, const double[:, :] fault,
            const double[:, :] evidence, const double[:, :] sd):
        """Return fault, evidence and sd in command units, the smoothed command that each fault scales, and its effect.

        All are (n, a). A fault that scales none has no number as its command, and the effect 1, as has one whose input
        has been commanded to both sides.
        """
        cdef Py_ssize_t k, i, channel, count = u.shape[0], faults = self.channel.shape[0]
        cdef double keep = self.keep, size, upper, behind
        if u.shape[1] != self.curves.shape[0] or not count == restart.shape[0] == fault.shape[0]:
            raise ValueError("u, restart and fault do not fit together")
        if not (same_shape(fault, evidence) and same_shape(fault, sd)) or fault.shape[1] != faults:
            raise ValueError(f"fault, evidence and sd are not of {faults} channels each")
        results = np.empty((5, count, faults))
        cdef double[:, ::1] scaled_fault = results[0], scaled_evidence = results[1], scaled_sd = results[2]
        cdef double[:, ::1] commands = results[3], full = results[4]
        for k in range(count):
            for i in range(self.inputs.shape[0]):
                size = u[k, self.inputs[i]]
                if restart[k]:
                    self.command[i] = size
                self.before[i] = self.command[i]
                self.both[i] |= size * self.command[i] < 0.0
                self.command[i] = keep * self.command[i] + (1.0 - keep) * size
            for i in range(faults):
                channel = self.channel[i]
                size, upper, behind = fault[k, i], fault[k, i] + sd[k, i], 0.0
                scaled_evidence[k, i], commands[k, i], full[k, i] = evidence[k, i], NAN, 1.0
                if channel >= 0:
                    commands[k, i] = self.command[channel]
                    if self.command[channel] != 0.0 and not self.both[channel]:
                        full[k, i] = effect(self.curves, self.inputs[channel], self.command[channel])
                    size = self.scaled(channel, size)
                    upper = self.scaled(channel, upper)
                    scaled_evidence[k, i] = self.scaled(channel, evidence[k, i])
                    # A share of the command is wrong by as much as the command differs from the one smoothed as the
                    # evidence is; the measurements of a row show the command of the row before.
                    if self.before[channel] != 0.0 and not self.both[channel]:
                        behind = scaled_evidence[k, i] * (u[k, self.inputs[channel]] / self.before[channel] - 1.0)
                scaled_fault[k, i] = size
                scaled_sd[k, i] = hypot(upper - size, behind)
        return tuple(results)

    cdef double scaled(self, Py_ssize_t channel, double fault) noexcept:
        return fault_in_command(self.curves, self.inputs[channel], fault, self.command[channel])


def shares_in_command(const double[:, ::1] curves, const Py_ssize_t[:] inputs, const double[:] command,
                      const double[:] share):
    """Return losses of the commands of inputs (n,), in their units, from shares (n,) of their effects; input -1: as it
    is."""
    cdef Py_ssize_t k, count = inputs.shape[0]
    if not count == command.shape[0] == share.shape[0]:
        raise ValueError("inputs, command and share differ in length")
    result = np.array(share)
    cdef double[:] lost = result
    for k in range(count):
        if inputs[k] >= 0:
            lost[k] = fault_in_command(
                curves, inputs[k], share[k] * effect(curves, inputs[k], command[k]), command[k])
    return result


cdef bint same_shape(const double[:, :] a, const double[:, :] b) noexcept:
    return a.shape[0] == b.shape[0] and a.shape[1] == b.shape[1]


cdef double effect(const double[:, ::1] curves, Py_ssize_t j, double u) noexcept:
    """Return v = c1 u + c2 u^2 + ... by Horner's rule."""
    cdef Py_ssize_t i, degree = curves.shape[1]
    cdef double value = curves[j, degree - 1] * u
    for i in range(degree - 2, -1, -1):
        value = (value + curves[j, i]) * u
    return value


cdef double bend(const double[:, ::1] bends, Py_ssize_t first, const double[:] v) noexcept:
    """Return what all inputs add to a state, whose rows of ``bends`` begin at ``first``."""
    cdef Py_ssize_t j
    cdef double total = 0.0
    for j in range(v.shape[0]):
        total += effect(bends, first + j, v[j])
    return total


cdef double slope(const double[:, ::1] curves, Py_ssize_t j, double u) noexcept:
    """Return dv/du, at least the smallest one."""
    cdef Py_ssize_t i, degree = curves.shape[1]
    cdef double value = degree * curves[j, degree - 1]
    for i in range(degree - 1, 0, -1):
        value = value * u + i * curves[j, i - 1]
    return at_least(value, SMALLEST_SLOPE)


cdef double fault_in_command(const double[:, ::1] curves, Py_ssize_t j, double fault, double u) noexcept:
    """Return u_eff - u with curve(u_eff) = curve(u) + fault.

    Below zero command a curve is extrapolated along its slope at zero: an actuator that pushes the other way.
    """
    cdef double target, linear, square, root, u_eff
    cdef int _
    if curves.shape[1] == 1:
        return fault / curves[j, 0]
    target = effect(curves, j, u) + fault
    if curves.shape[1] == 2:
        # The root of c2 u^2 + c1 u = target without cancellation: 2 target / (c1 + sqrt(c1^2 + 4 c2 target)).
        # Below zero the square root stays at that of zero, which is the extrapolation.
        linear, square = curves[j, 0], curves[j, 1]
        root = sqrt(at_least(linear * linear + 4.0 * square * at_least(target, 0.0), 0.0))
        return 2.0 * target / at_least(linear + root, SMALLEST_SLOPE) - u
    u_eff = u + fault / slope(curves, j, u)
    for _ in range(NEWTON_STEPS):
        u_eff = at_least(u_eff, 0.0)
        u_eff = u_eff + (target - effect(curves, j, u_eff)) / slope(curves, j, u_eff)
    return u_eff - u


cdef double at_least(double value, double limit) noexcept:
    """Return the larger one; NaN stays NaN."""
    return limit if value < limit else value
