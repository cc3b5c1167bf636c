"""One fitted observer: model, gains, source of its samples, calibrated alarms, and the findings of the fit."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, memory_bytes
from adapters.errors import UsageError
from gains.plants.model_file import write_model
from gains.plants.plant import Plant
from gains.synthesis.gains_file import write_gains
from gains.synthesis.peak import largest_bounds
from monitor.alarms.alarm import AlarmRule
from monitor.alarms.excuse import ExcuseRule
from monitor.display import number_text, size_text
from monitor.estimation.isolation_rule import BankRule, gains_file_names
from monitor.fitting.agreement import Agreement
from monitor.fitting.capability import Capability, capability_text
from monitor.fitting.fit_report import Comparison
from monitor.fitting.survey import Survey
from monitor.fitting.thresholds import (
    FALSE_ALARMS_PER_HOUR,
    Calibrated,
    Times,
    calibrated,
    healthy_levels,
    plain_only,
)
from monitor.profile import UNEXPLAINED, ObserverProfile, ObserverSetup, fault_channels, observer_table

BatchSource = Callable[[], Iterable[Batch]]
"""A recording; each call reads it once from its start."""

_KEPT_BYTES = 1 << 29
"""Memory for the parts of recordings that are kept between the passes of a fit. Chosen: 512 MB, some fifty flights of
four minutes at 100 Hz; longer ones are read again."""


def kept_logs(logs: Sequence[BatchSource]) -> list[BatchSource]:
    """Return recordings that are read only once if they fit into memory; each pass has to read to the end."""
    room = [_KEPT_BYTES]

    def kept(log: BatchSource) -> BatchSource:
        batches: list[Batch] | None = None

        def again() -> Iterable[Batch]:
            nonlocal batches
            if batches is not None:
                yield from batches
                return
            held: list[Batch] | None = []
            size = 0
            for batch in log():
                size += memory_bytes(batch)
                held = held if size <= room[0] else None
                if held is not None:
                    held.append(batch)
                yield batch
            if held is not None:
                batches, room[0] = held, room[0] - size

        return again

    return [kept(log) for log in logs]


_UNEXPLAINED = Times(fast_s=2.0, raise_s=2.0, clear_s=0.5)
"""Times of the unexplained alarm: a push or a collision is over sooner, two faults at once are not."""


@dataclass(frozen=True, slots=True)
class FitRequest:
    """The inputs of a vehicle's fit, for any kind of vehicle."""

    name: str  # name of the vehicle and its models
    logs: Sequence[BatchSource]  # healthy recordings
    surveys: Sequence[Survey] = ()  # contents of each recording; empty for a kind that needs a model
    model: Path | None = None  # model file with free parameters, of a kind that needs one
    log_names: Sequence[str] = ()  # names of the recordings
    rate_hz: float | None = None  # samples per second of the observer; None: the rate of the messages
    agreed: bool = False  # whether flights that disagree are left out already

    def without(self, names: Collection[str]) -> FitRequest:
        """Return the request without some of its recordings."""
        kept = [number for number, name in enumerate(self.names) if name not in names]
        return replace(
            self,
            logs=[self.logs[number] for number in kept],
            surveys=[self.surveys[number] for number in kept] if self.surveys else (),
            log_names=[self.names[number] for number in kept],
        )

    def grid_hz(self, most_hz: float) -> float:
        """Return the samples per second of an observer whose messages allow ``most_hz``; refuse more."""
        if self.rate_hz is None:
            return most_hz
        if self.rate_hz > most_hz:
            raise UsageError(
                f"--rate {self.rate_hz:g}: the recordings allow {most_hz:g} samples a second; ask for that or less"
            )
        return self.rate_hz

    def fraction_hz(self, signal_hz: float, usual_hz: float) -> float:
        """Return the samples per second behind a transform of signals: a whole fraction of theirs."""
        if self.rate_hz is None:
            return usual_hz
        return signal_hz / max(1, round(signal_hz / self.grid_hz(signal_hz)))

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the recordings; their numbers if they have none."""
        return tuple(self.log_names) or tuple(f"recording {number}" for number in range(1, len(self.logs) + 1))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Fitted(ObserverSetup):
    """A fitted observer."""

    plant: Plant  # the identified model
    alarms: tuple[Calibrated, ...] = ()  # calibrated alarm rules
    flight_s: float = 0.0  # healthy flight it was fitted on, seconds
    findings: Mapping[str, Any] = field(default_factory=dict)  # findings of the identification, for ``fit.json``
    lines: tuple[str, ...] = ()  # the same for people
    details: tuple[str, ...] = ()  # further lines for people, for ``fit.txt`` alone
    comparison: Comparison | None = None  # prediction against measurement on data kept back, for ``fit.png``
    measured: bool = False  # whether to measure on the recordings what will be detected
    capability: tuple[Capability, ...] = ()  # the faults that will be detected, and how fast
    excuses: tuple[ExcuseRule, ...] = ()  # which of its alarms explain evidence of which other channels
    agreement: Agreement | None = None  # which flights disagree

    @property
    def at_most(self) -> dict[str, float]:
        """How far each estimate is off at any one time at most, while no signal exceeds its size in the model."""
        return largest_bounds(gains.report for gains in self.gains)

    @property
    def sqrt_mu(self) -> float:
        """Largest certified bound of its designs."""
        return max(float(gains.report["sqrt_mu"]) for gains in self.gains)

    @property
    def rules(self) -> tuple[AlarmRule, ...]:
        """The alarms' rules, each with its rate of false alarms."""
        return tuple(found.rated(self.flight_s) for found in self.alarms)

    def profile(self) -> ObserverProfile:
        """Return the observer as it will be read from the profile."""
        setup = {key.name: getattr(self, key.name) for key in fields(ObserverSetup)}
        return ObserverProfile(**setup, faults=fault_channels(self.gains), alarms=self.rules)

    def table(self) -> dict[str, Any]:
        """Return the observer's part of profile.toml."""
        sees = {
            capability.channel: capability_text(capability).removeprefix(f"{capability.channel}: ")
            for capability in self.capability
        }
        return observer_table(self.profile(), sees)

    def write(self, folder: Path) -> None:
        """Write model and gains into a profile's folder."""
        write_model(self.plant, folder / f"{self.name}.model.toml")
        hypotheses = self.isolation.hypotheses if isinstance(self.isolation, BankRule) else ()
        for gains, file in zip(self.gains, gains_file_names(self.name, hypotheses), strict=True):
            write_gains(gains, folder / file)

    def _agreement(self, details: bool) -> list[str]:
        if self.agreement is None:
            return []
        return self.agreement.details() if details else self.agreement.lines()

    def report(self) -> dict[str, Any]:
        """Return what was found as a JSON object."""
        return {
            **self.findings,
            "flight_s": self.flight_s,
            **({"flights": self.agreement.to_json()} if self.agreement is not None else {}),
            "sqrt_mu": self.sqrt_mu,
            "at_most": self.at_most,
            "alarms": {found.rule.channel: _alarm_report(found) for found in self.alarms},
            "capability": {
                capability.channel: asdict(capability) | {"text": capability_text(capability)}
                for capability in self.capability
            },
        }

    def text(self, details: bool = False) -> list[str]:
        """Return what was found as lines for people, the first one a headline."""
        return [
            f"{self.name}: {self.flight_s:.0f} s of healthy samples, certified",
            *(f"  {line}" for line in self.lines),
            *(f"  {line}" for line in (*self.details, *self._bounds()) if details),
            *(f"  {line}" for line in self._agreement(details)),
            *(f"  sees {capability_text(capability)}" for capability in self.capability),
            *self._false_alarms(),
        ]

    def _bounds(self) -> list[str]:
        at_most, usual = self.at_most, self.profile().usual_commands
        known = [(name, rule.unit) for rule in self.rules if (name := rule.channel) in at_most]
        if not known:
            return []
        sizes = ", ".join(f"{name} {size_text(at_most[name], unit, usual.get(name))}" for name, unit in known)
        return [
            "in the model's worst case, where faults move at their rates and all disturbance and noise push one way at "
            f"full size, off by {sizes}"
        ]

    def _false_alarms(self) -> list[str]:
        rates = {rule.channel: rule.false_per_100h for rule in self.rules if rule.false_per_100h is not None}
        excluded = {rule.excluded_per_100h for rule in self.rules if rule.excluded_per_100h is not None}
        if not rates:
            return []
        most = max(rates, key=lambda channel: rates[channel])
        return [
            f"  false alarms in 100 hours: {100.0 * FALSE_ALARMS_PER_HOUR:.0f} granted (a median), "
            f"{number_text(sum(rates.values()), 2)} expected (a mean), "
            f"of {most} the most ({number_text(rates[most], 2)}); {self.flight_s / 60.0:.0f} minutes of flight "
            f"exclude only more than {max(excluded):,.0f} of each (95 %)"
        ]


