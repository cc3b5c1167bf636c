# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""The rule by which one channel's evidence raises, updates and clears its alarm, row after row.

The rule itself is described in :mod:`monitor.alarms.alarm`, whose names it bears.
"""

import numpy as np

from libc.math cimport INFINITY, NAN, exp, fabs, hypot, isfinite, isnan, sqrt
from libc.stdint cimport int64_t, uint8_t

cdef double NANOSECONDS = 1e9

# The contract with subscribers: updates come at most once a second (docs/operations.md).
cdef int64_t UPDATE_EVERY_NS = 1_000_000_000

# An update reports a size that changed by this share, or by half the threshold. The estimate of a constant loss of
# thrust varies by 3 to 6 % of itself (one standard deviation, losses of 5, 10 and 20 % in gusts), so 15 % is not noise.
cdef double UPDATE_SHARE = 0.15

# The move has to be this many standard deviations, too, of the difference of two sizes that both have errors. In a
# manoeuvre the size of a constant fault is known ten times worse than before it. Chosen: sizes change within a second,
# and of 60 in a minute normal noise moves three by two deviations, one in six minutes by three.
cdef double UPDATE_SDS = 3.0

# An update also reports a size whose standard deviation is smaller by this factor than that of the size last reported:
# the first size of a sudden change comes from two samples. Chosen: a halved uncertainty is a difference for a reader.
cdef double UPDATE_SHARPER = 2.0

# Two alarms within latch_s may have two causes; with the third the alarm counts as recurring (docs/thresholds.md).
cdef int RECURRENCES = 3

# A size that leaves through zero and comes back with the other sign within this time is that of one fault: a stuck
# position that the vehicle passes, say. Chosen: a vehicle at 1 m/s takes 3 s from one threshold of 1.5 m to the other.
cdef int64_t CROSSED_NS = 4_000_000_000

# Time constants of the two means whose difference gives the slope. Chosen: the slow one as long as the slow path's mean
# (slow_s of AlarmRule), the quick one a quarter of it; the slope of a ramp is known after WAIT_S + SLOW_S = 3 s.
cdef double QUICK_S = 0.5
cdef double SLOW_S = 2.0

# Time in which an estimate approaches a sudden fault: twice the slowest time constant of the fitted motor banks (0.42
# to 0.5 s on three quadcopters).
cdef double WAIT_S = 1.0

# Longest memory of the mean of the lasting path: that of a flight (monitor.fitting.lasting).
cdef double FLIGHT_NS = 300e9

# How long an alarm of a sudden change stays active although the estimate does not show it yet: as long as the test's
# window (WINDOW_S of monitor.estimation.changes) contains its onset.
cdef int64_t UNSEEN_NS = 2_000_000_000

# Rows of explained evidence count as consecutive up to this distance: two samples of the slowest observer.
cdef int64_t EXPLAINED_APART_NS = 2_000_000_000

cpdef enum:
    NONE, RAISED, UPDATED, CLEARED, EXPLAINED


# Earlier than any time of a vehicle's clock.
cdef int64_t LONG_AGO = -(1 << 62)

cdef struct Change:
    # A sudden change of one channel: its log-likelihood ratio in nats (zero: none); its size and the standard deviation
    # of it; how much the size grows per second; the fault that may be responsible in its place, -1 for none.
    double nats, size, sd, growth
    int64_t onset_ns
    Py_ssize_t rival


cdef class Trend:
    """Slope of one channel's evidence since its alarm was raised: see :mod:`monitor.alarms.alarm`."""

    cdef double run_s, quick, slow

    def __init__(self):
        self.reset()

    cdef void reset(self) noexcept:
        self.run_s = self.quick = self.slow = 0.0

    cpdef void update(self, double evidence, int64_t elapsed_ns) noexcept:
        """Process evidence that lasted for ``elapsed_ns``."""
        cdef double elapsed_s = elapsed_ns / NANOSECONDS
        if self.run_s < WAIT_S:
            # The estimate still approaches a sudden fault.
            self.quick = self.slow = evidence
        else:
            self.quick += (1.0 - exp(-elapsed_s / QUICK_S)) * (evidence - self.quick)
            self.slow += (1.0 - exp(-elapsed_s / SLOW_S)) * (evidence - self.slow)
        self.run_s += elapsed_s

    cpdef double size_in(self, double seconds) noexcept:
        """Return the size of the evidence some seconds ahead if it goes on growing; 0 where it does not grow."""
        cdef double slope, now
        if self.run_s < WAIT_S + SLOW_S:
            return 0.0
        # On a ramp of slope s, a mean lags by s times its time constant.
        slope = (self.quick - self.slow) / (SLOW_S - QUICK_S)
        now = self.quick + slope * QUICK_S
        return fabs(now + slope * seconds) if slope * now > 0.0 else 0.0


