# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Finds messages that were altered on their way: outputs that repeat while others change, stamps of another pace.

Outputs. In flight all motors respond to the same gusts. So an output that repeats to the bit while others of its
message change was altered, or is at a limit: the largest output of the flight, the smallest that one fell to, a value
at which an output has stayed before, or the value that replaces a stopped motor's.

Stamps. A message has a period in its stamps, and a pace: how fast stamps go on in the receiver's time. A link that
holds messages back or catches up, and a simulation at another speed, change the pace but not the period. Another rate
changes the period but not the pace. Where both change alike, the stamps were altered, or the vehicle's clock does not
run at the speed of its program.
"""

import numpy as np

from libc.math cimport INFINITY, fabs, floor, log, log10, rint, sqrt

# In nanoseconds.
cdef long long SECOND = 1_000_000_000

# Least time for which an altered output repeats, and least number of messages in which others change meanwhile.
# Measured in flight on 70 recordings of multirotors: healthy outputs repeat for 0.2 s and 12 messages at 100 Hz, 0.6 s
# and 5 at 10 Hz, 2 s and 3 at 2 Hz.
cdef long long STOOD = 3 * SECOND
cdef int MOVED = 20
# The number of messages is also at least this multiple of the largest in this flight. Chosen: outputs of a calm flight
# change seldom.
cdef int MORE = 4
# Time for which an output repeats at a limit. Chosen: five times as long as outputs repeat between their limits.
cdef long long LIMIT = SECOND

# Least change of a period that counts. Chosen: five times the error that a loop of 4 ms makes over a second.
cdef double LEAST = 0.02
# Largest difference between the changes of pace and period, as a share. Chosen: 75 ms of jitter over 3 s with a change
# of a tenth.
cdef double ALIKE = 0.25
# Least number of steps in a mean; longest step that counts, in periods, as some messages may be lost.
cdef int STEPS = 16
cdef int LONGEST = 3
# A step of stamps that differs by more from that of arrivals is a jump of the clock, or of the link's delay. Chosen: as
# long as the vehicle's clock takes a stamp for early (monitor/core/sampling.pyx).
cdef long long JUMP = 250_000_000
# Changed means in a row after which period and pace are compared, so that a late batch does not count, and after which
# a changed period is taken for another rate.
cdef int CHANGED = 3
cdef int RATE = 8
# Weight of a mean in the usual period and pace. Chosen: a period is exact, a pace contains the link's jitter and
# backlog.
cdef double FOLLOW = 0.125
cdef double FOLLOW_PACE = 0.25
# Shortest and longest time over which the pace of fixes is measured, seconds; fewest fixes. Chosen: told within 5 s; in
# the longest a clock that is 1 % slow is told by links of 0.1 s of jitter.
cdef double FIXES_FROM = 4.0
cdef double FIXES_UNTIL = 32.0
cdef int FIXES = 16
# Stamps that differ by less are of one fix that was sent twice, seconds. Receivers make 25 fixes a second at most.
cdef double SAME = 0.035
# A delay that grows by this over the measurement is no change of pace, seconds. Chosen: 2 % in 4 s.
cdef double DRIFT = 0.08
# Standard errors of the pace within which the period has to be explained; share of the change below which a period
# counts as a whole number of fixes, or this error.
cdef double ERRORS = 3.0
cdef double WHOLE = 0.5
cdef double NO_WHOLE = 0.01
# Largest difference of a step from a whole number of periods, as a share: the other stamps are no fixes' times.
cdef double UNEVEN = 0.15
# Longest time after which a command still changes a rate, seconds, and fewest samples. Chosen: two time constants of a
# motor and its delay; at 5 Hz one sample less explains nothing in some healthy windows of ArduPilot, two a fifth.
cdef double LAGS = 0.08
cdef int LEAST_LAGS = 2
cdef int MOST_LAGS = 6
# Duration of a window, seconds, and least number of samples per parameter in it. Chosen: two windows within 5 s at
# 100 Hz, 16 s at 5 Hz, where the share that is explained by chance varies by 0.15.
cdef double WINDOW = 1.5
cdef int SAMPLES = 4
# Share explained from which on commands act, and windows that show it. Chosen between the 0.59 and 0.05 that were
# measured at 100 Hz.
cdef double ACTS = 0.5
cdef int ACTED = 2
# Standard deviation of the share that is explained by chance, measured at 5 Hz, and least of this flight's.
cdef double CHANCE = 0.15
# Windows, and nats by which chance has to explain their shares better than commands that act as they did in this
# flight, in windows whose rates changed as much: in a calm hover at 5 Hz they explain a third, in a mission nearly all.
# Of 97 recordings, with and without manoeuvres, none reaches 10 and one reaches 7. Two windows with noise in the
# commands' place have 10 in seven of eight cases.
cdef int ACTED_NOT = 2
cdef double NATS = 10.0


cdef class Stands:
    """The newest outputs of a message, and since when each repeats.

    Parameters
    ----------
    stopped : Sequence[float]
        The value that replaces each output while its motor is stopped; NaN: none.
    """

    def __cinit__(self, stopped):
        self._width = len(stopped)
        self._values, self._stopped = np.zeros(self._width), np.array(stopped, float)
        self._since, self._moved = np.zeros((2, self._width), np.int64)

    cdef bint take(self, long long stamp, const double* row, bint flies) noexcept:
        """Process a row of outputs; return whether one of them has repeated for too long."""
        cdef bint stands = False
        cdef int moves = 0, i
        if flies and not self._flies:
            self._low, self._high, self._longest = INFINITY, -INFINITY, 0
            for i in range(STOPS):
                self._stops[i] = INFINITY
        for i in range(self._width):
            moves += row[i] != self._values[i]
            # At take-off outputs rise from an idle below the least in flight.
            if row[i] < self._values[i]:
                self._low = min(self._low, row[i])
            self._high = max(self._high, row[i])
        for i in range(self._width):
            if not flies or not self._flies or row[i] != self._values[i]:
                if self._moved[i] and not self.is_limit(i, self._values[i]):
                    self._longest = max(self._longest, self._moved[i])
                    if stamp - self._since[i] >= LIMIT:
                        self._stops[self._next_stop] = self._values[i]
                        self._next_stop = (self._next_stop + 1) % STOPS
                self._values[i], self._since[i], self._moved[i] = row[i], stamp, 0
            elif moves:
                self._moved[i] += 1
                if self._moved[i] >= max(MOVED, MORE * self._longest) and stamp - self._since[i] >= STOOD:
                    stands |= not self.is_limit(i, row[i])
        self._flies = flies
        return stands

    cdef bint is_limit(self, int which, double value) noexcept:
        """Return whether a value is a limit, at which a healthy output may repeat."""
        cdef int i
        if value == self._stopped[which]:
            return True
        for i in range(STOPS):
            if self._stops[i] == value:
                return True
        return not self._low < value < self._high


cdef class Pace:
    """The usual period and pace of a message's stamps."""

    cdef bint take(self, long long stamp, long long received) noexcept:
        """Process a stamp; return whether period and pace of the stamps have changed alike."""
        cdef long long step = stamp - self._last, gone = received - self._first_received, jump
        cdef double periods = 1.0, period, pace, delay, change
        cdef bint is_alike
        if not -10 * SECOND < step < 10 * SECOND or gone < 0:
            self._usual, self._changed, self._spread = 0.0, 0, INFINITY
            self.begin(stamp, received)
            return False
        if self._usual > 0.0:
            delay = <double>gone - <double>(stamp - self._first) / self._usual_pace
            self._least, self._most = min(self._least, delay), max(self._most, delay)
        if step <= 0:
            return False
        jump = step - (received - self._last_received)
        self._last, self._last_received = stamp, received
        if self._usual > 0.0:
            periods = rint(<double>step / self._usual)
        if not -JUMP < jump < JUMP and (self._usual == 0.0 or periods > LONGEST):
            self._changed = 0
            self.begin(stamp, received)
            return False
        if periods <= LONGEST:
            self._span += step
            self._steps += max(1, <int>periods)
        if self._steps < STEPS or gone < (self._changed + 1) * SECOND:
            return False
        period, pace = <double>self._span / self._steps, <double>(stamp - self._first) / <double>gone
        self.ratio = period / self._usual if self._usual > 0.0 else 1.0
        self._span, self._steps = 0, 0
        if fabs(self.ratio - 1.0) < LEAST or self._changed >= RATE:
            if self._usual == 0.0 or self._changed >= RATE:
                self._usual, self._usual_pace, self._spread = period, pace, INFINITY
            elif self._spread == INFINITY:
                self._spread = self._most - self._least
            else:
                self._spread = max(self._most - self._least, (1.0 - FOLLOW) * self._spread)
            self._usual += FOLLOW * (period - self._usual)
            self._usual_pace += FOLLOW_PACE * (pace - self._usual_pace)
            self._changed = 0
            self.begin(stamp, received)
            return False
        self._changed += 1
        change = ALIKE * fabs(self.ratio - 1.0)
        # Delays that vary by as much tell nothing about the pace.
        is_alike = fabs(pace / self._usual_pace - self.ratio) <= change
        if self._changed < CHANGED or not is_alike or self._spread > change * gone:
            return False
        self._changed = CHANGED
        return True

    cdef void begin(self, long long stamp, long long received) noexcept:
        """Begin another mean."""
        self._first = self._last = stamp
        self._first_received = self._last_received = received
        self._span, self._steps, self._least, self._most = 0, 0, 0.0, 0.0


