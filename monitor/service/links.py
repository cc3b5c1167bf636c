"""Open the links that a configuration names, and say which of them bring nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from adapters.errors import UsageError
from adapters.mavlink.mavlink_link import MavlinkLink
from adapters.mavlink.message_rates import RateRequests, RequestingLink
from adapters.mavlink.signing import SigningKey, read_key
from adapters.zenoh.zenoh_link import ZenohLink
from adapters.zenoh.zenoh_payload import PayloadDecoder
from monitor.configuration.config import Config, Vehicle
from monitor.service.inbox import Link
from monitor.service.log import ServiceLog

if TYPE_CHECKING:
    import zenoh

_FIRST_NS = 5_000_000_000
"""Silence after which a link is reported: every vehicle sends a heartbeat a second, and discovery takes a few."""


class Counting(Protocol):
    """A link that says what went through it."""

    def statistics(self) -> Any: ...  # noqa: D102


class TelemetryLink(Link, Counting, Protocol):
    """An open link: yields batches and counts them."""

    def close(self) -> None: ...  # noqa: D102


@dataclass(frozen=True, slots=True)
class LinkOptions:
    """Settings of all links of a process."""

    key: SigningKey | None = None  # key of MAVLink signatures; None verifies none
    require_signed: bool = False  # whether unsigned MAVLink packets are refused
    may_send: bool = False
    session: zenoh.Session | None = None  # an open session, for links over Zenoh
    types: Mapping[str, str] = field(default_factory=dict)  # types of telemetry over Zenoh by key expression
    definitions: Sequence[Path] = ()  # folders of message definitions
    batch_s: float = 0.0  # time from one batch to the next while telemetry comes, seconds


def _open_mavlink(url: str, options: LinkOptions) -> TelemetryLink:
    return MavlinkLink(url, options.key, options.require_signed, options.may_send, options.batch_s)


def _open_zenoh(url: str, options: LinkOptions) -> TelemetryLink:
    if options.session is None:
        raise UsageError(f"{url}: needs a Zenoh session")
    decoder = PayloadDecoder(options.types, options.definitions)
    return ZenohLink(options.session, url.removeprefix("zenoh:"), decoder, options.batch_s)


_OPENERS: Mapping[str, Callable[[str, LinkOptions], TelemetryLink]] = {
    **dict.fromkeys(("udp", "udpin", "udpout", "tcp", "tcpin", "serial"), _open_mavlink),
    "zenoh": _open_zenoh,
}
"""What opens a link by the first part of its URL; a new source is a line here and a module that yields batches."""


def open_link(url: str, options: LinkOptions) -> TelemetryLink:
    """Open the link that a URL names: one of :func:`adapters.mavlink.byte_link.open_byte_link`, or ``zenoh:KEYEXPR``.

    Raises
    ------
    TelemetryError
        The link cannot be opened, or the URL is not understood.
    """
    return _OPENERS.get(url.partition(":")[0], _open_mavlink)(url, options)


class OpenedLink(NamedTuple):
    """An open link under its name in the configuration, its reader, and the vehicle whose own it is."""

    name: str
    link: Counting
    reader: Link
    vehicle: Vehicle | None = None


def open_links(config: Config, session: zenoh.Session | None, stack: ExitStack) -> list[OpenedLink]:
    """Open all links of a configuration, those over Zenoh where there is a session; nothing reads them yet.

    Raises
    ------
    UsageError, TelemetryError
        A link, the signing key or a message definition cannot be used.
    """
    options = LinkOptions(
        key=read_key(config.signing.key_file) if config.signing.key_file is not None else None,
        require_signed=config.signing.require,
        may_send=config.send.allow,
        session=session,
        types=config.zenoh_types,
        definitions=() if config.definitions is None else (config.definitions,),
        batch_s=config.batch_ms / 1e3,
    )
    named: list[tuple[str, str, Vehicle | None]] = [(url, url, None) for url in config.mavlink]
    if session is not None:
        named += [(keyexpr, f"zenoh:{keyexpr}", None) for keyexpr in config.zenoh]
        named += [(own.zenoh, f"zenoh:{own.zenoh}", own) for own in config.vehicles if own.zenoh is not None]
    opened = []
    for name, url, vehicle in named:
        link = open_link(url, options)
        stack.callback(link.close)
        reader = _requesting(link, config, options.key) if isinstance(link, MavlinkLink) else link
        opened.append(OpenedLink(name, link, reader, vehicle))
    return opened


def _requesting(link: MavlinkLink, config: Config, key: SigningKey | None) -> Link:
    """Return what reads a link: itself, or with requests for message rates where the config allows them."""
    send = config.send
    if not (send.allow and send.rates):
        return link
    named = {vehicle.system for vehicle in config.vehicles}
    systems = () if 0 in named or config.new_vehicles.profile is not None else named
    requests = RateRequests(key, (send.source_system, send.source_component))
    return RequestingLink(link, requests, send.rates, systems, send.target_component)


class FirstLook:
    """Says once which links have brought nothing in their first seconds: a wrong port looks like a quiet vehicle."""

    def __init__(self, links: Mapping[str, Any], log: ServiceLog) -> None:
        self._links = links
        self._log = log
        self._due_ns: int | None = 0

    def turn(self, now_ns: int) -> None:
        """Look once, when it is due."""
        if self._due_ns is None or now_ns < self._due_ns:
            return
        if self._due_ns == 0:
            self._due_ns = now_ns + _FIRST_NS
            return
        self._due_ns = None
        for name, link in self._links.items():
            if not link.statistics().messages:
                advice = "is the vehicle on, and does it send to this address? See 'fauio doctor'"
                self._log.say("no telemetry yet", level="warning", link=name, advice=advice)
