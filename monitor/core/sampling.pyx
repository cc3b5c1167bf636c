# cython: language_level=3, boundscheck=False, wraparound=False, initializedcheck=False, cdivision=True
"""Messages of different rates -> samples (u, y) on a fixed-rate grid of the vehicle's clock.

Tick k is at t_k = k / rate_hz on the vehicle's own clock, rounded to a nanosecond, so a monitor that starts late gives
the same samples as one that ran from the start. Only the messages and their order count. The rules:

1. A measurement is (channel, stamp, value). The same channel and stamp again is a duplicate, ignored and counted:
   GPS_RAW_INT repeated with an unchanged ``time_usec`` is one measurement. Stamp 0 of a MAVLink message means that the
   sender has no time yet: it is ignored and counted, as is a missing clock field or one without a number. A channel
   whose message has no clock field gets the newest time of the vehicle; it is lost (rule 4) while other channels of its
   sampler come later than ``_UNDATED`` (as rule 3 measures it).
2. Measurements may come in any order. One older than its channel's newest is sorted in as long as its stamp is after
   the last tick given out or skipped; otherwise it is late: dropped and counted.
3. The grid starts when four measurements of every channel are there. Tick k is given out as soon as every channel has a
   measurement at or after t_k. ``linear`` channels are interpolated between the two measurements around t_k (speed and
   course over ground as one vector), ``previous`` ones keep the newest at or before it, ``mean`` ones are the mean from
   t_k to t_k+1 of the straight lines between measurements (a quick command on a slow grid), for which the next tick has
   to be waited for. So a sample comes at most one period of the slowest channel after its time, or after the next tick.
   Where a channel's measurements came out of order, and the neighbours of t_k are so far apart that one was lost, the
   tick waits until the newest measurement is later than these by the largest lateness of the last 10 to 20 s (half a
   second at most): the missing one may still come. On a link that keeps the order nothing waits.
4. A channel's nominal period is the median of its last 31 steps from stamp to stamp, or that of the grid where the grid
   is slower. Lines between measurements up to 1.75 periods apart are as good as measurements. If the neighbours of t_k
   (for ``mean``: any two whose line is used) are further apart, measurements were lost in between, and the sample is
   marked ``complete=False``; ``lines_ns`` of raw signals tells the distance. If three or more are missing the channel
   is ``lost``: its straight line is no measurement. A channel slower than every second tick is lost only in a gap; a
   mean after a whole tick; a raw signal of a transform, which is integrated, not before ``RAW_LINE_S``. An observer's
   sample with a lost channel is marked ``measured=False``: the observer coasts on its model. A channel three times as
   slow as in the fitted flights and as the grid is always lost: how the signal varies in between was never fitted. So
   is a mean with no more than one measurement a tick, if it had more in the fitted flights. Commands, rates, attitude
   and IMU of a ``restless`` vehicle that repeat to the bit are lost until they change: after five messages, a quarter
   of a second, and twice as many messages as they lately repeated. Where nothing came for longer than 10 periods and
   than ``max_gap_s`` there is a gap: its ticks are skipped and the first sample after it is marked ``restart=True``.
   This holds for each channel of an observer, and for raw signals where all of them are missing.
5. A channel that stops while others go on is waited for until the vehicle's clock is 0.5 s and 10 of its periods (three
   for a raw signal) ahead of it, and of the time at which messages came again after a silence. Then ticks are given out
   with its newest value, and the channel as lost, until rule 4 makes it a gap. Then ticks are skipped, and measurements
   for these ticks only are dropped. Memory is bounded.
6. The clock (:class:`VehicleClock`) decides which stamps to believe: a reboot empties all buffers, a single damaged
   stamp does not. A message with a doubtful stamp is held back until the next one decides about it; the stamp of a
   32-bit counter that wrapped is continued.
7. A missing or non-finite value is ignored and counted; other channels of the same message are not affected.

A batch is processed message by message; each message by every sampler in turn, and by every stream of each sampler.
Nothing looks ahead, so results do not depend on how telemetry is cut into batches.
"""

from fractions import Fraction
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from adapters.batch import RecordFields
from adapters.channels import CLOCK_UNITS_NS, COURSE, SPEED, STOPPED, field_steps
from adapters.sample import Samples

from cpython.buffer cimport PyBUF_SIMPLE, PyBUF_STRIDES, PyBUF_WRITABLE
from cpython.buffer cimport PyBuffer_Release, PyObject_GetBuffer
from cpython.mem cimport PyMem_Free, PyMem_Realloc
from libc.math cimport M_PI, NAN, atan2, cos, expm1, fabs, fmod, hypot, isfinite, rint, sin
from libc.stdlib cimport qsort
from libc.string cimport memcmp, memcpy, memmove, memset

from monitor.core.altered cimport Fixes, Pace, Response, Stands
from monitor.core.interleaved cimport Interleaved
from monitor.core.repeats cimport SENSES, Repeats

cdef extern from *:
    """
    /* Products of two times need 126 bits; GCC and Clang have such integers on every 64-bit processor. */
    typedef __int128 wide;
    """
    ctypedef long long wide

ctypedef long long nanoseconds

MAX_STAMP_NS = 1 << 62
"""Stamps and arrival times at or beyond it (the year 2116) are damaged; sums of two below it fit into 64 bits."""

# The same for C, and units.
cdef nanoseconds _MAX_STAMP = 1 << 62
cdef nanoseconds _SECOND = 1_000_000_000
cdef nanoseconds _MILLISECOND = 1_000_000
# Codes in place of a stamp: a clock field that holds none, and no clock field at all.
cdef nanoseconds _UNTIMED = -1
cdef nanoseconds _CLOCKLESS = -2

# Messages of one vehicle overtake each other by less: the longest silence of a link in 12 recorded flights is 0.11 s. A
# reboot steps back by the time since the last one, which is longer in anything that can fly already.
cdef nanoseconds _TOLERANCE = _SECOND
# A stamp with so much less delay than the least delayed ones may be another sender's: in 90 recordings the least delays
# differ from minute to minute by less than 0.1 s.
cdef nanoseconds _EARLY = 250 * _MILLISECOND
# A link holds messages back for less, and its quicker and slower ways differ by less: radios with a queue at 57,600
# baud and mobile networks by up to 3 s (docs/limits.md). An older message is of another clock.
cdef nanoseconds _HELD = 5 * _SECOND
# Largest time by which a message may be behind, in halves of the largest of the last minute. Chosen: that of one minute
# is exceeded in half of the next minutes, by more than a half of it hardly ever.
cdef int _BEHIND = 3
# Least memory of the largest time by which messages were behind: as long as that of delays.
cdef nanoseconds _REMEMBERED = 60 * _SECOND
# Duration of a contest, and the findings that begin it. Chosen: as for the flight phase (monitor/sampling/phase.py).
cdef nanoseconds _CONTEST = 10 * _SECOND
cdef int _RIVALS = 3
# The vehicle's clock is silent if it was switched off for so long; the longest silence of a radio was 2.5 s.
cdef nanoseconds _AWAY = 3 * _SECOND
# In flight another clock, which no reboot explains, is followed only after so long without the vehicle's own. Chosen:
# as long as a contest, so that its messages are never taken for the vehicle's without a contest being reported.
cdef nanoseconds _REPLACED = 10 * _SECOND
# A larger step ahead starts the clock anew. Chosen: after so long a silence no earlier estimate is of use.
cdef nanoseconds _JUMP = 10 * _SECOND
# Least delays are kept for a minute, in twelve parts. After it a clock with a skew of 200 ppm and up to 20 ms of jitter
# is mapped within half a millisecond (tests/test_monitor_sampling_clock.py). With a longer memory a changing skew is
# followed late.
cdef nanoseconds _BUCKET = 5 * _SECOND
cdef nanoseconds _BUCKETS = 12
# Quartz crystals keep 100 ppm over temperature; nothing five times as far off is a crystal.
cdef nanoseconds _LARGEST_SKEW_PPM = 500
# Least span for measuring the skew: the largest skew makes 7.5 ms over it; over less, jitter alone would look like
# skew.
cdef nanoseconds _LEAST_SPAN = 15 * _SECOND
# 32 bits of milliseconds and of microseconds.
cdef nanoseconds[2] _TURNS
_TURNS[0], _TURNS[1] = 1_000 << 32, 1_000_000 << 32

# Rule 3. The median of three steps is the period although one measurement was lost.
cdef int _FIRST_STEPS = 3
# Chosen: a changed rate moves the median after 16 steps; with a look every eighth step it is noticed at most half as
# much later, and sorting 31 steps each time would cost more than the rest of the sampling.
cdef int _RELEARN_EVERY = 8
# Rule 4, in quarters of a period. One lost measurement leaves two periods; three quarters are left for jitter: of steps
# of 10 ms in 12 recorded flights 99.9 % are within it. PX4's loop of 4 ms makes steps of 8, 12 and 16 ms at 100 Hz.
cdef nanoseconds _WHOLE_QUARTERS = 7
# Rule 5. Chosen: over four times the longest silence of 12 recorded flights. All other channels wait for so long.
cdef nanoseconds _SILENCE = 500 * _MILLISECOND
# Rule 5. A raw signal counts as stopped after more than two lost measurements; the others go on without it.
cdef nanoseconds _SILENT_PERIODS = 3
# Rules 4 and 5. Chosen: ten samples of a slow channel or grid; quick ones have max_gap_s.
cdef nanoseconds _GAP_PERIODS = 10
# Rule 3. Chosen: as long as a channel that stopped is waited for.
cdef nanoseconds _LATEST = _SILENCE
# Rule 3. The hold-back ends after one window without late measurements, at most two.
cdef nanoseconds _LATE_WINDOW = 10 * _SECOND

LINE_PERIODS = 3
"""Missing measurements from which a channel is lost and the observer coasts (rule 4): the best of 1, 2 and 3, measured
(docs/measurements.md, bench/gaps.py)."""
RAW_LINE_S = 0.1
"""Longest line of a raw signal that counts as measured (rule 4), seconds. Measured with bursts of 0.1 s on 45 flights:
of 0.06, 0.1 and 0.15 s the last raises gyro alarms in agile flight (7 times), the first loses a third of the
evidence."""
MAX_GAP_S = 1.5
"""Default of ``max_gap_s``, seconds. Chosen: as long as a fault is assumed to have grown before a restart
(:mod:`monitor.estimation.affine`), after which coasting is no better than a restart; and longer than a burst of 1 s."""

# Times beyond these are no measurements; ten times the longest period still fits into 64 bits.
cdef nanoseconds _RAW_LINE = round(1e9 * RAW_LINE_S)
# Rule 1. A time wrong by half a line's length changes a value no more than that line does. Measured on two flights
# whose controllers' speeds have no time: with jitter up to 75 ms no false alarm, with 100 ms five, with 200 ms 18.
cdef nanoseconds _UNDATED = _RAW_LINE // 2
cdef nanoseconds _LONGEST_PERIOD = 1 << 58

# Fewest commands, outputs and samples a second with which rates are compared with commands. Chosen: three body rates;
# what commands of 10 Hz are sampled at, slower ones act within one sample.
cdef int _ANSWERED = 3
cdef double _ANSWERED_HZ = 4.0

# Rule 4. Measured in flight on 21 healthy recordings of multirotors: commands in whole microseconds repeat in up to 11
# messages and 0.11 s at 100 Hz, in one or two at 1 to 10 Hz, rates and IMUs never. Forgotten after _LATE_WINDOW.
cdef int _STILL_ROWS = 5
cdef nanoseconds _STILL = 250 * _MILLISECOND

