"""A plain Zenoh client that writes down what a monitor says and when it heard it, one JSON line each.

python bench/soak_listener.py ENDPOINT FILE
"""

from __future__ import annotations

import json
import signal
import sys
import time

import zenoh


def main(endpoint: str, path: str) -> None:
    config = zenoh.Config()
    for key, value in {
        "mode": '"peer"',
        "connect/endpoints": json.dumps([endpoint]),
        "listen/endpoints": "[]",
        "scouting/multicast/enabled": "false",
    }.items():
        config.insert_json5(key, value)
    with open(path, "w", buffering=1) as out, zenoh.open(config) as session:  # noqa: PTH123 - line by line

        def heard(sample: zenoh.Sample) -> None:
            at_ns = time.time_ns()
            payload = json.loads(bytes(sample.payload))
            out.write(json.dumps({"at_ns": at_ns, "key": str(sample.key_expr), "payload": payload}) + "\n")

        subscribers = [session.declare_subscriber(f"fauio/*/{what}", heard) for what in ("alarm/**", "status")]
        signal.sigwait({signal.SIGTERM, signal.SIGINT})
        for subscriber in subscribers:
            subscriber.undeclare()


if __name__ == "__main__":
    # blocked before zenoh starts threads, which inherit it: the signal then waits for sigwait
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})
    main(*sys.argv[1:])
