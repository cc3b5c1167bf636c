"""Where an observer's samples come from: channels as they are, or raw signals through a named transform.

A transform turns samples of raw signals (``u`` in the order of its ``signals``) into samples (u, y) at the
observer's rate. It is deterministic, keeps its own state and starts anew with a sample that is marked ``restart``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from adapters.channels import Channel
from adapters.errors import TelemetryError
from adapters.sample import Given, Samples, joined_samples
from monitor.core.sampling import VehicleClock
from monitor.sampling.sampler import Sampler, SamplerStatistics
from monitor.vehicles.kinds import transform_classes


class Transform(Protocol):
    """What a kind of transform offers."""

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

        What comes out does not depend, to the bit, on how the raw samples are cut into batches.
        """


@dataclass(frozen=True, slots=True)
class TransformRule:
    """A transform of a profile."""

    kind: str  # name of a transform of a kind of vehicle
    rate_hz: float  # samples of the raw signals per second
    parameters: Mapping[str, float] = field(default_factory=dict)  # what the kind asks for


@dataclass(frozen=True, slots=True)
class SampleSource:
    """Where (u, y) come from."""

    # channels of u and y; empty with a transform
    inputs: tuple[Channel, ...] = ()
    outputs: tuple[Channel, ...] = ()
    transform: TransformRule | None = None  # none takes the channels as they are
    signals: tuple[Channel, ...] = ()  # channels of the transform's raw signals, in its order

    @property
    def channels(self) -> tuple[Channel, ...]:
        """All channels it takes."""
        return (*self.inputs, *self.outputs, *self.signals)


def make_transform(rule: TransformRule, rate_hz: float) -> Transform:
    """Return a transform that gives samples at ``rate_hz``.

    Raises
    ------
    TelemetryError
        There is no such kind, or it does not take these parameters or rates.
    """
    classes = transform_classes()
    if rule.kind not in classes:
        raise TelemetryError(f"no transform is called '{rule.kind}'; there are {', '.join(classes)}")
    transform: Transform = classes[rule.kind](rule.parameters, rule.rate_hz, rate_hz)
    return transform


class TransformedSampler:
    """A sampler of raw signals and the transform behind it, together like a sampler of ``rate_hz`` samples a second."""

    def __init__(self, rule: TransformRule, signals: Sequence[Channel], rate_hz: float, clock: VehicleClock) -> None:
        self._sampler = Sampler(signals, (), rule.rate_hz, clock)
        self._transform = make_transform(rule, rate_hz)
        self._size = round(rule.rate_hz / rate_hz)
        self._kept: list[Samples] = []

    def gathered(self, samples: Samples) -> Samples:
        """Keep raw samples as long as they complete nothing; return those kept with these once they do, else none.

        Transforms give a sample with the first or the last raw sample of one of its periods.
        """
        if not len(samples):
            return samples
        self._kept.append(samples)
        kept = sum(map(len, self._kept))
        if kept < self._size and all(0 < index % self._size < self._size - 1 for index in samples.index.tolist()):
            return samples.part(0, 0)
        parts, self._kept = self._kept, []
        return joined_samples(parts) if len(parts) > 1 else samples

    def run(self, samples: Samples) -> Given:
        """Return the observer's samples that raw samples complete, and the rows of those."""
        return self._transform.run(samples)

    @property
    def sampler(self) -> Sampler:
        """The sampler of the raw signals."""
        return self._sampler

    @property
    def interests(self) -> frozenset[str]:
        """Names of the messages the signals come from."""
        return self._sampler.interests

    def restart(self) -> None:
        """Start the transform anew with the next raw sample."""
        self._sampler.restart()

    def statistics(self) -> SamplerStatistics:
        """Return what the sampler of the raw signals counted."""
        return self._sampler.statistics()


def make_sampler(source: SampleSource, rate_hz: float, clock: VehicleClock) -> Sampler | TransformedSampler:
    """Return what turns the vehicle's messages into an observer's samples."""
    if source.transform is not None:
        return TransformedSampler(source.transform, source.signals, rate_hz, clock)
    return Sampler(source.inputs, source.outputs, rate_hz, clock)
