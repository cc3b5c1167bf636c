"""Kinds of values in the daemon's configuration: addresses, key expressions, paths, names, each checked on its own."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, ValidationInfo

from monitor.bus.keys import vehicle_root

_ENDPOINT = re.compile(r"(tcp|tls|udp|quic|ws|unixsock-stream|serial|vsock)/\S+")
_HOST_PORT = re.compile(r"(\[[0-9A-Fa-f:.%]+\]|[^\s:/\[\]]+):(\d{1,5})")
_LOCAL = ("unixsock-stream", "serial", "vsock")
_MESSAGE_TYPE = re.compile(r"json|[A-Za-z]\w*/(msg/)?[A-Za-z]\w*")
_CHANNEL = re.compile(r"[^\s/]+/[^\s/]+")
_URL_HELP = "use udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD"


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches a host: ``localhost``, 127.0.0.0/8, ``::1``."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def listens_beyond_loopback(address: str) -> bool:
    """Return whether an endpoint, MAVLink URL or HOST:PORT listens where other machines reach it.

    MAVLink links that connect and serial ones listen nowhere.
    """
    kind, slash, rest = address.partition("/")
    if slash and _ENDPOINT.fullmatch(address):
        return kind not in _LOCAL and not is_loopback(re.split(r"[?#]", rest)[0].rpartition(":")[0])
    kind, _, rest = address.partition(":")
    if kind in ("udp", "udpin", "tcpin"):
        return not is_loopback(rest.rpartition(":")[0])
    found = _HOST_PORT.fullmatch(address)
    return kind not in ("udpout", "tcp", "serial") and found is not None and not is_loopback(found[1])


def _listed(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _several(value: Any) -> Any:
    return (value,) if isinstance(value, str) else _listed(value)


def _endpoint(value: str) -> str:
    if not _ENDPOINT.fullmatch(value):
        raise ValueError(f"is '{value}', which is no Zenoh endpoint; write it like tcp/127.0.0.1:7447")
    return value


def _mavlink_url(value: str) -> str:
    kind, _, rest = value.partition(":")
    if kind == "serial" and rest:
        return value
    if kind not in ("udp", "udpin", "udpout", "tcp", "tcpin"):
        raise ValueError(f"is '{value}', an unknown kind of link; {_URL_HELP}")
    return _checked_host_port(value, rest, _URL_HELP)


def _host_port(value: str) -> str | None:
    return None if value == "off" else _checked_host_port(value, value, 'write "127.0.0.1:9464", or "off"')


def _checked_host_port(value: str, rest: str, mend: str) -> str:
    found = _HOST_PORT.fullmatch(rest)
    if found is None or int(found[2]) > 0xFFFF:
        raise ValueError(f"is '{value}', without HOST:PORT in it; {mend}")
    return value


def _key_expression(value: str) -> str:
    import zenoh

    try:
        zenoh.KeyExpr(value)
    except zenoh.ZError:
        raise ValueError(
            f"is '{value}', which is no Zenoh key expression; write it like arm/telemetry or rover/**"
        ) from None
    return value


def _key_chunks(value: str) -> str:
    try:
        vehicle_root(value, "*")
    except ValueError:
        raise ValueError(f"is '{value}', which cannot be part of a Zenoh key; use letters, digits, - and _") from None
    return value


def _vehicle_name(value: str) -> str:
    if value == "*" or "/" in value:
        raise ValueError(f"is '{value}', which is no name of a vehicle; use letters, digits, - and _")
    return _key_chunks(value)


def _vehicle_template(value: str) -> str:
    if "{system}" not in value:
        raise ValueError(f"is '{value}', which is the same for all vehicles; put {{system}} where the id shall stand")
    _vehicle_name(value.replace("{system}", "1"))
    return value


def _channel(value: str) -> str:
    if not _CHANNEL.fullmatch(value):
        raise ValueError(f"is '{value}', which is no channel; write OBSERVER/CHANNEL, like motors/motor1")
    return value


def _message_type(value: str) -> str:
    if not _MESSAGE_TYPE.fullmatch(value):
        raise ValueError(f"is '{value}', which is no type; write json or one like sensor_msgs/msg/Imu")
    return value


@cache
def _message_names() -> frozenset[str]:
    from adapters.mavlink.mavlink_message import mavlink_types

    return frozenset(kind.name for kind in mavlink_types().values())


def _message_name(value: str) -> str:
    if value not in _message_names():
        near = get_close_matches(value.upper(), _message_names(), 1)
        mend = f"did you mean {near[0]}?" if near else "write its name in capitals, like ATTITUDE"
        raise ValueError(f"is no MAVLink message; {mend}")
    return value


def _path(value: Any, info: ValidationInfo) -> Any:
    """Read texts as paths relative to the configuration file; paths came from elsewhere and stand as they are."""
    if not isinstance(value, str):
        return value
    if not value or "\0" in value:
        raise ValueError("is no path; leave the key out for none")
    folder = info.context.get("folder", Path()) if isinstance(info.context, Mapping) else Path()
    return Path(folder) / value


Endpoint = Annotated[str, AfterValidator(_endpoint)]
MavlinkUrl = Annotated[str, AfterValidator(_mavlink_url)]
KeyExpression = Annotated[str, AfterValidator(_key_expression)]
Endpoints = Annotated[tuple[Endpoint, ...], BeforeValidator(_several)]
MavlinkUrls = Annotated[tuple[MavlinkUrl, ...], BeforeValidator(_several)]
KeyExpressions = Annotated[tuple[KeyExpression, ...], BeforeValidator(_several)]
KeyChunks = Annotated[str, AfterValidator(_key_chunks)]
VehicleName = Annotated[str, AfterValidator(_vehicle_name)]
VehicleTemplate = Annotated[str, AfterValidator(_vehicle_template)]
ChannelPath = Annotated[str, AfterValidator(_channel)]
MessageType = Annotated[str, AfterValidator(_message_type)]
MessageName = Annotated[str, AfterValidator(_message_name)]
PathBesideFile = Annotated[Path, BeforeValidator(_path)]
HostPortOrOff = Annotated[str | None, AfterValidator(lambda value: value if value is None else _host_port(value))]
Listed = BeforeValidator(_listed)
