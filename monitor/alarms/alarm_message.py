"""What an alarm says to a pilot, in one sentence: which part, what is wrong with it, by how much."""

from __future__ import annotations

import math

from monitor.event import Kind, State

DEFLECTION = "fraction of full deflection"
"""Unit of surfaces, steering and throttle."""

_ACTS = {"steering": ("turns", ""), "throttle": ("pushes", "")}
_HAS_EFFECT = ("has", " effect")
_AXES = {"north": ("north", "south"), "east": ("east", "west"), "down": ("below", "above")}


def alarm_message(
    observer: str, channel: str, kind: Kind, unit: str, state: State, size: float, relative: float | None
) -> str:
    """Return the sentence.

    Parameters
    ----------
    observer, channel : str
        What the alarm watches.
    kind : Kind
        Sort of trouble.
    unit : str
        Unit of ``size``.
    state : State
        The alarm's state.
    size : float
        Signed size of the fault.
    relative : float | None
        Its share of the command, where there is one.
    """
    if state == "cleared":
        return f"{channel} is back to normal"
    if kind == "residual":
        return f"{observer}: no known fault explains what is measured ({size:.1f} times healthy)"
    if kind == "actuator" and unit == DEFLECTION:
        if relative is None:
            return f"{channel} acts {100 * abs(size):.0f} % of full deflection off where it is commanded"
        verb, noun = _ACTS.get(channel, _HAS_EFFECT)
        return f"{channel} {verb} {100 * abs(relative):.0f} % {'less' if relative < 0 else 'more'}{noun} than commanded"
    if kind == "actuator" and relative is not None:
        return f"{channel} delivers {100 * abs(relative):.0f} % {'less' if relative < 0 else 'more'} than commanded"
    if channel.startswith("disturbance_"):
        return f"{channel.removeprefix('disturbance_')} is disturbed by {_size(size, unit)}: no fault"
    found = _sensor(channel, unit, size)
    if found is not None:
        return found
    return (
        f"{channel} reads {_size(size, unit)} off" if kind == "sensor" else f"{channel} is off by {_size(size, unit)}"
    )


def _sensor(channel: str, unit: str, size: float) -> str | None:
    """Return the sentence for a sensor whose name the field knows, None for any other."""
    name, _, axis = channel.rpartition("_")
    amount = f"{abs(size):.3g} {unit}"
    if name == "gps":
        if axis not in _AXES:
            return None
        word = f"{_AXES[axis][size < 0]}{'' if axis == 'down' else ' of'}"
        return f"GPS is {amount} {word} where the inertial sensors say"
    if name == "gps_velocity":
        words = {"down": ("down", "up")}.get(axis, _AXES.get(axis))
        return None if words is None else f"GPS velocity is {amount} too much {words[size < 0]}"
    if channel == "baro":
        return f"barometer reads {amount} too {'high' if size > 0 else 'low'}"
    if channel == "compass":
        return (
            f"compass is {abs(math.degrees(size)):.0f} degrees too far {'clockwise' if size > 0 else 'anticlockwise'}"
        )
    if channel == "airspeed":
        return f"airspeed reads {amount} too {'fast' if size > 0 else 'slow'}"
    if name in ("gyro", "accel", "attitude"):
        part = {"gyro": "gyro", "accel": "accelerometer", "attitude": "attitude"}[name]
        return f"{part} {axis} reads {amount} too {'much' if size > 0 else 'little'}"
    return None


def _size(value: float, unit: str) -> str:
    return f"{value:+.3g} {unit}".rstrip()
