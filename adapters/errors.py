"""Errors of telemetry and recordings; ``exit_status`` is what the command line returns for them."""

from __future__ import annotations


class TelemetryError(ValueError):
    """A link, a recording or a channel mapping that cannot be used; the message is one line for the user."""

    exit_status = 2
