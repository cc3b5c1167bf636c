"""Flight phase as the vehicle reports it (armed or not, on the ground or in the air), and the vehicle's identity.

The newest report holds, unless two senders answer by turns. The reports of one sender keep their period. If its value
changes and changes back, the two reports around the changed one are two periods apart; if another sender's reports come
in between, they are one period apart. Reports are therefore contested

- after a single such change, or a burst of reports, however rare, if the two reports before it and the two after it
  agree and kept their period without it;
- otherwise from the third such change within 10 s on, or from the eighth change of any kind over more than 3.5 s.

While reports are contested, the vehicle counts as flying as long as reports say so: a vehicle that is watched on the
ground may raise an alarm too many, a vehicle that is not watched in the air may fall. An armed vehicle does not become
another vehicle, and a vehicle in the air does not take off: whoever reports that is another sender.

A landing vehicle counts as in the air until it is near the ground, by its reported height above home: a descent takes
as long as many a flight. A vehicle that does not report whether it flies is near the ground by that height, too. Near
the ground, or where no height comes, a landing vehicle sinks, by the altitude of its GPS: while it does not, or the GPS
was lost, and its motors run as in hover (without motors and height: it moves on), it counts as in the air.

For some seconds after the vehicle has armed nothing is contested: a slower radio still reports that it has not.

A plane reports that it is in the air while it rolls to take off: ArduPilot's from 10 m/s on. Until it has left the
height of its home it counts as on the ground, for as long as such a roll lasts at most.

Nobody else writes into a vehicle's own log, and it holds a report for each change: its reports are never contested.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from math import inf, nan
from typing import ClassVar, Literal, NamedTuple

from adapters.mavlink.heartbeat import ARMED, is_autopilot_heartbeat
from adapters.message import LATEST_NS, Message
from adapters.source import MAVLINK
from monitor.sampling.identity import Identity, Reports

Landed = Literal["ground", "air", "takeoff", "landing"]

Carried = Literal["rotors", "wings", "both"]

# The values of MAV_VTOL_STATE; in transitions both may carry the vehicle.
_CARRIED: dict[int, Carried] = {1: "both", 2: "both", 3: "rotors", 4: "wings"}
# The values of MAV_LANDED_STATE.
_LANDED: dict[int, Landed] = {1: "ground", 2: "air", 3: "takeoff", 4: "landing"}
CONTESTED = {
    "HEARTBEAT": "its HEARTBEAT alternates between armed and disarmed, or between two vehicles",
    "EXTENDED_SYS_STATE": "its EXTENDED_SYS_STATE alternates between flying and not flying",
    "landed_state": "its HEARTBEAT reports that it is disarmed, its EXTENDED_SYS_STATE that it is in the air",
    "PARAM_VALUE": "its PARAM_VALUE reports another frame in flight than before",
}
"""What two senders contradict each other in, with a sentence for each."""
_WINDOW_NS = 10_000_000_000
"""Time over which changes are counted: ten heartbeats at MAVLink's rate of one a second."""
_TURNS = 3
"""Changes within one period from which on reports are contested. A landing makes two if two links of a vehicle differ
by a second; a second sender at the vehicle's own rate makes them in 2 s."""
_CHANGES = 8
"""Changes of any kind from which on reports are contested: landing and bouncing twice make six. A second sender makes
them in 4 s."""
_BURST = 3
"""Least number of reports between two of one sender that are a burst of another's. The quicker of two radios brings one
report in that time, or two."""
_HELD_NS = 3_500_000_000
"""Shortest time from the first to the last change between the same two values: the slower of two radios repeats an old
report up to 3 s later (docs/limits.md), of a take-off and of the climb after it."""
_PERIODS = 1.5
"""Longest step that counts as one period and not two, for reports with a jitter of half a period. Steps of reports that
keep their period, and do not come in bursts from a link that holds them back, are shorter than a period by at most
as much."""
_RECENT_NS = 3_000_000_000
"""How long a contested report counts: three heartbeats, as one or two may be lost."""
_APART_NS = 5_000_000_000
"""How long a vehicle may be disarmed and in the air by its reports. They come 0.2 to 4 s apart, and ArduPilot's planes
count as flying for 3 s after they stand."""
_HIGH_MM = 2000
"""Height above home from which on a landing vehicle is still watched, millimetres. Chosen: rotors feel the ground up to
two of their diameters, and a height is off by this much after a long flight."""
_AWAY_NS = 1_000_000_000
"""How long a report of a height other than home's counts. Chosen: heights come once a second at least, and a plane that
touches down rolls for longer."""
_SINKS_MM = 1000
"""By how much a landing vehicle sinks within ``_SINKS_NS``, millimetres: autopilots land with 0.3 m/s and more, 1.5 m
in that time."""
_SINKS_NS = 5_000_000_000
_MOVES_CM_S = 500
"""Ground speed from which on a vehicle moves, centimetres per second: PX4's planes count as landed below it
(LNDFW_VEL_XY_MAX)."""
_ROLLS_NS = 20_000_000_000
"""Longest roll after the report that it flies: from 10 to 25 m/s with 1 m/s^2 takes 15 s. Heights that are forged hide
no more of a flight than that."""
_UNKNOWN = 65535  # MAVLink's speed of a receiver that does not know it
_MOST_REPORTS = 64
"""Most reports that are remembered. Chosen: at 6 Hz more than the time over which changes are counted; a flood needs no
more memory."""


