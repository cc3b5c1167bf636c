"""The simulated arm's telemetry: MAVLink packets, messages for recordings, and live publishing.

MAVLink: HEARTBEAT once a second and, for each sample, DEBUG_FLOAT_ARRAY with ``name`` "arm", ``time_usec``
the simulated time, ``data[0]`` the torque u, ``data[1..3]`` the outputs y, and the truth in ``data[4]`` (f_a)
and ``data[5]`` (f_s). Floats have 32 bits there. Zenoh: ``{"time_ns", "u": [1], "y": [3], "f_a": [1], "f_s":
[1]}``.
"""

import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

from adapters.batch import messages
from adapters.errors import TelemetryError
from adapters.mavlink.heartbeat import ARMED, AUTOPILOT
from adapters.mavlink.mavlink_columns import decoded, dialect, wanted_kinds
from adapters.mavlink.packets import PacketList, PacketScanner
from adapters.message import SECOND_NS, Message
from adapters.simulation.arm import ArmRun
from adapters.simulation.pacing import paced, send_paced

SYSTEM = 1
"""Ids of the simulated vehicle: the defaults of autopilots."""
ARRAY_NAME = "arm"

_HEARTBEAT_NS = SECOND_NS
"""MAVLink's rate of heartbeats, one a second."""
_ACTIVE = 4
"""MAV_STATE_ACTIVE."""
_MAVLINK_VERSION = 3
"""Value of the heartbeat's last field: 3 for both versions of the protocol."""
_FLOATS = 58
"""Length of DEBUG_FLOAT_ARRAY's data."""
# Publishing waits for a subscriber at most this long, so that none misses the start.
_SUBSCRIBER_S = 5.0


def arm_packets(run: ArmRun) -> Iterator[tuple[int, bytes]]:
    """Return simulated time, nanoseconds, and bytes of each MAVLink packet."""
    from pymavlink.dialects.v20 import ardupilotmega

    link = ardupilotmega.MAVLink(None, srcSystem=SYSTEM, srcComponent=AUTOPILOT)
    heartbeat = ardupilotmega.MAVLink_heartbeat_message(0, 0, ARMED, 0, _ACTIVE, _MAVLINK_VERSION)

    def pack(packed: ardupilotmega.MAVLink_message) -> bytes:
        packet = bytes(packed.pack(link))
        link.seq = (link.seq + 1) % 256
        return packet

    heartbeat_ns = 0
    for k, time_s in enumerate(run.t.tolist()):
        time_ns = round(time_s * 1e9)
        if time_ns >= heartbeat_ns:
            yield time_ns, pack(heartbeat)
            heartbeat_ns += _HEARTBEAT_NS
        data = [*run.u[k].tolist(), *run.y[k].tolist(), *run.f_a[k].tolist(), *run.f_s[k].tolist()]
        data += [0.0] * (_FLOATS - len(data))
        array = ardupilotmega.MAVLink_debug_float_array_message(time_ns // 1000, ARRAY_NAME.encode(), 0, data)
        yield time_ns, pack(array)


def arm_messages(run: ArmRun, start_unix_ns: int) -> Iterator[Message]:
    """Return the run as a MAVLink link without delay would receive it; simulated time 0 is ``start_unix_ns``."""
    scanner, packets = PacketScanner(dialect()), PacketList(dialect())
    for time_ns, packet in arm_packets(run):
        scanner.scan(packet, packets, start_unix_ns + time_ns)
    return messages(decoded(packets, wanted_kinds()))


def arm_payloads(run: ArmRun) -> Iterator[tuple[int, bytes]]:
    """Return simulated time, nanoseconds, and Zenoh payload of each sample."""
    for k, time_s in enumerate(run.t.tolist()):
        time_ns = round(time_s * 1e9)
        sample = {
            "time_ns": time_ns,
            "u": run.u[k].tolist(),
            "y": run.y[k].tolist(),
            "f_a": run.f_a[k].tolist(),
            "f_s": run.f_s[k].tolist(),
        }
        yield time_ns, json.dumps(sample).encode()


def send_arm(run: ArmRun, url: str, speed: float = 1.0) -> int:
    """Send the run as MAVLink to ``udpout:HOST:PORT`` at ``speed`` times real time; return the number of packets."""
    return send_paced(arm_packets(run), url, speed)


def publish_arm(
    run: ArmRun, key: str, connect: Sequence[str], speed: float = 1.0, config_file: str | Path | None = None
) -> int:
    """Publish the run as JSON under a Zenoh key at ``speed`` times real time; return the number of samples.

    Publishing starts when somebody subscribes, at the latest after 5 s. ``connect`` and ``config_file`` are those of
    :func:`adapters.zenoh.zenoh_session.open_session`.
    """
    import zenoh

    from adapters.zenoh.zenoh_session import open_session

    count = 0
    with open_session(connect=connect, config_file=config_file) as session:
        try:
            publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        except zenoh.ZError as error:
            raise TelemetryError(f"'{key}' is not a Zenoh key to publish under") from error
        until = time.monotonic() + _SUBSCRIBER_S
        # Zenoh's type stub calls the status a bool; it is an object.
        while not cast("Any", publisher.matching_status).matching and time.monotonic() < until:
            time.sleep(0.01)
        for payload in paced(arm_payloads(run), speed):
            publisher.put(payload, encoding=zenoh.Encoding.APPLICATION_JSON)
            count += 1
    return count
