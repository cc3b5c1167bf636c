"""The alarm desk: what operators do with alarms, after ISA-18.2.

Evidence raises, updates and clears the alarms. The desk adds the operators' side:

- acknowledged: an operator knows the alarm; this is withdrawn when the alarm becomes critical or returns;
- shelved: a channel is silent until a stated time. Its alarm begins as ``shelved``, its updates are not published, and
  it is raised again, with the same id, if it is still active at that time;
- latched: an alarm of such a channel stays active after its cause is gone, until an operator resets it;
- reset: ends any alarm; its observer restarts, and raises another alarm if the cause is still there;
- out of service: a channel publishes nothing; its active alarm clears, and is a new alarm if its cause is still there
  afterwards;
- flood: if too many alarms are raised at once, further warnings are shelved until the flood is over, and one alarm
  reports it. Critical alarms are never held back;
- one cause, one alarm: a finding that names the cause of an active alarm more exactly (a speed controller whose motor
  turns too slowly, for a motor that delivers less) becomes part of that alarm, which stays active until both are gone.

The desk numbers the events. It knows time only from messages, so a replay of a recording repeats what it did.
"""

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from monitor.event import AlarmEvent, alarm_id, fixed_rule_event

OBSERVER = "monitor"
FLOOD = "flood"
FLOOD_KEY = (OBSERVER, FLOOD)
MAX_SHELVE_NS = 30 * 86_400 * 1_000_000_000
"""Longest shelving: a month. ISA-18.2 requires that shelving ends by itself. The configuration sets less."""
AS_BEFORE = " (as before the monitor changed)"

ChannelKey = tuple[str, str]

MAX_FLOOD = 1_000_000
"""Largest number of alarms and of seconds in a rule. Chosen: a larger number is a mistake in a recorded rule."""


@dataclass(frozen=True, slots=True)
class DeskRule:
    """How the desk treats which channels; a channel is written ``observer/channel``."""

    latched: frozenset[str] = frozenset()  # channels whose alarms stay active until an operator resets them
    out_of_service: frozenset[str] = frozenset()  # channels that are out of service
    # a flood begins with this many alarms raised within ``flood_s`` seconds; 0: never
    flood_raised: int = 10
    flood_s: float = 60.0


def desk_rule(fields: Mapping[str, object], default: DeskRule) -> DeskRule:
    """Return the rule that a message's fields describe; missing or malformed fields keep their default."""

    def names(key: str, before: frozenset[str]) -> frozenset[str]:
        entries = fields.get(key)
        if not isinstance(entries, Sequence) or isinstance(entries, str):
            return before
        return frozenset(name for name in entries if isinstance(name, str))

    raised, within = fields.get("flood_raised"), fields.get("flood_s")
    return DeskRule(
        latched=names("latched", default.latched),
        out_of_service=names("out_of_service", default.out_of_service),
        flood_raised=raised if isinstance(raised, int) and 0 <= raised <= MAX_FLOOD else default.flood_raised,
        flood_s=float(within) if isinstance(within, int | float) and 0 < within <= MAX_FLOOD else default.flood_s,
    )


def rule_fields(rule: DeskRule) -> dict[str, object]:
    """Return the fields that :func:`desk_rule` reads back."""
    return {
        "latched": sorted(rule.latched),
        "out_of_service": sorted(rule.out_of_service),
        "flood_raised": rule.flood_raised,
        "flood_s": rule.flood_s,
    }


@dataclass(slots=True)
class _Active:
    """An active alarm: its last event, and what the desk knows about it."""

    event: AlarmEvent
    silent: bool = False
    """Whether nothing has been published since it was shelved."""
    text: str = ""
    """Its own sentence, without those of the findings."""
    findings: dict[ChannelKey, AlarmEvent] = field(default_factory=dict)
    """Last events of the findings that name its cause more exactly."""
    over: AlarmEvent | None = None
    """The event that clears it as soon as the findings are gone, too."""