class Said(NamedTuple):
    """Newest reports on one matter: times of arrival and values, and until when they are contested."""

    times: tuple[int, ...] = ()
    values: tuple[object, ...] = ()
    until_ns: int = 0

    def after(self, now_ns: int, value: object) -> Said:
        """Return the reports that are remembered after another one."""
        first = next((i for i, time in enumerate(self.times) if 0 <= now_ns - time < _WINDOW_NS), len(self.times))
        first = max(first, len(self.times) - _MOST_REPORTS + 1)
        times, values = (*self.times[first:], now_ns), (*self.values[first:], value)
        until_ns = self.until_ns if self.until_ns - now_ns <= _WINDOW_NS else 0
        if values.count(value) < len(values) and _contested(times, values):
            until_ns = now_ns + _WINDOW_NS // 2
        return Said(times, values, until_ns)

    @property
    def contested(self) -> bool:
        """Whether two senders answer by turns."""
        return bool(self.times) and self.times[-1] < self.until_ns

    def recent(self) -> list[object]:
        """Return the values of the last seconds."""
        return [
            value for time, value in zip(self.times, self.values, strict=True) if self.times[-1] - time < _RECENT_NS
        ]


def _contested(times: tuple[int, ...], values: tuple[object, ...]) -> bool:
    changes = [
        (time, frozenset(pair)) for time, pair in zip(times[1:], pairwise(values), strict=True) if len(set(pair)) > 1
    ]
    first: dict[frozenset[object], int] = {}
    if len(changes) >= _CHANGES and any(time - first.setdefault(pair, time) > _HELD_NS for time, pair in changes):
        return True
    steps: dict[object, list[int]] = {}
    for (a, x), (b, y) in pairwise(zip(times, values, strict=True)):
        if x == y:
            steps.setdefault(x, []).append(b - a)
    if not steps:
        return False
    period = _period([step for found in steps.values() for step in found])
    begins = [i for i in range(len(values)) if i == 0 or values[i - 1] != values[i]]
    within = [(i, k) for i, k in pairwise(begins[1:]) if values[i - 1] == values[k]]
    turns = sum(times[k] - times[i - 1] <= _PERIODS * period for i, k in within)
    return turns >= _TURNS or any(
        _keep_period((*times[i - 2 : i], *times[k : k + 2]), period if k - i == 1 else _period(steps[values[k]]))
        for i, k in within
        if i > 1 and values[i - 2 : i] == values[k : k + 2] and (k - i == 1 or k - i >= _BURST)
    )


