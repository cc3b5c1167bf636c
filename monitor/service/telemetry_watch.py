"""Find why observers get no samples: telemetry that does not come, comes too seldom, or belongs to another vehicle."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from adapters.batch import Fields
from monitor.profile import ObserverProfile
from monitor.sampling.slow_telemetry import seldom_text

_LACKING_NS = 5_000_000_000
"""Time after which a message counts as missing. Chosen: ten times the half second of silence that is a gap."""
_PERIODS = 5
"""The same for slow observers, in their own periods: each message has to come twice before the first sample, and
the next one has to show that none is late. A vehicle's VIBRATION, once in 2 s, gave a sample 8 to 10 s after a gap."""
_COUNTED_NS = 10_000_000_000
"""Time over which samples are counted. Chosen: at 10 Hz and more their share is known to 1 %."""
_FEWEST_SAMPLES = 20
"""Fewest samples of which a share has a meaning."""
_SET_BACK_NS = 1_000_000_000
"""A time of arrival that is earlier by more than this shows that the clock was set back."""


class TelemetryWatch:
    """Counts which messages come and which observers sample, from Unix time ``now_ns`` on.

    ``needs`` names the messages that each observer's channels come from; ``latest_ns`` is the time of the last such
    message, at first that of the start.
    """

    def __init__(self, observers: Sequence[ObserverProfile], needs: Mapping[str, frozenset[str]], now_ns: int) -> None:
        self.latest_ns = now_ns
        self._observers = tuple(observers)
        self._needs = needs
        self._needed = frozenset[str]().union(*needs.values())
        self._since_ns = now_ns
        self._silent = True
        channels = [channel for observer in observers for channel in observer.source.channels]
        self._least = {channel.message: channel.at_least for channel in channels if channel.at_least}
        self._short: dict[str, str] = {}
        self._received: dict[str, int] = {}
        self._sampled: dict[str, int] = {}
        self._counts: Counter[str] = Counter()
        self._samples: Counter[str] = Counter()
        self._counted_ns = self._asked_ns = now_ns
        self._slow: dict[str, str] = {}

    def count_messages(self, name: str, received_ns: int, count: int = 1, fields: Fields | None = None) -> None:
        """Count messages of the vehicle of one name, with their fields as columns, the last received at a Unix time."""
        if name in self._needed:
            if fields and name in self._least:
                self._short[name] = next(
                    (
                        f"{name} says {field} {fields[field][-1]:g} and counts from {least:g} on"
                        for field, least in self._least[name]
                        if field in fields and not fields[field][-1] >= least
                    ),
                    "",
                )
            if self._silent:
                # an observer needs some time from its first messages to its first sample
                self._since_ns, self._silent = received_ns, False
            self._received[name] = received_ns
            # Of the messages of a batch the newest counts, unless the clock was set back.
            if not 0 <= self.latest_ns - received_ns < _SET_BACK_NS:
                self.latest_ns = received_ns
            self._counts[name] += count

    def count_samples(self, observer: str, count: int = 1) -> None:
        """Count samples of an observer."""
        self._sampled[observer] = self.latest_ns
        self._samples[observer] += count

    def pause(self, now_ns: int) -> None:
        """Begin anew, after a time without messages or in which they were not processed in time."""
        self._since_ns, self._silent, self._asked_ns = now_ns, True, now_ns
        self._slow = {}
        self._count_anew(now_ns)

    def lacks(self, now_ns: int) -> list[str]:
        """Return why observers cannot watch as they should, a line for each."""
        self._count(now_ns)
        found = []
        for observer in self._observers:
            if nothing := self._nothing(observer, now_ns):
                found.append(nothing)
            elif slow := self._slow.get(observer.name):
                found.append(slow)
        return found

    def _count(self, now_ns: int) -> None:
        away_ns, self._asked_ns = now_ns - self._asked_ns, now_ns
        if not 0 <= away_ns < _COUNTED_NS:
            # This runs every second: the clock was set, or the process was stopped.
            self.pause(now_ns)
        elif now_ns - self._counted_ns >= _COUNTED_NS:
            lines = {observer.name: self._seldom(observer) for observer in self._observers}
            self._slow = {name: line for name, line in lines.items() if line}
            self._count_anew(now_ns)

    def _count_anew(self, now_ns: int) -> None:
        self._counts.clear()
        self._samples.clear()
        self._counted_ns = now_ns

    def _nothing(self, observer: ObserverProfile, now_ns: int) -> str | None:
        lacking_ns = max(_LACKING_NS, round(_PERIODS * 1e9 / observer.rate_hz))
        if now_ns - max(self._since_ns, self._sampled.get(observer.name, 0)) < lacking_ns:
            return None
        names = self._needs[observer.name]
        missing = sorted(name for name in names if now_ns - self._received.get(name, 0) >= lacking_ns)
        short = sorted(self._short[name] for name in names if self._short.get(name))
        why = f"no {', '.join(missing)}" if missing else "; ".join(short) or "no times in common"
        return f"{observer.name} watches nothing: {why}"

    def _seldom(self, observer: ObserverProfile) -> str | None:
        samples = self._samples[observer.name]
        if samples < _FEWEST_SAMPLES:
            return None
        # by the vehicle's clock, which in a simulation may run at another speed
        rates = {name: observer.rate_hz * count / samples for name, count in self._counts.items()}
        return seldom_text(observer.name, observer.source, observer.rate_hz, rates)
