"""Outputs that show vehicles while they are monitored: what a new kind of view (a window, a web page) has to offer."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Protocol

from adapters.batch import Batch
from monitor.estimate import Estimates, Layout
from monitor.event import AlarmEvent
from monitor.views.panels import Thresholds


class ShownVehicle(Protocol):
    """One vehicle in a view: an archive that keeps everything to be shown in bounded memory, without waiting."""

    def batch(self, batch: Batch) -> None: ...  # noqa: D102
    def estimates(self, estimates: Estimates) -> None: ...  # noqa: D102
    def event(self, event: AlarmEvent) -> None: ...  # noqa: D102
    def flush(self) -> None: ...  # noqa: D102
    def retune(self, thresholds: Thresholds) -> None:
        """Show other thresholds from now on."""


class View(Protocol):
    """Shows any number of vehicles. :mod:`monitor.service.live` opens the views that the configuration names."""

    def vehicle(
        self, name: str, layouts: Sequence[Layout], thresholds: Thresholds, messages: Collection[str]
    ) -> ShownVehicle:
        """Show one more vehicle; return its archive, to be given everything.

        Parameters
        ----------
        name : str
            The vehicle's name; one that is shown already is replaced.
        layouts : Sequence[Layout]
            Its observers.
        thresholds : Mapping[tuple[str, str], float]
            Alarm thresholds by observer and channel.
        messages : Collection[str]
            Names of the messages that its observers need.
        """
