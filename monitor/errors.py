"""Errors of profiles and of the running monitor; ``exit_status`` is what the command line returns for them."""

from __future__ import annotations


class ProfileError(ValueError):
    """A profile that cannot be used; the message names the file, the key and the mend."""

    exit_status = 2
