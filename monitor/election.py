"""Which of several monitors of one vehicle speaks: the oldest that is alive, told by liveliness tokens."""

from __future__ import annotations

import secrets
import threading
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import zenoh

_DISCOVERY_S = 1.0


class Election:
    """One monitor's candidacy for a vehicle.

    Every candidate holds the liveliness token ``<root>/candidate/<start time>-<random>``; the smallest name that is
    alive leads. A monitor that stops, is killed or cannot be reached loses its token, and the next one leads within the
    session's lease. One that comes back is younger and waits. Where a network was split and is whole again, the younger
    of two leaders steps down.

    Parameters
    ----------
    session : zenoh.Session
        An open session; left open by :meth:`close`.
    root : str
        What the vehicle's keys begin with.
    """

    def __init__(self, session: zenoh.Session, root: str) -> None:
        self.name = f"{time.time_ns():020d}-{secrets.token_hex(4)}"
        self._alive: set[str] = {self.name}
        self._lock = threading.Lock()
        self._decides_at = time.monotonic() + _DISCOVERY_S
        key = f"{root}/candidate"
        liveliness = session.liveliness()
        self._subscriber: Any = liveliness.declare_subscriber(f"{key}/*", self._on_token, history=True)
        self._token: Any = liveliness.declare_token(f"{key}/{self.name}")

    @property
    def leads(self) -> bool:
        """Whether this monitor speaks; not before others have had a second to show up."""
        with self._lock:
            return time.monotonic() >= self._decides_at and min(self._alive) == self.name

    @property
    def others(self) -> int:
        """Number of other candidates that are alive."""
        with self._lock:
            return len(self._alive) - 1

    def close(self) -> None:
        """Give up the candidacy: the next one leads at once."""
        self._token.undeclare()
        self._subscriber.undeclare()

    def _on_token(self, sample: zenoh.Sample) -> None:
        import zenoh

        name = str(sample.key_expr).rsplit("/", 1)[-1]
        with self._lock:
            if sample.kind == zenoh.SampleKind.PUT:
                self._alive.add(name)
            elif name != self.name:
                self._alive.discard(name)
