"""Checks of single values of the daemon's configuration: each raises a ValueError with a message for the user."""

import ipaddress
import re
from difflib import get_close_matches
from functools import cache

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
    """Return whether an endpoint, MAVLink URL or HOST:PORT listens on an address that other machines reach.

    MAVLink links that connect and serial ones do not listen.
    """
    kind, slash, rest = address.partition("/")
    if slash and _ENDPOINT.fullmatch(address):
        return kind not in _LOCAL and not is_loopback(re.split(r"[?#]", rest)[0].rpartition(":")[0])
    kind, _, rest = address.partition(":")
    if kind in ("udp", "udpin", "tcpin"):
        return not is_loopback(rest.rpartition(":")[0])
    match = _HOST_PORT.fullmatch(address)
    return kind not in ("udpout", "tcp", "serial") and match is not None and not is_loopback(match[1])


def endpoint(value: str) -> None:
    """Refuse a text that is no Zenoh endpoint."""
    if not _ENDPOINT.fullmatch(value):
        raise ValueError(f"is '{value}', which is no Zenoh endpoint; write it like tcp/127.0.0.1:7447")


def mavlink_url(value: str) -> None:
    """Refuse a text that is no URL of a MAVLink link."""
    kind, _, rest = value.partition(":")
    if kind == "serial" and rest:
        return
    if kind not in ("udp", "udpin", "udpout", "tcp", "tcpin"):
        raise ValueError(f"is '{value}', an unknown kind of link; {_URL_HELP}")
    _check_host_port(value, rest, _URL_HELP)


def udp_target(value: str) -> None:
    """Refuse a text that is no address that packets can be sent to."""
    kind, _, rest = value.partition(":")
    if kind != "udpout":
        raise ValueError(f"is '{value}'; write it like udpout:127.0.0.1:14551")
    _check_host_port(value, rest, "write it like udpout:127.0.0.1:14551")


def host_port_or_off(value: str) -> None:
    """Refuse a text that is neither HOST:PORT nor ``off``."""
    if value != "off":
        _check_host_port(value, value, 'write "127.0.0.1:9464", or "off"')


def _check_host_port(value: str, rest: str, mend: str) -> None:
    match = _HOST_PORT.fullmatch(rest)
    if match is None or int(match[2]) > 0xFFFF:
        raise ValueError(f"is '{value}', without HOST:PORT in it; {mend}")


def key_expression(value: str) -> None:
    """Refuse a text that is no Zenoh key expression."""
    import zenoh

    try:
        zenoh.KeyExpr(value)
    except zenoh.ZError:
        raise ValueError(
            f"is '{value}', which is no Zenoh key expression; write it like arm/telemetry or rover/**"
        ) from None


def key_chunks(value: str) -> None:
    """Refuse a text that cannot be part of a Zenoh key."""
    try:
        vehicle_root(value, "*")
    except ValueError:
        raise ValueError(f"is '{value}', which cannot be part of a Zenoh key; use letters, digits, - and _") from None


def vehicle_name(value: str) -> None:
    """Refuse a text that cannot be the name of a vehicle in topics."""
    if value == "*" or "/" in value:
        raise ValueError(f"is '{value}', which is no name of a vehicle; use letters, digits, - and _")
    key_chunks(value)


def vehicle_template(value: str) -> None:
    """Refuse a name without a placeholder for the system id."""
    if "{system}" not in value:
        raise ValueError(f"is '{value}', which is the same for all vehicles; put {{system}} where the id belongs")
    vehicle_name(value.replace("{system}", "1"))


def channel(value: str) -> None:
    """Refuse a text that is no OBSERVER/CHANNEL."""
    if not _CHANNEL.fullmatch(value):
        raise ValueError(f"is '{value}', which is no channel; write OBSERVER/CHANNEL, like motors/motor1")


def message_type(value: str) -> None:
    """Refuse a text that is neither ``json`` nor a type of ROS 2."""
    if not _MESSAGE_TYPE.fullmatch(value):
        raise ValueError(f"is '{value}', which is no type; write json or one like sensor_msgs/msg/Imu")


@cache
def _message_names() -> frozenset[str]:
    from adapters.mavlink.mavlink_message import mavlink_types

    return frozenset(kind.name for kind in mavlink_types().values())


def message_name(value: str) -> None:
    """Refuse a text that is no MAVLink message."""
    if value not in _message_names():
        near = get_close_matches(value.upper(), _message_names(), 1)
        mend = f"did you mean {near[0]}?" if near else "write its name in capitals, like ATTITUDE"
        raise ValueError(f"is no MAVLink message; {mend}")


def argument(value: str) -> None:
    """Refuse a text that cannot be an argument of a program."""
    if not value or "\0" in value:
        raise ValueError("is no argument; write the program and each of its arguments as a text of its own")


def path(value: str) -> None:
    """Refuse a text that cannot be a path."""
    if not value or "\0" in value:
        raise ValueError("is no path; leave the key out for none")
