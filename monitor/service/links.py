"""Open the links that a configuration names, and report those that bring nothing."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from adapters.mavlink.mavlink_link import MavlinkLink
from adapters.mavlink.message_rates import RateRequests
from adapters.mavlink.signing import SigningGuard, SigningKey, read_key
from adapters.zenoh.zenoh_link import ZenohLink
from adapters.zenoh.zenoh_payload import PayloadDecoder
from monitor.configuration.config import Config, Vehicle
from monitor.service.inbox import Link
from monitor.service.log import ServiceLog

if TYPE_CHECKING:
    import zenoh

_FIRST_NS = 5_000_000_000
"""Silence after which a link is reported: every vehicle sends a heartbeat a second, and discovery takes a few
seconds."""


class Counting(Link, Protocol):
    """A link that counts its messages."""

    def statistics(self) -> Any: ...  # noqa: D102


class OpenedLink(NamedTuple):
    """An open link under its name in the configuration, and the vehicle whose own link it is."""

    name: str
    link: Counting
    vehicle: Vehicle | None = None


def signing_guard(config: Config) -> SigningGuard | None:
    """Return the guard that verifies the signatures of all links, or None if there is no key.

    Raises TelemetryError if the key cannot be used.
    """
    signing, journal = config.signing, config.journal.path
    if signing.key_file is None:
        return None
    beside = None if journal is None else journal.with_name(f"{journal.name}.signing")
    return SigningGuard(read_key(signing.key_file), signing.require is not False, signing.state_file or beside)


def open_links(
    config: Config, session: zenoh.Session | None, stack: ExitStack, guard: SigningGuard | None
) -> list[OpenedLink]:
    """Open all links of a configuration, and those over Zenoh if there is a session; nothing reads them yet.

    Raises UsageError or TelemetryError if a link, the signing key or a message definition cannot be used.
    """
    batch_s = config.batch_ms / 1e3
    key = None if config.signing.key_file is None else read_key(config.signing.key_file)
    opened = []
    for url in config.mavlink:
        mavlink = MavlinkLink(url, guard, config.send.allow, batch_s, _requests(config, key))
        stack.callback(mavlink.close)
        opened.append(OpenedLink(url, mavlink))
    if session is None:
        return opened
    own = [(vehicle.zenoh, vehicle) for vehicle in config.vehicles if vehicle.zenoh is not None]
    for keyexpr, vehicle in [*((shared, None) for shared in config.zenoh), *own]:
        decoder = PayloadDecoder(config.zenoh_types, () if config.definitions is None else (config.definitions,))
        link = ZenohLink(session, keyexpr, decoder, batch_s)
        stack.callback(link.close)
        opened.append(OpenedLink(keyexpr, link, vehicle))
    return opened


def _requests(config: Config, key: SigningKey | None) -> RateRequests | None:
    """Return the requests for message rates of a link, if the configuration allows them."""
    send = config.send
    if not (send.allow and send.rates):
        return None
    requests = RateRequests(key, (send.source_system, send.source_component))
    named = {vehicle.system for vehicle in config.vehicles}
    if 0 in named or config.new_vehicles.profile is not None:
        requests.ask_everybody(send.rates, send.target_component)
    else:
        for system in named:
            requests.ask(system, send.rates, send.target_component)
    return requests


class FirstLook:
    """Reports once which links brought nothing in their first seconds: a wrong port looks like a quiet vehicle."""

    def __init__(self, links: Mapping[str, Any], log: ServiceLog) -> None:
        self._links = links
        self._log = log
        self._due_ns: int | None = 0

    def turn(self, steady_ns: int) -> None:
        """Look once, as soon as it is due by the monotonic clock."""
        if self._due_ns is None or steady_ns < self._due_ns:
            return
        if self._due_ns == 0:
            self._due_ns = steady_ns + _FIRST_NS
            return
        self._due_ns = None
        for name, link in self._links.items():
            if not link.statistics().messages:
                advice = "is the vehicle on, and does it send to this address? See 'fauio doctor'"
                self._log.say("no telemetry yet", level="warning", link=name, advice=advice)
