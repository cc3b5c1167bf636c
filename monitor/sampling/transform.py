"""The source of an observer's samples: channels as they are, or raw signals through a named transform.

A transform turns samples of raw signals (``u`` in the order of its ``signals``) into samples (u, y) at the observer's
rate. It is deterministic, keeps its own state and restarts with a sample that is marked ``restart``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

from adapters.channels import Channel
from adapters.errors import TelemetryError
from adapters.sample import Given, Samples
from monitor.vehicles.base import load
from monitor.vehicles.kinds import TRANSFORMS


class Transform(Protocol):
    """The interface of a kind of transform."""

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the raw signals, in order."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of u."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of y."""

    def run(self, samples: Samples) -> Given:
        """Return the observer's samples that raw samples complete, each with the ``known_ns`` of that raw sample.

        The result does not depend, to the bit, on how the raw samples are cut into batches.
        """


@dataclass(frozen=True, slots=True)
class TransformRule:
    """A transform of a profile."""

    kind: str  # name of a transform of a kind of vehicle
    rate_hz: float  # samples of the raw signals per second
    parameters: Mapping[str, float] = field(default_factory=dict)  # parameters of the kind


@dataclass(frozen=True, slots=True)
class LiftRule:
    """What alone has to carry a vehicle with rotors and wings for its samples to be evidence."""

    by: Literal["rotors", "wings"]
    least_command: float = 0.0  # smallest mean command at which it may be the rotors; 0: not checked


@dataclass(frozen=True, slots=True)
class SampleSource:
    """Where (u, y) come from."""

    # channels of u and y; empty with a transform
    inputs: tuple[Channel, ...] = ()
    outputs: tuple[Channel, ...] = ()
    transform: TransformRule | None = None  # None takes the channels as they are
    signals: tuple[Channel, ...] = ()  # channels of the transform's raw signals, in its order
    # messages per second in the fitted flights, for messages that count as not measured if they come far more seldom
    fitted_hz: Mapping[str, float] = field(default_factory=dict)
    lift: LiftRule | None = None  # None if the vehicle does not have both, or is watched whatever carries it

    @property
    def channels(self) -> tuple[Channel, ...]:
        """All channels that it reads."""
        return (*self.inputs, *self.outputs, *self.signals)


def make_transform(rule: TransformRule, rate_hz: float) -> Transform:
    """Return a transform that gives samples at ``rate_hz``.

    Raises
    ------
    TelemetryError
        There is no such kind, or it does not take these parameters or rates.
    """
    if rule.kind not in TRANSFORMS:
        raise TelemetryError(f"no transform is called '{rule.kind}'; there are {', '.join(TRANSFORMS)}")
    transform: Transform = load(TRANSFORMS[rule.kind])(rule.parameters, rule.rate_hz, rate_hz)
    return transform
