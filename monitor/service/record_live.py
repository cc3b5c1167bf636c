"""Record live telemetry as it comes, without a profile: the input of a first fit."""

from __future__ import annotations

import signal
import sys
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from adapters.batch import Batch, arrival_times
from adapters.errors import StorageError, TelemetryError, UsageError
from adapters.message import SECOND_NS
from adapters.output_file import check_suffix
from adapters.zenoh.zenoh_session import open_session
from monitor.configuration.config import Config
from monitor.recording.record_encoder import RecordEncoder
from monitor.recording.recorder import Recorder
from monitor.service.caught_signals import caught_signals
from monitor.service.inbox import Inbox
from monitor.service.links import FirstLook, open_links, signing_guard
from monitor.service.log import ServiceLog

_POLL_S = 0.1
"""Period at which Ctrl-C and the end of --seconds are checked: chosen."""


@dataclass(frozen=True, slots=True)
class LiveRecording:
    """The result of a recording."""

    messages: int  # messages in the file
    names: int  # different message names
    systems: tuple[int, ...]  # MAVLink systems of the senders
    seconds: float  # time from the first message to the last
    dropped: int  # messages dropped because the recorder did not keep up
    unrecordable: int  # messages that no record can hold
    interrupted: bool  # whether SIGINT ended it
    links: str  # the links' names


def record_live(config: Config, path: Path, seconds: float | None = None, *, as_json: bool = False) -> LiveRecording:
    """Record what the links bring, of all senders, until SIGINT, SIGTERM or so many seconds after the first message.

    What is older than a second survives a crash. ``as_json`` asks for log lines as JSON objects.

    Raises
    ------
    UsageError, StorageError, TelemetryError
        The file exists, or cannot be written; a link or the session cannot be used; nothing came until the end; the
        disk takes no more: what was flushed before stands in the file.
    """
    if not config.mavlink and not _over_zenoh(config):
        raise UsageError("no telemetry to listen to: give --mavlink URL or --zenoh KEYEXPR, or set it in --config")
    if path.exists():
        raise StorageError(f"{path}: already exists; name another file, or move it away")
    check_suffix(path, ".mcap")
    try:
        found = _record(config, path, seconds, as_json)
    except OSError as error:
        if error.filename != str(path):
            raise
        raise StorageError(
            f"{path}: {error.strerror}; telemetry up to a second before is in it: free some space, and record to "
            "another file"
        ) from error
    if not found.messages:
        path.unlink()
        raise TelemetryError(
            f"{path}: not written: nothing was received over {found.links}; does the vehicle send to this address?"
        )
    return found


def _over_zenoh(config: Config) -> bool:
    return bool(config.zenoh) or any(vehicle.zenoh for vehicle in config.vehicles)


def _record(config: Config, path: Path, seconds: float | None, as_json: bool) -> LiveRecording:
    json_lines = {"auto": not sys.stderr.isatty(), "json": True, "text": False}[config.log_format]
    tally = _Tally()
    with ExitStack() as stack, caught_signals() as received:
        log = ServiceLog(as_json or json_lines)
        stack.callback(log.close)
        session = None
        if _over_zenoh(config):
            opened = open_session(config.connect, config.listen, config.zenoh_config, config.zenoh_mode)
            session = stack.enter_context(opened)
        links = open_links(config, session, stack, signing_guard(config))
        encoder = RecordEncoder(())
        about = {"fauio": version("fauio")}
        recorder = stack.enter_context(Recorder(path, encoder.topics, about, {}, strict=True))
        inbox = Inbox(config.inbox)
        stack.callback(inbox.close)
        for link in links:
            inbox.listen(link.name, link.link)
        log.say("recording", file=str(path), telemetry=", ".join(link.name for link in links))
        first_look = FirstLook({link.name: link.link for link in links}, log)

        def record(timeout_s: float) -> None:
            for arrival in inbox.take(timeout_s):
                tally.add(arrival.batch)
                recorder.record(encoder.batch(arrival.batch))

        flushed_ns = time.monotonic_ns()
        ends_ns: int | None = None
        while not {signal.SIGINT, signal.SIGTERM} & set(received):
            record(_POLL_S)
            now_ns = time.monotonic_ns()
            if seconds is not None and tally.first_ns is not None and ends_ns is None:
                ends_ns = now_ns + round(seconds * 1e9)
            if ends_ns is not None and now_ns >= ends_ns:
                break
            first_look.turn(now_ns)
            if now_ns - flushed_ns >= SECOND_NS:
                flushed_ns = now_ns
                recorder.flush()
                _tell(f"{tally.seconds:.0f} s, {tally.names.total()} messages")
        inbox.close()
        while not inbox.empty:
            record(0.0)
        _tell("")
        counts = recorder.statistics()
        return LiveRecording(
            messages=counts.records - counts.unrecordable,
            names=len(tally.names),
            systems=tuple(sorted(tally.systems)),
            seconds=tally.seconds,
            dropped=inbox.statistics().dropped,
            unrecordable=encoder.unrecordable + counts.unrecordable,
            interrupted=signal.SIGINT in received,
            links=", ".join(link.name for link in links),
        )


class _Tally:
    """The counts so far."""

    def __init__(self) -> None:
        self.names: Counter[str] = Counter()
        self.systems: set[int] = set()
        self.first_ns: int | None = None
        self._last_ns = 0

    def add(self, batch: Batch) -> None:
        times_ns = arrival_times(batch).tolist()
        self.first_ns = times_ns[0] if self.first_ns is None else self.first_ns
        self._last_ns = times_ns[-1]
        self.names.update({columns.name: len(columns.position) for columns in batch.columns})
        self.names.update(message.name for message in batch.others.values())
        for sender in batch.entries:
            if sender.source.is_telemetry and sender.source.has_ids:
                self.systems.add(sender.system)

    @property
    def seconds(self) -> float:
        return 0.0 if self.first_ns is None else max(0, self._last_ns - self.first_ns) / 1e9


def _tell(text: str) -> None:
    """Show the progress on a terminal, on a line that the next one overwrites."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{text}")
        sys.stderr.flush()
