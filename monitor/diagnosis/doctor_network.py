"""Checks of ``fauio doctor`` about the network: free ports, monitors that answer there, a round trip over Zenoh."""

from __future__ import annotations

import json
import socket
import statistics
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import TYPE_CHECKING, Any

from adapters.errors import TelemetryError
from adapters.mavlink.byte_link import open_byte_link, resolve
from adapters.zenoh.zenoh_session import Mode, endpoints, open_session
from monitor.diagnosis.doctor import DoctorCheck

if TYPE_CHECKING:
    import zenoh

_ROUNDS = 20
"""Samples of the round trip. Chosen: enough for a median; on loopback they take milliseconds."""
_PATIENCE_S = 5.0
"""Seconds to wait for the round trip. Chosen: loopback that needs longer does not work."""
_SLOW_S = 0.02
"""Seconds from which a round trip is slow: half of the 40 ms from packet to alarm that are promised."""
_ANSWER_S = 1.5
"""Seconds to wait for replies. Chosen: enough for all monitors of a network."""
_OPEN_MS = 1000
"""Milliseconds to wait for a peer. Chosen: one that is there answers within milliseconds."""


def zenoh_port_check(endpoint: str) -> DoctorCheck:
    """Check that a Zenoh endpoint can be listened on, or find the monitors that do already."""
    name = "zenoh port"
    try:
        with open_session(listen=[endpoint]):
            pass
    except TelemetryError as error:
        reason = str(error)
    else:
        return DoctorCheck(name, "ok", f"{endpoint} is free")
    if "taken" not in reason:
        return DoctorCheck(name, "failed", reason, "give another endpoint with --listen, or mend this one")
    answers, vehicles = _who_answers(endpoint)
    if vehicles:
        return DoctorCheck(name, "ok", f"{endpoint}: a monitor runs there ({', '.join(vehicles)})")
    if answers:
        advice = "stop it, or give the monitor another endpoint ('listen', --listen)"
        return DoctorCheck(name, "warning", f"{endpoint}: a Zenoh program that is no monitor listens there", advice)
    advice = "stop it (ss -ltnp names it), or give the monitor another endpoint ('listen', --listen)"
    return DoctorCheck(name, "failed", f"{endpoint} is taken by something that is not Zenoh", advice)


def zenoh_file_check(config_file: Path, connect: Sequence[str], listen: Sequence[str], mode: Mode) -> DoctorCheck:
    """Check that a session opens with a Zenoh configuration: certificates exist, endpoints are free."""
    name = "zenoh port"
    try:
        places = ", ".join(endpoints("listen", listen, config_file, mode)) or "no listener"
        with open_session(connect, listen, config_file, mode):
            pass
    except TelemetryError as error:
        if "taken" in str(error):
            advice = "stop who listens there (ss -ltnp names it; a monitor of ours?), or use another port"
            return DoctorCheck(name, "warning", str(error), advice)
        return DoctorCheck(name, "failed", str(error), "mend the file ('zenoh_config')")
    return DoctorCheck(name, "ok", f"{places}: free, as {config_file} says")


def mavlink_check(url: str) -> DoctorCheck:
    """Check that a MAVLink link can be opened."""
    name = "mavlink link"
    try:
        open_byte_link(url, may_send=True).close()
    except TelemetryError as error:
        if "in use" in str(error):
            advice = "stop who listens there (ss -lunp names it; a monitor of ours?), or use another port ('mavlink')"
            return DoctorCheck(name, "warning", f"{url}: the port is taken", advice)
        return DoctorCheck(name, "failed", str(error), "mend the URL ('mavlink' in the configuration, or --mavlink)")
    return DoctorCheck(name, "ok", f"{url} can be opened")