cdef class AlarmState:
    """State of one channel's alarm.

    Attributes
    ----------
    active, critical, creeping, recurring : bool
        Whether the alarm is active, and what its events say of it.
    sudden : bool
        Whether its first size is that of a sudden change.
    frozen : bool
        Whether its sensor repeats one reading for longer than chance allows: it stays active, whatever its size.
    shown, peak, reported, size : float
        Evidence that the event of the latest row shows, the largest since the alarm was raised, that of the event
        before, and the size that raised it.
    rival : int
        The fault that may be responsible in place of this alarm's, as its latest event says; -1 for none.
    """

    cdef double threshold, clear, critical_size, raise_ns, clear_ns, fast, fast_ns, slow, slow_ns, latch_ns, ahead_s
    cdef double nats, least, lasting, lasting_ns
    cdef readonly bint active, critical, creeping, recurring, sudden, frozen
    cdef readonly double shown, peak, size, reported
    cdef readonly Py_ssize_t rival
    cdef double reported_sd, reported_command
    cdef int64_t reported_ns, counter_ns, fast_counter_ns, last_ns, ended_ns, unseen_ns
    cdef bint contiguous, fails_towards_less, explained, is_edge
    cdef int64_t explained_ns, explained_last_ns
    # The weighted mean of the slow path, the same neither limited nor divided by the scale; the mean of all evidence of
    # the lasting path, the same not divided by the scale, and the time these two cover.
    cdef double mean, mean_size, whole, whole_size, whole_ns
    cdef bint lasts
    cdef Trend trend
    cdef int64_t raised_ns[3]
    cdef int raised_count
    cdef int64_t pause_ns  # longest time without evidence between its raises, one soon after the other
    cdef bint excused_now
    cdef double allowed
    cdef int64_t[:, ::1] excused_spans

    def __init__(self):
        self.trend = Trend()
        self.active = self.contiguous = self.excused_now = self.sudden = self.explained = self.lasts = False
        self.frozen = False
        self.explained_ns = self.explained_last_ns = 0
        self.counter_ns = self.fast_counter_ns = 0
        self.raised_count = 0
        self.pause_ns = 0
        self.last_ns = self.ended_ns = LONG_AGO
        self.reported_sd = self.reported_command = NAN
        self.rival = -1
        self.forget()
        self.excused_spans = None
        self.allowed = 0.0

    def set_rule(self, rule):
        """Apply the sizes and times of an :class:`monitor.alarms.alarm.AlarmRule` from the next row on."""
        self.threshold, self.clear, self.critical_size = max(rule.threshold, rule.smallest), rule.clear, rule.critical
        self.raise_ns, self.clear_ns = rule.raise_s * NANOSECONDS, rule.clear_s * NANOSECONDS
        self.is_edge = rule.raise_s == 0.0 and rule.fast == INFINITY
        self.fast, self.fast_ns = max(rule.fast, rule.smallest), rule.fast_s * NANOSECONDS
        self.slow, self.slow_ns = max(rule.slow, rule.smallest), rule.slow_s * NANOSECONDS
        self.latch_ns, self.ahead_s = rule.latch_s * NANOSECONDS, rule.critical_ahead_s
        self.nats, self.least = rule.nats, max(rule.least, rule.smallest)
        self.lasting, self.lasting_ns = max(rule.lasting, rule.smallest), rule.lasting_s * NANOSECONDS
        # A surface may deflect by too little or too much, to either side.
        self.fails_towards_less = rule.kind == "actuator" and "deflection" not in rule.unit

    def set_excuse(self, bint now, spans):
        """Set when other alarms explain the evidence: always from now on, or in spans of vehicle time (m, 2), ns."""
        self.excused_now = now
        self.excused_spans = spans

    def allow(self, double size):
        """Set how much of the evidence another alarm's fault makes from now on: that much raises no alarm."""
        self.allowed = size

    def resume(self, double estimate, double peak, double size, double sd, int64_t reported_ns, bint critical,
               bint creeping, bint recurring):
        """Take over an active alarm from its event of another run of the monitor."""
        self.counter_ns = self.fast_counter_ns = self.unseen_ns = 0
        self.trend.reset()
        self.forget()
        if creeping:
            # The event does not say which of the two means raised the alarm: set both.
            self.mean, self.whole = limited(estimate, 2.0 * self.slow), limited(estimate, self.threshold)
            self.mean_size = self.whole_size = estimate
            self.lasts, self.whole_ns = self.lasting < INFINITY, self.lasting_ns
        self.active, self.critical, self.creeping, self.recurring = True, critical, creeping, recurring
        self.shown = self.reported = estimate
        self.peak, self.size, self.reported_ns, self.reported_sd = peak, size, reported_ns, sd
        # The event does not say how long it was quiet between its raises.
        self.pause_ns = <int64_t>self.latch_ns

    def deactivate(self):
        """Stop being active without an event, and forget the evidence so far."""
        self.active = self.contiguous = self.frozen = False
        self.ended_ns = self.last_ns
        self.counter_ns = self.fast_counter_ns = 0
        self.raised_count = 0
        self.forget()
        self.trend.reset()

    def forget_recurrences(self):
        """Count the alarm as one that comes and goes no more: its earlier raises were of no fault."""
        self.recurring, self.raised_count = False, 0

    cdef void forget(self) noexcept:
        """Forget the means."""
        self.mean = self.mean_size = self.whole = self.whole_size = self.whole_ns = 0.0

    cdef bint excused(self, int64_t now) noexcept:
        cdef Py_ssize_t i
        if self.excused_now:
            return True
        if self.excused_spans is not None:
            for i in range(self.excused_spans.shape[0]):
                if self.excused_spans[i, 0] <= now <= self.excused_spans[i, 1]:
                    return True
        return False

    cdef int step(self, int64_t now, bint restart, double evidence, bint speaking, double scale, double sd,
                  double noise, double command, Py_ssize_t rival, const Change* change, bint frozen) noexcept:
        """Process one row; return the event it causes."""
        cdef int event
        self.frozen = frozen
        event = self.event_of(now, restart, evidence, speaking, scale, sd, noise, command, rival, change)
        if event == RAISED or event == UPDATED:
            self.reported_command = command
            self.rival = change.rival if event == RAISED and self.sudden else rival
        return event

    cdef int event_of(self, int64_t now, bint restart, double evidence, bint speaking, double scale, double sd,
                      double noise, double command, Py_ssize_t rival, const Change* change) noexcept:
        cdef int64_t elapsed
        cdef int event
        if not self.active and self.is_certain(change, evidence) and not self.excused(now):
            self.last_ns, self.contiguous = now, True
            self.raise_alarm(now, change.size, self.least, False)
            self.sudden, self.reported_sd = True, change.sd
            # A growing change is visible only once it has grown.
            self.unseen_ns = UNSEEN_NS + (<int64_t>(self.ahead_s * NANOSECONDS) if change.growth != 0.0 else 0)
            return RAISED
        if self.frozen and not self.active and not self.excused(now):
            self.last_ns, self.contiguous = now, True
            self.reported_sd = sd
            return self.raise_alarm(now, evidence, self.threshold, False)
        # An excuse keeps an alarm from being raised; an active alarm follows its own evidence.
        if not speaking:
            self.contiguous = False
            return NONE
        if not self.active and (self.excused(now) or fabs(evidence) - scale * self.threshold < self.allowed != 0.0):
            self.contiguous = False
            return self.explain(now, fabs(evidence) / scale)
        self.explained, self.explained_ns = False, 0
        # After a reboot the vehicle's clock jumps back.
        elapsed = now - self.last_ns if self.contiguous and now > self.last_ns else 0
        self.last_ns, self.contiguous = now, True
        self.average(restart, evidence / scale, scale, elapsed)
        if self.active:
            return self.follow(now, evidence, scale, sd, command, rival, elapsed)
        # One sample may raise an edge, unless noise alone is larger: a gyro of a motors' observer was 17 degrees/s off,
        # give or take 770, where a simulator had stood still for a moment. (A jump moves, but that is no noise.)
        event = self.debounce(now, 0.0 if self.is_edge and fabs(evidence) < noise else evidence, scale, elapsed)
        if event == RAISED:
            self.reported_sd = sd
        if event == RAISED and not self.creeping and change.nats > 0.0 and change.onset_ns > self.ended_ns:
            # The estimate still approaches the sudden change, whose size the test knows already.
            if change.size * evidence > 0.0:
                self.shown = self.peak = self.reported = change.size
                self.critical = fabs(change.size) >= self.critical_size
                self.sudden, self.reported_sd = True, change.sd
        return event

    cdef int explain(self, int64_t now, double size) noexcept:
        """Return EXPLAINED, once, when evidence that other alarms explain would have raised this one."""
        cdef int64_t elapsed = now - self.explained_last_ns
        self.explained_last_ns = now
        elapsed = elapsed if 0 < elapsed <= EXPLAINED_APART_NS else 0
        self.explained_ns = counted(self.explained_ns, elapsed, size >= self.threshold)
        if self.explained or size < self.threshold or self.explained_ns < self.raise_ns:
            return NONE
        self.explained = True
        return EXPLAINED

    cdef bint is_certain(self, const Change* change, double evidence) noexcept:
        """Return whether a sudden change raises the alarm.

        One that began before the last alarm ended was reported with that alarm. A growing one counts with its future
        size. An actuator that delivers more than commanded has to show in the estimate, too.
        """
        cdef double size = fabs(change.size) + fabs(change.growth) * self.ahead_s
        if not (change.nats >= self.nats and size >= self.least + self.allowed and change.onset_ns > self.ended_ns):
            return False
        return change.size < 0.0 or not self.fails_towards_less or evidence >= self.clear

    cdef void average(self, bint restart, double evidence, double scale, int64_t elapsed) noexcept:
        """Update the means over slow_s, of evidence up to twice ``slow``, and of all evidence up to the threshold."""
        cdef double keep, entered
        if restart:
            # After a restart the estimate climbs back to a fault, which is no growth of the fault. A mean that keeps an
            # alarm active is kept, otherwise the fault would raise a second alarm.
            if not (self.active and self.creeping):
                self.forget()
            self.trend.reset()
            return
        if elapsed and self.slow < INFINITY:
            keep = exp(-elapsed / self.slow_ns)
            self.mean = keep * self.mean + (1.0 - keep) * limited(evidence, 2.0 * self.slow)
            self.mean_size = keep * self.mean_size + (1.0 - keep) * evidence * scale
        if elapsed and self.lasting < INFINITY:
            self.whole_ns = min(self.whole_ns + elapsed, FLIGHT_NS)
            keep, entered = 1.0 - min(1.0, elapsed / self.whole_ns), limited(evidence, self.threshold)
            self.whole = keep * self.whole + (1.0 - keep) * entered
            self.whole_size = keep * self.whole_size + (1.0 - keep) * entered * scale

    cdef int debounce(self, int64_t now, double evidence, double scale, int64_t elapsed) noexcept:
        """Raise the alarm by the fast, the plain, the slow or the lasting path, whichever comes first."""
        cdef double size = fabs(evidence) / scale
        self.counter_ns = counted(self.counter_ns, elapsed, size >= self.threshold)
        self.fast_counter_ns = counted(self.fast_counter_ns, elapsed, size >= self.fast)
        if size >= self.fast and self.fast_counter_ns >= self.fast_ns:
            return self.raise_alarm(now, evidence, scale * self.fast, False)
        if size >= self.threshold and self.counter_ns >= self.raise_ns:
            return self.raise_alarm(now, evidence, scale * self.threshold, False)
        if fabs(self.mean) >= self.slow:
            return self.raise_alarm(now, self.mean_size, scale * self.slow, True)
        if self.whole_ns >= self.lasting_ns and fabs(self.whole) >= self.lasting and self.whole != 0.0:
            self.raise_alarm(now, self.whole_size, self.whole_size / self.whole * self.lasting, True)
            self.lasts = True
            return RAISED
        return NONE

    cdef int raise_alarm(self, int64_t now, double evidence, double size, bint creeping) noexcept:
        cdef int i
        cdef int64_t quiet = now - self.ended_ns
        self.counter_ns = self.fast_counter_ns = self.unseen_ns = 0
        self.trend.reset()
        if self.raised_count and 0 <= quiet <= self.latch_ns:
            self.pause_ns = max(self.pause_ns, quiet + <int64_t>self.clear_ns)
        else:
            self.pause_ns = 0
        if not (self.raised_count and 0 <= quiet <= CROSSED_NS and evidence * self.peak < 0.0):
            if self.raised_count == RECURRENCES:
                for i in range(RECURRENCES - 1):
                    self.raised_ns[i] = self.raised_ns[i + 1]
                self.raised_count -= 1
            self.raised_ns[self.raised_count] = now
            self.raised_count += 1
        self.recurring = self.raised_count == RECURRENCES and 0 <= now - self.raised_ns[0] <= self.latch_ns
        self.active, self.creeping, self.sudden, self.lasts = True, creeping, False, False
        self.critical = fabs(evidence) >= self.critical_size
        self.size, self.shown, self.peak, self.reported, self.reported_ns = size, evidence, evidence, evidence, now
        return RAISED

    cdef int follow(self, int64_t now, double evidence, double scale, double sd, double command, Py_ssize_t rival,
                    int64_t elapsed) noexcept:
        """Update or clear an active alarm."""
        cdef double shown, ahead, moves, expected
        cdef bint worsens, due, moved, sharper, kept
        # The size of evidence that only a mean shows is the mean.
        self.creeping = self.creeping and fabs(evidence) < (scale if self.lasts else 1.0) * self.threshold
        shown = evidence
        if self.creeping:
            shown = self.whole_size if self.lasts else self.mean_size
        self.shown = shown
        self.trend.update(shown, elapsed)
        ahead = self.trend.size_in(self.ahead_s) if self.ahead_s > 0 else 0.0
        worsens = not self.critical and (fabs(shown) >= self.critical_size or ahead >= self.critical_size)
        self.critical = self.critical or worsens
        if fabs(shown) > fabs(self.peak):
            self.peak = shown
        due = not 0 <= now - self.reported_ns < UPDATE_EVERY_NS
        kept = fabs(self.whole) >= 0.5 * self.lasting if self.lasts else fabs(self.mean) >= 0.5 * self.slow
        if fabs(evidence) < self.clear and not self.frozen and not (self.creeping and kept):
            if self.unseen_ns > 0:
                self.unseen_ns -= elapsed
                return NONE
            self.counter_ns += elapsed
            # A fault that comes and goes has ended when it is away for longer than ever in between. Of n pauses of the
            # same kind the last is the longest by one chance in n, so even one that lasts raises few alarms.
            if self.counter_ns >= (min(self.latch_ns, self.pause_ns + self.clear_ns) if self.recurring
                                   else self.clear_ns):
                self.active = False
                self.ended_ns = now
                self.counter_ns = 0
                self.forget()
                return CLEARED
            if due and self.counter_ns >= self.clear_ns and fabs(self.reported) >= self.clear:
                # It may come back: until then nothing is seen of it.
                self.reported, self.reported_ns, self.reported_sd = shown, now, sd
                return UPDATED
            return NONE
        self.unseen_ns = 0
        if self.recurring:
            self.pause_ns, self.counter_ns = max(self.pause_ns, self.counter_ns), 0
        self.counter_ns = max(0, self.counter_ns - elapsed)
        # A constant share of a command that changed is no news.
        expected = self.reported
        if self.reported_command != 0.0 and isfinite(command / self.reported_command):
            expected *= command / self.reported_command
        moves = max(UPDATE_SHARE * fabs(expected), self.size / 2)
        if not isnan(sd):
            moves = max(moves, UPDATE_SDS * hypot(sd, self.reported_sd))
        moved = fabs(shown - expected) > moves
        # Any standard deviation is better than an unknown one.
        sharper = UPDATE_SHARPER * sd <= self.reported_sd or (isnan(self.reported_sd) and not isnan(sd))
        if worsens or ((moved or sharper or rival != self.rival) and due):
            if sharper and self.peak == self.reported:
                # The peak was the rough size of before.
                self.peak = shown
            self.reported, self.reported_ns, self.reported_sd = shown, now, sd
            return UPDATED
        return NONE


