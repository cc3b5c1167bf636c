"""Which messages hold the speeds and currents of motors, and which speed controller drives which motor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adapters.channels import Channel
from monitor.core.lagged import exponential_mean
from monitor.fitting.fitted import FitRequest
from monitor.fitting.flights import raw_flights
from monitor.fitting.survey import ESC_MESSAGES, Survey
from monitor.sampling.gate import GateRule

_STATUS = "ESC_STATUS"
_OF_A_MESSAGE = 4
"""Number of speed controllers in a message of either kind."""
_COMPARED_HZ = 50.0
"""Rate of the grid on which commands and speeds are compared, hertz: it resolves a lag of 50 ms."""
_USUAL_LAG_S = 0.05
"""Usual lag of a motor, seconds: that of PX4's SIH, within a factor of two and a half of the lag of other motors (20 to
100 ms)."""
_CLEARLY = 0.05
"""Share of the speeds' variance that another order of controllers has to explain beyond the given one to be believed.
Chosen: after half a minute, noise adds less than a hundredth; in a flight that turns, a wrong order loses a tenth
and more."""


@dataclass(frozen=True, slots=True)
class EscSignals:
    """Channels of the measurements of speed controllers, one for each motor, and their rate."""

    speed: tuple[Channel, ...]  # rpm
    current: tuple[Channel, ...]  # A
    voltage: tuple[Channel, ...]  # V
    rate_hz: float
    hover: tuple[float, ...] = ()  # usual speeds in flight, rpm
    # whether the controllers measure voltages: otherwise speeds may be computed from commands, as by PX4's simulator
    measured: bool = True

    def ordered(self, order: Sequence[int], numbers: Sequence[int], hover: Sequence[float]) -> EscSignals:
        """Return the channels of some controllers, named after the outputs with these numbers.

        ``hover`` has all controllers.
        """

        def chosen(channels: tuple[Channel, ...], name: str) -> tuple[Channel, ...]:
            return tuple(replace(channels[at], name=f"{name}{n}") for at, n in zip(order, numbers, strict=True))

        return EscSignals(
            chosen(self.speed, "rpm"),
            chosen(self.current, "amps"),
            chosen(self.voltage, "volts"),
            self.rate_hz,
            tuple(float(hover[at]) for at in order),
            self.measured,
        )

    def thrusts(self) -> tuple[Channel, ...]:
        """Return the thrusts expected at the speeds, as shares of those in hover.

        They are u = 2 w - 1 of the speed w as a share of the usual one: the tangent of w^2, since thrust is quadratic
        in speed. Thrust has no lag after speed, so the thrust until the next tick is the mean until then.
        """
        return tuple(
            replace(
                channel,
                name=f"prop{channel.name.removeprefix('rpm')}",
                scale=rounded(2.0 / usual),
                offset=-1.0,
                interpolation="mean",
            )
            for channel, usual in zip(self.speed, self.hover, strict=True)
        )


def esc_signals(surveys: Sequence[Survey], motors: int) -> EscSignals | None:
    """Return the channels of all speed controllers that every recording reports; None if there are too few.

    Names are ``rpm1``, ``amps1``, ``volts1`` and so on in the order of the messages.
    """
    common = set.intersection(*(set(survey.rate_hz) for survey in surveys)) if surveys else set[str]()
    places: list[tuple[str, int, tuple[tuple[str, int | str], ...], float]] = []
    measured = _STATUS not in common or all(any(survey.examples[_STATUS].get("voltage", ())) for survey in surveys)
    if _STATUS in common:
        for slot in range((1 if motors <= _OF_A_MESSAGE else 2) * _OF_A_MESSAGE):
            where = (("index", slot - slot % _OF_A_MESSAGE),)
            places.append((_STATUS, slot % _OF_A_MESSAGE, where, 1.0))
    else:
        for message in (name for name in ESC_MESSAGES if name in common):
            # in hundredths of volts and amperes
            places += ((message, element, (), 0.01) for element in range(_OF_A_MESSAGE))
    if len(places) < motors:
        return None

    def channels(name: str, field: str, scaled: bool) -> tuple[Channel, ...]:
        return tuple(
            Channel(
                f"{name}{at}",
                message,
                (field, element),
                scale=scale if scaled else 1.0,
                where=where,
                interpolation="previous",
            )
            for at, (message, element, where, scale) in enumerate(places, start=1)
        )

    rate_hz = min(survey.rate_hz[message] for survey in surveys for message, *_ in places)
    return EscSignals(
        channels("rpm", "rpm", False),
        channels("amps", "current", True),
        channels("volts", "voltage", True),
        rate_hz,
        measured=measured,
    )


def motor_speeds(request: FitRequest, gate: GateRule, commands: Sequence[Channel]) -> EscSignals | None:
    """Return the reports of speed controllers for each motor, in the order of its commands; None if there are none.

    Autopilots number controllers after the outputs or in an order of their own. The speeds decide: each controller is
    assigned to the motor whose commands its speed follows best, all together, if that is clearly better than the order
    of the messages.
    """
    found = esc_signals(request.surveys, len(commands))
    if found is None:
        return None
    channels = (*commands, *(replace(channel, interpolation="linear") for channel in found.speed))
    keep = float(np.exp(-1.0 / (_USUAL_LAG_S * _COMPARED_HZ)))
    stretches = []
    for flight in raw_flights(request.logs, channels, _COMPARED_HZ, gate):
        u = flight.samples.u
        if len(u):
            lagged = exponential_mean(u[:, : len(commands)] - u[0, : len(commands)], keep)
            stretches.append(np.hstack([lagged + u[0, : len(commands)], u[:, len(commands) :]])[flight.armed])
    values = np.concatenate(stretches) if stretches else np.empty((0, len(channels)))
    if len(values) < _COMPARED_HZ:
        return None
    order = _order(values[:, : len(commands)], values[:, len(commands) :])
    if order is None:
        return None
    numbers = [int(channel.name.removeprefix("motor")) for channel in commands]
    hover = np.median(values[:, len(commands) :], axis=0)
    return found.ordered(order, numbers, hover.tolist()) if (hover[order] > 0.0).all() else None


def _order(commands: NDArray[np.float64], speeds: NDArray[np.float64]) -> list[int] | None:
    """Return the column of speeds (N, m) that follows each of the commands (N, s); None if one does not move."""
    from scipy.optimize import linear_sum_assignment

    turning = np.flatnonzero(speeds.std(axis=0) > 0.0)
    if len(turning) < commands.shape[1] or not (commands.std(axis=0) > 0.0).all():
        return None
    both = np.corrcoef(commands.T, speeds[:, turning].T)
    explained = np.clip(both[: commands.shape[1], commands.shape[1] :], 0.0, None) ** 2
    rows, best = linear_sum_assignment(-explained)
    usual = np.arange(commands.shape[1])
    if explained[rows, best].mean() < explained[usual, usual].mean() + _CLEARLY:
        best = usual
    return [int(turning[at]) for at in best]


def rounded(value: float) -> float:
    """Return a number rounded to six digits, as a profile holds it."""
    return float(f"{value:.6g}")
