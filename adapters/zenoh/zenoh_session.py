"""Opens Zenoh sessions: no scouting, no listening unless requested, quick to reconnect, secured by a file.

Zenoh's own defaults listen on every address and search for peers by multicast; a monitor beside a vehicle does neither.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from adapters.errors import TelemetryError

if TYPE_CHECKING:
    import zenoh

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
MAX_MESSAGE_BYTES = 1 << 24
"""Memory for one message of a peer, bytes: sixteen times the largest telemetry, and the size of an answer of the
history."""

Mode = Literal["peer", "router", "client"]

# Settings whose default in Zenoh is not null, and the name that shows that a file sets them.
_DEFAULTED = {
    "transport/shared_memory/enabled": "shared_memory",
    "transport/link/tx/lease": "lease",
    "transport/link/rx/max_message_size": "max_message_size",
}
_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
_RETRY = {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5}


def open_session(
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    config_file: str | Path | None = None,
    mode: Mode = "peer",
) -> zenoh.Session:
    """Open a session.

    An unreachable endpoint is not an error: the session opens within about half a second and keeps trying in the
    background, every 0.2 to 0.5 s, also after a connection was lost. Only a client (``mode: "client"`` in the file)
    needs its router at the start. Samples are time-stamped, which the caches of advanced publishers need; shared memory
    is off. The caller closes the session: a process with an open one may never end.

    Parameters
    ----------
    connect : Sequence[str]
        Endpoints to connect to (``tcp/127.0.0.1:7447``).
    listen : Sequence[str]
        Endpoints to listen on; with none the session does not listen.
    config_file : str | Path | None
        Zenoh's own configuration in JSON5: TLS, passwords, access control. Its settings have priority, its endpoints
        replace ``connect`` and ``listen``; the rest stays as without it.
    mode : {"peer", "router", "client"}
        Zenoh's mode if the file does not set one. A router passes nothing between its peers: a session that needs data
        through a router joins it as a router, too, or as a client.

    Raises
    ------
    TelemetryError
        The file is missing or not valid, an endpoint is not understood, or one to listen on is in use.
    """
    import zenoh

    config, text = _read_config(config_file)
    settings: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/exit_on_failure": True,
        "listen/endpoints": list(listen),
        "connect/retry": _RETRY,
        "connect/endpoints": list(connect),
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": 1000,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
    }
    # a client would wait for its router for ever, and before the session is open
    chosen = json.loads(config.get_json("mode")) if _says(config, text, "mode") else mode
    if chosen != "client":
        settings |= {"connect/exit_on_failure": False, "connect/timeout_ms": -1}
    for key, value in settings.items():
        if _says(config, text, key):
            continue
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            if not key.endswith("/endpoints"):
                raise
            raise TelemetryError(
                f"Zenoh endpoint {' '.join(value)}: not understood; write it like {DEFAULT_ENDPOINT}"
            ) from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = f"listen on {' '.join(listen)}" if listen else f"connect to {' '.join(connect)}"
        if config_file is not None:
            where = f"open a session as {config_file} says"
        raise TelemetryError(f"Zenoh cannot {where}: {_reason(str(error))}") from error


def endpoints(
    side: Literal["connect", "listen"], otherwise: Sequence[str], config_file: str | Path | None, mode: Mode = "peer"
) -> tuple[str, ...]:
    """Return what :func:`open_session` connects to, or listens on: the file's endpoints, otherwise the given ones.

    ``mode`` is Zenoh's mode if the file does not set one; the file may name endpoints by mode.
    """
    config, text = _read_config(config_file)
    key = f"{side}/endpoints"
    if not _says(config, text, key):
        return tuple(otherwise)
    said = json.loads(config.get_json(key))
    if isinstance(said, dict):
        said = said.get(json.loads(config.get_json("mode")) or mode)
    return tuple(str(endpoint) for endpoint in said or ())


def _read_config(config_file: str | Path | None) -> tuple[zenoh.Config, str]:
    """Return a configuration file as read by Zenoh, if there is one, and its text without comments."""
    import zenoh

    if config_file is None:
        return zenoh.Config(), ""
    path = Path(config_file)
    try:
        text = path.read_text()
        config = zenoh.Config.from_json5(text)
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, zenoh.ZError) as error:
        raise TelemetryError(f"{path}: not a Zenoh configuration: {_reason(str(error))}") from error
    return config, _COMMENT.sub("", text)


def _says(config: zenoh.Config, text: str, key: str) -> bool:
    """Return whether a configuration file sets a key.

    Zenoh fills in its defaults while it reads, so a value equal to the default counts as not set: it stays null, or,
    for listening, becomes as safe as without a file. For the few other keys the name in the text decides.
    """
    import zenoh

    differs = config.get_json(key) != zenoh.Config().get_json(key)
    return bool(differs or (key in _DEFAULTED and re.search(rf"\b{_DEFAULTED[key]}\b", text)))


def _reason(text: str) -> str:
    """Return the useful part of Zenoh's nested error text."""
    if "Address already in use" in text:
        return "the port is taken; is another monitor running?"
    if (syntax := re.search(r"--> (\d+):(\d+).*= ([^\n]*)", text, re.DOTALL)) is not None:
        return f"line {syntax[1]}, column {syntax[2]}: {syntax[3]}"
    innermost = text.split("\n", maxsplit=1)[0].rsplit(" [", maxsplit=1)[-1]
    return re.sub(r"( at )?/\S+\.rs:\d+\.?", "", innermost).strip(" []")
