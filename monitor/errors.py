"""Errors of profiles and of the running monitor; ``exit_status`` is what the command line returns for them."""

from __future__ import annotations

from monitor.printable import printable


class ProfileError(ValueError):
    """A profile or configuration that cannot be used; the message names the file, the key and the mend.

    Several mistakes are a line each, whatever they quote: control characters become question marks.
    """

    exit_status = 2

    def __init__(self, *lines: str) -> None:
        super().__init__(*lines)

    def __str__(self) -> str:
        return "\n".join(map(printable, self.args))


class ExtraMissingError(ValueError):
    """A part that is installed on request is asked for and missing; the message names what to install."""

    exit_status = 2
