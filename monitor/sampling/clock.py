"""The vehicle's clock: which stamps to believe, and how vehicle time maps to Unix time, jitter removed."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

_SECOND_NS = 1_000_000_000
BUCKET_NS = 5 * _SECOND_NS
TOLERANCE_NS = _SECOND_NS
TURNS_NS = (1_000 << 32, 1_000_000 << 32)
_BUCKETS = 12
_JUMP_NS = 10 * _SECOND_NS
_LEAST_SPAN_NS = 15 * _SECOND_NS
_LARGEST_SKEW = 500, 1_000_000


class Point(NamedTuple):
    """Stamp of a packet and its delay: arrival minus stamp."""

    stamp_ns: int
    delay_ns: int


class Line(NamedTuple):
    """Delay of a packet that nothing held up, over vehicle time: through a point, rise / run its slope."""

    point: Point
    rise_ns: int = 0
    run_ns: int = 1

    def at(self, stamp_ns: int) -> int:
        """Return the delay at a vehicle time, rounded down."""
        if not self.rise_ns:
            return self.point.delay_ns
        return self.point.delay_ns + (stamp_ns - self.point.stamp_ns) * self.rise_ns // self.run_ns


class VehicleClock:
    """Follows one vehicle's clock through its messages; what it says depends on nothing but them.

    Belief. A stamp within 1 s of the newest one, before or after, is believed at once. One further away is
    believed only when the next message has another stamp near it (at most 1 s before or 10 s after), so a
    single damaged stamp changes nothing. Once believed, a step back of more than 1 s is a reboot and a step
    ahead of more than 10 s a clock that was set: both start the clock anew and count in ``boot``.

    Mapping. Arrival minus stamp is the clocks' offset, which drifts with the crystals' skew, plus a delay that is
    never negative. Of each 5 s of vehicle time the least delayed packet is kept, for 60 s. The line below all of
    these points with the least sum of distances to them is that of the packets nothing held up: offset and skew
    at once (S. Moon, P. Skelly, D. Towsley, "Estimation and Removal of Clock Skew from Network Delay
    Measurements", INFOCOM 1999). It is the edge of their lower convex hull below the mean of their stamps. Where
    they span less than 15 s, or the edge is steeper than any crystal (500 ppm: simulated time that runs fast, a
    clock that was just set), the least delay stands alone. A single arrival time that would lower the offset by
    more than 1 s is not believed.

    Attributes
    ----------
    boot : int
        How often the clock started anew.
    newest_ns : int
        Newest believed vehicle time, nanoseconds; 0 before the first.
    running : bool
        Whether a stamp was believed since the clock started (anew).
    line : Line
        The delays of packets that nothing held up.
    """

    def __init__(self) -> None:
        self.boot = 0
        self.newest_ns = 0
        self.running = False
        self._candidate_ns: int | None = None
        self._points: deque[Point] = deque()
        self.line = Line(Point(0, 0))
        self._doubtful: Point | None = None

    def near(self, stamp_ns: int) -> bool:
        """Return whether a stamp is close enough to the newest one to need no second opinion."""
        return not self.running or -TOLERANCE_NS <= stamp_ns - self.newest_ns <= TOLERANCE_NS

    def unwrap(self, stamp_ns: int) -> int:
        """Return the stamp of a 32-bit counter with the full turns added that bring it near the newest stamp.

        ``time_boot_ms`` turns over after 49.7 days, the 32-bit ``time_usec`` of SERVO_OUTPUT_RAW after 71.6
        minutes, while other clocks of the vehicle go on. A stamp no whole number of turns away is left as it
        is.
        """
        for turn_ns in TURNS_NS:
            unwrapped = stamp_ns + round((self.newest_ns - stamp_ns) / turn_ns) * turn_ns
            if stamp_ns < turn_ns and self.running and self.near(unwrapped):
                return unwrapped
        return stamp_ns

    def observe(self, stamp_ns: int, received_ns: int) -> bool:
        """Take a measurement's stamp and its time of arrival; return whether the stamp is believed."""
        if not self.near(stamp_ns):
            if not self._confirmed(stamp_ns):
                return False
            if not -TOLERANCE_NS <= stamp_ns - self.newest_ns <= _JUMP_NS:
                self._start_anew()
        self.advance(stamp_ns)
        self.learn(Point(stamp_ns, received_ns - stamp_ns))
        return True

    def to_unix(self, vehicle_ns: int) -> int:
        """Return the Unix time of a vehicle time, nanoseconds."""
        return vehicle_ns + self.line.at(vehicle_ns)

    @property
    def skew(self) -> float:
        """How much faster Unix time goes than the vehicle's clock, as a share: 1e-4 is 100 ppm."""
        return self.line.rise_ns / self.line.run_ns

    @property
    def newest_point(self) -> Point:
        """The newest of the points that define the line."""
        return self._points[-1]

    def advance(self, stamp_ns: int) -> None:
        """Note that a stamp near the newest one is believed."""
        self._candidate_ns = None
        if stamp_ns > self.newest_ns or not self.running:
            self.newest_ns = stamp_ns
            self.running = True

    def trust(self) -> None:
        """Forget a doubtful time of arrival: another one is in line."""
        self._doubtful = None

    def _confirmed(self, stamp_ns: int) -> bool:
        before = self._candidate_ns
        if before == stamp_ns:
            return False
        self._candidate_ns = stamp_ns
        return before is not None and -TOLERANCE_NS <= stamp_ns - before <= _JUMP_NS

    def _start_anew(self) -> None:
        self.boot += 1
        self.running = False
        self._points.clear()
        self._doubtful = None

    def learn(self, point: Point) -> None:
        """Take the delay of a message whose stamp is believed."""
        points = self._points
        early_ns = self.line.at(point.stamp_ns) - point.delay_ns
        if points and early_ns > TOLERANCE_NS:
            before = self._doubtful
            self._doubtful = point
            if (
                before is None
                or before.stamp_ns == point.stamp_ns
                or abs(before.delay_ns - point.delay_ns) > TOLERANCE_NS
            ):
                return
            points.clear()
        self._doubtful = None
        number = point.stamp_ns // BUCKET_NS
        if not points or number > points[-1].stamp_ns // BUCKET_NS:
            points.append(point)
            while points[0].stamp_ns // BUCKET_NS <= number - _BUCKETS:
                points.popleft()
        elif early_ns > self.line.at(points[-1].stamp_ns) - points[-1].delay_ns:
            points[-1] = point
        else:
            return
        self.line = _line_below(points)


def _line_below(points: Iterable[Point]) -> Line:
    """Return the line below points in order of time, horizontal where their lower edge tells no skew."""
    hull: list[Point] = []
    total_ns = count = 0
    for point in points:
        while len(hull) > 1 and not _turns_up(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
        total_ns += point.stamp_ns
        count += 1
    least = Line(min(hull, key=lambda point: point.delay_ns))
    if hull[-1].stamp_ns - hull[0].stamp_ns < _LEAST_SPAN_NS:
        return least
    at = next(i for i in range(1, len(hull)) if hull[i].stamp_ns * count >= total_ns)
    left, right = hull[at - 1], hull[at]
    rise_ns, run_ns = right.delay_ns - left.delay_ns, right.stamp_ns - left.stamp_ns
    most, among = _LARGEST_SKEW
    return Line(right, rise_ns, run_ns) if abs(rise_ns) * among <= most * run_ns else least


def _turns_up(first: Point, middle: Point, last: Point) -> bool:
    """Return whether the middle point lies below the line from the first to the last."""
    before = (middle.delay_ns - first.delay_ns) * (last.stamp_ns - middle.stamp_ns)
    return before < (last.delay_ns - middle.delay_ns) * (middle.stamp_ns - first.stamp_ns)