class AlarmDesk:
    """The alarms of one vehicle as operators see them.

    ``general`` gives, for each channel of findings, the channels whose alarms the finding becomes part of.
    """

    def __init__(
        self, vehicle: str, rule: DeskRule, general: Mapping[str, Collection[str]] = MappingProxyType({})
    ) -> None:
        self.rule = rule
        self._general = general
        self.seq = 0
        self._vehicle = vehicle
        self._active: dict[ChannelKey, _Active] = {}
        self._shelved: dict[ChannelKey, int] = {}
        self._raised_ns: deque[int] = deque(maxlen=rule.flood_raised + 1)
        self._flood_until_ns = 0
        self._held_back: set[ChannelKey] = set()
        self._unserved: dict[ChannelKey, AlarmEvent] = {}

    @property
    def active(self) -> tuple[AlarmEvent, ...]:
        """The last event of every active alarm."""
        return tuple(entry.event for entry in self._active.values())

    @property
    def shelved(self) -> Mapping[str, int]:
        """Shelved channels and the Unix times at which shelving ends, nanoseconds."""
        return {_text(key): until for key, until in self._shelved.items()}

    @property
    def shelved_by_operators(self) -> Mapping[str, int]:
        """The same without the channels that a flood holds back."""
        return {_text(key): until for key, until in self._shelved.items() if key not in self._held_back}

    def set_rule(self, rule: DeskRule, now_ns: int) -> list[AlarmEvent]:
        """Apply another rule from now on; return the events of channels that go out of service or return to service."""
        self.rule = rule
        self._raised_ns = deque(self._raised_ns, maxlen=rule.flood_raised + 1)
        published = []
        for key in [key for key in self._active if _text(key) in rule.out_of_service]:
            entry = self._active.pop(key)
            if not entry.event.latched and key != FLOOD_KEY:
                self._unserved[key] = entry.event
            published.append(self._numbered(_cleared(entry.event, now_ns, "taken out of service")))
            for finer, event in entry.findings.items():
                published.extend(self._take_raised(finer, replace(event, state="raised", time_ns=now_ns)))
        for key in [key for key in self._unserved if _text(key) not in rule.out_of_service]:
            event = replace(self._unserved.pop(key), state="raised", time_ns=now_ns, since_ns=now_ns)
            plain = replace(event, acknowledged=False, shelved_until_ns=None)
            published.extend(self._take_raised(key, replace(plain, id=alarm_id(self._vehicle, *key, now_ns))))
        return published

    def process(self, event: AlarmEvent) -> list[AlarmEvent]:
        """Process an alarm's event; return the events to publish."""
        key = event.observer, event.channel
        if _text(key) in self.rule.out_of_service:
            if event.state == "cleared":
                self._unserved.pop(key, None)
            else:
                self._unserved[key] = event
            return []
        if (refined := self._refined(key, event)) is not None:
            return self._refine(refined, key, event)
        if event.state == "raised":
            return self._take_raised(key, event)
        entry = self._active.get(key)
        if entry is None:
            return []
        # An alarm that returned while it was latched keeps its id.
        event = replace(event, id=entry.event.id, since_ns=entry.event.since_ns)
        if event.state == "cleared" and entry.findings:
            entry.over = event
            return self._keep_joined(entry, replace(event, state="updated"))
        if event.state == "cleared":
            if _text(key) in self.rule.latched:
                text = f"{event.message}; latched until reset"
                return self._keep(entry, replace(event, state="updated", message=text), latched=True)
            del self._active[key]
            return [self._numbered(self._carry(entry, event))]
        entry.text = event.message
        return self._keep_joined(entry, event)

    def findings(self, key: ChannelKey) -> tuple[ChannelKey, ...]:
        """Return the channels whose findings are part of a channel's active alarm."""
        entry = self._active.get(key)
        return () if entry is None else tuple(entry.findings)

    def _refined(self, key: ChannelKey, event: AlarmEvent) -> _Active | None:
        """Return the active alarm that this finding becomes part of, or None if the event is an alarm of its own."""
        known = next((entry for entry in self._active.values() if key in entry.findings), None)
        if known is not None or event.state != "raised" or key in self._active or key in self._shelved:
            return known
        general = self._general.get(key[1], ())
        active = (entry for other, entry in self._active.items() if other[1] in general and not entry.event.latched)
        return next(active, None)

    def _refine(self, entry: _Active, key: ChannelKey, event: AlarmEvent) -> list[AlarmEvent]:
        """Add a finding to the alarm whose cause it names.

        Mere updates of the finding are published with the alarm's next event.
        """
        was = entry.findings.get(key)
        if event.state == "cleared":
            del entry.findings[key]
            if entry.over is not None and not entry.findings:
                ended = replace(entry.over, time_ns=event.time_ns, vehicle_time_ms=event.vehicle_time_ms)
                entry.over = None
                return self.process(ended)
        else:
            entry.findings[key] = event
            worse = was is None or (event.severity, was.severity) == ("critical", "warning")
            if not worse and entry.over is None:
                return []
        now = replace(entry.event, time_ns=event.time_ns, vehicle_time_ms=event.vehicle_time_ms)
        return self._keep_joined(entry, replace(now, state="updated"))

    def _keep_joined(self, entry: _Active, event: AlarmEvent) -> list[AlarmEvent]:
        """Store an update together with the findings' sentences; a more severe one has to be acknowledged again."""
        joined = _joined(entry, event)
        worse = joined.severity == "critical" and entry.event.severity != "critical"
        return self._keep(entry, joined, acknowledged=entry.event.acknowledged and not worse)

    def tick(self, now_ns: int) -> list[AlarmEvent]:
        """Advance the Unix time to ``now_ns``; return the events of shelvings and floods that end by then."""
        events: list[AlarmEvent] = []
        if not self._shelved and FLOOD_KEY not in self._active:
            return events
        # If the clock was set back, a flood of seconds must not last hours.
        self._flood_until_ns = min(self._flood_until_ns, now_ns + round(self.rule.flood_s * 1e9))
        for key in self._held_back:
            self._shelved[key] = self._flood_until_ns
        # In the order of their ends and at those times, so that the result does not depend on when the next message
        # comes.
        ends = [(until, 0, key) for key, until in self._shelved.items()]
        ends += [(self._flood_until_ns, 1, FLOOD_KEY)] * (FLOOD_KEY in self._active)
        for until, is_flood, key in sorted(end for end in ends if end[0] <= now_ns):
            if not is_flood:
                self._unshelve(key)
                events.extend(self._raise_again(key, until, "it was shelved until now"))
            elif not (flood := self._active[key].event).latched:
                events.extend(self.process(_cleared(flood, until, "the flood of alarms is over")))
        return events

    @property
    def due_ns(self) -> int | None:
        """Unix time at which the next shelving or flood ends; None if nothing is shelved and there is no flood."""
        ends = [
            max(until, self._flood_until_ns if key in self._held_back else 0) for key, until in self._shelved.items()
        ]
        ends += [self._flood_until_ns] * (FLOOD_KEY in self._active)
        return min(ends, default=None)

    def refusal(self, verb: str, fields: Mapping[str, object]) -> str | None:
        """Return why an operator's command cannot be carried out, or None if it can."""
        if verb not in ("ack", "shelve", "unshelve", "reset"):
            return f"'{verb}' is no command; commands are ack, shelve, unshelve, reset"
        key = self.key(fields)
        wanted = fields.get("id") or fields.get("channel")
        if key is None:
            return f"no alarm '{wanted}' is active; ids and channels of those that are: {self._names()}"
        entry = self._active.get(key)
        if verb == "unshelve":
            return None if key in self._shelved else f"{_text(key)} is not shelved"
        if verb == "shelve":
            until = fields.get("until_ns")
            if isinstance(until, bool) or not isinstance(until, int):
                return "shelving needs 'until_ns', the Unix time at which it ends, in nanoseconds"
            return None
        if entry is None:
            return f"no alarm of {_text(key)} is active"
        return None

    def operate(self, verb: str, fields: Mapping[str, object], now_ns: int) -> list[AlarmEvent]:
        """Carry out an operator's command; a command that :meth:`refusal` rejects changes nothing."""
        key = self.key(fields)
        if key is None or self.refusal(verb, fields) is not None:
            return []
        entry = self._active.get(key)
        if verb == "shelve":
            until = fields["until_ns"]
            assert isinstance(until, int)  # noqa: S101 - refusal() has looked
            self._shelved[key] = min(until, now_ns + MAX_SHELVE_NS)
            self._held_back.discard(key)
            if entry is None:
                return []
            entry.silent = True
            changes = {"state": "shelved", "shelved_until_ns": self._shelved[key]}
            return [self._publish(entry, now_ns, _with(entry, _by("shelved", fields)), **changes)]
        if verb == "unshelve":
            self._unshelve(key)
            return self._raise_again(key, now_ns, _by("unshelved", fields))
        assert entry is not None  # noqa: S101 - refusal() has looked
        if verb == "ack":
            if entry.event.acknowledged:
                return []
            text = _with(entry, _by("acknowledged", fields))
            return [self._publish(entry, now_ns, text, state="acknowledged", acknowledged=True)]
        del self._active[key]
        event = _cleared(entry.event, now_ns, _by("reset", fields))
        return [self._numbered(replace(event, latched=False))]

    def adopt(
        self,
        alarms: Sequence[AlarmEvent],
        watched: Collection[ChannelKey],
        now_ns: int,
        shelved: Mapping[str, int] = MappingProxyType({}),
    ) -> list[AlarmEvent]:
        """Continue from the active alarms of an earlier run, or of another monitor.

        ``alarms`` holds the last event of each alarm, in the order of their numbers; ``watched`` the channels that can
        still clear by themselves; ``shelved`` the shelved channels, with or without an alarm, and the ends of shelving.
        Return every alarm once more: as updated if its subscribers know it, as raised if only this desk knew it, as
        cleared if its channel is no longer watched.
        """
        alarms = [replace(event, message=event.message.removesuffix(AS_BEFORE)) for event in alarms]
        known = {(event.observer, event.channel): event for event in alarms}
        own = [key for key in self._active if key not in known]
        published = []
        for event in alarms:
            if known[event.observer, event.channel] is not event:
                gone = replace(event, state="cleared", time_ns=now_ns, message="a later alarm took its place")
                published.append(self._numbered(gone))
        for name, until in shelved.items():
            observer, _, channel = name.partition("/")
            key = observer, channel
            if key not in known and until > now_ns:
                self._shelved.setdefault(key, min(until, now_ns + MAX_SHELVE_NS))
        for key, event in known.items():
            self._active[key] = entry = _Active(event, event.shelved_until_ns is not None, event.message)
            if event.shelved_until_ns is not None:
                self._shelved[key] = event.shelved_until_ns
            if key == FLOOD_KEY:
                self._flood_until_ns = event.time_ns + round(self.rule.flood_s * 1e9)
            serves = _text(key) not in self.rule.out_of_service
            if not serves or (key not in watched and key != FLOOD_KEY and not event.latched):
                del self._active[key]
                if key in watched and not event.latched:
                    self._unserved[key] = event
                published.append(self._numbered(_cleared(event, now_ns, "no longer watched")))
                continue
            state = "shelved" if entry.silent else "updated"
            published.append(self._publish(entry, now_ns, event.message + AS_BEFORE, state=state))
        for key in own:
            entry = self._active[key]
            published.append(
                self._publish(entry, now_ns, entry.event.message, state="shelved" if entry.silent else "raised")
            )
        return published

    def _take_raised(self, key: ChannelKey, event: AlarmEvent) -> list[AlarmEvent]:
        before = self._active.get(key)
        if before is not None:
            if before.over is not None:
                before.over, before.text = None, event.message
                again = replace(event, id=before.event.id, since_ns=before.event.since_ns, state="updated")
                return self._keep_joined(before, again)
            text = f"{event.message}; it came back before it was reset"
            again = replace(event, id=before.event.id, since_ns=before.event.since_ns, state="updated", message=text)
            return self._keep(before, again, latched=False, acknowledged=False)
        published = self._flood(event)
        if event.severity == "critical" and key in self._held_back:
            self._unshelve(key)
        elif event.severity == "warning" and event.time_ns < self._flood_until_ns and key not in self._shelved:
            self._shelved[key] = self._flood_until_ns
            self._held_back.add(key)
        return [*published, self._enter(key, event)]

    def _enter(self, key: ChannelKey, event: AlarmEvent) -> AlarmEvent:
        """Activate an alarm; return its event, shelved or not."""
        if (until := self._shelved.get(key)) is not None:
            event = replace(event, state="shelved", shelved_until_ns=until)
        entry = self._active[key] = _Active(self._numbered(event), until is not None, event.message)
        return entry.event

    def _unshelve(self, key: ChannelKey) -> None:
        del self._shelved[key]
        self._held_back.discard(key)

    def _flood(self, event: AlarmEvent) -> list[AlarmEvent]:
        """Count a raised alarm; return the alarm that reports a flood if this one begins it."""
        # Alarms about the monitor itself or the link are no reason to shelve alarms about the vehicle.
        if not self.rule.flood_raised or event.kind in ("stale", "system", "security", "blind"):
            return []
        now_ns, within_ns = event.time_ns, round(self.rule.flood_s * 1e9)
        self._raised_ns.append(now_ns)
        full = len(self._raised_ns) == self._raised_ns.maxlen
        if not full or now_ns - self._raised_ns[0] > within_ns:
            return []
        self._flood_until_ns = now_ns + within_ns
        if FLOOD_KEY in self._active or _text(FLOOD_KEY) in self.rule.out_of_service:
            return []
        first = fixed_rule_event(
            self._vehicle,
            OBSERVER,
            FLOOD,
            kind="system",
            state="raised",
            unit="alarms",
            threshold=float(self.rule.flood_raised),
            time_ns=now_ns,
            vehicle_time_ms=event.vehicle_time_ms,
            message=f"more than {self.rule.flood_raised} alarms in {self.rule.flood_s:g} s: "
            "further warnings are shelved until it is over; look at the first ones",
        )
        return [self._enter(FLOOD_KEY, first)]

    def _keep(self, entry: _Active, event: AlarmEvent, **flags: Any) -> list[AlarmEvent]:
        """Store an update; return it unless its channel is shelved."""
        carried = replace(self._carry(entry, event), **flags)
        key = event.observer, event.channel
        if entry.silent and event.severity == "critical" and key in self._held_back:
            self._unshelve(key)
            entry.silent = False
            carried = replace(carried, state="raised", shelved_until_ns=None)
        if entry.silent:
            entry.event = replace(carried, seq=entry.event.seq, state="shelved")
            return []
        entry.event = self._numbered(carried)
        return [entry.event]

    def _carry(self, entry: _Active, event: AlarmEvent) -> AlarmEvent:
        """Return an event with the flags of the event before it."""
        was = entry.event
        kept = {name: getattr(was, name) for name in ("acknowledged", "latched", "shelved_until_ns")}
        return replace(event, **kept, part=event.part or was.part)

    def _raise_again(self, key: ChannelKey, now_ns: int, why: str) -> list[AlarmEvent]:
        entry = self._active.get(key)
        if entry is None:
            return []
        entry.silent = False
        return [self._publish(entry, now_ns, _with(entry, why), state="raised", shelved_until_ns=None)]

    def _publish(self, entry: _Active, now_ns: int, text: str, **changes: Any) -> AlarmEvent:
        """Return a numbered event about an active alarm, which keeps its own sentence."""
        time_ns = max(now_ns, entry.event.time_ns)
        published = self._numbered(replace(entry.event, time_ns=time_ns, message=text, **changes))
        entry.event = replace(published, message=entry.event.message)
        return published

    def _numbered(self, event: AlarmEvent) -> AlarmEvent:
        self.seq += 1
        return replace(event, seq=self.seq)

    def key(self, fields: Mapping[str, object]) -> ChannelKey | None:
        """Return the channel that a command names, by an alarm's id or by name; it need not have an alarm."""
        wanted = fields.get("id")
        for key, entry in self._active.items():
            if wanted is not None and entry.event.id == wanted:
                return key
        name = fields.get("channel")
        if wanted is not None or not isinstance(name, str):
            return None
        observer, slash, channel = name.partition("/")
        if slash:
            return observer, channel
        named = [key for key in (*self._active, *self._shelved) if key[1] == name]
        return named[0] if named else None

    def _names(self) -> str:
        return ", ".join(f"{entry.event.id} ({_text(key)})" for key, entry in self._active.items()) or "none"


def _cleared(event: AlarmEvent, now_ns: int, text: str) -> AlarmEvent:
    return replace(event, state="cleared", time_ns=now_ns, message=text)


def _joined(entry: _Active, event: AlarmEvent) -> AlarmEvent:
    """Return an alarm's event with the sentences of its findings, as severe as the most severe of them."""
    findings = list(entry.findings.values())
    own = [entry.text] if entry.over is None else []
    return replace(
        event,
        message="; ".join([*own, *(finding.message for finding in findings)]),
        severity="critical" if any(raised.severity == "critical" for raised in (event, *findings)) else event.severity,
        part=findings[-1].channel if findings else event.part,
    )


def _with(entry: _Active, what: str) -> str:
    """Return an alarm's own sentence, followed by what the operator did."""
    return f"{entry.event.message} ({what})"


def _by(what: str, fields: Mapping[str, object]) -> str:
    """Return the action, the operator and the reason, as far as they are given."""
    by, reason = fields.get("by"), fields.get("reason")
    return (
        what
        + (f" by {by}" if isinstance(by, str) and by else "")
        + (f": {reason}" if isinstance(reason, str) and reason else "")
    )


def _text(key: ChannelKey) -> str:
    return "/".join(key)