cdef class Fixes:
    """The pace of the stamps of a GPS receiver's fixes by their arrival, from the first one on."""

    cdef bint take(self, long long stamp, long long received) noexcept:
        """Process a fix's stamp; return whether the stamps were altered."""
        cdef double x, y, step, periods, spread, deviation, error, per_s, by_arrival, change
        step = <double>(stamp - self._last) / SECOND
        if self._count and fabs(step) < SAME:
            return False
        if self._count == 0 or not 0.0 < step < FIXES_FROM or received < self._last_received:
            self.begin(stamp, received)
            return False
        x, y = <double>(received - self._first_received) / SECOND, <double>(stamp - self._first) / SECOND
        periods = max(1.0, rint(step * self._periods / self._y)) if self._periods > 0.0 else 1.0
        if self._periods > 0.0 and fabs(step * self._periods / self._y - periods) > UNEVEN * periods:
            self.begin(stamp, received)
            return False
        self._last, self._last_received, self._y = stamp, received, y
        self._count, self._periods = self._count + 1, self._periods + periods
        self._sum_x, self._sum_y = self._sum_x + x, self._sum_y + y
        self._sum_xx, self._sum_xy, self._sum_yy = self._sum_xx + x * x, self._sum_xy + x * y, self._sum_yy + y * y
        if y < FIXES_FROM or self._count < FIXES:
            return False
        # least squares of the stamps by their arrival
        spread = self._sum_xx - self._sum_x * self._sum_x / self._count
        if spread <= 0.0:
            return False
        deviation = self._sum_xy - self._sum_x * self._sum_y / self._count
        self.pace = deviation / spread
        error = self._sum_yy - self._sum_y * self._sum_y / self._count - self.pace * deviation
        error = sqrt(max(0.0, error) / ((self._count - 2) * spread))
        per_s, change = self._periods / y, fabs(self.pace - 1.0)
        by_arrival = per_s * self.pace
        if y >= FIXES_UNTIL:
            self.begin(stamp, received)
        if change < max(DRIFT / y, 5.0 * error) or per_s < 0.9:
            return False
        if fabs(per_s / rint(per_s) - 1.0) < min(NO_WHOLE, WHOLE * change) or rint(by_arrival) < 1.0:
            return False
        return fabs(by_arrival / rint(by_arrival) - 1.0) <= min(WHOLE * change, 0.002 + ERRORS * error)

    cdef void begin(self, long long stamp, long long received) noexcept:
        """Begin another measurement."""
        self._first = self._last = stamp
        self._first_received = self._last_received = received
        self._count, self._periods, self._y = 1, 0.0, 0.0
        self._sum_x = self._sum_y = self._sum_xx = self._sum_xy = self._sum_yy = 0.0