cdef inline double limited(double evidence, double most) noexcept:
    """Return evidence limited to ``most``; -``most`` for NaN."""
    evidence = most if most < evidence else evidence
    return evidence if evidence > -most else -most


cdef inline int64_t counted(int64_t counter_ns, int64_t elapsed, bint beyond) noexcept:
    """Return a counter of time that counts up while ``beyond``, otherwise down to zero."""
    return counter_ns + elapsed if beyond else max(0, counter_ns - elapsed)


cdef class ChainRows:
    """Evidence of one observer's alarms over n rows.

    Parameters
    ----------
    alarms : sequence of AlarmState
        The observer's alarms, in the order in which they are asked (A).
    position : int64 (n,)
        Place in the batch of the message that completed each row, ascending.
    times_ns : int64 (n,)
        Vehicle times.
    restart : bool (n,)
        Rows at which the observer started afresh.
    evidence : float64 (n, A)
        Signed sizes.
    speaking : bool (n, A)
        Where a row is evidence of a channel.
    scale : float64 (n, m), optional
        How many times its sizes evidence of each of the first m alarms has to reach; 1 where it is left out.
    changed : intp (n,), optional
        The alarm of which a sudden change is named at each row, -1 for none; with its ``nats``, ``size`` and
        ``growth`` a second, float64, and ``onset_ns``, int64 (n,), the ``change_sd`` of its size, and the fault that
        may be responsible ``instead``, -1 for none.
    sd : float64 (n, m), optional
        Standard deviation of the evidence of the first m alarms, not a number where it is not known.
    noise : float64 (n, m), optional
        The part of it that estimates have in healthy flight, without what a movement may still miss.
    command : float64 (n, m), optional
        The command of which the size of each of the first m alarms is a share, not a number where it is none.
    rival : intp (n, m), optional
        The fault that may be responsible in place of that of each of the first m alarms, -1 for none.
    frozen : bool (n, m), optional
        Where the sensor of each of the first m alarms repeats one reading for longer than chance allows.
    """

    cdef tuple alarms
    cdef const int64_t[:] position, times_ns
    cdef const uint8_t[:] restart
    cdef const double[:, :] evidence
    cdef const uint8_t[:, :] speaking
    cdef const Py_ssize_t[:] changed
    cdef const double[:, :] scale, sd, noise, command
    cdef const double[:] nats, size, growth, change_sd
    cdef const int64_t[:] onset_ns
    cdef const Py_ssize_t[:, :] rival
    cdef const Py_ssize_t[:] instead
    cdef const uint8_t[:, :] frozen

    def __init__(self, alarms, position, times_ns, restart, evidence, speaking, scale=None, changed=None, nats=None,
                 size=None, growth=None, onset_ns=None, change_sd=None, sd=None, noise=None, command=None,
                 rival=None, instead=None, frozen=None):
        self.alarms = tuple(alarms)
        self.position, self.times_ns = position, times_ns
        self.restart, self.evidence, self.speaking = restart, evidence, speaking
        self.scale, self.sd, self.noise, self.command = scale, sd, noise, command
        self.changed, self.nats, self.size, self.growth, self.onset_ns = changed, nats, size, growth, onset_ns
        self.change_sd, self.rival, self.instead, self.frozen = change_sd, rival, instead, frozen

    cdef void supersede(self, Py_ssize_t alarm) noexcept:
        """Clear the sooner the alarms of sudden changes of other channels that no estimate shows: this one is the
        cause."""
        cdef Py_ssize_t i
        for i in range(len(self.alarms)):
            if i != alarm:
                (<AlarmState>self.alarms[i]).unseen_ns = 0

    cdef bint is_frozen(self, Py_ssize_t row, Py_ssize_t alarm) noexcept:
        """Return whether the alarm's sensor is frozen; one that freezes beside another active alarm is its consequence.
        """
        cdef Py_ssize_t i
        if self.frozen is None or alarm >= self.frozen.shape[1] or not self.frozen[row, alarm]:
            return False
        for i in range(len(self.alarms)):
            if i != alarm and (<AlarmState>self.alarms[i]).active and not (<AlarmState>self.alarms[alarm]).active:
                return False
        return True

    cdef Change change_of(self, Py_ssize_t row, Py_ssize_t alarm) noexcept:
        cdef Change change = Change(0.0, 0.0, NAN, 0.0, 0, -1)
        cdef Py_ssize_t i
        cdef AlarmState other
        if self.changed is None or self.changed[row] != alarm:
            return change
        # A change that begins while another fault is active, or before it ends, belongs to that fault.
        for i in range(len(self.alarms)):
            other = <AlarmState>self.alarms[i]
            if i != alarm and (other.active or other.ended_ns >= self.onset_ns[row]):
                return change
        change = Change(
            self.nats[row], self.size[row], NAN if self.change_sd is None else self.change_sd[row], self.growth[row],
            self.onset_ns[row], -1 if self.instead is None else self.instead[row])
        return change


