"""Kinds of faults and attacks: their numbers, the checks of these numbers, and what each kind does to a quantity.

A change is called with the time and value of each measurement, before, during and after the attack, because some kinds
need earlier values. Its result is used only while the attack lasts.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from math import isfinite
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from adapters.errors import UsageError

AttackKind = Literal["bias", "ramp", "scale", "freeze", "replay", "noise", "delay", "drop", "spoof", "loss"]
ATTACK_KINDS: tuple[AttackKind, ...] = get_args(AttackKind)

AttackSignal = Callable[[int], float]
Change = Callable[[int, float], float]

DEFAULT_ACCELERATION = 0.5
"""Default acceleration of a spoof, m/s^2. Chosen: gentler than any manoeuvre, so that the spoof is detected and not its
start."""
_FLAGS = {"size": "--size", "rate": "--rate", "acceleration": "--accel", "source_ns": "--from"}


class _KindRule(NamedTuple):
    """Description of a kind, and the numbers that it needs and allows."""

    meaning: str
    needed: tuple[str, ...] = ()
    allowed: tuple[str, ...] = ()


_RULES: Mapping[AttackKind, _KindRule] = {
    "bias": _KindRule("adds {size:g}", ("size",)),
    "ramp": _KindRule("adds {rate:g} per second", ("rate",), ("size",)),
    "scale": _KindRule("multiplies by {size:g}", ("size",)),
    "freeze": _KindRule("holds the last value"),
    "replay": _KindRule("repeats an earlier segment of the recording", ("source_ns",)),
    "noise": _KindRule("adds noise with standard deviation {size:g}", ("size",)),
    "delay": _KindRule("shows the value of {size:g} s ago", ("size",)),
    "drop": _KindRule("loses messages", (), ("size",)),
    "spoof": _KindRule("moves position and velocity together, up to {rate:g} m/s", ("rate",), ("acceleration",)),
    "loss": _KindRule("delivers {size:g} of the command less than commanded", ("size",), ("rate",)),
}


@dataclass(frozen=True, slots=True)
class Attack:
    """One fault or attack; times are on the vehicle's clock, sizes in the channel's unit."""

    channel: str  # channel of the contract, ``MESSAGE.field``, or fault of a profile's plant
    kind: AttackKind
    # it acts on measurements with start_ns <= stamp < end_ns, vehicle clock
    start_ns: int
    end_ns: int
    # bias: offset; ramp: final size; scale: factor; noise: standard deviation; delay: seconds; drop: share of messages
    # lost (1); loss: share of the command
    size: float | None = None
    # ramp: growth per second; spoof: final velocity, m/s; loss: growth per second (default: at once)
    rate: float | None = None
    acceleration: float | None = None  # spoof: largest acceleration, m/s^2
    source_ns: int | None = None  # replay: begin of the segment that is repeated over and over; it ends at ``start_ns``
    seed: int = 0  # seed of the noise and of the lost messages

    @property
    def magnitude(self) -> float | None:
        """The one number that tells how severe it is."""
        return self.rate if self.kind in ("ramp", "spoof") else self.size

    @property
    def meaning(self) -> str:
        """A sentence about it for people."""
        if self.kind == "loss" and self.size is not None and self.size < 0.0:
            return replace(self, size=-self.size, rate=self.rate and -self.rate).meaning.replace(" less ", " more ")
        growth = f", growing by {self.rate:g} per second" if self.kind == "loss" and self.rate else ""
        bound = f" up to {self.size:g}" if self.kind == "ramp" and self.size is not None else ""
        return _RULES[self.kind].meaning.format(size=self.size, rate=self.rate) + growth + bound

    def check(self) -> None:
        """Raise UsageError if a number is missing, makes no sense, or does not belong to the kind."""
        if self.kind not in ATTACK_KINDS:
            raise UsageError(f"--kind {self.kind}: no such kind; use one of {', '.join(ATTACK_KINDS)}")
        rule = _RULES[self.kind]
        for name, flag in _FLAGS.items():
            value = getattr(self, name)
            if value is None and name in rule.needed:
                raise UsageError(f"--kind {self.kind} needs {flag}")
            if value is not None and name not in (*rule.needed, *rule.allowed):
                raise UsageError(f"{flag} has no effect with --kind {self.kind}; leave it out")
            if value is not None and not isfinite(value):
                raise UsageError(f"{flag} is {value}; give a finite number")
        if self.end_ns <= self.start_ns:
            raise UsageError("--end is not after --start; nothing would be altered")
        if self.kind in ("noise", "delay") and not (self.size or 0.0) > 0.0:
            raise UsageError(f"--size {self.size:g} is not positive; --kind {self.kind} needs a positive one")
        if self.kind == "loss" and not (self.size and -1.0 <= self.size <= 1.0):
            raise UsageError(f"--size {self.size:g}: a loss is a share of the command, at most 1; below 0 it is a gain")
        if self.kind == "drop" and self.size is not None and not 0.0 < self.size <= 1.0:
            raise UsageError(f"--size {self.size:g}: the share of messages lost is above 0 and at most 1")
        if self.kind == "ramp" and (self.size or 0.0) * (self.rate or 0.0) < 0.0:
            raise UsageError("--size and --rate of a ramp have different signs; the ramp would never reach --size")
        if self.kind == "loss" and self.rate is not None and self.rate * (self.size or 0.0) <= 0.0:
            raise UsageError(f"--rate {self.rate:g} does not have the sign of --size; a loss grows")
        if self.acceleration is not None and self.acceleration <= 0.0:
            raise UsageError(f"--accel {self.acceleration:g} is not positive; give the largest acceleration")
        if self.source_ns is not None and self.source_ns >= self.start_ns:
            raise UsageError("--from is not before --start; only what was recorded earlier can be replayed")

    def acts(self, stamp_ns: int) -> bool:
        """Return whether the attack acts at a time."""
        return self.start_ns <= stamp_ns < self.end_ns

    def growth(self, stamp_ns: int) -> float:
        """Return the size of a step, a ramp or a growing loss at a time, zero while it does not act."""
        if not self.acts(stamp_ns):
            return 0.0
        if self.rate is None:
            return self.size or 0.0
        grown = self.rate * (stamp_ns - self.start_ns) / 1e9
        return grown if self.size is None or abs(grown) < abs(self.size) else self.size

    def sizes(self, stamps_ns: Iterable[int]) -> NDArray[np.float64] | None:
        """Return the attack's size at times (n,), for a spoof that of the position; zero while it does not act.

        Return None if the kind's size depends on more than time.
        """
        if self.kind not in ("bias", "ramp", "loss", "spoof"):
            return None
        size = self.spoof()[0] if self.kind == "spoof" else self.growth
        return np.array([size(stamp_ns) if self.acts(stamp_ns) else 0.0 for stamp_ns in stamps_ns])

    def additive(self) -> AttackSignal | None:
        """Return the signal that the attack adds, if it adds one that depends on time alone, else None."""
        if self.kind in ("bias", "ramp"):
            return self.growth
        if self.kind == "noise":
            size, seed = self.size or 0.0, self.seed
            return lambda stamp_ns: size * float(_generator(seed, stamp_ns).standard_normal())
        return None

    def lost(self, stamp_ns: int) -> bool:
        """Return whether a message with this stamp is dropped."""
        share = 1.0 if self.size is None else self.size
        return self.acts(stamp_ns) and float(_generator(self.seed, stamp_ns).random()) < share

    def spoof(self) -> tuple[AttackSignal, AttackSignal]:
        """Return position and velocity of a consistent spoof.

        The velocity goes from zero to V = ``rate`` within T = 1.5 |V| / ``acceleration`` as V (3 q^2 - 2 q^3),
        q = t / T, so the acceleration begins and ends at zero; the position is its integral
        V T (q^3 - q^4 / 2), then V (t - T / 2).
        """
        final = self.rate or 0.0
        duration = 1.5 * abs(final) / (self.acceleration or DEFAULT_ACCELERATION)

        def position(stamp_ns: int) -> float:
            t = (stamp_ns - self.start_ns) / 1e9
            q = t / duration if duration else 1.0
            return final * duration * (q**3 - q**4 / 2.0) if q < 1.0 else final * (t - duration / 2.0)

        def velocity(stamp_ns: int) -> float:
            q = min(1.0, (stamp_ns - self.start_ns) / 1e9 / duration) if duration else 1.0
            return final * (3.0 * q**2 - 2.0 * q**3)

        return position, velocity

    def change(self, from_home: bool) -> Change:
        """Return a new change of one quantity.

        With ``from_home``, a scale factor acts on the difference from the first value.

        Raises UsageError if the kind does not change single values.
        """
        added = self.additive()
        if added is not None:
            return lambda stamp_ns, value: value + added(stamp_ns)
        if self.kind == "scale":
            return _scaled(self.size or 0.0, from_home)
        if self.kind == "freeze":
            return _past(lambda _: self.start_ns, self.start_ns)
        if self.kind == "delay":
            late_ns = round((self.size or 0.0) * 1e9)
            return _past(lambda stamp_ns: stamp_ns - late_ns, self.end_ns)
        if self.kind == "replay" and self.source_ns is not None:
            source_ns, length_ns = self.source_ns, self.start_ns - self.source_ns
            return _past(lambda stamp_ns: source_ns + (stamp_ns - self.start_ns) % length_ns, self.start_ns)
        raise UsageError(f"--kind {self.kind} does not go with --channel {self.channel}")


def _scaled(factor: float, from_home: bool) -> Change:
    """Return the change that scales a value's difference from zero or, with ``from_home``, from the first value."""
    home = None if from_home else 0.0

    def change(_: int, value: float) -> float:
        nonlocal home
        home = value if home is None else home
        return home + factor * (value - home)

    return change


def _past(time: Callable[[int], int], until_ns: int) -> Change:
    """Return the change that shows the value measured closest to another time, so that jitter does not matter.

    ``time`` returns that other time for each stamp. Values from ``until_ns`` on are not kept; the first one always is.
    """
    stamps: list[int] = []
    values: list[float] = []

    def change(stamp_ns: int, value: float) -> float:
        place = bisect_right(stamps, stamp_ns)
        known = place > 0 and stamps[place - 1] == stamp_ns
        if not known and (stamp_ns < until_ns or not stamps):
            stamps.insert(place, stamp_ns)
            values.insert(place, value)
        wanted_ns = time(stamp_ns)
        after = min(bisect_right(stamps, wanted_ns), len(stamps) - 1)
        before = max(after - 1, 0)
        return values[after if stamps[after] - wanted_ns < wanted_ns - stamps[before] else before]

    return change


def _generator(seed: int, stamp_ns: int) -> np.random.Generator:
    """Return the random numbers of a millisecond: all messages that show one measurement get the same ones."""
    return np.random.default_rng((seed, max(0, stamp_ns) // 1_000_000))
