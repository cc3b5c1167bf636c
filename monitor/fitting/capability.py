"""What a profile will detect and how fast: faults put onto healthy samples, the monitor's own chain run over them.

A fault that scales an input is a loss: the actuator executes (1 - loss) of the command recorded. Any other fault is a
step of its size, of either sign; so is one of an input that healthy flight commands so little that losing half of it
stays below the alarm threshold. Noise, gusts and model error are those of the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples
from gains.plants.discretise import discretise
from gains.plants.plant import Plant
from monitor.alarms.excuse import Excuses
from monitor.chain import ObserverChain, alarm_events
from monitor.core.sampling import VehicleClock
from monitor.estimation.affine import AffineObserver
from monitor.estimation.input_curve import effect_of_command
from monitor.fitting.flights import Flight
from monitor.fitting.progress import track
from monitor.fitting.superpose import effect_change, fault_response
from monitor.profile import FaultChannel, ObserverProfile
from monitor.sampling.gate import GateRule

WITHIN_S = (2.0, 1.0, 0.25)
"""Delays the smallest detected fault is asked for, seconds."""
ONSETS = 3

_LEAD_S = 2.0
_LONGEST_LEAD_S = 10.0
_TIME_CONSTANTS = 5.0
_WATCHED_S = 1.0
_TAIL_S = 1.0
_LOSSES = (0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.07, 0.10, 0.15, 0.20, 0.30, 0.50)
_DIGITS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
_STEPS = 12
_ACTIVE_S = 0.5
_ACTIVE_SHARE = 0.5
_GUESS = 1.2

_Calm = tuple[list[tuple[int, str]], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class Detection:
    """How a fault of one size was detected.

    Parameters
    ----------
    size : float
        Loss as a fraction of the command, or step in the channel's unit.
    median_s, worst_s : float | None
        Delay from onset to alarm over all onsets, seconds; None where an onset was missed.
    only : bool
        Whether that channel's alarm was the only one at every onset tried.
    """

    size: float
    median_s: float | None
    worst_s: float | None
    only: bool


@dataclass(frozen=True, slots=True)
class Capability:
    """What will be detected of one fault channel.

    Parameters
    ----------
    channel, unit : str
        The fault channel; its unit is empty where sizes are losses.
    loss : bool
        Whether sizes are fractions of the command.
    smallest : tuple[tuple[float, float | None], ...]
        Delay in seconds and the smallest size detected always, alone and within it; None where no size tried was.
    largest : float
        Largest size that could be tried.
    detections : tuple[Detection, ...]
        All sizes tried, ascending; empty where no healthy stretch is long enough.
    """

    channel: str
    unit: str
    loss: bool
    smallest: tuple[tuple[float, float | None], ...]
    largest: float
    detections: tuple[Detection, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """Healthy samples around an onset, the number of those before it, the sign of a step, and x^ since the onset."""

    samples: Samples
    before: int
    sign: float
    x: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Bench:
    """What faults of one channel are put on."""

    observer: ObserverProfile
    plant: Plant
    gate: GateRule
    fault: FaultChannel
    loss: bool
    windows: tuple[_Window, ...]


def capability(
    observer: ObserverProfile,
    plant: Plant,
    flights: Sequence[Flight],
    gate: GateRule,
    within_s: Sequence[float] = WITHIN_S,
    onsets: int = ONSETS,
) -> tuple[Capability, ...]:
    """Measure what an observer detects, for each fault channel whose alarm has a positive threshold.

    A ladder of sizes is searched from about the threshold outwards: of each channel about four sizes are run at each of
    the onsets, over the time the observer needs to settle (3 to 10 s) and the slowest delay asked for.

    Parameters
    ----------
    observer : ObserverProfile
        The observer with its alarm rules.
    plant : Plant
        The plant it was designed for, with all the faults of a bank; continuous or of the observer's rate.
    flights : Sequence[Flight]
        Healthy samples, as the observer takes them.
    gate : GateRule
        Gives the time an observer settles.
    within_s : Sequence[float]
        Delays asked for, seconds.
    onsets : int
        How many onsets to try, spread evenly over the flights (those where the command matters, for a loss).

    Raises
    ------
    ModelError
        The plant cannot be sampled at the observer's rate.
    """
    sampled = discretise(plant, observer.rate_hz)
    limits = sorted(within_s, reverse=True)
    thresholds = {rule.channel: rule.threshold for rule in observer.alarms}
    found = []
    calm: dict[tuple[int, int], _Calm] = {}
    for fault in track(observer.faults, f"measuring what {observer.name} will detect", "faults"):
        threshold = thresholds.get(fault.name, 0.0)
        if threshold <= 0.0:
            continue
        loss = _is_loss(fault, threshold, flights)
        sizes = _LOSSES if loss else step_sizes(threshold)
        bench = _Bench(observer, sampled, gate, fault, loss, ())
        windows = _windows(bench, flights, limits[0] + _TAIL_S, onsets, calm)
        bench = replace(bench, windows=windows)
        likely = _GUESS * threshold / (_typical_command(fault, flights) if loss else 1.0)
        found.append(_search(bench, sizes, limits, int(np.searchsorted(sizes, likely))))
    return tuple(found)


def capability_text(one: Capability) -> str:
    """Return a line for people: ``motor1: 4 % within 1 s, 10 % within 0.25 s``."""
    if not one.detections:
        return f"{one.channel}: not measured, no healthy stretch in the logs is long and quiet enough"
    parts: list[str] = []
    fastest: dict[float, float] = {size: within for within, size in one.smallest if size is not None}
    for size, within in sorted(fastest.items()):
        parts.append(f"{_size(one, size)} within {within:g} s")
    if not parts:
        slowest = max(within for within, _ in one.smallest)
        parts.append(f"nothing up to {_size(one, one.largest)} always and alone within {slowest:g} s")
    return f"{one.channel}: {', '.join(parts)}"


def step_sizes(threshold: float) -> tuple[float, ...]:
    """Return round sizes (1, 1.5, 2, 3, 5, 7, 10, ...) from about half a positive alarm threshold upwards."""
    decade = 10.0 ** np.floor(np.log10(threshold / 2.0))
    # Rounded so that sizes read as written: 0.3, not 0.30000000000000004.
    rungs = [float(f"{digit * decade * 10.0**power:.2g}") for power in range(4) for digit in _DIGITS]
    start = max(i for i, size in enumerate(rungs) if size <= threshold / 2.0 * (1.0 + 1e-9))
    return tuple(rungs[start : start + _STEPS])


def _is_loss(fault: FaultChannel, threshold: float, flights: Sequence[Flight]) -> bool:
    """Return whether losing the most of the input that is tried would matter."""
    if fault.input is None:
        return False
    return _LOSSES[-1] * _typical_command(fault, flights) >= threshold


def _typical_command(fault: FaultChannel, flights: Sequence[Flight]) -> float:
    """Return the root mean square of the command that a fault scales, zero where there is no sample."""
    at = 0 if fault.input is None else fault.input
    command = np.concatenate([flight.samples.u[flight.armed, at] for flight in flights])
    return float(np.sqrt(np.mean(command**2))) if len(command) else 0.0


def _lead_s(observer: ObserverProfile, gate: GateRule) -> float:
    """Return how long an observer started afresh needs until it can be watched."""
    slowest_s = AffineObserver(observer.gains).slowest_s()
    return min(_LONGEST_LEAD_S, gate.settle_s + max(_LEAD_S, _TIME_CONSTANTS * slowest_s))


def _search(bench: _Bench, sizes: Sequence[float], limits: Sequence[float], guess: int) -> Capability:
    """Find the smallest size for each of the delays, slowest first, beginning with size number ``guess``."""
    tried: dict[int, Detection] = {}

    def detection(at: int) -> Detection:
        if at not in tried:
            tried[at] = _detect(bench, sizes[at])
        return tried[at]

    smallest: list[tuple[float, float | None]] = []
    start = 0 if bench.windows else len(sizes)
    for within in limits:
        start = guess = _first(detection, start, len(sizes), within, guess)
        smallest.append((within, sizes[start] if start < len(sizes) else None))
    return Capability(
        channel=bench.fault.name,
        unit="" if bench.loss else bench.fault.unit,
        loss=bench.loss,
        smallest=tuple(smallest),
        largest=sizes[-1],
        detections=tuple(tried[at] for at in sorted(tried)),
    )


def _windows(
    bench: _Bench,
    flights: Sequence[Flight],
    after_s: float,
    onsets: int,
    calm: dict[tuple[int, int], _Calm],
) -> tuple[_Window, ...]:
    """Return healthy stretches around onsets spread evenly over the flights, where the input matters for a loss.

    ``calm`` keeps what happened without a fault, by flight and start, for the next channel.
    """
    observer, fault = bench.observer, bench.fault
    rate_hz = observer.rate_hz
    before, after = round(_lead_s(observer, bench.gate) * rate_hz), round(after_s * rate_hz)
    places: list[tuple[int, int]] = []
    strengths: list[NDArray[np.float64]] = []
    for number, flight in enumerate(flights):
        good = (flight.armed & ~flight.samples.restart).astype(np.float64)
        if len(good) < before + after:
            continue
        whole = np.convolve(good, np.ones(before + after), "valid") > before + after - 0.5
        starts = np.flatnonzero(whole)
        places.extend((number, int(start)) for start in starts)
        if bench.loss and fault.input is not None:
            effect = np.abs(effect_of_command(observer.gains[0].input_curves, flight.samples.u)[:, fault.input])
            ahead = max(1, round(_ACTIVE_S * rate_hz))
            mean = np.convolve(effect, np.full(ahead, 1.0 / ahead), "valid")
            strengths.append(mean[np.minimum(starts + before, len(mean) - 1)])
    if strengths:
        strength = np.concatenate(strengths)
        enough = _ACTIVE_SHARE * float(np.sqrt(np.mean(strength**2)))
        places = [place for place, size in zip(places, strength, strict=True) if size >= enough]
    found = []
    for i in range(onsets if places else 0):
        number, start = places[int((i + 0.5) / onsets * len(places))]
        samples = flights[number].part(start, start + before + after).samples
        window = _Window(samples, before, -1.0 if i % 2 else 1.0, np.zeros(0))
        if (number, start) not in calm:
            calm[number, start] = _run(bench, window, np.zeros((after, len(bench.plant.outputs))))
        raised, x = calm[number, start]
        # A stretch that raises an alarm by itself says nothing about a fault put onto it.
        if not raised:
            found.append(replace(window, x=x))
    return tuple(found)


def _first(detection: Callable[[int], Detection], start: int, stop: int, within: float, guess: int) -> int:
    """Return the first size from ``start`` on that is detected alone and within a delay, ``stop`` if there is none.

    Bisection once the answer is bracketed by strides that double from the guess.
    """
    low, high, stride = start - 1, stop, 1
    at = min(max(guess, start), stop - 1)
    while high - low > 1:
        found = detection(at)
        if found.only and found.worst_s is not None and found.worst_s <= within:
            high = at
        else:
            low = at
        if low < start:
            at = max(start, high - stride)
        elif high == stop:
            at = min(stop - 1, low + stride)
        else:
            at = (low + high) // 2
        stride *= 2
    return high


def _detect(bench: _Bench, size: float) -> Detection:
    delays = []
    for window in bench.windows:
        delay, only = _delay(bench, window, size)
        if delay is None or not only:  # the size is no use; the other onsets need not be run
            return Detection(size, None, None, only)
        delays.append(delay)
    return Detection(size, float(np.median(delays)), max(delays), only=True)


def _delay(bench: _Bench, window: _Window, size: float) -> tuple[float | None, bool]:
    """Return the delay of the channel's alarm after the onset, and whether no other alarm came up in the window."""
    fault = bench.fault
    u = window.samples.u[window.before :]
    signal = np.full(len(u), window.sign * size)
    if fault.input is not None:
        u = u[:, fault.input]
        executed = (1.0 - size) * u if bench.loss else u + signal
        curve = bench.observer.gains[0].input_curves[fault.input]
        signal = effect_change(u, executed, curve, bench.plant.taps)
    raised, _ = _run(bench, window, fault_response(bench.plant, fault.name, signal, window.x))
    right = [time_ns for time_ns, channel in raised if channel == fault.name]
    delay = (right[0] - int(window.samples.vehicle_time_ns[window.before])) / 1e9 if right else None
    return delay, len(right) == len(raised)