def metrics_check(address: str) -> DoctorCheck:
    """Check that metrics can be served at HOST:PORT."""
    name = "metrics"
    try:
        family, place = resolve(f"metrics {address}", address)
        with socket.socket(family) as probe:
            # as a server does: connections left by a former server are no obstacle
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place)
    except TelemetryError as error:
        return DoctorCheck(name, "failed", str(error), "mend 'listen' in [metrics]")
    except OSError as error:
        advice = "stop who listens there (ss -ltnp names it; a monitor of ours?), or use another port ('listen')"
        return DoctorCheck(name, "warning", f"{address}: {error.strerror}", advice)
    return DoctorCheck(name, "ok", f"{address} is free")


def round_trip_check() -> DoctorCheck:
    """Check that a Zenoh session on loopback receives from another, and how fast."""
    name = "zenoh"
    try:
        endpoint = f"tcp/127.0.0.1:{_free_port()}"
        with open_session(listen=[endpoint]) as ours, open_session(connect=[endpoint]) as theirs:
            latencies, answered = _round_trips(ours, theirs)
    except (OSError, TelemetryError) as error:
        return DoctorCheck(
            name, "failed", f"no session on loopback: {error}", "check that loopback is up: ip address show lo"
        )
    if len(latencies) < _ROUNDS or not answered:
        state = f"{len(latencies)} of {_ROUNDS} samples and {'an' if answered else 'no'} answer came over loopback"
        return DoctorCheck(name, "failed", state, "check for a firewall on loopback, and the load of the machine")
    median_s, longest_s = statistics.median(latencies), max(latencies)
    state = f"put and get on loopback work; median {median_s * 1e3:.2f} ms, longest {longest_s * 1e3:.2f} ms"
    if median_s > _SLOW_S:
        return DoctorCheck(name, "warning", state, "the machine is busy: alarms will be late by as much")
    return DoctorCheck(name, "ok", state)


def _round_trips(ours: zenoh.Session, theirs: zenoh.Session) -> tuple[list[float], bool]:
    """Return how long samples took from one session to the other, seconds, and whether a query was answered."""
    received = threading.Event()
    subscriber: Any = ours.declare_subscriber("fauio-doctor/put", lambda sample: received.set())
    queryable: Any = ours.declare_queryable("fauio-doctor/get", lambda query: query.reply("fauio-doctor/get", b"here"))
    publisher: Any = theirs.declare_publisher("fauio-doctor/put")
    until = time.monotonic() + _PATIENCE_S
    while not publisher.matching_status.matching and time.monotonic() < until:
        time.sleep(0.01)
    latencies = []
    for _ in range(_ROUNDS):
        received.clear()
        started = time.perf_counter()
        publisher.put(b"there")
        if not received.wait(max(0.0, until - time.monotonic())):
            break
        latencies.append(time.perf_counter() - started)
    answered = False
    while not answered and time.monotonic() < until:
        answered = any(reply.ok is not None for reply in theirs.get("fauio-doctor/get", timeout=1.0))
    for entity in (subscriber, queryable, publisher):
        entity.undeclare()
    return latencies, answered


def _who_answers(endpoint: str) -> tuple[bool, list[str]]:
    """Return whether Zenoh answers at an endpoint, and the vehicles of the monitors reached through it."""
    # a program that listens there but is not Zenoh never answers, and closing waits for it
    config = {"connect": {"endpoints": [endpoint]}, "transport": {"unicast": {"open_timeout": _OPEN_MS}}}
    try:
        with NamedTemporaryFile("w", suffix=".json5") as file:
            json.dump(config, file)
            file.flush()
            session = open_session(config_file=file.name)
        with session:
            until = time.monotonic() + _ANSWER_S
            while time.monotonic() < until:
                info = session.info
                if list(info.peers_zid()) or list(info.routers_zid()):
                    replies = session.liveliness().get("**/live", timeout=1.0)
                    keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
                    return True, sorted(key.split("/")[-2] for key in keys)
                time.sleep(0.05)
    except TelemetryError:
        pass
    return False, []


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
