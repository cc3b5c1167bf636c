"""Which of several monitors of one vehicle is active: the oldest whose main loop is heard, one term after the other."""

from __future__ import annotations

import logging
import math
import secrets
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from monitor.bus.payload import decode_payload, to_json
from monitor.bus.seal import Seal

if TYPE_CHECKING:
    import zenoh

DEADLINE_S = 2.0
"""Time without a sign of a monitor's main loop after which the monitor counts as gone: the status comes once a second,
so the second status is missing by then. Chosen: a shorter time would take a busy machine for a dead one."""
_BEAT_S = 0.25
"""Period of a candidate's messages. Chosen: the deadline is eight periods, and the answer that a new monitor waits for
comes within its discovery."""
_DISCOVERY_S = 1.0
"""Time for discovery. Chosen: on a network, peers are discovered within a part of a second; a monitor that decided
sooner could raise alarms beside another."""
_MOST_PEERS = 1024
"""Most monitors that are remembered. Only holders of the key get an entry; if there are more, the one that has been
silent for longest is forgotten."""
_TERM_BITS = 20
"""Event numbers of a term: a million, so that numbers stay exact in JavaScript (2^53) until the year 2242."""
_SLOT_BITS = 16
"""If two separated monitors become active in the same second, they most likely number from different sixteenths of a
term."""