def nats_asked(alarms, const double[:, :] evidence, const uint8_t[:, :] speaking, const double[:, :] scale,
               const double[:] beyond, lasting):
    """Return the fewest nats with which a sudden change can matter to any alarm, by row (n,).

    These are the fewest that raise an alarm, multiplied by the square of ``beyond``; 0 where the evidence itself may
    raise one, for a sudden change then gives its size. Infinity while an alarm is active for certain: a change belongs
    to its fault then.

    Parameters
    ----------
    alarms : sequence of AlarmState
        Those of faults, in the order of the evidence's first columns.
    evidence, speaking, scale, beyond
        As :class:`Weighing` takes and returns them.
    lasting : sequence of bool
        Whether each alarm is active before the first row and can be ended by nothing but its own evidence; empty where
        that makes no difference.
    """
    cdef tuple every = tuple(alarms)
    cdef list active = list(lasting)
    cdef Py_ssize_t k, i
    cdef AlarmState alarm
    cdef double least = INFINITY
    result = np.empty(evidence.shape[0])
    cdef double[::1] asked = result
    for alarm in every:
        least = min(least, alarm.nats)
    for k in range(evidence.shape[0]):
        asked[k] = least if beyond is None else least * beyond[k] * beyond[k]
        for i in range(len(every)):
            alarm = <AlarmState>every[i]
            if speaking[k, i] and fabs(evidence[k, i]) / scale[k, i] >= min(alarm.threshold, alarm.fast):
                asked[k] = 0.0
        for i in range(len(active)):
            alarm = <AlarmState>every[i]
            if speaking[k, i] and fabs(evidence[k, i]) < alarm.clear:
                active[i] = False
        if True in active:
            asked[k] = INFINITY
    return result


