"""What the commands need to know about a kind of vehicle; its own folder has the rest, which is loaded when needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from adapters.channels import Channel


@dataclass(frozen=True, slots=True)
class VehicleKind:
    """A kind of vehicle.

    Functions and classes are named as ``module:name`` and imported by :func:`load`, so that the daemon reads a profile
    without loading the code that identifies vehicles and designs observers.
    """

    name: str  # name on the command line and in profiles, and of its folder
    watches: str  # components that its observers watch, for people
    # function of a :class:`monitor.fitting.fitted.FitRequest`; returns the kind's observer and the gate of the profile
    fit: str
    # Function of a :class:`monitor.fitting.survey.Survey`; returns a :class:`Preview`. Empty: a recording alone cannot
    # tell.
    preview: str = ""
    messages: str = ""  # Names of the messages that a fit reads. Empty: the messages that the model's channels name.
    types: str = ""  # types of ROS 2 messages whose topics a fit reads, whatever the topics are called
    wanted_hz: float = 50.0  # rate at which its messages should come, hertz
    # classes of the transforms that its observers may use, by their names in profiles
    transforms: Mapping[str, str] = field(default_factory=dict)
    type_words: tuple[str, ...] = ()  # words in the names of ``MAV_TYPE`` that say that a vehicle is of this kind
    flies: bool = True  # whether it leaves the ground: the landing detector of a ground vehicle is meaningless
    # functions of a request and the profile's gate; each returns one more observer, or None if the recordings lack its
    # data
    further: tuple[str, ...] = ()
    inertial_too: bool = True  # whether the inertial observer is fitted beside the kind's own observer
    needs_model: bool = False  # whether the user has to give a model file


@dataclass(frozen=True, slots=True)
class Preview:
    """What could be watched on a vehicle that sends the messages of a recording."""

    watches: tuple[str, ...]  # fault channels
    channels: tuple[Channel, ...]  # channels that the observer would use
    rate_hz: float | None  # rate of its samples; None if no message tells it
    missing: tuple[str, ...] = ()  # fault channels that need missing messages, and the names of those messages
    facts: tuple[str, ...] = ()  # other data that a fit would use, one line each, for people

    def to_json(self) -> dict[str, Any]:
        """Return the preview as a JSON object."""
        from adapters.channels import channel_table

        return {
            "missing": list(self.missing),
            "facts": list(self.facts),
            "watches": list(self.watches),
            "channels": {
                channel.name: f"{channel.message}.{channel_table(channel)['field']}" for channel in self.channels
            },
            "rate_hz": self.rate_hz,
        }


def load(reference: str) -> Any:
    """Import an object given as ``module:name``."""
    module, _, name = reference.partition(":")
    return getattr(import_module(module), name)


def likely_kinds(kinds: Sequence[VehicleKind], vehicle_type: str) -> tuple[VehicleKind, ...]:
    """Return the kinds of a vehicle by its ``MAV_TYPE``, the likeliest first: a VTOL flies as two kinds."""
    name = vehicle_type.replace(" ", "_")
    return tuple(kind for kind in reversed(kinds) if any(word in name for word in kind.type_words))
