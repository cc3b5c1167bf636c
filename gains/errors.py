"""Errors of models and designs; ``exit_status`` is what the command line returns for them."""

from __future__ import annotations


class ModelError(ValueError):
    """A plant model or gains file that cannot be used; the message names the file, the key and the mend.

    It is one line whatever it quotes: control characters become question marks.
    """

    exit_status = 2

    def __init__(self, message: str) -> None:
        super().__init__("".join(c if c.isprintable() else "?" for c in message))


class InfeasibleError(ValueError):
    """No design of the asked kind exists (or the solver could not prove one); the message says why."""

    exit_status = 3


class InaccurateError(InfeasibleError):
    """The solver found gains, or nothing, but no certificate confirms them: they are not for use."""