cdef class Weighing:
    """Turns estimates into evidence of an observer's A alarms, with the factor (scale) by which sizes have to be
    larger.

    The first m alarms are those of faults, followed by those of residuals that no hypothesis explains.

    Parameters
    ----------
    fault_of : intp (m,)
        The fault of each of the first m alarms.
    alarms : int
        Number of alarms A.
    shown : bool (a, p)
        Outputs in which each fault shows.
    healthy : float64 (a,)
        Size that each fault's estimate reaches in health, as a share of its threshold.
    excited : intp
        Faults whose errors grow with rates and commands.
    """

    cdef const Py_ssize_t[::1] fault_of, excited
    cdef const uint8_t[:, ::1] shown
    cdef const double[::1] healthy
    cdef Py_ssize_t alarms

    def __init__(self, fault_of, alarms, shown, healthy, excited):
        self.fault_of, self.excited = np.asarray(fault_of, np.intp), np.asarray(excited, np.intp)
        self.shown, self.healthy, self.alarms = np.ascontiguousarray(shown), healthy, alarms

    def run(self, const double[:, :] isolated, const double[:] unexplained, const uint8_t[:] armed,
            const uint8_t[:, :] counted, const uint8_t[:, :] lost, const double[:] level, const double[:, :] beyond,
            const double[:, :] excitation):
        """Return evidence, speaking and scale of :class:`ChainRows`, and the scale of each fault (n, a).

        Data that no hypothesis explains (not ``counted``) are evidence neither for a fault nor against it, nor is a row
        for one whose outputs are all lost.

        Parameters
        ----------
        isolated, unexplained : float64 (n, a), (n,)
            Sizes by fault, and the score of what no hypothesis explains.
        armed, counted : bool (n,), (n, a)
            Rows that are evidence, and faults that are.
        lost : bool (n, s + p)
            Inputs, then outputs, that were not measured.
        level : float64 (n,)
            How many times that of healthy flight the residuals' mean square is.
        beyond : float64 (n, a) | None
            How many times larger sizes are outside of the fitted flights.
        excitation : float64 (n, 4) | None
            What :class:`monitor.core.excitation.Excitation` says of the rows.
        """
        cdef Py_ssize_t k, i, j, fault, count = isolated.shape[0], faults = self.fault_of.shape[0]
        cdef Py_ssize_t width = self.healthy.shape[0], outputs = self.shown.shape[1]
        cdef Py_ssize_t first = lost.shape[1] - outputs
        cdef double outside
        cdef bint hidden
        if not count == unexplained.shape[0] == armed.shape[0] == counted.shape[0] == lost.shape[0] == level.shape[0]:
            raise ValueError("isolated, unexplained, armed, counted, lost and level differ in length")
        if not isolated.shape[1] == counted.shape[1] == width or first < 0:
            raise ValueError(f"isolated and counted are not of {width} faults, or lost not of {outputs} outputs")
        results = (
            np.empty((count, self.alarms)), np.empty((count, self.alarms), np.bool_), np.empty((count, self.alarms)),
            np.empty((count, width)),
        )
        cdef double[:, ::1] evidence = results[0], scale = results[2], of_fault = results[3]
        cdef uint8_t[:, ::1] speaking = results[1]
        for k in range(count):
            for i in range(width):
                of_fault[k, i] = max(1.0, sqrt(max(1.0, level[k])) * self.healthy[i])
            # What no fault explains has errors of all of them in it.
            outside = 1.0
            if excitation is not None:
                for i in range(self.excited.shape[0]):
                    of_fault[k, self.excited[i]] = excitation[k, 2]
                outside = max(outside, excitation[k, 3])
            if beyond is not None:
                for i in range(width):
                    outside = max(outside, beyond[k, i])
                    # An edge is judged by what is flat before and after it.
                    if self.healthy[i] > 0.0:
                        of_fault[k, i] *= beyond[k, i]
            for i in range(self.alarms):
                if i >= faults:
                    evidence[k, i], speaking[k, i], scale[k, i] = unexplained[k], armed[k], outside
                    for j in range(outputs):
                        speaking[k, i] &= not lost[k, first + j]
                    continue
                fault = self.fault_of[i]
                hidden = True
                for j in range(outputs):
                    hidden = hidden and (lost[k, first + j] or not self.shown[fault, j])
                evidence[k, i], scale[k, i] = isolated[k, fault], of_fault[k, fault]
                speaking[k, i] = armed[k] and counted[k, fault] and not hidden
        return results