def _run(bench: _Bench, window: _Window, added: NDArray[np.float64]) -> _Calm:
    """Run the monitor's chain over a window with ``added`` (N, p) on y since the onset.

    Returns
    -------
    raised : list[tuple[int, str]]
        When alarms were raised, vehicle nanoseconds, and the channels of them.
    x : NDArray[np.float64]
        State estimates since the onset (N, n).
    """
    watched = window.before - round(_WATCHED_S * bench.observer.rate_hz)
    chain = ObserverChain(bench.observer, "", bench.gate, VehicleClock())
    y = window.samples.y.copy()
    y[window.before :] += added
    run = chain.estimate(replace(window.samples, y=y), np.arange(len(y)) >= watched)
    samples = window.samples
    known_ms = np.maximum(samples.known_ns, samples.vehicle_time_ns) // 1_000_000
    tick_ns = dict(zip(known_ms.tolist(), samples.vehicle_time_ns.tolist(), strict=True))
    raised = [
        (tick_ns[event.vehicle_time_ms], event.channel)
        for event in alarm_events([run], Excuses(()))
        if event.state == "raised"
    ]
    return raised, run.estimates.x[window.before :]


def _size(one: Capability, size: float) -> str:
    return f"{100 * size:g} %" if one.loss else f"{size:g} {one.unit}".rstrip()
