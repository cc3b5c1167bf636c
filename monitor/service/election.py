"""Which of several monitors of one vehicle is active: the oldest that is alive, as liveliness tokens say."""

from __future__ import annotations

import math
import secrets
import threading
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import zenoh

_DISCOVERY_S = 1.0
"""Chosen: on a network peers are discovered in part of a second; a monitor that decided sooner could raise alarms
beside another.
"""


class Election:
    """One monitor's candidacy for a vehicle whose keys begin with ``root``; the session is left open by :meth:`close`.

    Every candidate holds the liveliness token ``<root>/candidate/<start time>-<random>``; the smallest name that is
    alive leads. A monitor that is killed or cannot be reached loses its token, at once where its connection breaks,
    otherwise with the session's lease; the next one leads ``takeover_s`` seconds later, unless the token is back by
    then. One that stops says so with a ``put`` on its token's key, and the next one leads at once. One that was started
    anew is younger and waits. Where a network was split and is whole again, the younger of two leaders steps down.
    """

    def __init__(self, session: zenoh.Session, root: str, takeover_s: float = 0.5) -> None:
        self.name = f"{time.time_ns():020d}-{secrets.token_hex(4)}"
        self._takeover_s = takeover_s
        self._counts_until: dict[str, float] = {self.name: math.inf}
        self._lock = threading.Lock()
        self._decides_at = time.monotonic() + _DISCOVERY_S
        self._session = session
        self._key = f"{root}/candidate/{self.name}"
        everyone = f"{root}/candidate/*"
        liveliness = session.liveliness()
        self._resignations: Any = session.declare_subscriber(everyone, self._on_resignation)
        self._subscriber: Any = liveliness.declare_subscriber(everyone, self._on_token, history=True)
        self._token: Any = liveliness.declare_token(self._key)

    @property
    def leads(self) -> bool:
        """Whether this monitor is to be active; not before others have had a second to show up."""
        now = time.monotonic()
        with self._lock:
            for name in [name for name, until in self._counts_until.items() if until <= now]:
                del self._counts_until[name]
            return now >= self._decides_at and min(self._counts_until) == self.name

    @property
    def others(self) -> int:
        """Number of other candidates that are alive."""
        with self._lock:
            return sum(until == math.inf for until in self._counts_until.values()) - 1

    def close(self) -> None:
        """Give up the candidacy: the next one leads at once."""
        import zenoh

        # What may be dropped is dropped on a busy machine, and the next one would wait for nothing.
        self._session.put(self._key, b"resigns", congestion_control=zenoh.CongestionControl.BLOCK, express=True)
        self._token.undeclare()
        self._subscriber.undeclare()
        self._resignations.undeclare()

    def _on_token(self, sample: zenoh.Sample) -> None:
        import zenoh

        name = _name(sample)
        with self._lock:
            if sample.kind == zenoh.SampleKind.PUT:
                self._counts_until[name] = math.inf
            elif name != self.name and name in self._counts_until:
                self._counts_until[name] = time.monotonic() + self._takeover_s

    def _on_resignation(self, sample: zenoh.Sample) -> None:
        name = _name(sample)
        with self._lock:
            if name != self.name:
                self._counts_until.pop(name, None)


def _name(sample: zenoh.Sample) -> str:
    return str(sample.key_expr).rsplit("/", 1)[-1]