def bare_rule(observer: str, channel: str, kind: str, unit: str) -> AlarmRule:
    """Return a rule that names its channel and has no sizes yet."""
    of_kind = {"actuator": "actuator", "sensor": "sensor"}.get(kind, "residual")
    return AlarmRule(observer, channel, of_kind, unit, 0.0, 0.0, 0.0, 0.0, 0.0)  # type: ignore[arg-type]


def unexplained_alarm(
    observer: str,
    evidence: Sequence[NDArray[np.float64]],
    rate_hz: float,
    alarms_per_hour: float,
    floor: float,
    times: Times,
) -> Calibrated:
    """Return a bank's alarm that no hypothesis explains the data, from healthy evidence (its last column).

    ``floor`` is the score from which none explains them; its evidence lasts no less than that of a fault (``times``).
    """
    lasting = replace(_UNEXPLAINED, raise_s=max(_UNEXPLAINED.raise_s, times.raise_s))
    scores = healthy_levels([stretch[:, -1] for stretch in evidence], rate_hz, alarms_per_hour, lasting)
    bare = bare_rule(observer, UNEXPLAINED, "residual", "times healthy")
    return plain_only(calibrated(bare, scores, 1.0, floor=floor, critical=5 * floor, times=lasting))


def _alarm_report(found: Calibrated) -> dict[str, float | int | str]:
    rule, level = found.rule, found.level
    sizes: dict[str, float | int | str] = {"unit": rule.unit, "threshold": rule.threshold}
    if level is None:
        return sizes
    return sizes | {
        "level": found.scale * level.level,
        "level_low": found.scale * level.low,
        "level_high": found.scale * level.high,
        "healthy_hours": level.hours,
        "peaks": level.peaks,
    }