# How long a command has to be too small for flight until the vehicle no longer flies. Half of the command of hovering
# carries half of the weight at most: in the air it would sink 2.5 m/s faster by then. Of a PX4 that reported "in the
# air" for 3 to 5 s after touch-down, with a tenth of the command of hovering, the first false alarm came after 1.3 s.
cdef nanoseconds _LOW = 500 * _MILLISECOND
# A vehicle that has reported for so long that it flies is believed: without a load it hovers with less. Chosen: twice
# the longest of the slow take-offs seen (4 s).
cdef nanoseconds _LIFTED = 10 * _SECOND
# The rates of a standing vehicle are its gyros' noise: in eight touch-downs of PX4 they were 0.3 to 0.7 degrees a
# second while its controllers, which still held a position, ran the motors down within 1.5 to 2.5 s. In the air a
# vehicle hardly keeps within a degree a second for 0.5 s while its thrust falls. Samples further apart than half of
# that time are means of rates, which hide its turns.
cdef double _STANDING = 0.0175
cdef nanoseconds _STANDS = 500 * _MILLISECOND
# Share of its mean below which the command falls, and the time constant of this mean: touch-downs fall by 15 to 30 % a
# second. The step into a descent, 7 to 15 %, counts as one for a second or two where nothing moves the vehicle.
cdef double _FALLING = 0.95
cdef double _CARRIES_NS = 2e9

CAPACITY = 1 << 14
"""Most measurements that a lane keeps; a flood of one channel while another is waited for drops the older half. Chosen:
16 s at 1 kHz, and 2 MB for a lane of 15 channels."""

cdef Py_ssize_t _CAPACITY = CAPACITY

cdef enum:
    # Parts of a minute, and room for those that damaged clocks add; then the oldest point is dropped.
    _MOST_POINTS = 64
    # Odd, so that the median is one of the steps; up to 15 lost or doubled ones do not change it.
    _STEPS = 31


cdef void* _resized(void* buffer, size_t size) except NULL:
    """Return a buffer of a size with its old content; NULL: a new one."""
    cdef void* resized = PyMem_Realloc(buffer, size)
    if resized == NULL:
        raise MemoryError
    return resized


cdef inline wide _floor_div(wide dividend, wide divisor) noexcept:
    """Return the quotient rounded down; the divisor is positive."""
    cdef wide quotient = dividend / divisor
    if quotient * divisor > dividend:
        quotient -= 1
    return quotient


cdef inline nanoseconds _bounded(wide value) noexcept:
    """Return a time within 64 bits, cut at their limits."""
    cdef wide most = <wide>_MAX_STAMP + (_MAX_STAMP - 1)
    if value > most:
        return <nanoseconds>most
    if value < -most:
        return <nanoseconds>-most
    return <nanoseconds>value


cdef struct Point:
    # Stamp of a packet, and its delay: arrival minus stamp.
    nanoseconds stamp
    nanoseconds delay