def walk(chains, on_event):
    """Process the evidence of all of a vehicle's observers, in the order in which messages completed the rows.

    Rows that one message completed come observer by observer. An event takes effect on all rows after it, also those
    of other observers (an alarm may excuse another channel).

    Parameters
    ----------
    chains : sequence of ChainRows
        The observers, in order.
    on_event : callable
        Called with observer, row and alarm (indices) and ``RAISED``, ``UPDATED`` or ``CLEARED`` at each event, before
        the next row is processed; with ``EXPLAINED`` where evidence would have raised an alarm that others excuse.
    """
    cdef tuple every = tuple(chains)
    cdef Py_ssize_t count = len(every), k, best, row, i
    cdef ChainRows chain
    cdef AlarmState alarm
    cdef int event
    cdef Change change
    cdef list rows = [0] * count
    while True:
        best = -1
        for k in range(count):
            chain = <ChainRows>every[k]
            row = rows[k]
            if row < chain.position.shape[0] and (
                best < 0 or chain.position[row] < (<ChainRows>every[best]).position[<Py_ssize_t>rows[best]]
            ):
                best = k
        if best < 0:
            return
        chain = <ChainRows>every[best]
        row = rows[best]
        for i in range(len(chain.alarms)):
            alarm = <AlarmState>chain.alarms[i]
            change = chain.change_of(row, i)
            event = alarm.step(
                chain.times_ns[row], chain.restart[row], chain.evidence[row, i], chain.speaking[row, i],
                chain.scale[row, i] if chain.scale is not None and i < chain.scale.shape[1] else 1.0,
                chain.sd[row, i] if chain.sd is not None and i < chain.sd.shape[1] else NAN,
                chain.noise[row, i] if chain.noise is not None and i < chain.noise.shape[1] else NAN,
                chain.command[row, i] if chain.command is not None and i < chain.command.shape[1] else NAN,
                chain.rival[row, i] if chain.rival is not None and i < chain.rival.shape[1] else -1, &change,
                chain.is_frozen(row, i))
            if event == RAISED:
                chain.supersede(i)
            if event:
                on_event(best, row, i, event)
        rows[best] = row + 1