def _period(steps: list[int]) -> int:
    """Return the usual step; two radios that both bring each report give unequal steps, and twice as many."""
    return min(sorted(steps)[len(steps) // 2], sum(steps) // len(steps))


def _keep_period(times: tuple[int, ...], period: int) -> bool:
    """Return whether reports kept their period, without what came between them."""
    return all(period <= _PERIODS * (b - a) and b - a <= _PERIODS * period for a, b in pairwise(times))


class FlightPhase:
    """Follows the autopilot's HEARTBEAT, EXTENDED_SYS_STATE and height; heartbeats of other components are ignored.

    Samples of another vehicle than the one that the profile was ``fitted`` to are no evidence. ``reports`` is what the
    vehicle has told about itself; ``contradiction`` the sentence that shows that it is another one, None if nothing
    does; ``contested`` names the messages that two senders answer by turns. ``driven`` is set while the vehicle counts
    as flying although it reports that it does not, because its commands are those of flight or it moves on; ``hovers``
    while those of a landing vehicle are the ones of hover (without commands and height: while it moves on), or not
    known yet;
    ``logged`` if the reports are those of its own log. ``carried`` is what carries a vehicle with rotors and wings by
    its own report, None without one. ``interests`` names the messages that are read, ``fields`` the only fields that
    are, of frequent ones.
    """

    fields: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "GLOBAL_POSITION_INT": ("relative_alt",),
        "GPS_RAW_INT": ("fix_type", "alt", "vel"),
    }
    interests: ClassVar[frozenset[str]] = Reports.interests | {"EXTENDED_SYS_STATE", *fields}

    def __init__(self, fitted: Identity | None = None) -> None:
        self._armed: bool | None = None
        self._landed: Landed | None = None
        self._has_been = (False, False)  # armed, in the air
        self.driven = False
        self.hovers = False
        self.logged = False
        self.carried: Carried | None = None
        self.reports = Reports()
        self.contradiction: str | None = None
        self.contested: tuple[str, ...] = ()
        self._fitted = fitted
        self._beats = Said()
        self._landings = Said()
        self._armed_ns = -LATEST_NS  # when it armed for the first time
        # the last message that reported another vehicle in flight, and its time
        self._other: tuple[str, int] = ("", -LATEST_NS)
        self._apart_ns: int | None = None  # since when it is disarmed and in the air by its reports
        self._high_ns: int | None = None  # when it was last reported to be high; None: it is low, or unknown
        self._height_ns: int | None = None  # when its height was last reported; None: not of late
        # the GPS's last fix; when its altitude last was a metre below the highest since then, and this highest; whether
        # that was of late
        self._fix_ns: int | None = None
        self._sank_ns, self._highest_mm, self._sinks = -LATEST_NS, -inf, False
        # when it was reported to be at about the height of its home, by all reports of the last second; None otherwise
        self._low_ns: int | None = None
        self._moves_ns: int | None = None  # since when all fixes have shown that it moves; None if it does not
        self._away_ns: int | None = None  # when it was last reported to be at another height
        # when its report changed from the ground to the air at the height of its home; None once it has left that
        self._rolls_ns: int | None = None

    @property
    def airborne(self) -> bool | None:
        """Whether it flies: in the air, or landing and still high; None if the vehicle does not report it."""
        landed = self.landed
        return None if landed is None else landed == "air" or (landed == "landing" and self._stays_up)

    @property
    def level(self) -> bool:
        """Whether it lands and does not sink as far as is known."""
        return self._landed == "landing" and self._fix_ns is not None and not self._sinks

    @property
    def has_height(self) -> bool:
        """Whether it reported its height of late."""
        return self._height_ns is not None

    @property
    def _stays_up(self) -> bool:
        """Whether a landing vehicle is still high, or does not sink and hovers."""
        return self._high_ns is not None or (self.level and self.hovers)

    @property
    def low(self) -> bool:
        """Whether it is at about the height of its home, by all reports of the last second."""
        return self._low_ns is not None

    @property
    def near_home(self) -> bool:
        """Whether it is at about the height of its home, and does not report whether it flies, or has just begun to."""
        return self.low and (self._landed is None or self._rolls_ns is not None)

    @property
    def armed(self) -> bool | None:
        """Whether bit 128 of HEARTBEAT.base_mode is set; None before the first heartbeat."""
        return True if self.driven else self._armed

    @property
    def landed(self) -> Landed | None:
        """EXTENDED_SYS_STATE.landed_state; None if the vehicle does not report it."""
        return "air" if self.driven and self._landed is not None else self._landed

    @property
    def grounded(self) -> bool:
        """Whether it reports to be disarmed, or on the ground after a flight."""
        return self._armed is False or (self._landed == "ground" and self._has_been[1])

    @property
    def state(self) -> tuple[object, ...]:
        """The part of the state that decides something now; the rest may change without a consequence."""
        lands = self._landed == "landing"
        flies = self._armed, self._landed, lands and self._stays_up, lands and self.level, self.low, self.carried
        return *flies, self._rolls_ns is None, self.reports, self.contradiction, self.contested

    def moves(self, since_ns: int, now_ns: int) -> bool:
        """Return whether it moved at a Unix time and has moved on until now, by all fixes of its GPS.

        Before it was armed it may be carried.
        """
        moved_ns, fix_ns = self._moves_ns, self._fix_ns
        has_moved = any(self._has_been) and moved_ns is not None and moved_ns <= since_ns
        return has_moved and fix_ns is not None and 0 <= now_ns - fix_ns < _RECENT_NS

    def fly(self) -> None:
        """Follow that it flies, although it does not report whether it does."""
        self._has_been = self._has_been[0], True

    def feed(self, message: Message) -> None:
        """Follow a message; other messages than :attr:`interests` change nothing."""
        if message.name not in self.interests:
            return
        now_ns = message.received_ns
        self.logged |= message.source.is_onboard_log
        if message.name == "GLOBAL_POSITION_INT":
            self._follow_height(message)
            return
        if message.name == "GPS_RAW_INT":
            self._follow_position(message)
            return
        is_heartbeat = is_autopilot_heartbeat(message)
        if is_heartbeat:
            said = message.fields
            mode = said.get("base_mode")
            armed = bool(mode & ARMED) if isinstance(mode, int) else None
            if armed and self._armed is False and not self._has_been[0]:
                self._armed_ns = now_ns
            # The slower of two radios repeats that it is disarmed.
            if not self.logged and not 0 <= now_ns - self._armed_ns < _HELD_NS:
                self._beats = self._beats.after(now_ns, (armed, said.get("type"), said.get("autopilot")))
        self._identify(message)
        if message.source is not MAVLINK:
            return
        if message.name == "EXTENDED_SYS_STATE":
            self._follow_landed(message)
        elif is_heartbeat and isinstance(mode, int):
            if self._low_ns is not None and not 0 <= now_ns - self._low_ns < _RECENT_NS:
                self._low_ns = None
            self._armed = armed
            if self._beats.contested:
                self._armed = any(isinstance(beat, tuple) and beat[0] for beat in self._beats.recent())
        self._has_been = self._has_been[0] or bool(self._armed), self._has_been[1] or self._landed == "air"
        contests = {"HEARTBEAT": self._beats, "EXTENDED_SYS_STATE": self._landings}
        contested = {name for name, said in contests.items() if said.contested}
        if self._armed is not False or self._landed != "air" or self.logged:
            self._apart_ns = None
        elif self._apart_ns is None or now_ns < self._apart_ns:
            self._apart_ns = now_ns
        elif now_ns - self._apart_ns >= _APART_NS:
            contested.add("landed_state")
        other, other_ns = self._other
        self.contested = tuple(sorted(contested | {other} if 0 <= now_ns - other_ns < _WINDOW_NS else contested))

    def _follow_height(self, message: Message) -> None:
        now_ns, height = message.received_ns, message.fields.get("relative_alt")
        above_mm = height if message.source is MAVLINK and isinstance(height, int | float) else nan
        self._height_ns = now_ns
        self._high_ns = now_ns if above_mm > _HIGH_MM else None
        if abs(above_mm) > _HIGH_MM:
            self._away_ns = now_ns
        # A forged height of home among true heights must not end the watch.
        was_away = self._away_ns is not None and 0 <= now_ns - self._away_ns < _AWAY_NS
        self._low_ns = now_ns if abs(above_mm) <= _HIGH_MM and not was_away else None
        if self._low_ns is None or self._rolls_ns is None or not 0 <= now_ns - self._rolls_ns < _ROLLS_NS:
            self._rolls_ns = None

    def _follow_landed(self, message: Message) -> None:
        now_ns, state, on = message.received_ns, message.fields.get("landed_state"), message.fields.get("vtol_state")
        landed = _LANDED.get(state) if isinstance(state, int) else None
        self.hovers |= self._landed in (None, "air") and landed == "landing"
        if self._landed == "ground" and landed == "air" and self.low:
            self._rolls_ns = now_ns
        self._landed = "air" if (self._landed, landed) == ("air", "takeoff") else landed
        self.carried = _CARRIED.get(on) if isinstance(on, int) else None
        if not self.logged:
            self._landings = self._landings.after(now_ns, self._landed)
        if self._height_ns is not None and not 0 <= now_ns - self._height_ns < _RECENT_NS:
            self._high_ns = self._height_ns = None
        self._sinks &= self._fix_ns is not None and 0 <= now_ns - self._fix_ns < _RECENT_NS
        self.hovers &= self.level
        if self._landings.contested and "air" in self._landings.recent():
            self._landed = "air"

    def _follow_position(self, message: Message) -> None:
        """Follow by the GPS whether the vehicle moves, and by its altitude whether it sinks."""
        now_ns, altitude, speed = message.received_ns, message.fields.get("alt"), message.fields.get("vel")
        has_fix = message.source is MAVLINK and message.fields.get("fix_type") not in (0, 1, 2)
        if not has_fix or not isinstance(speed, int | float) or not _MOVES_CM_S <= speed < _UNKNOWN:
            self._moves_ns = None
        elif self._moves_ns is None or now_ns < self._moves_ns:
            self._moves_ns = now_ns
        if not has_fix or not isinstance(altitude, int | float):
            return
        if altitude <= self._highest_mm - _SINKS_MM:
            self._sank_ns, self._highest_mm = now_ns, altitude
        self._fix_ns, self._highest_mm = now_ns, max(self._highest_mm, altitude)
        self._sinks = 0 <= now_ns - self._sank_ns < _SINKS_NS
        self.hovers &= self.level

    def _identify(self, message: Message) -> None:
        """Follow what a message tells about the vehicle's identity."""
        reports = self.reports.after(message)
        if reports is self.reports:
            return
        contradiction = None if self._fitted is None else reports.identity.contradiction(self._fitted)
        changed = self.reports.identity.difference(reports.identity) is not None
        if contradiction is not None and self.contradiction is None and self._armed and changed and not self.logged:
            self._other = message.name, message.received_ns
        elif contradiction is None or not self._beats.contested:
            self.reports, self.contradiction = reports, contradiction
