"""What tests of whole daemons share: processes of ``fauio run`` on example configurations, and what they publish."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import zenoh

from adapters.logs.tlog import TlogReader
from adapters.simulation.pacing import paced
from adapters.zenoh.zenoh_session import open_session

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"
FAUIO = (sys.executable, "-m", "fauio")
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}


def free_ports(count: int, kind: socket.SocketKind = socket.SOCK_STREAM) -> list[int]:
    """Return different ports of loopback that nobody listens on."""
    probes = [socket.socket(socket.AF_INET, kind) for _ in range(count)]
    for probe in probes:
        probe.bind(("127.0.0.1", 0))
    ports = [int(probe.getsockname()[1]) for probe in probes]
    for probe in probes:
        probe.close()
    return ports


def filled_in(example: str, folder: Path, values: Mapping[str, str]) -> Path:
    """Write an example configuration to a folder, with ports and paths in place of those it names; return the file."""
    text = (EXAMPLES / example).read_text()
    # one after the other would replace what was filled in before
    for k, old in enumerate(values):
        text = text.replace(old, f"<{k}>")
    for k, new in enumerate(values.values()):
        text = text.replace(f"<{k}>", new)
    path = folder / example
    path.write_text(text)
    return path


class DaemonProcess:
    """A daemon that runs on a configuration; what it logs goes to a file beside that."""

    def __init__(self, config: Path) -> None:
        self.config = config
        self._log = config.with_suffix(".log")
        self._before = self._log.stat().st_size if self._log.exists() else 0
        with self._log.open("ab") as log:
            command = [*FAUIO, "run", "--config", str(config)]
            self.process = subprocess.Popen(command, stderr=log, env=ENVIRONMENT, cwd=config.parent)

    def log(self) -> list[dict[str, Any]]:
        """Return the log lines of this run."""
        with self._log.open("rb") as log:
            log.seek(self._before)
            return [json.loads(line) for line in log.read().splitlines() if line.startswith(b"{")]

    def kill(self) -> None:
        """Kill it as a crash would."""
        self.process.kill()
        self.process.wait(10)

    def terminate(self) -> int:
        """Ask it to stop, return its exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(10)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()


class Flight(threading.Thread):
    """Sends each packet of a flight to several ports of loopback, in real time, until it or its context ends."""

    def __init__(self, log: Path, ports: Sequence[int], start_s: float) -> None:
        super().__init__(name=f"flight {log.name}", daemon=True)
        packets = list(TlogReader(log).packets())
        self._first_ns = packets[0][0]
        since_ns = self._first_ns + round(start_s * 1e9)
        self._packets = [(time_ns, (time_ns, packet)) for time_ns, packet in packets if time_ns >= since_ns]
        self._ports = ports
        self.at_s = 0.0
        """Time since the log's first packet, seconds."""
        self._ended = threading.Event()
        self.start()

    def __enter__(self) -> Flight:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self.join()

    def run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for time_ns, packet in paced(self._packets, 1.0):
                for port in self._ports:
                    out.sendto(packet, ("127.0.0.1", port))
                if self._ended.is_set():
                    return
                self.at_s = (time_ns - self._first_ns) / 1e9


class Seen(NamedTuple):
    """A sample as a plain subscriber gets it."""

    key: str
    said: dict[str, Any]
    by: str
    """Which session said it."""
    at: float
    """Monotonic time of arrival, seconds."""


class Watcher:
    """A plain Zenoh session that sees all below a key, and asks."""

    def __init__(self, connect: list[str], below: str = "fauio") -> None:
        # A peer would get from two routers everything twice, and a client is connected to one of them at a time.
        self.session = open_session(connect=connect, mode="router")
        self._lock = threading.Lock()
        self._seen: list[Seen] = []
        self._live: set[str] = set()
        # both are callbacks at once: a full channel would stall the session
        self._subscriber: Any = self.session.declare_subscriber(f"{below}/**", self._take)
        self._tokens: Any = self.session.liveliness().declare_subscriber(f"{below}/**", self._note, history=True)

    def seen(self, part: str, since: float = 0.0) -> list[Seen]:
        """Return what came on keys that hold a text, from a monotonic time on."""
        with self._lock:
            return [sample for sample in self._seen if part in sample.key and sample.at >= since]

    def events(self, channel: str = "", since: float = 0.0) -> list[dict[str, Any]]:
        """Return alarm events of a channel, or of all."""
        return [one.said for one in self.seen(f"/alarm/{channel}", since)]

    def live(self, part: str) -> set[str]:
        """Return liveliness tokens that hold a text."""
        with self._lock:
            return {key for key in self._live if part in key}

    def ask(self, key: str, payload: Mapping[str, Any] | None = None) -> list[Any]:
        """Return the answers of all who answer."""
        replies = self.session.get(
            key,
            payload=None if payload is None else json.dumps(payload),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=5.0,
        )
        return [json.loads((reply.ok or reply.err).payload.to_bytes()) for reply in replies]  # type: ignore[union-attr]

    def close(self) -> None:
        self.session.close()

    def _take(self, sample: zenoh.Sample) -> None:
        at = time.monotonic()
        assert sample.timestamp is not None
        said = json.loads(sample.payload.to_bytes()) if sample.encoding == zenoh.Encoding.APPLICATION_JSON else {}
        with self._lock:
            self._seen.append(Seen(str(sample.key_expr), said, str(sample.timestamp.get_id()), at))

    def _note(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        with self._lock:
            (self._live.add if sample.kind == zenoh.SampleKind.PUT else self._live.discard)(key)
