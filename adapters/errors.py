"""Errors of telemetry and recordings; ``exit_status`` is what the command line returns for them."""

from __future__ import annotations


class TelemetryError(ValueError):
    """A link, a recording or a channel mapping that cannot be used; the message is one line for the user.

    It is one line whatever it quotes: control characters become question marks.
    """

    exit_status = 2

    def __init__(self, message: str) -> None:
        super().__init__("".join(c if c.isprintable() else "?" for c in message))
