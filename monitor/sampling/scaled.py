"""Transforms that scale a vehicle's deflections by its speed: what they share (parameters, timing, grouping).

Effects pass the actuator's transport delay and first-order lag here, because the accelerations and rates beside them,
which are inputs as well, do not. Below ``minimum_speed`` a deflection has hardly any effect, and the division by it
would only amplify noise: all channels of such samples count as ``lost``, so an observer coasts over them, and they are
no evidence.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.errors import TelemetryError
from adapters.sample import Given, Samples
from monitor.core.lagged import LaggedMeans

Array = NDArray[np.float64]


class Scaled(NamedTuple):
    """Inputs and outputs of raw samples, one column each (n,), and where they are evidence (n,)."""

    columns: list[Array]
    evidence: NDArray[np.bool_]


class Mix(NamedTuple):
    """Two outputs that each move a vehicle about two axes: half of their difference, and their mean."""

    parameter: str  # of the transform: 1 if the vehicle has such outputs
    difference: str  # actuator that half of the difference stands for
    mean: str
    first: str  # signals of the two outputs, in place of those of the actuators
    second: str


def raw_per_sample(transform: str, signal_rate_hz: float, rate_hz: float) -> int:
    """Return how many raw samples make one sample; ``transform`` is the name for the error message.

    Raises
    ------
    TelemetryError
        The first rate is no whole multiple of the second.
    """
    size = round(signal_rate_hz / rate_hz) if rate_hz > 0 else 0
    if size < 1 or abs(size * rate_hz - signal_rate_hz) > 1e-6 * signal_rate_hz:
        raise TelemetryError(
            f"transform '{transform}': signals at {signal_rate_hz:g} Hz cannot be grouped to samples at "
            f"{rate_hz:g} Hz; choose a rate that divides the signals' rate"
        )
    return size


def check_parameters(
    kind: str, parameters: Mapping[str, float], needed: Collection[str], optional: Collection[str] = ()
) -> None:
    """Check that a transform has all parameters that it needs, and no unknown ones.

    Raises
    ------
    TelemetryError
        A parameter is missing or unknown: the profile was written by another version, or by hand.
    """
    if wrong := sorted((set(needed) ^ set(parameters)) - set(optional)):
        verb = "is unknown" if wrong[0] in parameters else "is missing"
        raise TelemetryError(f"transform '{kind}': '{wrong[0]}' {verb}; fit the profile again")


class ScaledInputs(ABC):
    """A transform whose inputs are effects of actuators at the present speed; a kind implements :meth:`scale`.

    Parameters
    ----------
    parameters : Mapping[str, float]
        ``reference_speed`` and ``minimum_speed`` (m/s); for each actuator optionally ``<name>_delay_s`` and
        ``<name>_lag_s``; of each of ``mixes`` its parameter; what else the kind knows.
    signal_rate_hz, rate_hz : float
        Raw samples and given samples per second; the first is a whole multiple of the second.

    Raises
    ------
    TelemetryError
        A parameter is missing, unknown or out of range, or the rates do not fit.
    """

    kind: ClassVar[str]
    actuators: ClassVar[tuple[str, ...]]
    signals: tuple[str, ...]
    inputs: ClassVar[tuple[str, ...]]
    outputs: ClassVar[tuple[str, ...]]
    extra_parameters: ClassVar[frozenset[str]] = frozenset()
    mixes: ClassVar[tuple[Mix, ...]] = ()
    # whether a vehicle that is slow in operation has everything it needs: one on the ground
    may_stand: ClassVar[bool] = False

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        self._check(parameters)
        self.reference, self.minimum = parameters["reference_speed"], parameters["minimum_speed"]
        size = raw_per_sample(self.kind, signal_rate_hz, rate_hz)
        timing = [
            (parameters.get(f"{name}_delay_s", 0.0), parameters.get(f"{name}_lag_s", 0.0)) for name in self.actuators
        ]
        self._mixed = []
        for mix in self.mixes:
            if parameters.get(mix.parameter):
                names = type(self).signals
                self._mixed.append((names.index(mix.difference), names.index(mix.mean)))
                outputs = {mix.difference: mix.first, mix.mean: mix.second}
                self.signals = tuple(outputs.get(name, name) for name in self.signals)
        self._means = LaggedMeans(timing, signal_rate_hz, size, len(self.inputs), len(self.outputs))

    @abstractmethod
    def scale(self, signals: Array) -> Scaled:
        """Return inputs, then outputs, before timing and grouping; ``signals`` is (number of signals, n)."""

    def run(self, samples: Samples) -> Given:
        """Return the observer's samples that raw samples complete.

        A sample marked ``restart`` forgets lag and group.
        """
        # Absurd values may overflow; they are no evidence, and need no warning.
        with np.errstate(all="ignore"):
            signals = np.array(samples.u.T, order="C")
            for first, second in self._mixed:
                half = 0.5 * signals[first], 0.5 * signals[second]
                signals[first], signals[second] = half[0] - half[1], half[0] + half[1]
            scaled = self.scale(signals)
        given = self._means.run(samples, scaled.columns, scaled.evidence)
        stands = ~scaled.evidence & ~samples.lost.any(axis=1)
        return given._replace(unflown=stands[given.rows]) if self.may_stand else given

    def _check(self, parameters: Mapping[str, float]) -> None:
        timing = {f"{actuator}_{key}" for actuator in self.actuators for key in ("delay_s", "lag_s")}
        speeds = ("reference_speed", "minimum_speed")
        mixes = {mix.parameter for mix in self.mixes}
        check_parameters(self.kind, parameters, speeds, optional=timing | mixes | self.extra_parameters)
        for name in speeds:
            if not 0.0 < parameters[name] < 1e4:
                raise TelemetryError(f"transform '{self.kind}': '{name}' is no positive speed in m/s")
        for name in sorted(timing & set(parameters)):
            if not 0.0 <= parameters[name] <= 2.0:
                raise TelemetryError(
                    f"transform '{self.kind}': '{name}' is {parameters[name]:g}; it must lie between 0 and 2 s"
                )
