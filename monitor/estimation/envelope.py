"""The limits of the motion that an observer was fitted on, and how its sizes grow outside of them.

If sensors are compared through the vehicle's attitude, errors of scale and of timing grow in proportion to the tilt and
to the rates that they act on. Sizes were calibrated on flights that reached some tilt and some rate; at f times as much
they are f times as large, and as integrated signals remember their errors, so is f. Inside, f is 1.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from math import degrees, exp, radians

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples
from adapters.toml_tables import Table
from monitor.core.excitation import Beyond

_MEMORY_S = 30.0
"""Time constant with which the excess fades, seconds: that of the washed-out positions and angles, in which errors stay
for that time."""
WORTH_SAYING = 1.25
"""Excess from which people are told. Chosen: a quarter beyond is another kind of flying, and no gust."""
_ORDINARY = (radians(30.0), radians(60.0), 0.0)
"""Tilt and rate of ordinary flight, by ArduPilot's defaults (ANGLE_MAX, ATC_SLEW_YAW): errors of a hover are noise, and
do not grow in proportion to its tilt of a degree or two. Without these limits a jump of GPS by 5 m was missed over a
radio."""
_SIGNALS = ("roll", "pitch", "xgyro", "ygyro", "zgyro", "gps_speed")


@dataclass(frozen=True, slots=True)
class Envelope:
    """Largest tilt (rad), body rate (rad/s) and speed (m/s) of the flights that were fitted; 0: not measured."""

    tilt: float = 0.0
    rate: float = 0.0
    speed: float = 0.0


def read_envelope(table: Table) -> Envelope:
    """Return the envelope of an observer's table, its fields by name; mistakes are recorded in its file."""
    found = Envelope(**{key.name: table.number(key.name, 0.0, at_least=0.0) for key in fields(Envelope)})
    table.done()
    return found


def reached(signals: Sequence[str], rows: Sequence[NDArray[np.float64]], rate_hz: float) -> Envelope:
    """Return the envelope of raw signals by name, in stretches (n, number of signals) of healthy flight."""
    largest, begins = np.zeros(3), np.ones(1, np.bool_)
    core = _core(Envelope(), signals, rate_hz)
    for stretch in rows:
        for row in stretch:
            core.run(row[None], begins, np.array([0]))
            largest = np.fmax(largest, core.reached)
    return Envelope(*(float(f"{size:.3g}") for size in largest))


def _core(envelope: Envelope, signals: Sequence[str], rate_hz: float) -> Beyond:
    columns = [signals.index(name) if name in signals else -1 for name in _SIGNALS]
    fitted = [envelope.tilt, envelope.rate, envelope.speed]
    return Beyond(
        [max(size, least) if size > 0.0 else 0.0 for size, least in zip(fitted, _ORDINARY, strict=True)],
        columns,
        exp(-1.0 / (_MEMORY_S * rate_hz)),
        WORTH_SAYING,
    )


class EnvelopeStage:
    """Computes how far a flight is outside of the envelope, sample by sample."""

    def __init__(self, envelope: Envelope, signals: Sequence[str], rate_hz: float) -> None:
        self._envelope, self._rate_hz = envelope, rate_hz
        self._core = _core(envelope, signals, rate_hz)

    def run(self, raw: Samples, ends: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the factor on the sizes at some of n rows of raw signals (m,)."""
        return self._core.run(raw.u, raw.restart, ends)

    @property
    def outside(self) -> str | None:
        """The latest excess over the fitted flights, for people; None if there was none."""
        return outside_text(self._sizes(self._core.reached), self._core.factor)

    @property
    def furthest(self) -> tuple[float, str] | None:
        """For how long, seconds, and how far a run was outside of the fitted flights; None if it was not."""
        sizes, after = self._sizes(self._core.furthest), "only larger faults are detected there and 30 s after"
        return furthest_text(sizes, self._core.rows / self._rate_hz, after)

    def _sizes(self, sizes: Sequence[float]) -> Iterator[tuple[str, float, float, str]]:
        units = (("tilt", "degrees", degrees(1.0)), ("rate", "rad/s", 1.0), ("speed", "m/s", 1.0))
        for (name, unit, scale), now, key in zip(units, sizes, fields(Envelope), strict=True):
            yield name, scale * now, scale * getattr(self._envelope, key.name), unit


def excess_text(sizes: Iterable[tuple[str, float, float, str]]) -> str | None:
    """Return which sizes (name, now, in the fitted flights, unit) are worth telling; None if there are none.

    A size of 0 in the fitted flights was not measured there.
    """
    parts = (
        f"{name} {now:.3g} {unit}, fitted to {fitted:.3g}"
        for name, now, fitted, unit in sizes
        if fitted > 0.0 and now > WORTH_SAYING * fitted
    )
    return "; ".join(parts) or None


def furthest_text(
    sizes: Iterable[tuple[str, float, float, str]], seconds: float, after: str
) -> tuple[float, str] | None:
    """Return for how long and how far a run was outside of the fitted flights, and the consequence.

    None: it was not.
    """
    text = excess_text(sizes)
    return None if text is None else (seconds, f"outside the fitted flights: {text}; {after}")


def outside_text(sizes: Iterable[tuple[str, float, float, str]], factor: float) -> str | None:
    """Return which sizes of a flight are outside of the fitted ones, and the factor on the faults detected there."""
    text = excess_text(sizes)
    # a speed changes no size, and 1.04 would read "1 times as large"
    detected = f"only faults {factor:.2g} times as large" if factor >= 1.05 else "faults of the usual size"
    return text and f"outside the fitted flights ({text}): {detected} are detected"
