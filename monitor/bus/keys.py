"""Zenoh keys of the contract: where the monitor publishes what."""

import re

from adapters.errors import UsageError

ANY = "*"

_FORBIDDEN = re.compile(r"[/*$?#\s]")


def vehicle_root(prefix: str, vehicle: str) -> str:
    """Return the beginning of a vehicle's keys; :data:`ANY` stands for all vehicles.

    Raises UsageError if the prefix or the name cannot be part of a key.
    """
    named = [("prefix", prefix, prefix.split("/"))]
    if vehicle != ANY:
        named.append(("vehicle name", vehicle, [vehicle]))
    for what, name, chunks in named:
        if any(not chunk or chunk.startswith("@") or _FORBIDDEN.search(chunk) for chunk in chunks):
            raise UsageError(f"{what} '{name}' cannot be part of a Zenoh key; use letters, digits, - and _")
    return f"{prefix}/{vehicle}"


def alarm_key(root: str, observer: str, channel: str) -> str:
    """Return the key of one channel's alarm events."""
    return f"{root}/alarm/{_chunk(observer)}/{_chunk(channel)}"


def estimate_key(root: str, observer: str) -> str:
    """Return the key of one observer's estimates."""
    return f"{root}/estimate/{_chunk(observer)}"


def vehicle_of(root: str, key: str) -> str:
    """Return the vehicle's name in a key below a root that may hold :data:`ANY`."""
    return key.split("/")[root.count("/")]


def _chunk(name: str) -> str:
    """Return a name as one chunk of a key."""
    return _FORBIDDEN.sub("_", name) or "_"
