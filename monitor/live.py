"""Set up the daemon for one vehicle: configuration, link, Zenoh session, recording, signals, log lines."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import zenoh

from adapters.mavlink_link import MavlinkLink
from adapters.zenoh_link import ZenohLink
from adapters.zenoh_session import open_session
from monitor.config import Config
from monitor.daemon import Daemon, Link
from monitor.errors import ProfileError
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import read_profile
from monitor.publisher import Publisher
from monitor.recorder import Recorder


def run_live(profile_folder: Path, config: Config, *, as_json: bool = False) -> int:
    """Monitor a vehicle until SIGINT or SIGTERM.

    Parameters
    ----------
    profile_folder : Path
        The vehicle's profile.
    config : Config
        Where telemetry comes from and where results go.
    as_json : bool
        Whether log lines on stderr are JSON objects; they are whenever stderr is no terminal.

    Returns
    -------
    int
        Exit status: 0 after SIGTERM, 130 after SIGINT.

    Raises
    ------
    ProfileError, TelemetryError
        The profile, the link or the session cannot be used.
    """
    profile = read_profile(profile_folder)
    if config.mavlink is None and config.zenoh is None:
        raise ProfileError("no telemetry to listen to: give --mavlink URL or --zenoh KEYEXPR, or set it in --config")
    pipeline = Pipeline(profile, config.vehicle)
    log = _Log(as_json or not sys.stderr.isatty())
    with ExitStack() as stack:
        session = stack.enter_context(open_session(connect=config.connect, listen=config.listen))
        link = stack.enter_context(_open_link(config, session))
        recorder = None
        if config.record is not None:
            recorder = stack.enter_context(
                Recorder(config.record, pipeline.layouts, pipeline.metadata(), profile.files)
            )
        publisher = Publisher(session, pipeline.vehicle, pipeline.layouts, config.prefix, config.estimate_rate_hz)
        stack.callback(publisher.close)
        daemon = Daemon(pipeline, link, publisher, recorder, on_event=log.event)
        with _stop_on_signals(daemon) as received:
            log.say(
                "monitoring",
                vehicle=pipeline.vehicle,
                telemetry=config.mavlink or config.zenoh,
                zenoh=", ".join(config.listen) or "no listener",
                topics=f"{config.prefix}/{pipeline.vehicle}/**",
            )
            daemon.run()
        log.say("stopped", **{k: v for k, v in daemon.status(time.time_ns()).items() if isinstance(v, int)})
        return 130 if received == [signal.SIGINT] else 0


@contextmanager
def _open_link(config: Config, session: zenoh.Session) -> Iterator[Link]:
    link = MavlinkLink(config.mavlink) if config.mavlink is not None else ZenohLink(session, config.zenoh or "")
    with contextlib.closing(link):
        yield link


@contextmanager
def _stop_on_signals(daemon: Daemon) -> Iterator[list[int]]:
    """Stop the daemon on the first SIGINT or SIGTERM; yield the list of signals received."""
    received: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        del frame
        received.append(number)
        daemon.stop()

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Log:
    """Log lines on stderr: for people on a terminal, JSON lines otherwise."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json

    def say(self, what: str, **details: Any) -> None:
        self._write(what, details, "  ".join(f"{key} {value}" for key, value in details.items()))

    def event(self, event: AlarmEvent) -> None:
        seconds = event.vehicle_time_ms / 1000
        text = f"{seconds:.3f} s  {event.observer}/{event.channel} {event.state} ({event.severity}): {event.message}"
        self._write("alarm", event.to_json(), text)

    def _write(self, what: str, details: Mapping[str, Any], text: str) -> None:
        if self._as_json:
            line = json.dumps(
                {
                    "time_ns": time.time_ns(),
                    "event": what,
                    **({"alarm": details} if what == "alarm" else details),
                }
            )
        else:
            line = f"{time.strftime('%H:%M:%S')} {what}  {text}"
        sys.stderr.write(line + "\n")
        sys.stderr.flush()
