"""Put one fault or attack onto a recording, message by message, and note exactly what was altered."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from adapters.channels import ANY_CLOCK, Channel, parse_channel
from adapters.errors import TelemetryError, UsageError
from adapters.message import Message
from gains.plants.plant import Fault, Plant
from monitor.core.sampling import VehicleClock
from monitor.profile import ObserverProfile, Profile
from replay.attacks.attack import Attack, AttackSignal, Change
from replay.attacks.instruments import INSTRUMENTS, SPOOFED, AttackScene, Quantity, alike, channel_quantity, unit_of
from replay.attacks.plant_response import PlantResponse, States, find_fault, output_signals

_MALFORMED = (KeyError, TypeError, ValueError, OverflowError)
WITHOUT_PAST = ("loss", "bias", "ramp", "noise")
"""Kinds that do not depend on earlier measurements."""


class VehicleTime:
    """Determines the time of one vehicle's messages on its clock: their own stamp, else the newest stamp so far.

    ``clocks`` holds, by message, a channel that names the message's clock field, if the field's name does not show it.
    """

    def __init__(self, clocks: Mapping[str, Channel]) -> None:
        self._clocks = clocks
        self._clock = VehicleClock()

    def stamp(self, message: Message) -> int | None:
        """Return the time of a message, nanoseconds; None before the first stamp."""
        clock = self._clock
        stamp_ns = self._clocks.get(message.name, ANY_CLOCK).stamp_ns(message.fields)
        if stamp_ns is not None and (stamp_ns > 0 or (stamp_ns == 0 and not message.source.zero_stamp_is_unset)):
            stamp_ns = clock.unwrap(stamp_ns)
            if clock.observe(stamp_ns, message.received_ns):
                return stamp_ns
        return clock.newest_ns or None


@dataclass(slots=True)
class Senders:
    """Messages of one vehicle of a recording."""

    names: set[str]
    # first and newest time on its clock
    first_ns: int | None = None
    last_ns: int | None = None


def survey_senders(messages: Iterable[Message], clocks: Mapping[str, Channel]) -> dict[int, Senders]:
    """Read a recording once; return which messages each system sends and when."""
    senders: dict[int, tuple[Senders, VehicleTime]] = {}
    for message in messages:
        if message.system not in senders:
            senders[message.system] = Senders(set()), VehicleTime(clocks)
        sender, time = senders[message.system]
        sender.names.add(message.name)
        stamp_ns = time.stamp(message)
        if stamp_ns is not None:
            sender.first_ns = stamp_ns if sender.first_ns is None else sender.first_ns
            sender.last_ns = stamp_ns if sender.last_ns is None else max(sender.last_ns, stamp_ns)
    return {system: sender for system, (sender, _) in senders.items()}


def profile_clocks(profile: Profile | None) -> dict[str, Channel]:
    """Return, by message, a channel of the profile that names the message's clock."""
    observers = profile.observers if profile else ()
    channels = [channel for observer in observers for channel in observer.source.channels]
    return {channel.message: channel for channel in channels if channel.clock is not None}


