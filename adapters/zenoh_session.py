"""Opens Zenoh sessions: no scouting, no listening but where told, quick to reconnect.

Zenoh's own defaults listen on every address and look for peers by multicast; a monitor beside a vehicle does
neither.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from adapters.errors import TelemetryError

if TYPE_CHECKING:
    import zenoh

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
MAX_MESSAGE_BYTES = 1 << 24

_RETRY = {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5}


def open_session(connect: Sequence[str] = (), listen: Sequence[str] = ()) -> zenoh.Session:
    """Open a session in peer mode.

    What cannot be reached is no error: the session opens within about half a second and goes on trying in the
    background, every 0.2 to 0.5 s, also after a connection was lost. Samples are time-stamped, which the
    caches of advanced publishers need; shared memory is off. The caller closes the session: a process with an
    open one may never end.

    Parameters
    ----------
    connect : Sequence[str]
        Endpoints to connect to (``tcp/127.0.0.1:7447``).
    listen : Sequence[str]
        Endpoints to listen on; none listens nowhere.

    Raises
    ------
    TelemetryError
        An endpoint is not understood, or one to listen on is taken.
    """
    import zenoh

    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/exit_on_failure": True,
        "listen/endpoints": list(listen),
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1,
        "connect/retry": _RETRY,
        "connect/endpoints": list(connect),
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": 1000,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
    }
    for key, value in settings.items():
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
        raise TelemetryError(f"Zenoh cannot {where}: {_reason(str(error))}") from error


def _reason(text: str) -> str:
    """Return what is of use in Zenoh's nested error text."""
    if "Address already in use" in text:
        return "the port is taken; is another monitor running?"
    innermost = text.split("\n", maxsplit=1)[0].rsplit(" [", maxsplit=1)[-1]
    return re.sub(r"( at )?/\S+\.rs:\d+\.?", "", innermost).strip(" []")
