from collections.abc import Collection
from typing import NamedTuple

from adapters.batch import Batch
from adapters.message import Message
from monitor.alarms.command_watch import StreamFilter
from monitor.sampling.phase import FlightPhase

class Segment(NamedTuple):
    stop: int
    carried_ns: int
    carrier: int
    heartbeat_ns: int

class Arrivals:
    batch: Batch
    foreign: int
    def __init__(
        self,
        batch: Batch,
        names: Collection[str],
        wanted: Collection[str],
        system: int,
        component: int,
        phase: FlightPhase,
        streams: StreamFilter,
    ) -> None: ...
    def __len__(self) -> int: ...
    def message(self, i: int) -> Message: ...
    def reports(self, start: int, stop: int) -> list[Message]: ...
    def received_ns(self, i: int) -> int: ...
    def segment(
        self,
        start: int,
        processed: bool,
        due_ns: int,
        carried_ns: int | None,
        silent_ns: int,
        heartbeat_ns: int,
        without_heartbeat_ns: int,
        awaits_heartbeat: bool,
        set_back_ns: int,
        most: int,
    ) -> Segment: ...
