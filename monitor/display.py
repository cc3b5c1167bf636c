"""Sizes in people's words: the only module that turns a number and its unit into words."""

import math
from collections.abc import Mapping

_TURN = 180.0 / math.pi
_UNITS: Mapping[str, tuple[float, str]] = {
    "rad": (_TURN, "degrees"),
    "rad/s": (_TURN, "degrees/s"),
    "rad/s^2": (_TURN, "degrees/s²"),
    "m/s^2": (1.0, "m/s²"),
    "fraction of full command": (100.0, "% of full thrust"),
    "share of the command": (100.0, "% of the command"),
    "share of messages": (100.0, "% of messages"),
    "share": (100.0, "%"),
}
"""People's name for a unit, and the factor from the unit to it."""
_FRACTION, _LOGARITHM = "fraction of ", "natural logarithm of times"
_SHARES: Mapping[str, str] = {
    "fraction of full command": "% of thrust",
    "fraction of full deflection": "% of effect",
    "fraction of speed at hover": "% of speed",
    "fraction of current at hover": "% of current",
    "fraction of thrust at hover": "% of thrust",
    "fraction of usual resistance": "% of resistance",
}
_WHOLE_MINUTES = 5
"""Minutes from which seconds are left out. Chosen: nobody counts seconds then."""
_LARGEST = 1e30
"""Larger than any measurement; sizes may come from a network."""


def display_unit(unit: str, usual_command: float | None = None) -> tuple[float, str]:
    """Return the factor from a unit to the one that people use, and the name of that unit.

    An actuator's loss is given as a share of its usual command if that is known.
    """
    if usual_command is not None:
        return 100.0 / usual_command, share_unit(unit)
    if unit in _UNITS:
        return _UNITS[unit]
    of, _, time = unit.rpartition("/")
    if of in _UNITS:
        factor, name = _UNITS[of]
        return factor, f"{name}/{time}"
    return (100.0, f"% of {unit.removeprefix(_FRACTION)}") if unit.startswith(_FRACTION) else (1.0, unit)


def share_unit(unit: str) -> str:
    """Return people's unit for a percentage of the command, of an actuator whose sizes have this unit."""
    return _SHARES.get(unit, "% of the command")


def size_text(size: float, unit: str, usual_command: float | None = None, *, signed: bool = False) -> str:
    """Return a size in one of the monitor's units in people's words: ``5.73 degrees``; per cent have two digits."""
    if unit == _LOGARITHM:
        return f"{number_text(math.exp(min(size, 50.0)), 2)} times"
    factor, name = display_unit(unit, usual_command)
    return f"{number_text(factor * size, 2 if '%' in name else 3, signed=signed)} {name}".rstrip()


def doubt_text(deviation: float, unit: str, share: float | None) -> str:
    """Return the uncertainty of a size in people's words; ``share`` converts it to a share of the command."""
    if share is not None or unit == _LOGARITHM:
        # a logarithm's deviation is nearly the relative deviation of the number
        return f"{percent_text(abs(deviation * (share or 1.0)))} %"
    return size_text(deviation, unit)


def fault_text(channel: str, estimate: float | None, relative: float | None, unit: str) -> str:
    """Return the size of a fault, as a share of the command if that is known; empty if there is no size."""
    if not isinstance(unit, str):  # from a network, not yet checked
        return ""
    if _is_size(relative):
        return f"{percent_text(float(relative or 0.0), signed=True)} {share_unit(unit)}"
    if not _is_size(estimate):
        return ""
    size = float(estimate or 0.0)
    # The estimate of a heading may count whole turns; a compass is off by half a turn at most.
    return size_text(math.remainder(size, math.tau) if channel == "compass" else size, unit, signed=True)


def battery_text(ohm: float, amps: float, left_s: float) -> str:
    """Return a battery's resistance, its voltage drop at the present current, and how long its charge lasts at it."""
    left = "" if left_s <= 0.0 else f"; {_time_text(left_s)} left at this current"
    return f"{number_text(1000.0 * ohm)} milliohms, {number_text(ohm * amps, 2)} V at {number_text(amps)} A{left}"


def _time_text(seconds: float) -> str:
    minutes, rest = divmod(round(min(seconds, _LARGEST)), 60)
    return f"{minutes} min" if minutes >= _WHOLE_MINUTES else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def percent_text(share: float, *, signed: bool = False) -> str:
    """Return a share as a percentage, without the sign for per cent."""
    return number_text(100.0 * share, 2, signed=signed)


def number_text(value: float, digits: int = 3, *, signed: bool = False) -> str:
    """Return a number with this many significant digits, whole numbers without an exponent."""
    sign = "+" if signed else ""
    text = f"{value + 0.0:{sign}.{digits}g}"
    return f"{value:{sign}.0f}" if "e+" in text and abs(value) < _LARGEST else text


def _is_size(value: object) -> bool:
    return type(value) in (int, float) and -_LARGEST <= value <= _LARGEST  # type: ignore[operator]
