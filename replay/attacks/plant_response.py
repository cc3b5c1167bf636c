"""The response of a plant's outputs to a fault of an actuator, which an injected loss adds to recorded measurements.

With the plant in discrete time, the deviation from the recorded flight obeys

    dx(k+1) = A dx(k) + E f(k),   dy(k) = C dx(k),   f(k) = sum_d h_d phi(k-d),

where a loss l of an actuator with the command u and the static curve v(u) has phi = v((1 - l) u) - v(u), as if its
command were multiplied by 1 - l after it was recorded; other faults have phi = f. For the observer of a linear plant
this is exact, whatever the commands are. Nonlinearities add G (g(H (x + dx)) - g(H x)) to dx(k+1), as accurately as the
state x is known along the recording.

An autopilot compensates a loss: it commands more until the motor delivers the thrust that the flight needs. Without
that, the rates of a multirotor would grow to turns per second, and neither attitude nor velocity would fit them. So for
an output of an autopilot (SERVO_OUTPUT_RAW) the command changes: u' = u / (1 - l), at most full command, and

    phi = v((1 - l) u') - v(u)

is zero unless the command is at its limit: motion and all measurements stay as recorded and fit each other. The
autopilot is assumed to answer at once; a real one lags, and the rates change meanwhile. Commands of other plants stay
as recorded.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapters.channels import Channel
from adapters.errors import UsageError
from adapters.message import Message
from gains.plants.discretise import discretise
from gains.plants.expression import compile_expression
from gains.plants.plant import Fault, Plant
from monitor.estimation.input_curve import effect_of_command
from monitor.profile import ObserverProfile, Profile
from replay.attacks.attack import AttackSignal

_MAX_STEPS = 2000
"""Longest time without a sample, ticks. Chosen: after 20 s at 100 Hz the response restarts, as observers do."""
_AUTOPILOT_OUTPUT = "SERVO_OUTPUT_RAW"
_FULL_COMMAND = 1.0
"""Largest command: commands are fractions of full throw."""


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """States along a recording."""

    times_ns: NDArray[np.int64]  # vehicle nanoseconds, ascending (N,)
    x: NDArray[np.float64]  # state at each time (N, n)

    def at(self, stamp_ns: int) -> NDArray[np.float64]:
        """Return the newest state at a time; before the first one, the first."""
        row = int(np.searchsorted(self.times_ns, stamp_ns, side="right")) - 1
        return np.asarray(self.x[max(row, 0)])


class PlantResponse:
    """State of the deviation of a discrete plant with an actuator fault.

    ``inputs`` are the channels of the commands, ``size`` is the loss or fault over time (vehicle nanoseconds). The
    deviation of a nonlinear plant depends on the states along the recording; without them its nonlinearities are left
    out. ``command`` is the channel of the autopilot's answer, None if no autopilot answers; ``first_ns`` and
    ``last_ns`` are the stamps of the first and the last command during the fault.
    """

    def __init__(
        self, plant: Plant, fault: Fault, inputs: Sequence[Channel], size: AttackSignal, states: States | None = None
    ) -> None:
        self._A, self._C, self._column = plant.A, plant.C, fault.column
        self._G, self._states = plant.G, states
        self._g = [(compile_expression(g.expression, g.arguments), g.rows) for g in plant.nonlinearities]
        self._step_ns = 1e9 / (plant.rate_hz or 1.0)
        self._taps = np.array(plant.taps)
        self._size = size
        self._channel: Channel | None = None
        self._curve: NDArray[np.float64] = np.ones((1, 1))
        if fault.input is not None:
            self._channel = next((channel for channel in inputs if channel.name == fault.input), None)
            if self._channel is None:
                raise UsageError(f"{fault.name}: the profile has no channel '{fault.input}', so it cannot lose effect")
            if plant.curves:
                self._curve = np.array([plant.curves[plant.inputs.index(fault.input)]])
        answered = self._channel is not None and self._channel.message == _AUTOPILOT_OUTPUT
        self.command = self._channel if answered else None
        self._command: float | None = None
        self._restart(0)
        # the time of the last question, and the answer
        self._asked_ns: int | None = None
        self._asked = np.zeros(len(self._C))
        self.first_ns: int | None = None
        self.last_ns: int | None = None

    def _restart(self, tick: int) -> None:
        self._tick = tick
        self._before = self._after = np.zeros(len(self._A))
        self._effects = deque([0.0] * len(self._taps), maxlen=len(self._taps))

    def feed(self, message: Message, stamp_ns: int) -> None:
        """Process a message of the vehicle."""
        channel = self._channel
        if channel is None:
            if self._size(stamp_ns):
                self._mark(stamp_ns)
            return
        if message.name == channel.message and channel.selects(message.fields):
            value = channel.value(message.fields)
            if value is not None:
                self._command = value
                if self._size(stamp_ns) and value:
                    self._mark(stamp_ns)

    def answer(self, stamp_ns: int, u: float) -> float:
        """Return the command with which the autopilot replaces a recorded one."""
        size = self._size(stamp_ns)
        if self.command is None or not size or u <= 0.0:
            return u
        most = max(u, _FULL_COMMAND)
        return most if size >= 1.0 else min(u / (1.0 - size), most)

    def at(self, stamp_ns: int) -> NDArray[np.float64]:
        """Return the deviation of the outputs (p,) at a time, interpolated between two samples."""
        if stamp_ns == self._asked_ns:
            # each output of a message asks for itself
            return self._asked
        place = stamp_ns / self._step_ns
        tick = int(place // 1)
        if abs(tick - self._tick) > _MAX_STEPS:
            self._restart(tick)
        while self._tick <= tick:
            self._advance()
        ahead = min(1.0, max(0.0, place - self._tick + 1.0))
        self._asked_ns, self._asked = stamp_ns, self._C @ (self._before + ahead * (self._after - self._before))
        return self._asked

    def _advance(self) -> None:
        """Advance by one sample."""
        self._effects.appendleft(self._effect(round(self._tick * self._step_ns)))
        self._before = self._after
        self._after = self._A @ self._before + self._column * float(self._taps @ np.array(self._effects))
        if self._g and self._states is not None:
            # G (g(H (x + dx)) - g(H x))
            x = self._states.at(round(self._tick * self._step_ns))
            changes = [g(*rows @ (x + self._before)) - g(*rows @ x) for g, rows in self._g]
            self._after = self._after + self._G @ np.array(changes)
        self._tick += 1

    def _effect(self, stamp_ns: int) -> float:
        """Return phi at a time."""
        size = self._size(stamp_ns)
        if not size or self._channel is None:
            return size
        u = 0.0 if self._command is None else self._command
        answer = self.answer(stamp_ns, u)
        if size < 1.0 and answer == u / (1.0 - size):
            return 0.0
        commands = np.array([[(1.0 - size) * answer], [u]])
        lost, whole = effect_of_command(self._curve, commands)[:, 0]
        return float(lost - whole)

    def _mark(self, stamp_ns: int) -> None:
        self.first_ns = stamp_ns if self.first_ns is None else min(self.first_ns, stamp_ns)
        self.last_ns = stamp_ns if self.last_ns is None else max(self.last_ns, stamp_ns)


def find_fault(profile: Profile, channel: str) -> tuple[ObserverProfile, Plant, Fault] | None:
    """Return the observer that estimates a fault, its plant sampled at the observer's rate, and the fault."""
    for observer in profile.observers:
        if observer.model is not None and any(fault.name == channel for fault in observer.faults):
            plant = discretise(observer.model, observer.rate_hz)
            return observer, plant, next(fault for fault in plant.faults if fault.name == channel)
    return None


def output_signals(
    plant: Plant, fault: Fault, response: Callable[[int], NDArray[np.float64]]
) -> list[tuple[str, AttackSignal]]:
    """Return the outputs that a fault moves and their deviation over time, given the response of all outputs."""
    if fault.kind == "sensor":
        moved = fault.column != 0.0
    else:
        reach, column = np.zeros(len(plant.outputs), dtype=bool), fault.column
        for _ in plant.states:
            reach |= np.abs(plant.C @ column) > 0.0
            column = plant.A @ column
        moved = reach
    return [
        (name, lambda stamp_ns, o=o: float(response(stamp_ns)[o]))  # type: ignore[misc]
        for o, name in enumerate(plant.outputs)
        if moved[o]
    ]