@dataclass(frozen=True, slots=True)
class AttackTarget:
    """An altered quantity, how it is altered, and whether its alteration continues after the attack."""

    quantity: Quantity
    change: Change
    outlasts: bool = False


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that one attack alters."""

    targets: tuple[AttackTarget, ...]  # quantities to alter; for the kind ``drop`` the messages to lose
    response: PlantResponse | None = None  # response of the plant, if the attack has one
    unit: str = ""  # unit of the attack's size

    @property
    def messages(self) -> frozenset[str]:
        """Names of the messages that the attack may alter."""
        return frozenset(target.quantity.message for target in self.targets)


def plan(attack: Attack, names: Iterable[str], profile: Profile | None = None, states: States | None = None) -> Plan:
    """Determine what a checked attack has to alter.

    ``names`` are the messages of the recording, to distinguish ``MESSAGE`` from ``field``. The profile provides the
    plant for faults of actuators, and names of channels. A nonlinear plant also needs its ``states`` along the
    recording. Raises UsageError if the channel is unknown, or the kind does not go with it.
    """
    attack.check()
    channel, known = attack.channel, frozenset(names)
    if channel in INSTRUMENTS:
        return _instrument_plan(attack, INSTRUMENTS[channel])
    fault = find_fault(profile, channel) if profile is not None else None
    if fault is not None:
        return _plant_plan(attack, *fault, states)
    mapped = _field(channel, known, profile_clocks(profile))
    if mapped is not None:
        return _instrument_plan(attack, (channel_quantity(mapped),))
    faults = [fault.name for observer in (profile.observers if profile else ()) for fault in observer.faults]
    choice = ", ".join(dict.fromkeys((*INSTRUMENTS, *faults)))
    raise UsageError(
        f"--channel {channel}: no such channel; use one of {choice}, or MESSAGE.field with a message of the "
        f"log{'' if profile else '; a motor or another actuator needs --profile'}"
    )


def _field(channel: str, names: frozenset[str], clocks: Mapping[str, Channel]) -> Channel | None:
    """Return the channel that ``MESSAGE.field`` means; a Zenoh key may hold dots itself, so the longest name wins."""
    places = [place for place, letter in enumerate(channel) if letter == "." and channel[:place] in names]
    if not places or places[-1] == len(channel) - 1:
        return None
    message, path = channel[: places[-1]], channel[places[-1] + 1 :]
    try:
        mapped = parse_channel(channel, {"message": message, "field": path}, f"--channel {channel}")
    except TelemetryError as error:
        raise UsageError(str(error)) from error
    clock = clocks.get(message)
    return replace(mapped, clock=clock.clock, clock_unit_ns=clock.clock_unit_ns) if clock else mapped


def _instrument_plan(attack: Attack, quantities: Iterable[Quantity]) -> Plan:
    kind = attack.kind
    quantities = tuple(quantities)
    if kind == "loss":
        raise UsageError(f"--kind loss is for actuators with a model (--profile); {attack.channel} is a sensor")
    if kind == "spoof":
        if attack.channel not in SPOOFED:
            raise UsageError(f"--kind spoof moves a GPS: use --channel {' or '.join(SPOOFED)}, not {attack.channel}")
        position, velocity = attack.spoof()
        moved = INSTRUMENTS[SPOOFED[attack.channel]]
        targets = [AttackTarget(quantity, _plus(position)) for quantity in quantities]
        return Plan((*targets, *(AttackTarget(quantity, _plus(velocity)) for quantity in moved)), unit="m/s")
    if kind == "drop":
        return Plan(
            tuple(AttackTarget(quantity, _plus(lambda _: 0.0)) for quantity in quantities), unit="share of messages"
        )
    if kind == "scale" and any(quantity.circular for quantity in quantities):
        raise UsageError(f"--kind scale does not go with {attack.channel}: a heading has no size to scale")
    unit = {"scale": "times", "delay": "s"}.get(kind, unit_of(attack.channel))
    grows = f"{unit} per second" if kind == "ramp" and unit else unit
    return Plan(tuple(AttackTarget(quantity, attack.change(quantity.from_home)) for quantity in quantities), unit=grows)


def _plant_plan(attack: Attack, observer: ObserverProfile, plant: Plant, fault: Fault, states: States | None) -> Plan:
    """Return what a fault of a profile's plant alters: the outputs that it moves, and the autopilot's command."""
    channel, kind = attack.channel, attack.kind
    response, targets = None, list[AttackTarget]()
    if fault.kind == "sensor":
        signal = attack.additive()
        if signal is None:
            raise UsageError(f"--kind {kind} does not go with {channel} of the profile; use bias, ramp or noise")
        moves = output_signals(plant, fault, lambda stamp_ns: fault.column * signal(stamp_ns))
    else:
        size = attack.growth if kind == "loss" else attack.additive()
        if size is None or (fault.input is None) == (kind == "loss"):
            use = "bias, ramp or noise" if fault.input is None else "loss"
            raise UsageError(f"--kind {kind} does not go with {channel} of the profile; use {use}")
        if plant.nonlinearities and states is None:
            raise UsageError(f"--channel {channel}: {plant.name} is nonlinear; only its sensors can be put at fault")

        def acting(stamp_ns: int) -> float:
            return size(stamp_ns) if attack.acts(stamp_ns) else 0.0

        response = PlantResponse(plant, fault, observer.source.inputs, acting, states)
        moves = output_signals(plant, fault, response.at)
        if response.command is not None:
            targets.append(AttackTarget(channel_quantity(response.command), response.answer))
    mapped = {output.name: output for output in observer.source.outputs}
    for output, move in moves:
        if output not in mapped:
            raise UsageError(f"--channel {channel}: output {output} of {plant.name} comes from no single message")
        for quantity, factor in alike(mapped[output]):
            targets.append(AttackTarget(quantity, _plus(move, factor), outlasts=response is not None))
    return Plan(tuple(targets), response, "share of the command" if kind == "loss" else fault.unit)


def _plus(signal: AttackSignal, factor: float = 1.0) -> Change:
    return lambda stamp_ns, value: value + factor * signal(stamp_ns)


class Injector:
    """State of one attack on the messages of one vehicle: MAVLink ``system``, or 0 for telemetry without ids.

    ``altered`` counts the messages altered or dropped so far; ``clocks`` are those of :class:`VehicleTime`.
    """

    def __init__(self, attack: Attack, made: Plan, system: int, clocks: Mapping[str, Channel]) -> None:
        self._attack = attack
        self._response = made.response
        self._unit = made.unit
        self._system = system
        self._time = VehicleTime(clocks)
        self._scene = AttackScene()
        self._targets: dict[str, list[AttackTarget]] = {}
        for target in made.targets:
            self._targets.setdefault(target.quantity.message, []).append(target)
        self.altered = 0
        self._first_ns: int | None = None
        self._last_ns: int | None = None

    def feed(self, message: Message) -> Message | None:
        """Process a message of the recording; return it, altered if the attack alters it, or None if it is lost."""
        if message.system != self._system:
            return message
        stamp_ns = self._time.stamp(message)
        with suppress(*_MALFORMED):
            self._scene.feed(message)
        if stamp_ns is None:
            return message
        if self._response is not None:
            self._response.feed(message, stamp_ns)
        if stamp_ns < self._attack.start_ns and self._attack.kind in WITHOUT_PAST:
            return message
        targets = self._targets.get(message.name)
        if targets is None:
            return message
        if self._attack.kind == "drop":
            if self._attack.lost(stamp_ns):
                self._count(stamp_ns)
                return None
            return message
        fields = message.fields
        for target in targets:
            with suppress(*_MALFORMED):
                fields = self._alter(fields, target, stamp_ns)
        if fields == message.fields or fields is message.fields:
            return message
        self._count(stamp_ns)
        return replace(message, fields=fields)

    def _alter(self, fields: Mapping[str, Any], target: AttackTarget, stamp_ns: int) -> Mapping[str, Any]:
        quantity = target.quantity
        value = quantity.read(fields, self._scene)
        if value is None:
            return fields
        changed = target.change(stamp_ns, value)
        acts = self._attack.acts(stamp_ns) or (target.outlasts and stamp_ns >= self._attack.start_ns)
        return quantity.write(fields, changed, self._scene) if acts and changed != value else fields

    def _count(self, stamp_ns: int) -> None:
        self.altered += 1
        self._first_ns = stamp_ns if self._first_ns is None else min(self._first_ns, stamp_ns)
        self._last_ns = stamp_ns if self._last_ns is None else max(self._last_ns, stamp_ns)

    def truth(self) -> dict[str, Any]:
        """Return the truth about the attack, as one entry of ``faults``; ``numbers`` determine its course over time.

        ``on`` and ``off`` are the vehicle's time at the first and the last altered (or lost) message. For an actuator
        they are the first and the last command during its fault; its outputs respond later and longer.
        """
        attack, response = self._attack, self._response
        span = (self._first_ns, self._last_ns) if response is None else (response.first_ns, response.last_ns)
        on, off = (None if stamp_ns is None else {"time_boot_ms": stamp_ns // 1_000_000} for stamp_ns in span)
        return {
            "kind": attack.kind,
            "target": attack.channel,
            "magnitude": attack.magnitude,
            "meaning": attack.meaning,
            "numbers": {"size": attack.size, "rate": attack.rate, "acceleration": attack.acceleration},
            "unit": self._unit,
            "seed": attack.seed,
            "messages": self.altered,
            "on": on,
            "off": off,
        }


def inject(messages: Iterable[Message], injector: Injector) -> Iterator[Message]:
    """Yield the messages of a recording, altered by the injector's attack."""
    for message in messages:
        altered = injector.feed(message)
        if altered is not None:
            yield altered