def first_number(last: int, now_ns: int) -> int:
    """Return the number before the first event of a new term; ``last`` is the largest number that is known.

    A term is the Unix time in seconds at which it began, or the term after the last known one, whichever is later. So
    no number is used twice, even if the disk lost the latest events.
    """
    term = max(now_ns // 1_000_000_000, term_of(last) + 1)
    return term << _TERM_BITS | secrets.randbelow(1 << (_TERM_BITS - _SLOT_BITS)) << _SLOT_BITS


def term_of(number: int) -> int:
    """Return the term that an event's number belongs to."""
    return number >> _TERM_BITS


@dataclass(slots=True)
class _Peer:
    """What is known of another monitor; times are of the monotonic clock, in seconds."""

    beat: int = 0
    active: bool = False
    term: int = 0
    heard_s: float = -math.inf
    answered_s: float = -math.inf  # when it last reported that it hears this monitor
    lost_s: float = math.inf  # when its token was last lost; infinite if it was heard after that


class Election:
    """One monitor's candidacy for a vehicle whose keys begin with ``root``; the session is left open by :meth:`close`.

    Every monitor publishes four times a second, on ``<root>/candidate/<start time>-<random>`` and from its main loop,
    whether it is active, in which term, and whom it hears. A message counts only if it is sealed with the shared secret
    and comes from a monitor that hears this one: nobody without the key has a say, and no recorded message has. A
    monitor counts as gone if it has not been heard for :data:`DEADLINE_S`, even if its process and its connection live,
    or if its liveliness token has been gone for ``takeover_s``. A monitor that stops says so, and the next one becomes
    active at once.

    While no monitor is active, the oldest becomes active, in a term of its own. The active monitor gives way only to a
    monitor that is active in a later term: a monitor that was taken for dead and comes back yields. The age is by Unix
    time, which only sorts the names: if a clock was set, another monitor becomes active, and nobody waits longer.
    ``term`` is the term in which this monitor is active, or was; the caller sets it, who knows the numbers of earlier
    events.
    """

    def __init__(self, session: zenoh.Session, root: str, seal: Seal, takeover_s: float = 0.5) -> None:
        import zenoh

        self.name = f"{time.time_ns():020d}-{secrets.token_hex(4)}"
        self.term = 0
        self._seal = seal
        self._takeover_s = takeover_s
        self._active = False
        self._beat = 0
        self._due_s = 0.0
        self._peers: dict[str, _Peer] = {}
        self._forged = False
        self._lock = threading.Lock()
        self._decides_at = time.monotonic() + _DISCOVERY_S
        self._session = session
        self._key = f"{root}/candidate/{self.name}"
        everyone = f"{root}/candidate/*"
        liveliness = session.liveliness()
        self._beats: Any = session.declare_subscriber(everyone, self._on_beat)
        self._subscriber: Any = liveliness.declare_subscriber(everyone, self._on_token)
        self._publisher: Any = session.declare_publisher(
            self._key, congestion_control=zenoh.CongestionControl.DROP, express=True
        )
        self._token: Any = liveliness.declare_token(self._key)

    def turn(self) -> bool:
        """Announce this monitor; return whether it is to be active.

        Call it often, from the loop that monitors: if that loop hangs, the announcements stop. It returns False until
        the other monitors have had a second to answer.
        """
        now_s = time.monotonic()
        with self._lock:
            alive = {name: peer for name, peer in self._peers.items() if self._is_alive(peer, now_s)}
            others = [(peer.term, name) for name, peer in alive.items() if peer.active]
            if self._active:
                # If two monitors became active in one term while they were separated, the older one stays active.
                self._active = not any(
                    term > self.term or (term == self.term and name < self.name) for term, name in others
                )
            elif now_s >= self._decides_at and not others:
                self._active = all(self.name < name for name in alive)
            due = now_s >= self._due_s
            hears = [name for name, peer in self._peers.items() if now_s - peer.heard_s < DEADLINE_S]
        if due:
            self._due_s = now_s + _BEAT_S
            payload = self._said(hears)
            self._publisher.put(payload, attachment=self._seal.attachment(self._key, payload))
        return self._active

    @property
    def others(self) -> int:
        """Number of other monitors that are alive."""
        now_s = time.monotonic()
        with self._lock:
            return sum(self._is_alive(peer, now_s) for peer in self._peers.values())

    def close(self) -> None:
        """Give up the candidacy: the next monitor becomes active at once."""
        import zenoh

        payload = self._said([], stops=True)
        # A busy machine drops messages that may be dropped; the next monitor would then wait for the deadline.
        self._session.put(
            self._key,
            payload,
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
            attachment=self._seal.attachment(self._key, payload),
        )
        for declared in (self._token, self._publisher, self._subscriber, self._beats):
            declared.undeclare()

    def _is_alive(self, peer: _Peer, now_s: float) -> bool:
        return now_s - peer.answered_s < DEADLINE_S and now_s - peer.lost_s < self._takeover_s

    def _said(self, hears: list[str], stops: bool = False) -> bytes:
        self._beat += 1
        state = {"beat": self._beat, "active": self._active, "term": self.term, "hears": hears, "stops": stops}
        return to_json(state)

    def _on_beat(self, sample: zenoh.Sample) -> None:
        name = _name(sample)
        if name == self.name:
            return
        if not self._seal.holds(sample):
            if not self._forged:
                self._forged = True
                text = "a sender without the standby key claims to be a monitor on %s; it is ignored"
                logging.getLogger(__name__).warning(text, sample.key_expr)
            return
        said = decode_payload(sample.payload)
        if not isinstance(said, dict) or not said.keys() >= {"beat", "active", "term", "hears", "stops"}:
            return
        now_s = time.monotonic()
        with self._lock:
            peer = self._peers.get(name)
            if peer is None:
                if len(self._peers) >= _MOST_PEERS:
                    del self._peers[min(self._peers, key=lambda name: self._peers[name].heard_s)]
                peer = self._peers[name] = _Peer()
                # it waits for an answer
                self._due_s = 0.0
            if said["beat"] <= peer.beat:
                return
            peer.beat, peer.active, peer.term = said["beat"], said["active"], said["term"]
            peer.heard_s, peer.lost_s = now_s, math.inf
            if said["stops"]:
                peer.heard_s = peer.answered_s = -math.inf
            elif self.name in said["hears"]:
                peer.answered_s = now_s

    def _on_token(self, sample: zenoh.Sample) -> None:
        import zenoh

        with self._lock:
            peer = self._peers.get(_name(sample))
            if peer is not None and sample.kind == zenoh.SampleKind.DELETE:
                peer.lost_s = min(peer.lost_s, time.monotonic())


def _name(sample: zenoh.Sample) -> str:
    return str(sample.key_expr).rsplit("/", 1)[-1]
