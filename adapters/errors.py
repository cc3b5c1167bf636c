"""All errors that are meant for a user, and the one way to make text printable.

::

    ValueError
    └── FauioError                one or more lines for a user; the command line prints them and returns 2
        ├── UsageError            an option, address, name or argument that cannot be used; a part not installed
        ├── ConfigError           a configuration file of the monitor
        ├── ProfileError          a profile folder
        ├── ModelError            a plant model, a gains file, or recordings that determine no model
        ├── InfeasibleError       no design of the asked kind exists; the command line returns 3
        │   └── InaccurateError   a solver's answer that no certificate confirms
        ├── TelemetryError        a link or a recording
        │   └── OtherVehicleError     telemetry of another vehicle than the one that is meant
        ├── PayloadError          one received message; the receiver counts it and goes on
        │   └── UndefinedTypeError    a message of a type whose definition is not known here
        └── StorageError          a place to write to: a journal, a folder of recordings, an output

Whatever else is raised is either an ``OSError`` of the operating system, which the command line prints in a line too,
or a defect of this program.
"""


def printable(text: str) -> str:
    """Return a text with a question mark for each control character, including line ends.

    Use it on every text from elsewhere (a file, a network, an operator) before it is shown: a terminal obeys control
    characters. Tabs at its end are left out: PX4 marks texts by one that it sends as events, too.
    """
    return "".join(c if c.isprintable() else "?" for c in text.rstrip("\t"))


class FauioError(ValueError):
    """An error that ends a command, explained to its user: what is wrong, where, and what to do.

    Raise one of the classes below; raise this class only if none of them fits. Each of ``lines`` is a mistake. Control
    characters in quoted texts become question marks, so that each stays one line. ``exit_status`` is returned by the
    command line.
    """

    exit_status = 2

    def __init__(self, *lines: str) -> None:
        super().__init__(*lines)

    def __str__(self) -> str:
        return "\n".join(map(printable, self.args))


class UsageError(FauioError):
    """An option, address, name or argument that cannot be used as given, or a part of fauio that is not installed."""


class ConfigError(FauioError):
    """A configuration file of the monitor that cannot be used; one line per mistake."""


class ProfileError(FauioError):
    """A profile that cannot be used; one line per mistake in one of its files."""


class ModelError(FauioError):
    """A plant model or gains file that cannot be used, or recordings that do not determine a model."""


class UntoldError(ModelError):
    """Recordings that do not determine a vehicle's own model; the observers of its sensors may work without it."""


class InfeasibleError(FauioError):
    """No design of the requested kind exists (or the solver could not prove one); the message says why."""

    exit_status = 3


class InaccurateError(InfeasibleError):
    """The solver's answer, gains or none, is not confirmed by a certificate: the gains must not be used."""


class TelemetryError(FauioError):
    """A link or a recording that cannot be used, or that lacks required messages."""


class OtherVehicleError(TelemetryError):
    """Telemetry of another vehicle than the profile's, or of another kind than the requested one."""


class PayloadError(FauioError):
    """One message cannot be decoded; the receiver counts it and continues with the next."""


class UndefinedTypeError(PayloadError):
    """One message has a type whose definition is not known; the user has to name the type."""


class StorageError(FauioError):
    """A journal, a folder of recordings or an output that cannot be written, or that would overwrite a file."""