def standing_rungs(const int64_t[:] below, Py_ssize_t rungs, Py_ssize_t samples):
    """Return, for each value, the highest of some rising thresholds at which a debounce would have passed by then.

    The debounce of a threshold counts a value at or above it up and any other down, never below zero; it passes while
    its count is at least ``samples``. Counts fall from threshold to threshold: it is their differences that are kept,
    of which a value changes two.

    Parameters
    ----------
    below : int64 (n,)
        How many of the thresholds are at or below each value.
    rungs : int
        Number of thresholds.
    samples : int
        Values that have to stand, at least 1.

    Returns
    -------
    int64 (n,)
        Index of the threshold, -1 where not even the lowest has passed.
    """
    if samples < 1:
        raise ValueError("a debounce counts to 1 at least")
    result = np.empty(below.shape[0], np.int64)
    cdef int64_t[::1] passed = result
    cdef int64_t[::1] fall = np.zeros(rungs + 1, np.int64)
    # the number of thresholds whose count is above zero; the highest that passes, and its count
    cdef Py_ssize_t counting = 0, high = -1, row, at
    cdef int64_t count = 0
    for row in range(below.shape[0]):
        at = below[row]
        if not 0 <= at <= rungs:
            raise ValueError("a value has more thresholds below it than there are")
        # one more for those at or below the value, one less for those above it that count
        if high >= 0:
            count += 1 if high < at else -1
        if at:
            fall[at - 1] += 1
        if counting > at:
            if at:
                fall[at - 1] += 1
            fall[counting - 1] -= 1
        counting = max(counting, at)
        while counting and not fall[counting - 1]:
            counting -= 1
        while high >= 0 and count < samples:
            high -= 1
            if high >= 0:
                count += fall[high]
        if high < 0:
            count = 0
            at = counting - 1
            while at >= 0 and count + fall[at] < samples:
                count += fall[at]
                at -= 1
            high = at
            count = count + fall[at] if at >= 0 else 0
        while high + 1 < counting and count - fall[high] >= samples:
            count -= fall[high]
            high += 1
        passed[row] = high
    return result
