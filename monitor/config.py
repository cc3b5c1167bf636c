"""Configuration of the daemon: a TOML file, overridden by the command line."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from monitor.errors import ProfileError
from monitor.tables import Table

DEFAULT_LISTEN = "tcp/127.0.0.1:7447"
DEFAULT_PREFIX = "fauio"


@dataclass(frozen=True, slots=True)
class Config:
    """What ``fauio run`` does beside its profile.

    Parameters
    ----------
    mavlink : str | None
        MAVLink URL to listen on, for example ``udpin:127.0.0.1:14550``.
    zenoh : str | None
        Key expression of telemetry over Zenoh; used where ``mavlink`` is None.
    vehicle : str | None
        Name in topics; None takes the profile's.
    listen, connect : tuple[str, ...]
        Zenoh endpoints to listen on and to connect to.
    prefix : str
        Prefix of all topics.
    record : str | None
        MCAP file to record to.
    estimate_rate_hz : float
        Largest rate of published estimates.
    """

    mavlink: str | None = None
    zenoh: str | None = None
    vehicle: str | None = None
    listen: tuple[str, ...] = (DEFAULT_LISTEN,)
    connect: tuple[str, ...] = ()
    prefix: str = DEFAULT_PREFIX
    record: str | None = None
    estimate_rate_hz: float = 10.0


def read_config(path: str | Path) -> Config:
    """Read a configuration file.

    Raises
    ------
    ProfileError
        The file is missing, is not TOML, or has a key that is unknown or of the wrong type.
    """
    try:
        content = tomllib.loads(Path(path).read_text())
    except FileNotFoundError as error:
        raise ProfileError(f"{path}: no such file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProfileError(f"{path}: not valid TOML: {error}") from error
    table = Table(str(path), "", content)
    default = Config()
    config = Config(
        mavlink=table.optional_text("mavlink"),
        zenoh=table.optional_text("zenoh"),
        vehicle=table.optional_text("vehicle"),
        listen=table.texts("listen", default.listen),
        connect=table.texts("connect", default.connect),
        prefix=table.text("prefix", default.prefix),
        record=table.optional_text("record"),
        estimate_rate_hz=table.number("estimate_rate_hz", default.estimate_rate_hz, at_least=0.0),
    )
    table.done()
    return config
