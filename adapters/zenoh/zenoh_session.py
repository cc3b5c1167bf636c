"""Opens Zenoh sessions: no scouting, no listening but where told, quick to reconnect, secured by a file.

Zenoh's own defaults listen on every address and look for peers by multicast; a monitor beside a vehicle does
neither.
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
"""Bytes that a peer can make us hold for one message: sixteen times the largest telemetry, as much as history answers
with.
"""

Mode = Literal["peer", "router", "client"]

# Settings with a default of Zenoh's own other than null, and the name that shows that a file sets them.
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

    What cannot be reached is no error: the session opens within about half a second and goes on trying in the
    background, every 0.2 to 0.5 s, also after a connection was lost. Only a client (``mode: "client"`` in the file)
    needs its router at the start. Samples are time-stamped, which the caches of advanced publishers need; shared
    memory is off. The caller closes the session: a process with an open one may never end.

    Parameters
    ----------
    connect : Sequence[str]
        Endpoints to connect to (``tcp/127.0.0.1:7447``).
    listen : Sequence[str]
        Endpoints to listen on; none listens nowhere.
    config_file : str | Path | None
        Zenoh's own configuration in JSON5: TLS, passwords, access control. What it says counts, its
        endpoints in place of ``connect`` and ``listen``; the rest stays as without it.
    mode : {"peer", "router", "client"}
        Zenoh's mode where the file does not say. A router passes nothing between its peers: what shall be seen
        through one joins it as a router, too, or as a client.

    Raises
    ------
    TelemetryError
        The file is missing or not valid, an endpoint is not understood, or one to listen on is taken.
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
    side: Literal["connect", "listen"],
    otherwise: Sequence[str] = (),
    config_file: str | Path | None = None,
    mode: Mode = "peer",
) -> tuple[str, ...]:
    """Return what :func:`open_session` connects to, or listens on: the file's endpoints, else those given.

    ``mode`` is Zenoh's mode where the file does not say; the file may name endpoints by mode.

    Raises
    ------
    TelemetryError
        The file is missing or not valid.
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
    """Return Zenoh's own reading of a configuration file, if there is one, and its text without comments."""
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

    Zenoh fills in its defaults while it reads, so what is like them counts as not set: it stays null, or, for
    listening, becomes as safe as without a file. For the few others the name in the text decides.
    """
    import zenoh

    differs = config.get_json(key) != zenoh.Config().get_json(key)
    return bool(differs or (key in _DEFAULTED and re.search(rf"\b{_DEFAULTED[key]}\b", text)))


def _reason(text: str) -> str:
    """Return what is of use in Zenoh's nested error text."""
    if "Address already in use" in text:
        return "the port is taken; is another monitor running?"
    if (syntax := re.search(r"--> (\d+):(\d+).*= ([^\n]*)", text, re.DOTALL)) is not None:
        return f"line {syntax[1]}, column {syntax[2]}: {syntax[3]}"
    innermost = text.split("\n", maxsplit=1)[0].rsplit(" [", maxsplit=1)[-1]
    return re.sub(r"( at )?/\S+\.rs:\d+\.?", "", innermost).strip(" []")