cdef class Response:
    """Whether outputs change as the commands of the vehicle say, by least squares in windows of a flight.

    Parameters
    ----------
    inputs, outputs : int
        Number of commands and outputs in a sample.
    rate_hz : float
        Samples per second.
    """

    def __cinit__(self, int inputs, int outputs, double rate_hz):
        self._inputs, self._outputs = inputs, outputs
        self._lags = max(LEAST_LAGS, min(MOST_LAGS, <int>rint(LAGS * rate_hz)))
        self._width = (inputs - 1) * (self._lags + 1) + 1
        self._window = max(<int>rint(WINDOW * rate_hz), SAMPLES * self._width)
        self._squares = np.zeros((self._width, self._width))
        self._products = np.zeros((self._width, outputs))
        self._row, self._before = np.zeros(self._width), np.zeros(outputs)
        self._energies = np.zeros(outputs)
        self._usual, self._since = np.zeros((2, DECADES, 4))

    cdef bint take(self, const double* vector, bint is_usable) noexcept:
        """Process a sample [u; y]; return whether the outputs do not change as the commands say any more."""
        cdef int own = self._inputs - 1, i, k
        cdef bint is_known = self._known > self._lags
        cdef double mean = 0.0, change
        if not is_usable:
            self._known = 0
            self.begin()
            return False
        for i in range(self._width - 1, own, -1):
            self._row[i] = self._row[i - own]
        for i in range(self._inputs):
            mean += vector[i] / self._inputs
        # Stopped motors stand still.
        self._moved |= mean != self._mean
        self._mean = mean
        self._row[0] = 1.0
        for i in range(own):
            self._row[1 + i] = vector[i] - mean
        for k in range(self._outputs):
            change = vector[self._inputs + k] - self._before[k]
            self._before[k] = vector[self._inputs + k]
            self._energies[k] += is_known * change * change
            for i in range(self._width):
                self._products[i, k] += is_known * self._row[i] * change
        if not is_known:
            self._known += 1
            return False
        for i in range(self._width):
            for k in range(i + 1):
                self._squares[i, k] += self._row[i] * self._row[k]
        self._count += 1
        return self._count == self._window and self.judge()

    cdef bint judge(self) noexcept:
        """Compare the window with those before; return whether the commands have ceased to act."""
        cdef int n = self._count, width = self._width, i, j, k, decade
        cdef double[:, ::1] factor = self._squares
        cdef double ridge = 0.0, total, variance, rest, best = 0.0, changes = 0.0, mean
        cdef double* usual
        cdef bint acts
        for i in range(width):
            ridge += 1e-9 * factor[i, i]
        for i in range(width):
            # Cholesky: the lower triangle in place; forward substitution of the products.
            factor[i, i] += ridge
            for j in range(i + 1):
                total = factor[i, j]
                for k in range(j):
                    total -= factor[i, k] * factor[j, k]
                factor[i, j] = sqrt(total) if i == j else total / factor[j, j]
            for k in range(self._outputs):
                total = self._products[i, k]
                for j in range(i):
                    total -= factor[i, j] * self._products[j, k]
                self._products[i, k] = total / factor[i, i]
        for k in range(self._outputs):
            # the first parameter is the mean
            rest = self._energies[k] - self._products[0, k] * self._products[0, k]
            variance = rest / n
            changes += variance
            for i in range(1, width):
                rest -= self._products[i, k] * self._products[i, k]
            if variance > 0.0:
                best = max(best, 1.0 - rest / (n - width) / variance)
        acts, decade = best >= ACTS, <int>max(0.0, min(DECADES - 1.0, floor(log10(changes)) + 12.0))
        usual = &self._usual[decade, 0]
        self._acted += acts
        if acts or not self._moved:
            self._nats, self._not = 0.0, 0
        elif usual[3] >= ACTED:
            mean = usual[1] / usual[0]
            variance = max(CHANCE * CHANCE, usual[2] / usual[0] - mean * mean)
            self._nats += 0.5 * (log(variance) + (best - mean) ** 2 / variance - (best / CHANCE) ** 2) - log(CHANCE)
            if best >= mean or self._nats <= 0.0:
                self._nats = 0.0
            self._not = self._not + 1 if self._nats > 0.0 else 0
        if acts or self._moved:
            self._since[decade, 0] += 1.0
            self._since[decade, 1] += best
            self._since[decade, 2] += best * best
            self._since[decade, 3] += acts
        if self._nats == 0.0:
            for k in range(DECADES):
                for i in range(4):
                    self._usual[k, i] += self._since[k, i]
            self._since[:, :] = 0.0
        self.begin()
        return self._not >= ACTED_NOT and self._nats >= NATS

    cdef void forget(self) noexcept:
        """Forget the windows since there is evidence: another cause of it has ended."""
        self._nats, self._not = 0.0, 0
        self._since[:, :] = 0.0
        self.begin()

    cdef void begin(self) noexcept:
        """Begin another window."""
        self._squares[:, :] = 0.0
        self._products[:, :] = 0.0
        self._energies[:] = 0.0
        self._count, self._moved = 0, False
