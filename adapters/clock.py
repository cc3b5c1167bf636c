"""The vehicle's clock: which stamps to believe, and how vehicle time maps to Unix time, jitter removed."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

_SECOND_NS = 1_000_000_000
_BUCKET_NS = 5 * _SECOND_NS
_BUCKETS = 12
_TOLERANCE_NS = _SECOND_NS
_JUMP_NS = 10 * _SECOND_NS
_TURNS_NS = (1_000 << 32, 1_000_000 << 32)


class _Bucket(NamedTuple):
    """Least delay (arrival minus stamp) seen among stamps of one stretch of vehicle time."""

    number: int
    least_ns: int


class VehicleClock:
    """Follows one vehicle's clock through its messages; what it says depends on nothing but them.

    Belief. A stamp within 1 s of the newest one, before or after, is believed at once. One further away is
    believed only when the next message has another stamp near it (at most 1 s before or 10 s after), so a
    single damaged stamp changes nothing. Once believed, a step back of more than 1 s is a reboot and a step
    ahead of more than 10 s a clock that was set: both start the clock anew and count in ``boot``.

    Mapping. Arrival minus stamp is the clocks' offset plus a delay that is never negative. The least value
    among the last 60 s of vehicle time belongs to the least delayed packet, so it is the offset, and 60 s are
    short enough to follow the drift of a crystal. A single arrival time that would lower it by more than 1 s
    is not believed either.

    Attributes
    ----------
    boot : int
        How often the clock started anew.
    newest_ns : int
        Newest believed vehicle time, nanoseconds; 0 before the first.
    """

    def __init__(self) -> None:
        self.boot = 0
        self.newest_ns = 0
        self._running = False
        self._candidate_ns: int | None = None
        self._buckets: deque[_Bucket] = deque()
        self._offset_ns = 0
        self._doubtful: tuple[int, int] | None = None

    def near(self, stamp_ns: int) -> bool:
        """Return whether a stamp is close enough to the newest one to need no second opinion."""
        return not self._running or -_TOLERANCE_NS <= stamp_ns - self.newest_ns <= _TOLERANCE_NS

    def unwrap(self, stamp_ns: int) -> int:
        """Return the stamp of a 32-bit counter with the full turns added that bring it near the newest stamp.

        ``time_boot_ms`` turns over after 49.7 days, the 32-bit ``time_usec`` of SERVO_OUTPUT_RAW after 71.6
        minutes, while other clocks of the vehicle go on. A stamp no whole number of turns away is left as it
        is.
        """
        for turn_ns in _TURNS_NS:
            unwrapped = stamp_ns + round((self.newest_ns - stamp_ns) / turn_ns) * turn_ns
            if stamp_ns < turn_ns and self._running and self.near(unwrapped):
                return unwrapped
        return stamp_ns

    def observe(self, stamp_ns: int, received_ns: int) -> bool:
        """Take a measurement's stamp and its time of arrival; return whether the stamp is believed."""
        if not self.near(stamp_ns):
            if not self._confirmed(stamp_ns):
                return False
            if not -_TOLERANCE_NS <= stamp_ns - self.newest_ns <= _JUMP_NS:
                self._start_anew()
        self._candidate_ns = None
        if stamp_ns > self.newest_ns or not self._running:
            self.newest_ns = stamp_ns
            self._running = True
        self._learn_offset(stamp_ns, received_ns - stamp_ns)
        return True

    def to_unix(self, vehicle_ns: int) -> int:
        """Return the Unix time of a vehicle time, nanoseconds."""
        return vehicle_ns + self._offset_ns

    def _confirmed(self, stamp_ns: int) -> bool:
        before = self._candidate_ns
        if before == stamp_ns:
            return False
        self._candidate_ns = stamp_ns
        return before is not None and -_TOLERANCE_NS <= stamp_ns - before <= _JUMP_NS

    def _start_anew(self) -> None:
        self.boot += 1
        self._running = False
        self._buckets.clear()
        self._doubtful = None

    def _learn_offset(self, stamp_ns: int, delay_ns: int) -> None:
        buckets = self._buckets
        if buckets and delay_ns < self._offset_ns - _TOLERANCE_NS:
            before = self._doubtful
            self._doubtful = stamp_ns, delay_ns
            if before is None or before[0] == stamp_ns or abs(before[1] - delay_ns) > _TOLERANCE_NS:
                return
            buckets.clear()
        self._doubtful = None
        number = stamp_ns // _BUCKET_NS
        if not buckets or number > buckets[-1].number:
            buckets.append(_Bucket(number, delay_ns))
            while buckets[0].number <= number - _BUCKETS:
                buckets.popleft()
        elif delay_ns < buckets[-1].least_ns:
            buckets[-1] = _Bucket(buckets[-1].number, delay_ns)
        else:
            return
        self._offset_ns = min(bucket.least_ns for bucket in buckets)