cdef class VehicleClock:
    """Follows one vehicle's clock by its messages alone.

    Belief. A stamp within 1 s of the newest one is believed at once; so is one up to 5 s behind, which a link held
    back. A stamp leads if it is up to 5 s ahead both of the newest one and of its expected time (by more than 0.25 s,
    after the first 5 s). It is believed once stamps have led by as much for 0.25 s without others in between: the clock
    was set, or the link became quicker. A stamp further away is believed only if the next message has another stamp
    near it (at most 1 s before or 10 s after), so a single damaged stamp changes nothing. Then a step back of more than
    1 s is a reboot and a step ahead of more than 10 s a clock that was set: both start the clock anew and count in
    ``boot``.

    Reboots. After a reboot the clock shows at most the time since the last message. In flight no other clock is
    followed unless the vehicle's own has been silent for 10 s; then it counts as another sender's until the end of the
    flight.

    Contests. These contradict a single sender, whatever the jitter:
    - a message leads, those after it are behind it by more than any in the last minute, and their stamps pass it (after
      a link became quicker nothing newer comes by its slow way); twice in 10 s;
    - stamps of another clock go on with time while near stamps of the same channel come in between, for longer than a
      link holds messages back;
    - in flight the vehicle's time stands still while messages come, for a second and one and a half times the largest
      time by which a message was behind in the last minute.
    Three such findings within 10 s are a contest, which lasts until none came for 10 s. Meanwhile no other clock is
    believed unless this one has been silent for 3 s on the ground.

    Mapping. Arrival minus stamp is the offset of the clocks, which drifts with the crystals' skew, plus a delay that is
    never negative. The least delayed packet of each 5 s of vehicle time is kept, for 60 s. Of the lines below all of
    these points, the one with the least sum of distances to them belongs to packets without a delay and gives offset
    and skew (S. Moon, P. Skelly, D. Towsley, "Estimation and Removal of Clock Skew from Network Delay Measurements",
    INFOCOM 1999). It is the edge of the points' lower convex hull below the mean of their stamps. Where the points span
    less than 15 s, or the edge is steeper than any crystal (500 ppm: simulated time that runs fast, a clock that was
    just set), the least delay alone counts. A single arrival time that would lower the offset by more than 0.25 s is
    not believed.

    Attributes
    ----------
    boot : int
        How often the clock started anew.
    newest_ns : int
        Newest believed vehicle time, nanoseconds; 0 before the first.
    running : bool
        Whether a stamp was believed since the clock started (anew).
    contested_ns : int
        Unix time until which the clock is contested; 0: it never was.
    rival_ns : int
        By how much the other sender's stamps were ahead when the contest began.
    flies : bool
        Whether the vehicle says that it is in flight: then its clock is not set and the vehicle not replaced.
    found : dict[tuple[str, str], int]
        Until which Unix time a message, by its name, is taken to be another sender's, and by what: ``turns`` (values of
        two senders), ``before`` (sent before, value by value), ``still`` (outputs beside others), ``pace`` (of stamps,
        compared with that before), ``fixes`` (of stamps, compared with time), ``response`` (commands beside rates).
    pace : float
        How fast stamps went on when they were last found to have another pace.
    repeated_ns : int
        Since when the message that was last found to repeat earlier values does so, Unix time.
    """

    cdef readonly int boot
    cdef readonly nanoseconds newest_ns
    cdef readonly bint running
    cdef readonly nanoseconds contested_ns, rival_ns
    cdef public bint flies
    cdef readonly dict found
    cdef readonly double pace
    cdef readonly nanoseconds repeated_ns
    cdef bint _has_candidate, _has_doubtful
    # The newest stamp of another clock and its arrival; since when such stamps go on; the number of findings and the
    # first one's time; whether near ones came after it, and of the next one's channel; the last arrivals of a near and
    # of a newer one.
    cdef Point _rival
    cdef bint _has_rival, _interleaved, _shared, _began, _replaced
    # Whether the clock was followed for 5 s since it started (anew).
    cdef bint _followed
    cdef int _rivals
    cdef nanoseconds _rival_since, _rivals_since, _found_received, _near_received, _newer_received
    cdef nanoseconds _candidate
    cdef Point _doubtful
    # The last stamp that led and its arrival; since when stamps lead; the first one that others came behind, and their
    # number.
    cdef Point _leader, _passed
    cdef bint _led
    cdef nanoseconds _led_since
    cdef int _overtaken
    # Largest time behind the newest stamp: since that stamp, in this minute, in the one before; the end of this minute.
    cdef nanoseconds _standing, _behind, _behind_before, _minute_end
    cdef Point[_MOST_POINTS] _points
    cdef int _count
    # The line: through a point, rise / run its slope.
    cdef Point _anchor
    cdef nanoseconds _rise, _run

    def __cinit__(self):
        self._run = 1
        self.found = {}

    def near(self, stamp_ns):
        """Return whether a stamp is so close to the newest one that it is believed at once."""
        return 0 <= stamp_ns < MAX_STAMP_NS and self._near(stamp_ns)

    def unwrap(self, stamp_ns):
        """Return the stamp of a 32-bit counter with the full turns added that bring it near the newest stamp.

        ``time_boot_ms`` turns over after 49.7 days, the 32-bit ``time_usec`` of SERVO_OUTPUT_RAW after 71.6
        minutes, while other clocks of the vehicle go on. A stamp no whole number of turns away is left as it
        is.
        """
        return self._unwrap(stamp_ns) if 0 <= stamp_ns < MAX_STAMP_NS else stamp_ns

    def observe(self, stamp_ns, received_ns):
        """Process a measurement's stamp and its time of arrival; return whether the stamp is believed."""
        if not 0 <= stamp_ns < MAX_STAMP_NS:
            return False
        return self._observe(stamp_ns, max(-MAX_STAMP_NS, min(received_ns, MAX_STAMP_NS)))

    def to_unix(self, vehicle_ns):
        """Return the Unix time of a vehicle time, nanoseconds."""
        return self._to_unix(vehicle_ns)

    @property
    def skew(self):
        """The rate of Unix time over that of the vehicle's clock, minus 1: 1e-4 is 100 ppm."""
        return <double>self._rise / <double>self._run

    cdef inline bint _near(self, nanoseconds stamp) noexcept:
        return not self.running or -_TOLERANCE <= stamp - self.newest_ns <= _TOLERANCE

    cdef nanoseconds _unwrap(self, nanoseconds stamp) noexcept:
        cdef nanoseconds turn, unwrapped
        cdef int i
        for i in range(2):
            turn = _TURNS[i]
            unwrapped = stamp + <nanoseconds>rint(<double>(self.newest_ns - stamp) / <double>turn) * turn
            if stamp < turn and self.running and self._near(unwrapped):
                return unwrapped
        return stamp

    cdef bint _observe(self, nanoseconds stamp, nanoseconds received) noexcept:
        cdef nanoseconds behind = self.newest_ns - stamp
        cdef bint was_held = self._count and _TOLERANCE < behind <= _HELD
        cdef Point point
        self._followed |= self._count > 1
        if self._replaced:
            self._replaced = self.flies
            if self._replaced:
                self._contest(_RIVALS, self.rival_ns, received)
        if self._near(stamp) or (was_held and not self._rebooted(stamp, received)):
            if self._leads(stamp, received):
                return False
            self._interleaved = True
            self._stand(behind, received)
        elif self._count > 1 and -_HELD <= behind < 0 and self._leads(stamp, received):
            return False
        else:
            if self._is_rival(stamp, received) or not self._confirmed(stamp):
                return False
            if not -_TOLERANCE <= stamp - self.newest_ns <= _JUMP:
                self._replaced |= self._is_foreign(stamp, received)
                self.boot += 1
                self.running = False
                self._count = self._overtaken = 0
                self._behind = self._behind_before = self._standing = 0
                self._has_doubtful = self._led = self._followed = False
                # If the clock from before goes on, there are two senders.
                self._rival.stamp, self._rival.delay = self.newest_ns, self._near_received - self.newest_ns
                self._rival_since = received - _HELD
        self._has_candidate = False
        self._near_received = received
        if stamp > self.newest_ns or not self.running:
            self.newest_ns = stamp
            self.running = True
            self._newer_received = received
            self._behind, self._standing = max(self._behind, self._standing), 0
        point.stamp = stamp
        point.delay = received - stamp
        self._learn(point)
        return True

    cdef inline bint _rebooted(self, nanoseconds stamp, nanoseconds received) noexcept:
        """Return whether a vehicle that rebooted after its last message may have sent a stamp."""
        cdef nanoseconds silence = received - self._near_received
        return stamp <= silence + (_HELD if silence >= _TOLERANCE else _TOLERANCE)

    cdef bint _is_foreign(self, nanoseconds stamp, nanoseconds received) noexcept:
        """Return whether only a vehicle that does not fly could have sent a stamp far from the newest one."""
        if not self.flies or not self._followed or self._rebooted(stamp, received):
            return False
        return stamp < self.newest_ns or self._delay_at(stamp) - (<wide>received - stamp) > _HELD

    cdef void _stand(self, nanoseconds behind, nanoseconds received) noexcept:
        """Process by how much a message is behind the newest one; find that the vehicle's time stands still."""
        cdef nanoseconds stood = received - self._newer_received
        if received >= self._minute_end or self._minute_end - received > _REMEMBERED:
            self._behind_before, self._behind, self._minute_end = self._behind, 0, received + _REMEMBERED
        # A message is also behind later ones; if no later one comes, the vehicle's time stands still.
        self._standing = max(self._standing, behind)
        if self.flies and self._followed and behind > _EARLY:
            if stood > _TOLERANCE + _BEHIND * self._usually_behind() // 2:
                self._contest(1, behind, received)

    cdef inline nanoseconds _usually_behind(self) noexcept:
        return max(self._behind, self._behind_before)

    cdef bint _leads(self, nanoseconds stamp, nanoseconds received) noexcept:
        """Process a stamp; return whether it leads, where none has done so for long."""
        cdef nanoseconds delay = received - stamp, ahead = stamp - self.newest_ns
        cdef wide apart = <wide>delay - self._leader.delay
        # Messages held up before the link was opened come at once, and the least delay is not known before 5 s.
        if self._count < 2 or ahead <= _EARLY or self._delay_at(stamp) - delay <= _EARLY:
            if self._led and received > self._leader.stamp + self._leader.delay:
                self._led = False
                self._overtake(self._leader, stamp, received)
            if self._overtaken >= _RIVALS - 1 and stamp > self._passed.stamp:
                self._contest(_RIVALS, self._leader.stamp - self.newest_ns, received)
            return False
        if not self._led or not -_EARLY <= apart <= _EARLY:
            self._led, self._led_since = True, received
        self._leader.stamp, self._leader.delay = stamp, delay
        self._led = received - self._led_since < _EARLY
        return self._led

    cdef void _overtake(self, Point leader, nanoseconds stamp, nanoseconds received) noexcept:
        """Process a stamp that came after one that led."""
        if leader.stamp - stamp <= min(_EARLY // 2 + _BEHIND * self._usually_behind() // 2, _HELD):
            return
        if not 0 <= received - self._passed.stamp - self._passed.delay < _CONTEST:
            self._overtaken, self._passed = 0, leader
        self._overtaken += 1

    cdef bint _is_rival(self, nanoseconds stamp, nanoseconds received) noexcept:
        """Process a stamp far from the newest one; return whether it is a rival's while the clock is contested."""
        cdef wide apart = <wide>received - stamp - self._rival.delay
        cdef nanoseconds gone = received - self._rival.delay - self._rival.stamp
        cdef wide early = self._delay_at(stamp) - (<wide>received - stamp)
        cdef bint goes_on = self._has_rival and 0 <= gone <= _CONTEST and -_TOLERANCE <= apart <= _TOLERANCE
        cdef bint foreign
        if self._count and -_HELD <= early <= _EARLY:
            # The vehicle's own, after a silence of the link.
            return False
        if not goes_on:
            self._rival_since = received
        foreign = self._is_foreign(stamp, received)
        if self._has_rival and not (self._rival.stamp == stamp and gone == 0):
            if foreign and received - self._newer_received > _TOLERANCE:
                self._contest(1, _bounded(early), received)
            elif goes_on and self._interleaved and self._shared and (
                not -_HELD <= early <= _HELD or received - self._rival_since > early
            ):
                self._contest(1, stamp - self.newest_ns, received)
            self._interleaved = False
        self._has_rival = True
        self._rival.stamp, self._rival.delay = stamp, received - stamp
        if foreign:
            return received - max(self._rival_since, self._near_received) < _REPLACED
        return received < self.contested_ns and received - self._near_received < _AWAY

    cdef void _contest(self, int count, nanoseconds ahead, nanoseconds received) noexcept:
        """Count a message that only another sender can have sent as ``count`` findings; one arrival time counts
        once."""
        if received == self._found_received:
            return
        self._found_received = received
        if not 0 <= received - self._rivals_since < _CONTEST:
            self._rivals, self._rivals_since = 0, received
        self._rivals += count
        if self._rivals >= _RIVALS or received < self.contested_ns:
            if received >= self.contested_ns:
                self._began, self.rival_ns = True, ahead
            self.contested_ns = received + _CONTEST

    cdef bint register(self, name, str what, nanoseconds received) except -1:
        """Register by what a message shows another sender; return whether it did not so before."""
        cdef bint begins = received >= self.found.get((name, what), 0)
        self._began |= begins
        self.found[name, what] = received + _CONTEST
        return begins

    cdef int withdraw(self, name, str what, nanoseconds received) except -1:
        """End what was registered of a message, as it was found not to be so any more."""
        self._began = True
        self.found[name, what] = received
        return 0

    cdef bint _confirmed(self, nanoseconds stamp) noexcept:
        """Return whether the candidate before, which was far from the newest stamp too, is near this one."""
        cdef nanoseconds before = self._candidate
        cdef bint had = self._has_candidate
        if had and before == stamp:
            return False
        self._candidate = stamp
        self._has_candidate = True
        return had and -_TOLERANCE <= stamp - before <= _JUMP

    cdef inline wide _delay_at(self, nanoseconds stamp) noexcept:
        """Return the delay of the line at a vehicle time, rounded down."""
        if not self._rise:
            return self._anchor.delay
        return self._anchor.delay + _floor_div(<wide>(stamp - self._anchor.stamp) * self._rise, self._run)

    cdef inline nanoseconds _to_unix(self, nanoseconds stamp) noexcept:
        return _bounded(stamp + self._delay_at(stamp))

    cdef void _learn(self, Point point) noexcept:
        """Keep the delay of a message with a believed stamp if it is the least of its 5 s."""
        cdef wide early = self._delay_at(point.stamp) - point.delay
        cdef wide apart
        cdef Point before
        cdef nanoseconds bucket
        cdef int old
        if self._count and early > _EARLY:
            before = self._doubtful
            apart = <wide>before.delay - point.delay
            had = self._has_doubtful
            self._doubtful = point
            self._has_doubtful = True
            if not had or before.stamp == point.stamp or apart > _EARLY or apart < -_EARLY:
                return
            self._count = 0
        self._has_doubtful = False
        bucket = point.stamp // _BUCKET
        if not self._count or bucket > self._points[self._count - 1].stamp // _BUCKET:
            old = 1 if self._count == _MOST_POINTS else 0
            while old < self._count and self._points[old].stamp // _BUCKET <= bucket - _BUCKETS:
                old += 1
            self._count -= old
            memmove(self._points, self._points + old, self._count * sizeof(Point))
            self._points[self._count] = point
            self._count += 1
        elif early > self._delay_at(self._points[self._count - 1].stamp) - self._points[self._count - 1].delay:
            self._points[self._count - 1] = point
        else:
            return
        self._draw_line()

    cdef void _draw_line(self) noexcept:
        """Draw the line below the points; horizontal where they do not tell the skew."""
        cdef Point[_MOST_POINTS] hull
        cdef Point least, left, right
        cdef wide total = 0, rise
        cdef int size = 0, i
        # The lower convex hull of points in order of time (Andrew's monotone chain).
        for i in range(self._count):
            while size > 1 and not _turns_up(hull[size - 2], hull[size - 1], self._points[i]):
                size -= 1
            hull[size] = self._points[i]
            size += 1
            total += self._points[i].stamp
        least = hull[0]
        for i in range(1, size):
            if hull[i].delay < least.delay:
                least = hull[i]
        self._anchor, self._rise, self._run = least, 0, 1
        if hull[size - 1].stamp - hull[0].stamp < _LEAST_SPAN:
            return
        # The edge below the mean of the stamps has the least sum of distances to the points above it.
        i = 1
        while i < size - 1 and <wide>hull[i].stamp * self._count < total:
            i += 1
        left, right = hull[i - 1], hull[i]
        rise = <wide>right.delay - left.delay
        if (rise if rise >= 0 else -rise) * 1_000_000 <= <wide>_LARGEST_SKEW_PPM * (right.stamp - left.stamp):
            self._anchor, self._rise, self._run = right, <nanoseconds>rise, right.stamp - left.stamp


cdef inline bint _turns_up(Point first, Point middle, Point last) noexcept:
    """Return whether the middle point lies below the line from the first to the last."""
    return (<wide>middle.delay - first.delay) * (last.stamp - middle.stamp) < (
        <wide>last.delay - middle.delay) * (middle.stamp - first.stamp)


cdef class Grid:
    """Ticks t_k = k / rate_hz, rounded to a nanosecond.

    Parameters
    ----------
    rate_hz : float
        Ticks per second, as a fraction with a denominator of at most a million.
    """

    cdef wide _numerator, _denominator

    def __init__(self, rate_hz):
        period = 1_000_000_000 / Fraction(rate_hz).limit_denominator(1_000_000)
        self._numerator, self._denominator = <nanoseconds>period.numerator, <nanoseconds>period.denominator

    cpdef nanoseconds time_ns(self, nanoseconds index) noexcept:
        """Return the time of a tick."""
        return _bounded(_floor_div(2 * index * self._numerator + self._denominator, 2 * self._denominator))

    cpdef nanoseconds index_at(self, nanoseconds time_ns) noexcept:
        """Return the first tick at or after a time."""
        cdef nanoseconds index = <nanoseconds>-_floor_div(-time_ns * self._denominator, self._numerator)
        return index - 1 if self.time_ns(index - 1) >= time_ns else index


cdef int _compare(const void* a, const void* b) noexcept nogil:
    cdef nanoseconds first = (<const nanoseconds*>a)[0], second = (<const nanoseconds*>b)[0]
    return (first > second) - (first < second)


cdef nanoseconds _median(nanoseconds* steps, Py_ssize_t count) noexcept:
    """Sort the steps and return the middle one, of an even number the smaller of the two."""
    qsort(steps, count, sizeof(nanoseconds), _compare)
    return steps[(count - 1) // 2]


cdef enum Kind:
    _LINEAR
    # Speed and course, which are interpolated as one vector.
    _SPEED
    _COURSE
    _PREVIOUS
    _MEAN


cdef struct Column:
    # A channel of a lane: its index in a row of its stream, and in [u; y].
    int source
    int place
    Kind kind
    double period


cdef enum Number:
    _NO_NUMBER
    _SIGNED
    _UNSIGNED
    _FLOATING


# By NumPy's kind of number.
_NUMBERS = {"i": _SIGNED, "u": _UNSIGNED, "f": _FLOATING}


cdef struct Field:
    # Where a record has a number; _NO_NUMBER: it has none.
    Py_ssize_t offset, size
    Number number


cdef struct Scaling:
    # What turns a number into a channel's value.
    double scale, offset, stopped_as, largest
    bint stops


cdef struct View:
    Py_buffer buffer
    const char* start
    Py_ssize_t stride
    Py_ssize_t size
    Number number


cdef class Lane:
    """Measurements of channels that came together: one stamp and one row of values each, in order of time.

    The lane keeps the newest 31 steps between stamps of dropped measurements, and limits that follow from their median,
    in nanoseconds:

    loss
        Distance of neighbours beyond which measurements are missing between them.
    line
        Distance of neighbours beyond which the straight line between them is no measurement.
    gap
        Distance of neighbours beyond which nothing is interpolated.
    silence
        How long a lane that stopped is waited for.

    Beyond the period ``seldom`` the channels are always lost (0: never). ``hold`` is how far the newest measurement has
    to be ahead of a tick where one around it may be missing.
    """

    cdef Column* columns
    cdef int width
    # Whether any channel is a mean until the next tick; whether their message has no clock field; whether they repeat.
    cdef bint averages, undated, still
    cdef nanoseconds max_gap, tick, seldom, line_periods
    cdef bint raw
    # Measurements start <= i < start + count of buffers with room for `room`.
    cdef nanoseconds* _stamps
    cdef double* _rows
    cdef Py_ssize_t start, count, room
    cdef nanoseconds[_STEPS] steps
    cdef int newest_step
    cdef nanoseconds learned
    cdef nanoseconds loss, line, gap, silence
    # The largest lateness of this window and of the one before, and the end of this one.
    cdef nanoseconds hold, latest, latest_before, window_end

    def __cinit__(self, int width, nanoseconds max_gap, nanoseconds tick, bint raw):
        self.width, self.max_gap, self.tick, self.raw, self.line_periods = width, max_gap, tick, raw, LINE_PERIODS
        self.columns = <Column*>_resized(NULL, width * sizeof(Column))
        self.set_limits(0)

    def __dealloc__(self):
        PyMem_Free(self.columns)
        PyMem_Free(self._stamps)
        PyMem_Free(self._rows)

    cdef inline nanoseconds* stamps(self) noexcept:
        return self._stamps + self.start

    cdef inline double* row(self, Py_ssize_t i) noexcept:
        return self._rows + (self.start + i) * self.width

    cdef inline nanoseconds newest(self) noexcept:
        return self._stamps[self.start + self.count - 1]

    cdef void set_limits(self, nanoseconds period) noexcept:
        """Set the limits that follow from a period."""
        cdef nanoseconds spacing
        period = min(period, _LONGEST_PERIOD)
        spacing = max(period, self.tick)
        self.gap = max(self.max_gap, _GAP_PERIODS * spacing)
        # A mean takes every measurement, however slow the grid is.
        spacing = period if self.averages else spacing
        self.loss = _WHOLE_QUARTERS * spacing // 4
        self.line = self.loss + (self.line_periods - 1) * spacing
        if self.averages:
            self.line = max(self.line, self.tick)
        elif self.raw:
            self.line = max(self.line, _RAW_LINE)
        elif 2 * period >= 5 * self.tick:
            self.line = self.gap
        if self.seldom and period > self.seldom:
            self.line = -1
        self.silence = max(_SILENCE, (_SILENT_PERIODS if self.raw else _GAP_PERIODS) * period)

    cdef void arrive_late(self, nanoseconds by, nanoseconds now) noexcept:
        """Process the lateness of a measurement that came after a newer one of the lane."""
        if by <= _LATEST:
            self.turn_window(now)
            self.latest = max(self.latest, by)
            self.hold = max(self.latest, self.latest_before)

    cdef void turn_window(self, nanoseconds now) noexcept:
        """Begin another window if this one is over."""
        if now >= self.window_end:
            self.latest_before = self.latest if now < self.window_end + _LATE_WINDOW else 0
            self.latest, self.window_end = 0, now + _LATE_WINDOW
            self.hold = self.latest_before

    cdef bint is_whole(self, nanoseconds due, nanoseconds until) noexcept:
        """Return whether no measurement around a time may be missing; the newest is after that time."""
        cdef nanoseconds* stamps = self.stamps()
        cdef nanoseconds newest = self.newest()
        cdef Py_ssize_t i = self.count - 1
        while i > 0 and stamps[i - 1] >= until:
            i -= 1
        if stamps[i] == until and due == until:
            return True
        while i > 0 and stamps[i] > due:
            if stamps[i] - stamps[i - 1] > self.loss and newest < stamps[i] + self.hold:
                return False
            i -= 1
        return True

    cdef inline bint ready(self) noexcept:
        """Return whether there are enough measurements to know their period."""
        return self.learned + self.count > _FIRST_STEPS

    cdef int settle(self) except -1:
        """Set the limits by all measurements so far."""
        cdef Py_ssize_t known = min(self.learned, <nanoseconds>_STEPS), count = known + self.count - 1, i
        cdef nanoseconds* steps = <nanoseconds*>_resized(NULL, count * sizeof(nanoseconds))
        memcpy(steps, self.steps, known * sizeof(nanoseconds))
        for i in range(self.count - 1):
            steps[known + i] = self.stamps()[i + 1] - self.stamps()[i]
        self.set_limits(_median(steps, count))
        PyMem_Free(steps)
        return 0

    cdef void clear(self) noexcept:
        """Forget everything."""
        self.start = self.count = self.learned = self.newest_step = 0
        self.hold = self.latest = self.latest_before = self.window_end = 0
        self.set_limits(0)

    cdef inline void drop(self, Py_ssize_t count) noexcept:
        """Drop the oldest measurements."""
        self.start += count
        self.count -= count

    cdef int insert(self, Py_ssize_t at, nanoseconds stamp, const double* values) except -1:
        """Insert a measurement at an index; ``values`` is a row of its stream."""
        cdef int i
        cdef double* row
        if self.start + self.count == self.room:
            if self.start > self.room // 2:
                memmove(self._stamps, self.stamps(), self.count * sizeof(nanoseconds))
                memmove(self._rows, self.row(0), self.count * self.width * sizeof(double))
                self.start = 0
            else:
                self.grow(2 * self.room if self.room else 16)
        if at < self.count:
            memmove(self.stamps() + at + 1, self.stamps() + at, (self.count - at) * sizeof(nanoseconds))
            memmove(self.row(at + 1), self.row(at), (self.count - at) * self.width * sizeof(double))
        self.stamps()[at] = stamp
        row = self.row(at)
        for i in range(self.width):
            row[i] = values[self.columns[i].source]
        self.count += 1
        return 0

    cdef int grow(self, Py_ssize_t room) except -1:
        """Make room for ``room`` measurements."""
        self._stamps = <nanoseconds*>_resized(self._stamps, room * sizeof(nanoseconds))
        self._rows = <double*>_resized(self._rows, room * self.width * sizeof(double))
        self.room = room
        return 0

    cdef void pass_to(self, nanoseconds time) noexcept:
        """Drop measurements before the newest one at or before a time, and keep their steps."""
        cdef nanoseconds* stamps = self.stamps()
        cdef nanoseconds[_STEPS] steps
        cdef Py_ssize_t count = 0
        while count + 1 < self.count and stamps[count + 1] <= time:
            self.steps[self.newest_step] = stamps[count + 1] - stamps[count]
            self.newest_step = (self.newest_step + 1) % _STEPS
            count += 1
        self.learned += count
        self.drop(count)
        if self.learned >= _STEPS and self.learned % _RELEARN_EVERY < count:
            memcpy(steps, self.steps, sizeof(steps))
            self.set_limits(_median(steps, _STEPS))

    cdef void interpolate(self, double fraction, double* vector) noexcept:
        """Write the values between the two oldest measurements into [u; y]."""
        cdef double* left = self.row(0)
        cdef double* right = self.row(1)
        cdef Column* column
        cdef double angle, along, across
        cdef int i, speed = -1, course = -1
        for i in range(self.width):
            column = self.columns + i
            if column.kind < _PREVIOUS:
                vector[column.place] = left[i] + _turned(left[i], right[i], column.period) * fraction
            elif column.kind == _PREVIOUS:
                vector[column.place] = left[i]
            if column.kind == _SPEED:
                speed = i
            elif column.kind == _COURSE:
                course = i
        if speed < 0 or course < 0:
            return
        # The line between two velocities, along and across the first one.
        column = self.columns + course
        angle = 2.0 * M_PI / column.period * _turned(left[course], right[course], column.period)
        along = (1.0 - fraction) * left[speed] + fraction * right[speed] * cos(angle)
        across = fraction * right[speed] * sin(angle)
        vector[self.columns[speed].place] = hypot(along, across)
        vector[column.place] = left[course] + column.period / (2.0 * M_PI) * atan2(across, along)

    cdef void copy(self, double* vector) noexcept:
        """Write the values of the oldest measurement into [u; y]."""
        cdef int i
        for i in range(self.width):
            if self.columns[i].kind != _MEAN:
                vector[self.columns[i].place] = self.row(0)[i]

    cdef nanoseconds longest_step(self, nanoseconds until, nanoseconds* after_gap) noexcept:
        """Return the longest step from the oldest measurement to the first at or after a time.

        ``after_gap`` becomes the measurement after the last gap, if there is any.
        """
        cdef nanoseconds* stamps = self.stamps()
        cdef nanoseconds longest = 0
        cdef Py_ssize_t i = 0
        while i + 1 < self.count and stamps[i] < until:
            i += 1
            longest = max(longest, stamps[i] - stamps[i - 1])
            if stamps[i] - stamps[i - 1] > self.gap:
                after_gap[0] = stamps[i]
        return longest

    cdef void average(self, nanoseconds due, nanoseconds until, double* vector) noexcept:
        """Write the means of the lines over a time, and of the newest value after them, into [u; y]."""
        cdef nanoseconds* stamps = self.stamps()
        cdef nanoseconds first, last
        cdef Column* column
        cdef double total, value, step, width
        cdef Py_ssize_t k
        cdef int i
        for i in range(self.width):
            column = self.columns + i
            if column.kind != _MEAN:
                continue
            # Sums of differences from the oldest value: exact for a constant, and an angle may leave its range.
            total, value, k = 0.0, 0.0, 0
            while k + 1 < self.count and stamps[k] < until:
                width = <double>(stamps[k + 1] - stamps[k])
                step = _turned(self.row(k)[i], self.row(k + 1)[i], column.period)
                first, last = max(due, stamps[k]), min(until, stamps[k + 1])
                total += <double>(last - first) * (
                    value + step * (0.5 * (<double>(first - stamps[k]) + <double>(last - stamps[k])) / width)
                )
                value += step
                k += 1
            if stamps[k] < until:
                total += <double>(until - max(due, stamps[k])) * value
            vector[column.place] = self.row(0)[i] + total / <double>(until - due)

    cdef Lane part(self, const double* values, bint missing):
        """Return a lane with the same past, of the columns whose value is present in a stream's row, or missing."""
        cdef int width = 0, i
        cdef Py_ssize_t k
        cdef Lane part
        for i in range(self.width):
            width += (values[self.columns[i].source] != values[self.columns[i].source]) == missing
        part = Lane.__new__(Lane, width, self.max_gap, self.tick, self.raw)
        part.averages, part.undated, part.seldom, part.still = self.averages, self.undated, self.seldom, self.still
        if self.count:
            part.grow(self.count + 1)
        width = 0
        for i in range(self.width):
            if (values[self.columns[i].source] != values[self.columns[i].source]) == missing:
                part.columns[width] = self.columns[i]
                for k in range(self.count):
                    part._rows[k * part.width + width] = self.row(k)[i]
                width += 1
        if self.count:
            memcpy(part._stamps, self.stamps(), self.count * sizeof(nanoseconds))
        part.count = self.count
        memcpy(part.steps, self.steps, sizeof(self.steps))
        part.newest_step, part.learned = self.newest_step, self.learned
        part.loss, part.line, part.gap, part.silence = self.loss, self.line, self.gap, self.silence
        part.hold, part.latest, part.latest_before = self.hold, self.latest, self.latest_before
        part.window_end = self.window_end
        return part


cdef inline double _modulo(double value, double period) noexcept:
    """Return the remainder in [0, period)."""
    cdef double remainder = fmod(value, period)
    return remainder + period if remainder < 0.0 else remainder


cdef inline double _turned(double start, double end, double period) noexcept:
    """Return the step from a value to the next, of one that wraps (a period above zero) the shorter way round."""
    return end - start if period == 0.0 else _modulo(end - start + 0.5 * period, period) - 0.5 * period


cdef class Stream:
    """Channels that share message, selection and clock.

    They start in one lane; a message that holds only some of them splits it.
    """

    cdef object channel
    cdef list channels, lanes
    cdef Interleaved senders
    cdef Repeats before
    cdef Pace pace
    cdef Fixes fixes
    cdef Stands stands
    cdef int width
    cdef Scaling* scalings
    # Paths of the fields read: one for each channel; those that select messages, with the values asked; clocks, with
    # their units.
    cdef list paths, equal, least, units
    # Where records of these places have them.
    cdef object places
    cdef Field* found
    # Unix time at which a stamp of it was last believed.
    cdef nanoseconds agreed
    # For values that never repeat for long: the newest ones; since when, and for how many messages, they have repeated;
    # the largest number of repetitions of late.
    cdef bint restless
    cdef double* newest
    cdef nanoseconds changed, compared
    cdef int stills
    cdef double usual_stills

    def __init__(self, group, nanoseconds max_gap, nanoseconds tick, bint raw, nanoseconds fitted, bint restless,
                 bint commands):
        """Begin with ``group``, pairs of index in [u; y] and channel; ``fitted`` is their period in fitted flights."""
        cdef Lane lane = Lane.__new__(Lane, len(group), max_gap, tick, raw)
        cdef Column* column
        cdef int i
        self.channels = [channel for _, channel in group]
        self.channel = self.channels[0]
        self.width = len(group)
        for i, (place, channel) in enumerate(group):
            column = lane.columns + i
            column.source, column.place = i, place
            column.kind, column.period = _LINEAR, channel.period or 0.0
            if channel.interpolation == "mean":
                column.kind = _MEAN
                lane.averages = True
            elif channel.interpolation == "previous":
                column.kind = _PREVIOUS
            elif channel.name == COURSE and channel.period:
                column.kind = _COURSE
            elif channel.name == SPEED:
                column.kind = _SPEED
        if fitted and lane.averages:
            # Between one and two measurements a tick.
            lane.seldom = max(LINE_PERIODS * fitted, 3 * tick // 4)
        elif fitted:
            lane.seldom = LINE_PERIODS * max(fitted, tick)
        self.lanes = [lane]
        self.senders = Interleaved([channel.period or 0.0 for channel in self.channels])
        noisy = len(group) >= SENSES or (restless and not commands)
        self.before = Repeats(len(group)) if noisy else None
        stopped = [NAN if channel.stopped_as is None else channel.stopped_as for channel in self.channels]
        self.pace, self.stands = Pace(), Stands(stopped) if commands else None
        channel = self.channel
        self.fixes = Fixes() if channel.message == "GPS_RAW_INT" else None
        self.restless, self.newest = restless, <double*>_resized(NULL, self.width * sizeof(double))
        self.equal = [value for _, value in channel.where]
        self.least = [least for _, least in channel.at_least]
        clocks = dict(_clocks(channel))
        self.units = list(clocks.values())
        self.paths = [channel.path for channel in self.channels]
        self.paths += [*((name,) for name, _ in (*channel.where, *channel.at_least)), *clocks]
        self.scalings = <Scaling*>_resized(NULL, self.width * sizeof(Scaling))
        self.found = <Field*>_resized(NULL, len(self.paths) * sizeof(Field))
        for i, channel in enumerate(self.channels):
            stops = channel.stopped_as is not None
            self.scalings[i] = Scaling(
                channel.scale, channel.offset, channel.stopped_as if stops else 0.0, channel.largest, stops)

    def __dealloc__(self):
        PyMem_Free(self.scalings)
        PyMem_Free(self.found)
        PyMem_Free(self.newest)

    cdef bint compare(self, nanoseconds stamp, const double* row) noexcept:
        """Count for how long values repeat; return whether a time ends for which they were lost for long."""
        cdef nanoseconds stood = stamp - self.changed
        cdef Lane lane
        cdef bint was = False, still
        if not self.restless or 0 <= self.compared - stamp < _HELD:
            return False
        self.compared = stamp
        still = memcmp(row, self.newest, self.width * sizeof(double)) == 0
        if still:
            self.stills += 1
            still = self.stills >= _STILL_ROWS and stood >= _STILL and self.stills > 2.0 * self.usual_stills
        else:
            self.usual_stills = max(self.stills, self.usual_stills * max(0.0, 1.0 - <double>stood / _LATE_WINDOW))
            self.stills, self.changed = 0, stamp
            memcpy(self.newest, row, self.width * sizeof(double))
        for lane in self.lanes:
            was |= lane.still
            lane.still = still
        return was and not still and stood > (<Lane>self.lanes[0]).max_gap

    cdef int find(self, places) except -1:
        """Find the fields in records of these places."""
        cdef Py_ssize_t i
        if places is not self.places:
            for i in range(len(self.paths)):
                self.found[i] = _field(places, self.paths[i])
            self.places = places
        return 0

    cdef bint open(self, Py_ssize_t which, fields, const Py_buffer* record, View* view, Py_ssize_t count) except -1:
        """Open the numbers at a path, one of each message, for reading; return whether there are any to be released.

        They are in ``record``, whose places were found; NULL: in columns of their own.
        """
        if record == NULL:
            return _open_column(_leaf(fields, self.paths[which]), view, count)
        memset(&view.buffer, 0, sizeof(Py_buffer))
        view.start = <const char*>record.buf + self.found[which].offset
        view.stride, view.size = record.strides[0], self.found[which].size
        view.number = self.found[which].number
        return view.number != _NO_NUMBER

    cdef bint knows(self, nanoseconds stamp) noexcept:
        """Return whether all channels have a newest measurement of this time."""
        cdef Lane lane
        for lane in self.lanes:
            if not lane.count or lane.newest() != stamp:
                return False
        return True


cdef struct Tick:
    nanoseconds index
    nanoseconds vehicle
    nanoseconds unix_time
    nanoseconds known
    nanoseconds position
    bint restart
    bint complete
    bint measured


cdef class SamplerCore:
    """Turns the messages of one vehicle into samples, by :func:`sample_batch`.

    Parameters
    ----------
    inputs, outputs : Sequence[Channel]
        Channels of u and of y, in the order of the plant model.
    rate_hz : float
        Samples per second of the vehicle's clock.
    clock : VehicleClock
        The vehicle's clock; several samplers may share it.
    max_gap_s : float
        Longest time without measurements that is no gap, seconds (at least 10 periods of the channel in any case).
    fitted_hz : Mapping[str, float]
        Rates of messages in the fitted flights, by name, where they matter.
    restless : bool
        Whether commands and rates of this kind of vehicle never repeat for long in flight.
    idles : bool
        Whether its commands may do so all the same, as wings carry it at times.

    Attributes
    ----------
    interests : frozenset[str]
        Names of the messages the channels come from; others are ignored.
    clock : VehicleClock
        The vehicle's clock.
    waiting : int
        Number of measurements that wait in the fullest lane.

    Raises
    ------
    ValueError
        There is no channel, or the rate is not positive.
    """

    cdef readonly object interests
    cdef readonly VehicleClock clock
    cdef Grid _grid
    cdef dict _streams
    cdef list _lanes
    cdef Lane _waiting
    cdef int _boot, _inputs, _size
    # Whether the channels are the raw signals of a transform.
    cdef bint _raw
    # The message that is held back because of its stamp.
    cdef Stream _held
    cdef nanoseconds _held_stamp
    cdef double* _held_row
    # The next tick and its time; the last tick given out or skipped; the last one given out and its Unix time.
    cdef bint _started, _restarting, _has_unix
    cdef nanoseconds _next_tick, _due, _until, _last_tick, _unix_tick, _unix
    # Newest time of the vehicle at the message before; time at which messages came again after a silence.
    cdef nanoseconds _newest, _resumed
    cdef nanoseconds _messages, _duplicates, _late, _invalid, _untimed, _doubted
    cdef nanoseconds _clock_restarts, _samples, _incomplete, _restarts, _skipped
    # The samples of the batch.
    cdef Tick* _ticks
    cdef double* _vectors
    cdef char* _lost
    cdef nanoseconds* _lines
    cdef Py_ssize_t _count, _room
    cdef nanoseconds _position
    cdef object _none
    # Whether rates follow commands, which message has these, and whether they were found not to.
    cdef Response _response
    cdef object _commands
    cdef bint _unanswered
    # Number of windows in which they did, when they were last found not to; -1: they follow. When they were first.
    cdef int _acted
    cdef nanoseconds _found_unanswered

    def __init__(self, inputs, outputs, rate_hz, VehicleClock clock not None, max_gap_s=MAX_GAP_S,
                 fitted_hz=MappingProxyType({}), bint restless=False, bint idles=False):
        cdef int widest
        channels = (*inputs, *outputs)
        if not channels or not 0 < rate_hz <= 1_000_000_000:
            raise ValueError("a sampler needs a channel and a positive rate")
        self.clock = clock
        self._boot = clock.boot
        self._inputs, self._size = len(inputs), len(channels)
        self._raw = not outputs
        self._grid = Grid(rate_hz)
        groups = {}
        for place, channel in enumerate(channels):
            key = channel.message, channel.where, channel.at_least, channel.clock, channel.clock_unit_ns
            groups.setdefault(key, []).append((place, channel))
        self._streams, self._lanes = {}, []
        for (name, *_), group in groups.items():
            fitted = round(1e9 / fitted_hz[name]) if name in fitted_hz else 0
            # Fixes, heights and fields do repeat.
            turns = any([channel.period for _, channel in group]) and not group[0][1].at_least
            moves = restless and (turns or len(group) >= (SENSES if self._raw else 3))
            commands = not self._raw and group[0][0] < self._inputs
            moves = moves and not (idles and commands)
            stream = Stream(
                group, round(max_gap_s * 1e9), round(1e9 / rate_hz), self._raw, fitted, moves, moves and commands)
            self._streams.setdefault(name, []).append(stream)
            if moves and commands and min(len(inputs), len(outputs)) >= _ANSWERED and rate_hz >= _ANSWERED_HZ:
                self._response, self._commands = Response(len(inputs), len(outputs), rate_hz), name
        for streams in self._streams.values():
            for stream in streams:
                self._lanes.extend((<Stream>stream).lanes)
        self.interests = frozenset(self._streams)
        widest = max(map(len, groups.values()))
        self._held_row = <double*>_resized(NULL, widest * sizeof(double))
        self._last_tick = self._due = self._acted = -1
        self._restarting = True

    def __dealloc__(self):
        PyMem_Free(self._held_row)
        PyMem_Free(self._ticks)
        PyMem_Free(self._vectors)
        PyMem_Free(self._lost)
        PyMem_Free(self._lines)

    @property
    def seldom(self):
        """Return the names of the messages that come too seldom compared with the fitted flights."""
        return tuple([
            name
            for name, streams in self._streams.items()
            if any([(<Lane>lane).line < 0 for stream in streams for lane in (<Stream>stream).lanes])
        ])

    @property
    def still(self):
        """Return the names of the messages whose values repeat, and the vehicle times of their last change, ns."""
        return {
            name: (<Stream>stream).changed
            for name, streams in self._streams.items()
            for stream in streams
            if any([(<Lane>lane).still for lane in (<Stream>stream).lanes])
        }

    def restart(self):
        """Mark the next sample as the first after a break."""
        self._restarting = True

    def counts(self):
        """Return what was counted so far, by name."""
        return {
            "messages": self._messages,
            "duplicates": self._duplicates,
            "late": self._late,
            "invalid": self._invalid,
            "untimed": self._untimed,
            "doubted": self._doubted,
            "clock_restarts": self._clock_restarts,
            "samples": self._samples,
            "incomplete": self._incomplete,
            "restarts": self._restarts,
            "skipped": self._skipped,
        }

    @property
    def waiting(self):
        """Number of measurements that wait in the fullest lane."""
        return max([(<Lane>lane).count for lane in self._lanes])

    cdef int feed(
        self, Stream stream, nanoseconds stamp, nanoseconds received, const double* row, bint zero_is_unset
    ) except -1:
        """Process one message of a stream: its stamp or a code, and its values, NaN where there is none."""
        cdef VehicleClock clock = self.clock
        cdef bint clockless = stamp == _CLOCKLESS
        cdef Lane lane
        self._messages += 1
        if stream.before is not None and stream.before.take(received, row):
            clock.register(stream.channel.message, "before", received)
            clock.repeated_ns = stream.before.since
        elif stream.before is not None and stream.before.ends(received):
            clock.withdraw(stream.channel.message, "before", received)
            if self._acted >= 0 and self._found_unanswered >= stream.before.since:
                # The rates that did not follow were the recording's.
                clock.withdraw(self._commands, "response", received)
                self._response.forget()
                self._acted = -1
        if clockless and stream.channel.clock is None and clock.newest_ns > 0:
            stamp = clock.newest_ns
            for lane in stream.lanes:
                lane.undated = True
        if stamp < 0 or (stamp == 0 and zero_is_unset):
            self._untimed += 1
            return 0
        if stamp < clock.newest_ns - _SECOND:
            stamp = clock._unwrap(stamp)
        if stream.knows(stamp):
            for lane in stream.lanes:
                self._duplicates += lane.width
            if not clockless and stream.senders.take(stamp, received, row):
                clock.register(stream.channel.message, "turns", received)
        elif clockless or self.believe(stream, stamp, received, row):
            self.follow_clock()
            if stream.compare(stamp, row):
                # Nothing between frozen values and these is known: no line joins them.
                self.skip_to(stamp)
                self._restarting = True
            if not clockless and stream.senders.take(stamp, received, row):
                clock.register(stream.channel.message, "turns", received)
            if not clockless and stream.pace.take(stamp, received):
                if clock.register(stream.channel.message, "pace", received):
                    clock.pace = stream.pace.ratio
            if not clockless and stream.fixes is not None and stream.fixes.take(stamp, received):
                if clock.register(stream.channel.message, "fixes", received):
                    clock.pace = stream.fixes.pace
            if stream.stands is not None and stream.stands.take(stamp, row, clock.flies):
                clock.register(stream.channel.message, "still", received)
            self.store(stream, stamp, row)
            self.give_out()
            if self._unanswered:
                if clock.register(self._commands, "response", received):
                    self._found_unanswered = received
                self._unanswered, self._acted = False, self._response._acted
            elif 0 <= self._acted < self._response._acted:
                clock.withdraw(self._commands, "response", received)
                self._acted = -1
        return 0

    cdef void follow_clock(self) noexcept:
        """Find when messages came again after a silence too long for lines of the quickest channel."""
        cdef nanoseconds now = self.clock.newest_ns, shortest = _MAX_STAMP
        cdef Lane lane
        if now > self._newest:
            if self._started and now - self._newest > _RAW_LINE:
                for lane in self._lanes:
                    shortest = min(shortest, lane.line)
                if now - self._newest > shortest:
                    self._resumed = now
            self._newest = now

    cdef int believe(self, Stream stream, nanoseconds stamp, nanoseconds received, const double* row) except -1:
        """Return whether the stamp is believed; if not, hold the message back; if so, store the one held before."""
        cdef VehicleClock clock = self.clock
        cdef Stream held = self._held
        cdef bint agrees = held is not None and not clock._near(stamp)
        clock._shared = stream.agreed and received - stream.agreed <= _CONTEST
        if not clock._observe(stamp, received):
            self._doubted += held is not None
            self._held, self._held_stamp = stream, stamp
            memcpy(self._held_row, row, stream.width * sizeof(double))
            return False
        stream.agreed = received
        if clock.boot != self._boot:
            self.start_anew()
        if held is not None:
            self._held = None
            if agrees or (clock._near(self._held_stamp) and self._held_stamp - clock.newest_ns <= _EARLY):
                self.store(held, self._held_stamp, self._held_row)
            else:
                self._doubted += 1
        return True

    cdef void start_anew(self) noexcept:
        """Forget everything before the restart of the vehicle's clock."""
        cdef Lane lane
        self._boot = self.clock.boot
        self._clock_restarts += 1
        for lane in self._lanes:
            lane.clear()
        for streams in self._streams.values():
            for stream in streams:
                (<Stream>stream).senders.clear()
                (<Stream>stream).pace = Pace()
                if (<Stream>stream).fixes is not None:
                    (<Stream>stream).fixes = Fixes()
        self._waiting = None
        self._newest = self._resumed = 0
        self._started = self._has_unix = False
        self._last_tick = self._due = self._acted = -1
        self._restarting = True

    cdef int store(self, Stream stream, nanoseconds stamp, const double* row) except -1:
        """Store a message's values in the lanes of its stream."""
        cdef Lane lane, absent
        cdef Py_ssize_t at = 0
        cdef int missing, i
        while at < len(stream.lanes):
            lane = <Lane>stream.lanes[at]
            at += 1
            if lane.count and lane.newest() == stamp:
                self._duplicates += lane.width
                continue
            missing = 0
            for i in range(lane.width):
                missing += row[lane.columns[i].source] != row[lane.columns[i].source]
            self._invalid += missing
            if missing == lane.width:
                continue
            if missing:
                # Separate the channels that are in the message from the others.
                present, absent = lane.part(row, False), lane.part(row, True)
                for lanes in (stream.lanes, self._lanes):
                    place = lanes.index(lane)
                    lanes[place : place + 1] = [present, absent]
                if self._waiting is lane:
                    self._waiting = None
                lane = present
                at += 1
            self.insert(lane, stamp, row)
        return 0

    cdef int insert(self, Lane lane, nanoseconds stamp, const double* row) except -1:
        """Sort a measurement into a lane unless it is known or late."""
        cdef Py_ssize_t low, high, middle
        if not lane.count or stamp > lane.newest():
            lane.insert(lane.count, stamp, row)
            if lane.count > _CAPACITY:
                lane.drop(_CAPACITY // 2)
            return 0
        low, high = 0, lane.count
        while low < high:
            middle = (low + high) // 2
            if lane.stamps()[middle] < stamp:
                low = middle + 1
            else:
                high = middle
        if lane.stamps()[low] == stamp:
            self._duplicates += lane.width
            return 0
        lane.arrive_late(lane.newest() - stamp, self.clock.newest_ns)
        if stamp <= self._last_tick or lane.count >= _CAPACITY:
            self._late += lane.width
        else:
            lane.insert(low, stamp, row)
        return 0

    cdef int give_out(self) except -1:
        """Give out all ticks for which every lane has its measurements."""
        cdef Lane lane, waiting
        cdef nanoseconds first
        while True:
            waiting = self.find_waiting()
            if waiting is not None:
                self.give_up(waiting)
                return 0
            if self._started:
                self.tick()
                continue
            first = 0
            for lane in self._lanes:
                lane.settle()
                first = max(first, lane.stamps()[0])
            self._started = True
            self.go_to(self._grid.index_at(first))

    cdef Lane find_waiting(self):
        """Return a lane without a measurement for the next tick; before the first tick, one that is not ready."""
        cdef Lane lane
        if not self._started:
            for lane in self._lanes:
                if not lane.ready():
                    return lane
            return None
        if self._waiting is None or not self.may_come(self._waiting):
            self._waiting = None
            for lane in self._lanes:
                if self.may_come(lane):
                    self._waiting = lane
                    break
        return self._waiting

    cdef inline bint may_come(self, Lane lane) noexcept:
        """Return whether the next tick has to wait for a lane."""
        cdef nanoseconds newest = lane.newest(), needed = self.needed(lane), now = self.clock.newest_ns
        if lane.hold:
            lane.turn_window(now)
        if newest >= needed and (not lane.hold or lane.is_whole(self._due, needed)):
            return False
        if now < needed or now - max(newest, self._resumed) <= lane.silence:
            return True
        return newest < self._due - lane.gap and not self._raw

    cdef void go_to(self, nanoseconds index) noexcept:
        self._next_tick = index
        self._due, self._until = self._grid.time_ns(index), self._grid.time_ns(index + 1)

    cdef inline nanoseconds needed(self, Lane lane) noexcept:
        """Return the time at or after which the next tick needs a measurement of a lane."""
        return self._until if lane.averages else self._due

    cdef int tick(self) except -1:
        """Give out the next tick, or skip the ticks of the gap that contains it."""
        cdef nanoseconds due = self._due, left, right, width, after_gap, latest = 0
        cdef Tick* tick
        cdef double* vector
        cdef char* lost
        cdef nanoseconds* lines
        cdef Lane lane
        cdef Py_ssize_t room
        cdef bint absent, bridged, known
        cdef int i
        if self._count == self._room:
            room = 2 * self._room if self._room else 8
            self._ticks = <Tick*>_resized(self._ticks, room * sizeof(Tick))
            self._vectors = <double*>_resized(self._vectors, room * self._size * sizeof(double))
            self._lost = <char*>_resized(self._lost, room * self._size)
            self._lines = <nanoseconds*>_resized(self._lines, room * self._size * sizeof(nanoseconds))
            self._room = room
        tick, vector = self._ticks + self._count, self._vectors + self._count * self._size
        lost, lines = self._lost + self._count * self._size, self._lines + self._count * self._size
        tick.complete = tick.measured = True
        tick.known = due
        for lane in self._lanes:
            latest = max(latest, lane.hold)
        for lane in self._lanes:
            if lane.count > 1 and lane.stamps()[1] <= due:
                lane.pass_to(due)
            left = lane.stamps()[0]
            if left > due:
                self.skip_to(left)
                return 0
            absent = lane.newest() < self.needed(lane)
            width = 0
            if lane.averages:
                width = lane.longest_step(self._until, &after_gap)
                if width > lane.gap and self.is_gap(&after_gap):
                    self.skip_to(after_gap)
                    return 0
                tick.known = max(tick.known, self._until)
                lane.average(due, self._until, vector)
            if left == due or lane.count == 1:
                lane.copy(vector)
            else:
                after_gap = right = lane.stamps()[1]
                width = max(width, right - left)
                if right - left > lane.gap and self.is_gap(&after_gap):
                    self.skip_to(after_gap)
                    return 0
                tick.known = max(tick.known, right)
                lane.interpolate(<double>(due - left) / <double>(right - left), vector)
            tick.complete &= width <= lane.loss and not absent
            bridged = absent or lane.still or width > lane.line or (lane.undated and latest > _UNDATED)
            tick.measured &= not bridged
            for i in range(lane.width):
                lost[lane.columns[i].place] = bridged
                lines[lane.columns[i].place] = max(width, due - left) if absent or width > lane.loss else 0
        tick.index, tick.vehicle, tick.position = self._next_tick, due, self._position
        tick.unix_time = self.to_unix(due)
        tick.restart = self._restarting
        if self._response is not None:
            known = self.clock.flies and tick.complete and tick.measured and not tick.restart
            self._unanswered |= self._response.take(vector, known)
        self._count += 1
        self._samples += 1
        self._restarts += tick.restart
        self._incomplete += not tick.complete
        self._restarting = False
        self._last_tick = due
        self.go_to(self._next_tick + 1)
        return 0

    cdef bint is_gap(self, nanoseconds* after) noexcept:
        """Return whether a lane's gap is one of the samples; ``after``, the end of the gap, may become later.

        Raw signals have a gap where all of them are missing: a transform goes on with those that are there.
        """
        cdef Lane other
        if not self._raw:
            return True
        for other in self._lanes:
            if other.count > 1 and other.stamps()[1] <= self._due:
                other.pass_to(self._due)
            if other.count > 1:
                if other.stamps()[1] - other.stamps()[0] <= other.gap:
                    return False
                after[0] = max(after[0], other.stamps()[1])
        return True

    cdef void skip_to(self, nanoseconds time) noexcept:
        """Skip the ticks before a time."""
        cdef nanoseconds index
        if not self._started:
            return
        index = self._grid.index_at(time)
        if index > self._next_tick:
            self._skipped += index - self._next_tick
            self._last_tick = self._grid.time_ns(index - 1)
            self._restarting = True
            self.go_to(index)

    cdef void give_up(self, Lane lane) noexcept:
        """Drop measurements that have waited too long for a lane that stopped."""
        cdef nanoseconds horizon = self.clock.newest_ns - lane.silence
        cdef Lane other
        if lane.count and max(lane.newest(), self._resumed) >= horizon:
            return
        self.skip_to(horizon)
        for other in self._lanes:
            if other.count > 1 and other.stamps()[1] <= horizon:
                other.pass_to(horizon)

    cdef nanoseconds to_unix(self, nanoseconds tick) noexcept:
        """Return a tick's Unix time, which goes on while the clock's offset is being corrected."""
        cdef nanoseconds unix_time = self.clock._to_unix(tick)
        cdef wide least
        if self._has_unix:
            least = <wide>self._unix + (tick - self._unix_tick) // 2
            if unix_time < least < <wide>unix_time + _SECOND:
                unix_time = <nanoseconds>least
        self._has_unix = True
        self._unix_tick, self._unix = tick, unix_time
        return unix_time

    cdef object collect(self):
        """Return the samples of the batch, and the position of the message that completed each."""
        cdef Py_ssize_t count = self._count, k
        cdef nanoseconds* times
        cdef char* flags
        cdef double* u
        cdef double* y
        cdef Tick* tick
        cdef int outputs = self._size - self._inputs
        if not count and self._none is not None:
            return self._none
        whole, marks = np.empty((5, count), np.int64), np.empty((3, count), np.bool_)
        lost = np.empty((count, self._size), np.bool_)
        inputs, measured = np.empty((count, self._inputs)), np.empty((count, outputs))
        times, flags = <nanoseconds*>_data(whole), <char*>_data(marks)
        u, y = <double*>_data(inputs), <double*>_data(measured)
        for k in range(count):
            tick = self._ticks + k
            times[k] = tick.index
            times[count + k] = tick.vehicle
            times[2 * count + k] = tick.unix_time
            times[3 * count + k] = tick.known
            times[4 * count + k] = tick.position
            flags[k], flags[count + k], flags[2 * count + k] = tick.restart, tick.complete, tick.measured
            memcpy(u + k * self._inputs, self._vectors + k * self._size, self._inputs * sizeof(double))
            memcpy(y + k * outputs, self._vectors + k * self._size + self._inputs, outputs * sizeof(double))
        lines = np.empty((count, self._size), np.int64) if self._raw else None
        samples = Samples(
            whole[0], whole[1], whole[2], inputs, measured, marks[0], marks[1], whole[3], marks[2], lost, lines
        )
        memcpy(<char*>_data(lost), self._lost, count * self._size)
        if lines is not None:
            memcpy(<nanoseconds*>_data(lines), self._lines, count * self._size * sizeof(nanoseconds))
        self._count = 0
        collected = samples, whole[4]
        if not count:
            # Most batches of a live link complete no sample of a slow observer.
            self._none = collected
        return collected


cdef class Settling:
    """Decides which samples are evidence: those for which a condition has held for a while.

    Parameters
    ----------
    settle_s : float
        Time for which it has to hold first, seconds of vehicle time; it begins anew at a restart.

    Attributes
    ----------
    idle : int
        The last row of the latest run whose mean input was too small; -1 where none was.
    commanded : bool
        Whether the mean input was large enough in the last row, where a least one was given.
    """

    cdef double _settle_ns
    cdef bint _holds
    cdef readonly Py_ssize_t idle
    cdef readonly bint commanded
    cdef nanoseconds _since

    def __init__(self, double settle_s):
        self._settle_ns = settle_s * 1e9

    def run(self, samples, bint allowed, least_command, const unsigned char[:] flies):
        """Return which samples are evidence (n,): ``allowed``, measured, with a mean input of ``least_command`` or
        more, and where ``flies`` (n,) is given, true there.

        A sample all of whose outputs are lost is no evidence either.
        """
        cdef const nanoseconds[:] times = samples.vehicle_time_ns
        cdef const unsigned char[:] restart = samples.restart, measured = samples.measured
        cdef const unsigned char[:, :] lost = samples.lost
        cdef const double[:, :] u
        cdef bint by_command = least_command is not None
        cdef double least = least_command if by_command else 0.0
        cdef Py_ssize_t row, i, outputs_from = samples.u.shape[1]
        cdef bint holds, present
        admitted = np.empty(times.shape[0], np.bool_)
        cdef unsigned char[::1] flags = admitted
        if by_command:
            u = samples.u
        self.idle = -1
        for row in range(times.shape[0]):
            holds = allowed and (flies is None or flies[row])
            if by_command:
                self.commanded = _mean(u, row) >= least
                if not self.commanded:
                    holds, self.idle = False, row
            if holds and (restart[row] or not self._holds):
                self._since = times[row]
            self._holds = holds
            flags[row] = holds and measured[row] and times[row] - self._since >= self._settle_ns
            if flags[row] and lost.shape[1] > outputs_from:
                present = False
                for i in range(outputs_from, lost.shape[1]):
                    present |= not lost[row, i]
                flags[row] = present
        return admitted


cdef class Lifting:
    """Follows by the mean command whether a vehicle that reports that it flies has lifted off, and not come down since.

    A vehicle that stands has not lifted off, and one whose command falls while it stands has touched down: no motor
    turns a vehicle that the ground holds.

    Parameters
    ----------
    airborne, hovering : float
        Mean command from which it may fly, and that of what lifts off.

    Attributes
    ----------
    waits : int
        The last row of the latest run before it lifted off; -1 where there was none.
    down, fell : bool
        Whether it came down by its command and has not lifted off since; whether it came down in the latest run.
    """

    cdef double _airborne, _hovering
    cdef bint _lifted
    cdef double _carries  # mean command of the last seconds
    # vehicle times of the last sample, and since which it stands still; -1: None
    cdef nanoseconds _last, _still
    # vehicle times since which it reports that it flies, and since which its command is too small for flight; -1: None
    cdef nanoseconds _reported, _low
    cdef readonly Py_ssize_t waits
    cdef readonly bint down, fell

    def __init__(self, double airborne, double hovering):
        self._airborne, self._hovering = airborne, hovering
        self.waits = -1
        self.forget()

    def forget(self):
        """Begin anew."""
        self._lifted = self.down = False
        self._reported = self._low = self._still = -1

    def run(self, samples, bint landed):
        """Return which samples are from after it lifted off, and not of a touch-down (n,).

        A vehicle that came down by its command is ``landed`` if it is at about the height of its home, or if its own
        log says so, which nobody alters: it then waits for its next take-off, however long its landing detector takes
        (14 s in a flight of PX4).
        """
        cdef const nanoseconds[:] times = samples.vehicle_time_ns
        cdef const double[:, :] u = samples.u, y = samples.y
        cdef Py_ssize_t row, i
        cdef double command
        cdef bint still, stands
        found = np.empty(times.shape[0], np.bool_)
        cdef unsigned char[::1] flies = found
        self.waits, self.fell = -1, False
        for row in range(times.shape[0]):
            command = _mean(u, row)
            if self._reported < 0:
                self._reported = times[row]
            still = y.shape[1] > 0
            for i in range(y.shape[1]):
                still &= fabs(y[row, i]) <= _STANDING
            if not still:
                self._still = -1
            elif self._still < 0 or times[row] - self._last > _STANDS // 2:
                self._still = times[row]
            stands = landed and still and times[row] - self._still >= _STANDS
            if not self._lifted:
                self._carries = command if command == command else self._hovering
                self._lifted = (command >= self._hovering and not stands) or (
                    not command < self._airborne and times[row] - self._reported >= _LIFTED)
                self.down = self.down and not self._lifted
                if not self._lifted and (landed or not self.down):
                    self.waits = row
            elif not command < self._airborne:
                self._low = -1
            elif self._low < 0:
                self._low = times[row]
            elif times[row] - self._low >= _LOW:
                self._lifted, self._reported, self._low = False, times[row], -1
                self.down = self.fell = True
            if command == command and times[row] > self._last:
                self._carries += (command - self._carries) * -expm1((self._last - times[row]) / _CARRIES_NS)
            self._last = times[row]
            flies[row] = self._lifted and not (stands and command < _FALLING * self._carries)
        return found


cdef double _mean(const double[:, :] values, Py_ssize_t row) noexcept:
    cdef double total = 0.0
    cdef Py_ssize_t i
    for i in range(values.shape[1]):
        total = total + values[row, i]
    return total / values.shape[1]


cdef void* _data(array) except NULL:
    """Return the address of a new array's numbers."""
    cdef Py_buffer view
    PyObject_GetBuffer(array, &view, PyBUF_SIMPLE | PyBUF_WRITABLE)
    cdef void* data = view.buf
    PyBuffer_Release(&view)
    return data


class Taken(NamedTuple):
    """The result of a batch of messages.

    Parameters
    ----------
    samples : tuple[Samples, ...]
        The samples of each sampler, in the order of the samplers.
    position : tuple[NDArray[np.int64], ...]
        For each sampler, the index in the batch of the message that completed each sample (n,).
    newest_ns : NDArray[np.int64]
        Newest time on the vehicle's clock after each message (batch.count,).
    used : int
        Messages processed: fewer than there are where a contest of the clock began with the last of them.
    """

    samples: tuple
    position: tuple
    newest_ns: object
    used: int


def sample_batch(VehicleClock clock not None, samplers, batch, bint stops=False):
    """Process the messages of a batch; return the samples that they complete.

    The whole batch is processed, unless ``stops`` and a contest of the vehicle's clock begins: then up to that message.

    Parameters
    ----------
    clock : VehicleClock
        The vehicle's clock.
    samplers : Sequence[SamplerCore]
        Samplers that share this clock; each message goes to them in this order.
    batch : Batch
        Messages of one vehicle, in the order of arrival. Those in which no sampler is interested are skipped.
    """
    cdef Py_ssize_t count = batch.count, place, used = batch.count
    cdef SamplerCore sampler
    cdef _Messages group
    cdef list groups = [], feeds
    cdef dict singles = {}
    cdef int[::1] owners
    cdef nanoseconds[::1] newest
    for columns in batch.columns:
        feeds = _interested(samplers, columns.name)
        if feeds:
            groups.append(_of_columns(columns, feeds))
    for place in sorted(batch.others):
        message = batch.others[place]
        singles.setdefault(message.name, []).append((place, message))
    for name, members in singles.items():
        feeds = _interested(samplers, name)
        if feeds:
            groups.append(_of_messages(members, feeds))
    newest_ns, owner = np.empty(count, np.int64), np.empty(count, np.intc)
    newest, owners = newest_ns, owner
    for place in range(count):
        owners[place] = -1
    for number, group in enumerate(groups):
        for place in range(group.count):
            if not 0 <= group.position[place] < count:
                raise IndexError("a message lies outside of its batch")
            owners[group.position[place]] = number
    clock._began = False
    for place in range(count):
        if owners[place] >= 0:
            group = <_Messages>groups[owners[place]]
            group.feed_next(place)
        newest[place] = clock.newest_ns
        if stops and clock._began:
            used = place + 1
            break
    collected = [(<SamplerCore?>sampler).collect() for sampler in samplers]
    return Taken(tuple([pair[0] for pair in collected]), tuple([pair[1] for pair in collected]), newest_ns, used)


cdef list _interested(samplers, name):
    """Return the streams that take messages of a name, with their samplers, in their order."""
    cdef SamplerCore sampler
    return [(sampler, stream) for sampler in samplers for stream in sampler._streams.get(name, ())]


cdef class _Feed:
    """The messages of one name and sender as one stream sees them: whether selected, stamps, values."""

    cdef SamplerCore sampler
    cdef Stream stream
    cdef char* chosen
    cdef nanoseconds* stamps
    cdef double* values

    def __cinit__(self, SamplerCore sampler, Stream stream, Py_ssize_t count):
        cdef Py_ssize_t i
        self.sampler, self.stream = sampler, stream
        self.chosen = <char*>_resized(NULL, count + 1)
        self.stamps = <nanoseconds*>_resized(NULL, (count + 1) * sizeof(nanoseconds))
        self.values = <double*>_resized(NULL, (count * stream.width + 1) * sizeof(double))
        for i in range(count):
            self.chosen[i] = True
            self.stamps[i] = _CLOCKLESS

    def __dealloc__(self):
        PyMem_Free(self.chosen)
        PyMem_Free(self.stamps)
        PyMem_Free(self.values)

    cdef int read(self, fields, const Py_buffer* record, Py_ssize_t count) except -1:
        """Read n messages of columns, whose numbers are opened by :meth:`Stream.open`."""
        cdef Stream stream = self.stream
        cdef Py_ssize_t which, at = stream.width
        cdef View view
        cdef bint there
        for which in range(stream.width):
            there = stream.open(which, fields, record, &view, count)
            _read_values(&view if there else NULL, stream.scalings + which, self.values + which, stream.width, count)
        _stand_in(stream.scalings, self.values, stream.width, count)
        for value in stream.equal:
            _select(stream.open(at, fields, record, &view, count), &view, fields, stream.paths[at], value, self.chosen,
                    count)
            at += 1
        for least in stream.least:
            _reach(stream.open(at, fields, record, &view, count), &view, least, self.chosen, count)
            at += 1
        for unit_ns in stream.units:
            if stream.open(at, fields, record, &view, count):
                _read_clock(&view, unit_ns, self.stamps, count)
            at += 1
        return 0


cdef class _Messages:
    """The messages of one name and sender in a batch, and the feeds of the streams that take them."""

    cdef Py_ssize_t count, next
    cdef nanoseconds* position
    cdef nanoseconds* received
    cdef bint zero_is_unset
    cdef list feeds

    def __cinit__(self, Py_ssize_t count, bint zero_is_unset):
        self.count, self.zero_is_unset = count, zero_is_unset
        self.position = <nanoseconds*>_resized(NULL, (count + 1) * sizeof(nanoseconds))
        self.received = <nanoseconds*>_resized(NULL, (count + 1) * sizeof(nanoseconds))

    def __dealloc__(self):
        PyMem_Free(self.position)
        PyMem_Free(self.received)

    cdef int feed_next(self, nanoseconds place) except -1:
        """Give the next message to the samplers."""
        cdef Py_ssize_t row = self.next
        cdef _Feed feed
        self.next += 1
        for feed in self.feeds:
            if feed.chosen[row]:
                feed.sampler._position = place
                feed.sampler.feed(
                    feed.stream,
                    feed.stamps[row],
                    self.received[row],
                    feed.values + row * feed.stream.width,
                    self.zero_is_unset,
                )
        return 0


cdef _Messages _of_messages(list members, list feeds):
    """Return messages that are not columns, with the values that the channels read."""
    cdef Py_ssize_t count = len(members), row
    cdef _Messages group = _Messages.__new__(_Messages, count, False)
    cdef _Feed feed
    cdef Stream stream
    cdef int i
    group.feeds = [_Feed.__new__(_Feed, sampler, stream, count) for sampler, stream in feeds]
    for row, (place, message) in enumerate(members):
        fields = message.fields
        group.position[row] = place
        group.received[row] = max(-MAX_STAMP_NS, min(message.received_ns, MAX_STAMP_NS))
        for feed in group.feeds:
            stream = feed.stream
            feed.chosen[row] = stream.channel.selects(fields)
            if not feed.chosen[row]:
                continue
            stamp = stream.channel.stamp_ns(fields)
            if stamp is not None:
                usable = 0 <= stamp < MAX_STAMP_NS and not (stamp == 0 and message.source.zero_stamp_is_unset)
                feed.stamps[row] = stamp if usable else _UNTIMED
            for i, channel in enumerate(stream.channels):
                value = channel.value(fields)
                feed.values[row * stream.width + i] = float("nan") if value is None else value
    return group


cdef _Messages _of_columns(columns, list feeds):
    """Return the messages of columns, with the values that the channels read."""
    cdef Py_ssize_t count = len(columns.position), row
    cdef _Messages group = _Messages.__new__(_Messages, count, columns.source.zero_stamp_is_unset)
    cdef _Feed feed
    cdef Py_buffer record
    fields = columns.fields
    _read_times(columns.position, group.position, count)
    _read_times(columns.received_ns, group.received, count)
    for row in range(count):
        group.received[row] = max(-_MAX_STAMP, min(group.received[row], _MAX_STAMP))
    group.feeds = [_Feed.__new__(_Feed, sampler, stream, count) for sampler, stream in feeds]
    if not isinstance(fields, RecordFields):
        for feed in group.feeds:
            feed.read(fields, NULL, count)
        return group
    PyObject_GetBuffer(fields.record, &record, PyBUF_STRIDES)
    try:
        places = fields.places
        for feed in group.feeds:
            feed.stream.find(places)
            feed.read(fields, &record, count)
    finally:
        PyBuffer_Release(&record)
    return group


cdef object _leaf(fields, path):
    """Return the column at a field's path: one number of each message; None where there is none."""
    column = fields.get(path[0])
    if column is None or column.ndim != len(path):
        return None
    if len(path) == 1:
        return column
    step = path[1]
    return column[:, step] if isinstance(step, int) and step < column.shape[1] else None


cdef Field _field(places, path) except *:
    """Return where a record of these places has the number at a path."""
    cdef Field field = Field(0, 0, _NO_NUMBER)
    place = places.get(path[0])
    if place is None or (len(path) > 1) != (place.length > 0) or len(path) > 2:
        return field
    step = path[1] if place.length else 0
    if isinstance(step, int) and (step < place.length or not place.length):
        field.offset, field.size, field.number = place.offset + step * place.size, place.size, _NUMBERS[place.kind]
    return field


cdef list _clocks(channel):
    """Return paths and units of the clock fields of a channel's message: its own, or the usual ones."""
    if channel.clock is None:
        return [((name,), channel.clock_unit_ns or unit_ns) for name, unit_ns in CLOCK_UNITS_NS.items()]
    unit_ns = channel.clock_unit_ns or CLOCK_UNITS_NS.get(channel.clock, 1)
    return [((channel.clock,), unit_ns), (field_steps(channel.clock), unit_ns)]


cdef bint _open_column(column, View* view, Py_ssize_t count) except -1:
    """Open a column of numbers; return whether it is one, which has to be released."""
    if column is None:
        return False
    kind = column.dtype.kind
    if kind not in _NUMBERS or column.ndim != 1 or len(column) < count:
        return False
    if not column.dtype.isnative or (kind == "f" and column.dtype.itemsize not in (4, 8)):
        # Another byte order, or numbers of another width: convert them.
        column = column.astype(np.float64 if kind == "f" else column.dtype.newbyteorder("="))
    PyObject_GetBuffer(column, &view.buffer, PyBUF_STRIDES)
    view.start = <const char*>view.buffer.buf
    view.stride = view.buffer.strides[0]
    view.size = view.buffer.itemsize
    view.number = _NUMBERS[kind]
    return True


cdef inline unsigned long long _unsigned_at(View* view, Py_ssize_t row) noexcept:
    """Return an unsigned integer, or the bytes of a signed one, at any address."""
    cdef const char* at = view.start + row * view.stride
    cdef unsigned char one
    cdef unsigned short two
    cdef unsigned int four
    cdef unsigned long long eight
    if view.size == 8:
        memcpy(&eight, at, 8)
        return eight
    if view.size == 4:
        memcpy(&four, at, 4)
        return four
    if view.size == 2:
        memcpy(&two, at, 2)
        return two
    memcpy(&one, at, 1)
    return one


cdef inline long long _signed_at(View* view, Py_ssize_t row) noexcept:
    """Return a signed integer: shifting to the right keeps the sign, as GCC and Clang do it."""
    cdef int spare = 64 - 8 * <int>view.size
    return <long long>(_unsigned_at(view, row) << spare) >> spare


cdef inline double _double_at(View* view, Py_ssize_t row) noexcept:
    """Return a number as a float, rounded to the nearest."""
    cdef const char* at = view.start + row * view.stride
    cdef float four
    cdef double eight
    if view.number == _SIGNED:
        return <double>_signed_at(view, row)
    if view.number == _UNSIGNED:
        return <double>_unsigned_at(view, row)
    if view.size == 8:
        memcpy(&eight, at, 8)
        return eight
    memcpy(&four, at, 4)
    return four


cdef int _read_times(column, nanoseconds* out, Py_ssize_t count) except -1:
    """Copy a column of whole nanoseconds."""
    cdef View view
    cdef Py_ssize_t row
    if not _open_column(column, &view, count):
        raise TypeError("positions and times of arrival have to be columns of whole numbers")
    for row in range(count):
        out[row] = _signed_at(&view, row)
    PyBuffer_Release(&view.buffer)
    return 0


cdef int _read_values(View* view, const Scaling* scaling, double* out, Py_ssize_t stride,
                      Py_ssize_t count) except -1:
    """Read a channel's values, NaN where a number is missing or impossible (rule 7); NULL: all are missing."""
    cdef Py_ssize_t row
    cdef double value
    if view == NULL:
        for row in range(count):
            out[row * stride] = NAN
        return 0
    for row in range(count):
        value = scaling.scale * _double_at(view, row) + scaling.offset
        out[row * stride] = value if -scaling.largest <= value <= scaling.largest else NAN
    PyBuffer_Release(&view.buffer)
    return 0


cdef int _stand_in(const Scaling* scalings, double* values, Py_ssize_t width, Py_ssize_t count) except -1:
    """Replace the values of stopped motors while others turn; where none turns the vehicle does not fly."""
    cdef Py_ssize_t row, i
    cdef double* value
    cdef double stopped = STOPPED
    cdef bint turns
    for row in range(count):
        value, turns = values + row * width, False
        for i in range(width):
            turns |= scalings[i].stops and value[i] >= stopped
        for i in range(width if turns else 0):
            if scalings[i].stops and value[i] < stopped:
                value[i] = scalings[i].stopped_as
    return 0


cdef int _read_clock(View* view, unit_ns, nanoseconds* out, Py_ssize_t count) except -1:
    """Read the stamps of one clock field where none is known yet; codes where it has none or one out of range."""
    cdef Py_ssize_t row
    cdef nanoseconds most = (MAX_STAMP_NS - 1) // unit_ns, unit = unit_ns if most else 0
    cdef double factor = unit_ns, stamp
    cdef unsigned long long whole
    for row in range(count):
        if out[row] != _CLOCKLESS:
            continue
        if view.number == _FLOATING:
            stamp = _double_at(view, row) * factor
            if isfinite(stamp):
                stamp = rint(stamp)
                out[row] = <nanoseconds>stamp if 0.0 <= stamp < 4611686018427387904.0 else _UNTIMED
            continue
        if view.number == _SIGNED and _signed_at(view, row) < 0:
            out[row] = _UNTIMED
            continue
        whole = _unsigned_at(view, row)
        out[row] = <nanoseconds>whole * unit if whole <= <unsigned long long>most else _UNTIMED
    PyBuffer_Release(&view.buffer)
    return 0


cdef int _select(bint there, View* view, fields, path, value, char* chosen, Py_ssize_t count) except -1:
    """Keep the messages whose field has a value; ``there``: it was opened as numbers."""
    cdef Py_ssize_t row
    cdef long long wanted
    if there and isinstance(value, int) and -MAX_STAMP_NS < value < MAX_STAMP_NS:
        wanted = value
        for row in range(count):
            if view.number == _SIGNED:
                chosen[row] &= _signed_at(view, row) == wanted
            elif view.number == _UNSIGNED:
                chosen[row] &= wanted >= 0 and _unsigned_at(view, row) == <unsigned long long>wanted
            else:
                chosen[row] &= _double_at(view, row) == <double>wanted
    else:
        column = fields.get(path[0])
        for row in range(count):
            chosen[row] &= column is not None and column[row].tolist() == value
    if there:
        PyBuffer_Release(&view.buffer)
    return 0


cdef int _reach(bint there, View* view, double least, char* chosen, Py_ssize_t count) except -1:
    """Keep the messages whose field is at least a number; ``there``: it was opened as numbers."""
    cdef Py_ssize_t row
    for row in range(count):
        chosen[row] &= there and _double_at(view, row) >= least
    if there:
        PyBuffer_Release(&view.buffer)
    return 0
