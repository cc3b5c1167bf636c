"""Turn the messages of one vehicle into samples (u, y) on a grid of its clock, and count them.

The rules are at the top of :mod:`monitor.core.sampling`, which carries them out: :func:`sample_batch` processes a batch
of telemetry for all samplers of a vehicle at once.
"""

from dataclasses import dataclass

from monitor.core.sampling import SamplerCore


@dataclass(frozen=True, slots=True)
class SamplerStatistics:
    """Counts of a sampler so far; measurements count once per channel."""

    messages: int  # messages of interest
    # measurements ignored because they were known already, or came after their ticks
    duplicates: int
    late: int
    invalid: int  # values that are missing, no number or not finite
    untimed: int  # messages without a usable stamp
    doubted: int  # messages dropped because no other message agreed with their stamp
    clock_restarts: int  # reboots and jumps of the vehicle's clock
    # samples given out; those among them with ``complete=False``; those with ``restart=True``
    samples: int
    incomplete: int
    restarts: int
    skipped: int  # ticks inside gaps, for which there is no sample


class Sampler(SamplerCore):
    """A sampler with its counts; see :class:`monitor.core.sampling.SamplerCore` for the parameters."""

    def statistics(self) -> SamplerStatistics:
        """Return the counts so far."""
        return SamplerStatistics(**self.counts())
