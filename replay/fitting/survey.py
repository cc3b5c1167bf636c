"""What a recording holds: message names, senders, rates; and which of them can feed a multirotor's channels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from adapters.channels import Channel
from adapters.errors import TelemetryError
from adapters.message import LATEST_NS, Message
from adapters.sampling.phase import FlightPhase
from adapters.sampling.strapdown_channels import INERTIAL_MESSAGES

MOTOR_MESSAGE = "SERVO_OUTPUT_RAW"
_GPS_MESSAGE = "GPS_RAW_INT"
_UNKNOWN = 65_535
_OUTPUTS_PER_MESSAGE = 16
_GRAVITY = 9.80665
_STILL_US = 0.5
_IDLE_US = 1050.0

_RATES = (
    ("ATTITUDE", ("rollspeed", "pitchspeed", "yawspeed"), 1.0),
    ("HIGHRES_IMU", ("xgyro", "ygyro", "zgyro"), 1.0),
    ("ATTITUDE_QUATERNION", ("rollspeed", "pitchspeed", "yawspeed"), 1.0),
)
_VERTICAL = (
    ("HIGHRES_IMU", "zacc", 1.0),
    ("SCALED_IMU", "zacc", _GRAVITY / 1000.0),
    ("RAW_IMU", "zacc", _GRAVITY / 1000.0),
)
_SPEED_MESSAGES = frozenset({"VFR_HUD", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"})
_CHANNEL_MESSAGES = frozenset({MOTOR_MESSAGE} | {name for name, *_ in (*_RATES, *_VERTICAL)})
FIT_MESSAGES = _CHANNEL_MESSAGES | _SPEED_MESSAGES | INERTIAL_MESSAGES | FlightPhase.interests


@dataclass(frozen=True, slots=True)
class Survey:
    """Counts of a recording's messages by name, their largest rates, and how each servo output moved while armed.

    Parameters
    ----------
    counts : dict[str, int]
        Messages by name.
    rate_hz : dict[str, float]
        Messages per second of the vehicle's clock, by name, for those that carry a time.
    outputs : dict[int, tuple[float, float]]
        Servo output number -> mean and standard deviation of its pulse while armed, microseconds.
    examples : dict[str, Mapping[str, Any]]
        Fields of the last message of each name while armed; of the GPS, the last that knew speed and course.
    """

    counts: dict[str, int]
    rate_hz: dict[str, float]
    outputs: dict[int, tuple[float, float]]
    examples: dict[str, Mapping[str, Any]] = field(default_factory=dict)


def survey(messages: Iterable[Message]) -> Survey:
    """Go through a recording once."""
    counts: Counter[str] = Counter()
    spans: dict[str, tuple[int, int]] = {}
    sums: dict[int, list[float]] = {}
    armed = True
    clock = Channel("clock", "", ("",))
    examples: dict[str, Mapping[str, Any]] = {}
    for message in messages:
        counts[message.name] += 1
        if armed and not (message.name == _GPS_MESSAGE and _UNKNOWN in map(message.fields.get, ("vel", "cog"))):
            examples[message.name] = message.fields
        stamp = clock.stamp_ns(message.fields)
        if stamp and abs(stamp) < LATEST_NS:
            first, _ = spans.get(message.name, (stamp, stamp))
            spans[message.name] = (first, stamp)
        if message.name == "HEARTBEAT" and message.fields.get("autopilot") != 8:
            mode = message.fields.get("base_mode")
            armed = isinstance(mode, int) and bool(mode & 128)
        elif message.name == MOTOR_MESSAGE and armed and not message.fields.get("port"):
            for number in range(1, _OUTPUTS_PER_MESSAGE + 1):
                pulse = message.fields.get(f"servo{number}_raw")
                if isinstance(pulse, int) and 0 < pulse <= _UNKNOWN:
                    total = sums.setdefault(number, [0.0, 0.0, 0.0])
                    total[0] += 1
                    total[1] += pulse
                    total[2] += pulse * pulse
    rates = {name: (counts[name] - 1) * 1e9 / (last - first) for name, (first, last) in spans.items() if last > first}
    outputs = {
        number: (total / count, max(0.0, square / count - (total / count) ** 2) ** 0.5)
        for number, (count, total, square) in sorted(sums.items())
    }
    return Survey(dict(counts), rates, outputs, examples)


def of_one_vehicle(messages: Iterable[Message]) -> Iterator[Message]:
    """Yield the messages of the first system that sends motor commands, rates or accelerations, from then on."""
    system: int | None = None
    for message in messages:
        if system is None and message.name in _CHANNEL_MESSAGES:
            system = message.system
        if message.system == system:
            yield message


def multirotor_channels(surveys: Sequence[Survey]) -> tuple[tuple[Channel, ...], tuple[Channel, ...]]:
    """Choose the input and output channels of a multirotor from what every recording holds.

    Motors are the servo outputs that moved above idle while armed, numbered after the output.

    Raises
    ------
    TelemetryError
        A message that is needed is missing; the text says which to stream.
    """
    common = set.intersection(*(set(found.rate_hz) for found in surveys))
    rates = next((source for source in _RATES if source[0] in common), None)
    vertical = next((source for source in _VERTICAL if source[0] in common), None)
    if rates is None:
        raise TelemetryError(f"no body rates in every log; record one of {', '.join(s[0] for s in _RATES)} at 50 Hz+")
    if vertical is None:
        raise TelemetryError(
            f"no vertical acceleration in every log; record one of {', '.join(s[0] for s in _VERTICAL)} at 50 Hz+"
        )
    if MOTOR_MESSAGE not in common:
        raise TelemetryError(f"no motor commands in every log; record {MOTOR_MESSAGE} at 50 Hz or more")
    motors = [
        number
        for number in range(1, _OUTPUTS_PER_MESSAGE + 1)
        if all(_is_motor(found.outputs.get(number)) for found in surveys)
    ]
    if len(motors) < 3:
        raise TelemetryError(f"{MOTOR_MESSAGE} shows {len(motors)} outputs that move in flight; a multirotor has more")
    inputs = tuple(
        Channel(
            f"motor{number}",
            MOTOR_MESSAGE,
            (f"servo{number}_raw",),
            scale=0.001,
            offset=-1.0,
            where=(("port", 0),),
        )
        for number in motors
    )
    names = ("roll_rate", "pitch_rate", "yaw_rate")
    outputs = tuple(
        Channel(name, rates[0], (field,), scale=rates[2]) for name, field in zip(names, rates[1], strict=True)
    )
    message, field, scale = vertical
    return inputs, (*outputs, Channel("vertical_acceleration", message, (field,), scale=scale))


def common_rate_hz(surveys: Sequence[Survey], channels: Sequence[Channel]) -> float:
    """Return the rate of the grid: the slowest channel's in the slowest log, rounded to a whole number of hertz."""
    slowest = min(found.rate_hz[channel.message] for found in surveys for channel in channels)
    return float(max(1, round(slowest)))


def _is_motor(moved: tuple[float, float] | None) -> bool:
    return moved is not None and moved[0] > _IDLE_US and moved[1] > _STILL_US
