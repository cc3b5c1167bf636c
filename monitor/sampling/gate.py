"""Samples and when they count as evidence: armed, in the air, and settled; never on the ground, at take-off or landing.

Rules, in order: a vehicle known to be disarmed is not watched; where the vehicle reports its landed state, only
"in the air" counts, and "landing" while it is still high; where it does not, a mean command of at least
``airborne_command`` takes its place; if that is zero, a height that is not its home's. ArduPilot reports "in the air"
as soon as motors leave idle, so that one that is flown by hand may still stand on the ground and lean against it: from
that report on a multirotor's samples count once its mean command has been that of hovering. Autopilots also report it
for some seconds after touch-down: where the command stays below ``airborne_command``, the vehicle stands or falls, and
its samples count again once it hovers. A vehicle that reports a low height, or whose own log is read, has touched down
as soon as its command falls while it stands still, and lifts off when it moves. A vehicle of rotors and wings has to be
carried by those that an observer watches. Each time the rules come to hold, ``settle_s`` of vehicle time passes before
evidence counts. When the reported flight phase comes to allow evidence, the samples restart: the estimates made on the
ground, before the first fix of the GPS or while the vehicle was carried about, are forgotten.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch
from adapters.sample import Given, Samples, joined_samples
from adapters.toml_tables import Table
from monitor.core.sampling import Lifting, Settling, VehicleClock, sample_batch
from monitor.sampling.phase import FlightPhase
from monitor.sampling.sampler import Sampler
from monitor.sampling.supply import Supply, SupplyRule
from monitor.sampling.transform import LiftRule, SampleSource, make_transform

_DRIVEN_SAMPLES = 3
"""Samples with commands of flight that say that it flies. Of 44 flights over all links commands fall with the report
that it has landed or is disarmed, or with the next message of them: one sample more at most."""

_HOVERING = 1.8
"""Mean command of what lifts off, in ``airborne_command``: nine tenths of that of the fitted flights, of which that is
the half. To lift off takes more than to hover; of flights that only hover every second sample has less than all."""


@dataclass(frozen=True, slots=True)
class GateRule:
    """What has to hold for samples to count."""

    require_armed: bool = True  # which of the rules apply
    require_airborne: bool = True
    settle_s: float = 1.0  # wait after they come to hold, seconds
    # mean command from which a vehicle that does not report its landed state is taken to fly; 0: not looked at
    airborne_command: float = 0.0


def read_gate(table: Table, default: GateRule) -> GateRule:
    """Return the rule of a table ``phase``; mistakes are recorded in its file."""
    gate = GateRule(
        require_armed=table.boolean("require_armed", default.require_armed),
        require_airborne=table.boolean("require_airborne", default.require_airborne),
        settle_s=table.number("settle_s", default.settle_s, at_least=0.0),
        airborne_command=table.number("airborne_command", default.airborne_command),
    )
    table.done()
    return gate


class FlightGate:
    """Says which samples are evidence; keeps since when the rules hold.

    ``by_command`` says whether the mean command ever had to tell that the vehicle flies. Without ``commands`` of
    flight the inputs do not tell it. ``carried`` says whether what is watched carried the vehicle alone
    in the latest samples.
    """

    def __init__(self, rule: GateRule, commands: bool = True, lift: LiftRule | None = None) -> None:
        # commands of flight are known of multirotors alone
        self._rule, self.commands = rule, commands and rule.airborne_command > 0.0
        self._settling = Settling(rule.settle_s)
        self._driven: int | None = None
        self._command, self._commanded = 0.0, 0  # sum of the mean commands since they are looked at, and how many
        self._lifting = Lifting(rule.airborne_command, _HOVERING * rule.airborne_command)
        self._reported = False  # whether the vehicle reported that it flies in the latest samples
        self.down = False  # whether it came down by its command in them or before, and still reports that it flies
        self.by_command = False
        self._lift = lift
        self._least = lift.least_command if lift is not None and commands and lift.least_command > 0.0 else None
        self.carried = True

    @property
    def idle(self) -> int:
        """The last row of the latest samples with a mean command too small for flight; -1 where there was none."""
        waits = self._lifting.waits if self._reported else -1
        return max(waits, self._settling.idle if self.by_command else -1)

    @property
    def airborne(self) -> bool | None:
        """Whether the mean command was one of flight when last asked; None where it never was."""
        return self._settling.commanded if self.by_command else None

    def watch_commands(self) -> None:
        """Look from now on whether the commands are those of flight."""
        self._driven, self._command, self._commanded = 0, 0.0, 0

    @property
    def hovers(self) -> bool:
        """Whether the mean of the commands since :meth:`watch_commands` was that of hovering."""
        return self._commanded > 0 and self._command / self._commanded >= _HOVERING * self._rule.airborne_command

    @property
    def driven(self) -> bool | None:
        """Whether all commands since :meth:`watch_commands` were those of flight; None while that is undecided."""
        driven = self._driven
        return None if driven is None or 0 <= driven < _DRIVEN_SAMPLES else driven > 0

    def admitted(self, phase: FlightPhase, samples: Samples) -> NDArray[np.bool_]:
        """Return which samples count as evidence (n,), the flight phase being the same for all of them."""
        rule, commands = self._rule, self.commands
        by_command = rule.require_airborne and phase.landed is None and commands
        self.by_command |= by_command
        if self._driven is not None and commands:
            # A command that was lost is none that was low.
            sizes = samples.u[samples.measured & np.isfinite(samples.u).all(axis=1)].mean(axis=1).tolist()
            for size in sizes:
                self._command += size
            self._commanded += len(sizes)
            low = any(size < rule.airborne_command for size in sizes)
            self._driven = -1 if low or self._driven < 0 else self._driven + len(sizes)
        lift = self._lift
        self.carried = lift is None or phase.carried in (None, lift.by)
        allowed, least = allows(rule, phase), rule.airborne_command if by_command else self._least
        if not allowed:
            self._lifting.forget()
        self.down, flies = self._lifting.down, None
        self._reported = allowed and rule.require_airborne and commands and phase.landed is not None
        if self._reported:
            flies = self._lifting.run(samples, phase.low or phase.logged)
            self.down |= self._lifting.fell
        admitted = self._settling.run(samples, self.carried and allowed, least, flies)
        self.carried &= self._least is None or self._settling.commanded
        return admitted


class GatedSamples(NamedTuple):
    """Samples, and which of them are evidence (n,)."""

    samples: Samples
    armed: NDArray[np.bool_]


class GatedSampler:
    """An observer's samples from the vehicle's messages, each with whether it is evidence.

    ``rule`` says when samples count, ``supply`` how commands act with the battery's voltage; None: they do not.
    ``sampler`` turns messages into samples, of raw signals where a transform follows; ``gate`` says which are evidence.
    """

    def __init__(
        self,
        source: SampleSource,
        rate_hz: float,
        clock: VehicleClock,
        rule: GateRule,
        supply: SupplyRule | None = None,
        *,
        commands: bool = True,
    ) -> None:
        self._transform, self._size = None, 1
        inputs, outputs, sampled_hz = source.inputs, source.outputs, rate_hz
        if source.transform is not None:
            inputs, outputs, sampled_hz = source.signals, (), source.transform.rate_hz
            self._transform = make_transform(source.transform, rate_hz)
            self._size = round(sampled_hz / rate_hz)
        # commands of flight are known of multirotors alone; wings may carry a vehicle while its motors idle
        restless, idles = rule.airborne_command > 0.0, source.lift is not None
        self.sampler = Sampler(
            inputs, outputs, sampled_hz, clock, fitted_hz=source.fitted_hz, restless=restless, idles=idles
        )
        self._kept: list[Samples] = []
        self.gate = FlightGate(rule, commands and source.transform is None, source.lift)
        self._rule = rule
        self._allowed = False
        self._supply = None if supply is None else Supply(supply)

    def enter(self, allowed: bool) -> bool:
        """Restart the samples where the phase has come to allow evidence; return whether it has."""
        enters, self._allowed = allowed and not self._allowed, allowed
        if enters:
            self.sampler.restart()
        return enters

    def supplied(self, samples: Samples, batch: Batch, position: NDArray[np.int64]) -> Samples:
        """Return samples of :attr:`sampler` with what the commands are worth at the battery's voltage.

        ``position`` is the place in the batch of the message that completed each (n,).
        """
        if self._supply is None:
            return samples
        return replace(samples, u=samples.u * self._supply.factors(batch, position)[:, None])

    def gathered(self, samples: Samples) -> Samples:
        """Return samples for :meth:`run`: raw ones together with those before them that completed nothing, or none.

        Transforms give a sample with the first or the last raw sample of one of its periods.
        """
        if self._transform is None or not len(samples):
            return samples
        self._kept.append(samples)
        kept = sum(map(len, self._kept))
        if kept < self._size and all(0 < index % self._size < self._size - 1 for index in samples.index.tolist()):
            return samples.part(0, 0)
        parts, self._kept = self._kept, []
        return joined_samples(parts) if len(parts) > 1 else samples

    def run(self, samples: Samples) -> Given:
        """Return the observer's samples that those of :attr:`sampler` give, and the rows that completed them."""
        return Given(samples) if self._transform is None else self._transform.run(samples)

    def admitted(self, samples: Samples, phase: FlightPhase) -> NDArray[np.bool_]:
        """Return which samples are evidence (n,), the phase having been entered."""
        return self.gate.admitted(phase, samples)

    def sample(self, batch: Batch, phase: FlightPhase) -> GatedSamples:
        """Return the samples that a batch completes and which are evidence, the phase being the same for all of it."""
        self.enter(allows(self._rule, phase))
        taken = sample_batch(self.sampler.clock, [self.sampler], batch)
        samples = self.run(self.supplied(taken.samples[0], batch, taken.position[0])).samples
        return GatedSamples(samples, self.admitted(samples, phase))


def allows(rule: GateRule, phase: FlightPhase) -> bool:
    """Return whether the reported flight phase allows evidence; unknown states do not block, another vehicle does."""
    if phase.contradiction is not None or (rule.require_armed and phase.armed is False):
        return False
    if rule.require_airborne and rule.airborne_command == 0.0 and phase.near_home:
        return False
    return not rule.require_airborne or phase.airborne is not False
