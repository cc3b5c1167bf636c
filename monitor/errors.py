"""Errors of profiles and of the running monitor; ``exit_status`` is what the command line returns for them."""

from __future__ import annotations


class ProfileError(ValueError):
    """A profile that cannot be used; the message names the file, the key and the mend."""

    exit_status = 2


class ExtraMissingError(ValueError):
    """A part that is installed on request is asked for and missing; the message names what to install."""

    exit_status = 2
