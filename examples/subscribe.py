"""Alarms of fauio in a terminal, with nothing but Zenoh (`pip install eclipse-zenoh`): what stands, then what changes.

    python subscribe.py                              # of all vehicles, from tcp/127.0.0.1:7447
    python subscribe.py --connect tcp/10.0.0.5:7447 --vehicle copter-1

Zenoh looks for a lost connection again by itself, and the subscriptions come back with it. What changed meanwhile is
asked for when the monitor's liveliness token is back. An event may come twice, by both ways: the second is dropped.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import queue
from collections.abc import Iterator
from typing import Any

import zenoh

LARGEST_QUEUE = 10_000


def configuration(endpoints: list[str]) -> zenoh.Config:
    """Return a session that connects there and nowhere else, and tries again twice a second."""
    config = zenoh.Config()
    settings = {
        "connect/endpoints": endpoints,
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5},
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


class Alarms:
    """What one or all vehicles' monitors say, taken off the network at once and handed out line by line.

    Parameters
    ----------
    session : zenoh.Session
        An open session.
    vehicle : str
        Name of the vehicle, ``*`` for all.
    prefix : str
        What the monitor's keys begin with.
    """

    def __init__(self, session: zenoh.Session, vehicle: str = "*", prefix: str = "fauio") -> None:
        self._session = session
        self._prefix = prefix
        self._seen: set[tuple[str, str, int]] = set()
        self._queue: queue.Queue[tuple[str, str, bytes]] = queue.Queue()
        # First subscribe, then ask: nothing falls between the two.
        self._events: Any = session.declare_subscriber(f"{prefix}/{vehicle}/alarm/**", self._on_event)
        self._tokens: Any = session.liveliness().declare_subscriber(
            f"{prefix}/{vehicle}/live", self._on_token, history=True
        )

    def _on_event(self, sample: zenoh.Sample) -> None:
        self._put("event", sample)

    def _on_token(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self._put("gone", sample)
            return
        vehicle = self._vehicle(sample)
        # A callback: waiting for the answer here would hold up the session that brings it.
        self._session.get(f"{self._prefix}/{vehicle}/alarms", self._on_standing, timeout=2.0)

    def _on_standing(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._put("standing", reply.ok)

    def _put(self, kind: str, sample: zenoh.Sample) -> None:
        # Without a bound a terminal that stands still would fill the memory.
        while self._queue.qsize() >= LARGEST_QUEUE:
            self._queue.get_nowait()
        self._queue.put((kind, self._vehicle(sample), sample.payload.to_bytes()))

    def _vehicle(self, sample: zenoh.Sample) -> str:
        return str(sample.key_expr).removeprefix(f"{self._prefix}/").partition("/")[0]

    def lines(self) -> Iterator[str]:
        """Yield a line for each change, for ever."""
        while True:
            kind, vehicle, payload = self._queue.get()
            if kind == "gone":
                yield f"{vehicle}: monitor is gone"
                continue
            try:
                content = json.loads(payload)
                events = content if kind == "standing" else [content]
                if kind == "standing":
                    yield f"{vehicle}: monitor is there, alarms that stand: {len(events)}"
                for event in events:
                    mark = (vehicle, event["id"], event["seq"])
                    if mark not in self._seen:
                        self._seen.add(mark)
                        yield f"{vehicle}: {event['state']} {event['severity']} {event['channel']}: {event['message']}"
            except (ValueError, KeyError, TypeError) as error:
                yield f"{vehicle}: not understood: {error!r}"
            if len(self._seen) > LARGEST_QUEUE:
                self._seen.clear()


def main() -> None:
    """Print alarms until interrupted."""
    parser = argparse.ArgumentParser(description="Print fauio's alarms: what stands now, then what changes.")
    parser.add_argument("--connect", nargs="+", default=["tcp/127.0.0.1:7447"], metavar="ENDPOINT")
    parser.add_argument("--vehicle", default="*", metavar="NAME")
    args = parser.parse_args()
    with zenoh.open(configuration(args.connect)) as session:
        for line in Alarms(session, args.vehicle).lines():
            print(line, flush=True)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
