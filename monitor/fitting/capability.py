"""The faults that a profile will detect and how fast, as fits report it.

:mod:`replay.sensitivity.capability` measures it.
"""

from __future__ import annotations

from dataclasses import dataclass

from monitor.display import size_text


@dataclass(frozen=True, slots=True)
class Detection:
    """How a fault of one size was detected."""

    size: float  # loss as a fraction of the command, or step in the channel's unit
    # delay from onset to alarm over all onsets, seconds; None if an onset was missed
    median_s: float | None
    worst_s: float | None
    only: bool  # whether that channel's alarm was the only one at every onset tried


@dataclass(frozen=True, slots=True)
class Capability:
    """The faults of one channel that will be detected."""

    # the fault channel; its unit is empty if sizes are losses
    channel: str
    unit: str
    loss: bool  # whether sizes are fractions of the command
    # delay in seconds, and the smallest size that is always detected within it and alone; None if no tried size was
    smallest: tuple[tuple[float, float | None], ...]
    largest: float  # largest size that could be tried
    detections: tuple[Detection, ...]  # all sizes tried, ascending; empty if no healthy stretch is long enough


def capability_text(capability: Capability) -> str:
    """Return a line for people: ``motor1: 4 % within 1 s, 10 % within 0.25 s``."""
    if not capability.detections:
        return f"{capability.channel}: not measured, no healthy stretch in the logs is long and quiet enough"
    parts: list[str] = []
    fastest: dict[float, float] = {size: within for within, size in capability.smallest if size is not None}
    for size, within in sorted(fastest.items()):
        parts.append(f"{_size(capability, size)} within {within:g} s")
    if not parts:
        slowest = max(within for within, _ in capability.smallest)
        largest = _size(capability, capability.largest)
        parts.append(f"nothing up to {largest} reliably within {slowest:g} s by this observer alone")
    return f"{capability.channel}: {', '.join(parts)}"


def _size(capability: Capability, size: float) -> str:
    return f"{100 * size:g} %" if capability.loss else size_text(size, capability.unit)
