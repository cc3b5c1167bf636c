"""Which messages come too seldom: for a fit, and for an observer that samples faster than they come."""

from collections.abc import Collection, Mapping, Sequence
from statistics import median_high

from adapters.channels import Channel
from monitor.sampling.transform import SampleSource

SELDOM = frozenset({"GPS_RAW_INT", "SCALED_PRESSURE", "VFR_HUD", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"})
"""Messages that are slow by their nature; the transforms that read them delay the others."""
_POSITION = ("lat", "lon", "gps_alt")
"""Signals of transforms whose messages are as slow, whatever they are called."""

_ENOUGH = 0.8
"""Share of the wanted rate that is enough. Chosen: a rate a little below the wanted one is no reason for a
complaint."""
_SPANNED = 3.0
"""Samples between two messages from which on an observer interpolates more than it measures: two of three are
between."""


_FAR_BELOW = 0.5
"""Share of the other recordings' rate below which a recording slows the fit down. Chosen: at half the rate, means of
commands take twice as long."""
COMMANDS_PER_TICK = 2
"""Least number of commands in a tick. Measured on ArduPilot and PX4 at 10 Hz and on radios at 2 Hz: two detect a motor
with 12 to 15 % less thrust after 0.6 to 4 s, three after 0.5 to 11 s, with as few false alarms; more are later
still."""
_LEVELS = frozenset({"VIBRATION"})
"""Levels that autopilots average over some time: a higher rate would tell no more."""


def _seldom(channels: Collection[Channel]) -> frozenset[str]:
    return SELDOM | {channel.message for channel in channels if channel.name in _POSITION}


def slow_messages(
    recordings: Sequence[Mapping[str, float]], channels: Collection[Channel], wanted_hz: float
) -> dict[str, float]:
    """Return the messages that come clearly more seldom than wanted in some recording, and their rates.

    Recordings are given as messages per second by name; only messages of the channels count.
    """
    fast = sorted({channel.message for channel in channels} - _seldom(channels) - _LEVELS)
    rates = {name: min(recording.get(name, 0.0) for recording in recordings) for name in fast}
    return {name: rate for name, rate in rates.items() if rate < _ENOUGH * wanted_hz}


def slowest_text(recordings: Sequence[tuple[str, Mapping[str, float]]], slow: Collection[str]) -> str | None:
    """Return a line about recordings in which a slow message comes far more seldom than in the others, None if none.

    Recordings are given as names and messages per second by name; ``slow`` are names of messages.
    """
    usual = {message: median_high(rates.get(message, 0.0) for _, rates in recordings) for message in slow}
    found = []
    for log, rates in recordings:
        behind = [name for name, hz in usual.items() if rates.get(name, 0.0) < _FAR_BELOW * hz]
        if behind:
            name = min(behind, key=lambda message: rates.get(message, 0.0) / usual[message])
            found.append(f"{log} ({name} {rates.get(name, 0.0):.3g} Hz, others {usual[name]:.3g} Hz)")
    if not found:
        return None
    return f"all logs are fitted at the rates of the slowest; without it faults show sooner: {', '.join(found)}"


def slow_text(slow: Mapping[str, float], wanted_hz: float, *, onboard: bool, commands_hz: float | None = None) -> str:
    """Return a line about slow messages, of onboard logs or of links: what a higher rate would show, and how to get it.

    ``commands_hz`` is the rate of motor commands if a multirotor's are slow.
    """
    rates = ", ".join(f"{name} {rate:.3g} Hz" for name, rate in slow.items())
    gain = "" if commands_hz is None else f": {motor_gain(commands_hz)}"
    return f"slow telemetry: {rates}; {wanted_hz:g} Hz or more show faults sooner and smaller ones{gain}. " + (
        LOG_FASTER if onboard else _SEND_FASTER
    )


def motor_gain(commands_hz: float) -> str:
    """Return which loss of a motor 100 Hz would show, and which this many commands a second show instead.

    Measured by fits to healthy flights of two autopilots' simulators: the lines "sees" of docs/rates.md.
    """
    now = "10 to 30 %" if commands_hz >= _RADIO_HZ else "5 to 15 % within 10 to 20 s"
    return f"100 Hz would show a motor's loss of 1.5 to 3 % within 1 s instead of {now}"


_RADIO_HZ = 4.0
"""Border between the 10 Hz of logs and the 2 Hz of radios, on a logarithmic scale."""
_SEND_FASTER = (
    "Raise the rates in the autopilot (ArduPilot SRx_*, PX4 mavlink stream) or with [send] rates of fauio.toml, record "
    "again and fit again"
)
LOG_FASTER = (
    "Log at high rate (PX4: SDLOG_PROFILE 17) and fit again; ArduPilot logs motor outputs 10 times a second whatever "
    "is set: record telemetry instead (fauio record)"
)


def spanned(source: SampleSource, rate_hz: float, rates: Mapping[str, float]) -> dict[str, float]:
    """Return the messages between which an observer takes three samples or more, and how many samples.

    Messages whose values hold until the next one are left out: they may come only on a change. So are messages without
    a rate; ``rates`` are messages per second by name. For messages that come less than a third as often as in the
    fitted flights, the number is that ratio.
    """
    names = {channel.message for channel in source.channels if channel.interpolation == "linear"}
    if source.transform is not None:
        names -= _seldom(source.channels)
    grid_hz = rate_hz if source.transform is None else source.transform.rate_hz
    wanted = dict.fromkeys(names, rate_hz) | {name: min(hz, grid_hz) for name, hz in source.fitted_hz.items()}
    return {name: hz / rates[name] for name, hz in sorted(wanted.items()) if 0.0 < rates.get(name, 0.0) < hz / _SPANNED}


def unfitted(source: SampleSource, rate_hz: float, rates: Mapping[str, float]) -> str | None:
    """Return which messages come too seldom for an observer to watch anything, compared with its fit.

    None if none do.
    """
    slow = [name for name in spanned(source, rate_hz, rates) if name in source.fitted_hz]
    return ", ".join(f"{name} {rates[name]:.2g} Hz, fitted at {source.fitted_hz[name]:.3g} Hz" for name in slow) or None


def seldom_text(observer: str, source: SampleSource, rate_hz: float, rates: Mapping[str, float]) -> str | None:
    """Return a line about an observer that samples much faster than its messages come; None if it does not."""
    slow = spanned(source, rate_hz, rates)
    if not slow:
        return None
    if found := unfitted(source, rate_hz, rates):
        return f"{observer} watches nothing: {found}; fit it to recordings like this one"
    seldom = ", ".join(f"{name} {rates[name]:.2g} Hz" for name in slow)
    which = f"{seldom} for {rate_hz:g} samples a second"
    return f"{observer} detects faults late or not at all, and may raise false alarms: {which}"
