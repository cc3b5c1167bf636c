"""Black box: for each raised alarm a clip of its own, from some seconds before to some seconds after."""

import contextlib
import os
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Final

from adapters.errors import StorageError
from monitor.event import AlarmEvent
from monitor.recording.record_encoder import EncodedRecord, EncodedRecords, Topic
from monitor.recording.recorder import RETRY_S, RecordFile
from monitor.recording.retention import Retention, Together, file_stem, writable_folder
from monitor.sampling.phase import FlightPhase

MAX_OPEN_CLIPS: Final = 4
"""Most clips that are made at once. Chosen: they hold the same records, so a fifth adds nothing to four; a further
alarm is named in the clips that cover it."""
MAX_WAITING_CLIPS: Final = 8
"""Most clips that wait, with their records in memory, for a disk that refused them; the oldest is given up for the next
one. Eight clips of at most ``held_bytes`` of :class:`BlackBox` share those bytes, since clips of one moment hold the
same records."""
MAX_TRIES: Final = 60
"""Tries, over ten minutes, until a clip is given up. Chosen: no memory is kept longer for a disk that nobody attends
to."""

_PHASE_TOPICS = frozenset(f"/mavlink/{name}" for name in FlightPhase.interests)
# Letters of Crockford's base 32, of which ULIDs consist (https://github.com/ulid/spec).
_ULID = r"[0-9A-HJKMNP-TV-Z]{26}"
# Ids of recent alarms that a clip may have to name: more than an alarm flood raises in the seconds before a clip.
_MOST_RAISED = 256


@dataclass(slots=True)
class BlackBoxStatistics:
    """Records that a black box holds for alarms to come, and counts so far."""

    held_records: int = 0
    held_bytes: int = 0
    open: int = 0  # clips being made, those that wait for the disk included
    written: int = 0  # clips completed
    dropped: int = 0  # records left out because a clip was too slow or already had its largest size
    failures: int = 0  # clips given up because they could not be written
    failed: str | None = None  # why a clip could not be written; None once the disk takes clips again


@dataclass(slots=True)
class _Clip:
    """A clip being made: the records that wait, its file once there is one, and the number of records in the file."""

    path: Path
    begun_ns: int
    ends_ns: int
    metadata: dict[str, str]
    waiting: deque[EncodedRecord]
    alarms: list[str]
    log: RecordFile | None = None
    ended: bool = False
    done: list[EncodedRecord] | None = field(default_factory=list)
    """Records to write again if the file has to be begun again; None where they are too many to keep."""
    done_bytes: int = 0
    tries: int = 0
    retry_ns: int = 0


class BlackBox:
    """Keeps the last seconds of one vehicle's records and writes ``<folder>/<vehicle>-<alarm id>.mcap``.

    A clip is complete in itself: profile, metadata (``alarm_id``, ``alarm_channel``, ``alarm_observer``, and
    ``alarm_ids`` of all alarms raised until its file was begun), telemetry, estimates and alarms. It begins with the
    vehicle's last messages about its flight phase before that, so that a replay knows it armed. Time is that of
    telemetry's arrival. A clip that the disk refuses is begun again from memory, every
    :data:`~monitor.recording.recorder.RETRY_S` seconds up to :data:`MAX_TRIES` times. Nothing is written but by
    :meth:`work` and :meth:`close`; no method raises after construction. Not for several threads at once.

    ``before_s`` and ``after_s`` are the span of a clip around the moment its alarm was raised. The vehicle's clips may
    take ``budget_bytes``, and those of all vehicles what ``together`` says, checked whenever one is completed; a single
    clip ends early at a quarter of ``budget_bytes``.
    ``held_records`` and ``held_bytes`` bound the records held for alarms to come. A vehicle with two observers at 125
    Hz makes 1,000 records a second of 160 bytes on average (measured): the defaults hold 100 s. A clip drops records
    while twice as many wait to be written. The rest is as of :class:`~monitor.recording.recorder.Recorder`.

    Raises
    ------
    StorageError
        The folder cannot be written to.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        vehicle: str,
        topics: Sequence[Topic],
        metadata: Mapping[str, str],
        profile_files: Mapping[str, bytes],
        *,
        before_s: float = 30.0,
        after_s: float = 30.0,
        budget_bytes: int = 256 * 1024 * 1024,
        together: Together | None = None,
        held_records: int = 100_000,
        held_bytes: int = 32 * 1024 * 1024,
    ) -> None:
        self._folder = writable_folder(folder)
        self._stem = file_stem(vehicle)
        self._topics = topics
        self._metadata = dict(metadata)
        self._profile_files = dict(profile_files)
        self._before_ns = round(before_s * 1e9)
        self._after_ns = round(after_s * 1e9)
        self._clip_bytes = budget_bytes // 4
        self._held_records = held_records
        self._held_bytes = held_bytes
        self._retention = Retention(self._folder, self._stem, f"-{_ULID}\\.mcap", budget_bytes, together)
        self._now_ns: int | None = None
        # Kept apart from the records, so that an alarm copies the records in one call.
        self._held: deque[EncodedRecord] = deque()
        self._arrived_ns: deque[int] = deque()
        self._phase: dict[int, EncodedRecord] = {}
        self._clips: list[_Clip] = []
        self._raised: deque[tuple[int, str]] = deque(maxlen=_MOST_RAISED)
        self._counts = BlackBoxStatistics()

    @property
    def has_clips(self) -> bool:
        """Whether clips are being made."""
        return bool(self._clips)

    def record(self, records: EncodedRecords, *, telemetry: bool = False) -> None:
        """Hold records for alarms to come, and give them to the open clips.

        Those of ``telemetry`` have the time of their arrival, which is the time of the black box.
        """
        if not records:
            return
        times_ns = records.times_ns
        for clip in self._clips:
            self._give(clip, records, times_ns if telemetry else ())
        if telemetry:
            self._now_ns = times_ns[-1]
        elif self._now_ns is not None:
            times_ns = [self._now_ns] * len(records)
        self._held.extend(records)
        self._arrived_ns.extend(times_ns)
        self._counts.held_bytes += sum(map(len, records.data))
        self._forget(times_ns[-1])

    def alarm(self, event: AlarmEvent) -> None:
        """Begin the clip of an alarm that was just raised; other events change nothing."""
        if event.state != "raised":
            return
        now = self._now_ns if self._now_ns is not None else event.time_ns
        for clip in self._clips:
            if not clip.ended and event.id not in clip.alarms:
                clip.alarms.append(event.id)
        self._raised.append((now, event.id))
        path = self._folder / f"{self._stem}-{file_stem(event.id)}.mcap"
        if path.exists() or any(clip.path == path for clip in self._clips):
            return
        if sum(not clip.ended for clip in self._clips) >= MAX_OPEN_CLIPS:
            return
        if len(self._clips) >= MAX_WAITING_CLIPS:
            self._give_up(next(clip for clip in self._clips if clip.ended))
        alarm = {"alarm_id": event.id, "alarm_channel": event.channel, "alarm_observer": event.observer}
        alarms = [*dict.fromkeys(raised for at_ns, raised in self._raised if now - at_ns <= self._before_ns)]
        waiting = self._held.copy()
        waiting.extendleft(sorted(self._phase.values(), key=itemgetter(2), reverse=True))
        self._clips.append(_Clip(path, now, now + self._after_ns, self._metadata | alarm, waiting, alarms))

    def work(self, max_records: int, now_ns: int | None = None) -> int:
        """Write up to so many of the records that wait, on each turn of the loop; return how many were written.

        Unix time ends clips also while no telemetry arrives.
        """
        if now_ns is not None:
            self._now_ns = now_ns
            for clip in self._clips:
                clip.ended |= self._is_behind(clip, now_ns)
        left, now = max_records, self._now_ns or 0
        for clip in [*self._clips]:
            if not 0 < clip.retry_ns - now <= RETRY_S * 1e9:
                left -= self._advance(clip, left)
        return max_records - left

    def close(self) -> None:
        """Complete all clips with the records at hand, as far as the disk takes them."""
        for clip in [*self._clips]:
            clip.ended, clip.tries = True, MAX_TRIES
            self._advance(clip, len(clip.waiting))

    def add_metadata(self, metadata: Mapping[str, str]) -> None:
        """Add entries to the metadata of the clips to come."""
        self._metadata.update(metadata)

    def statistics(self) -> BlackBoxStatistics:
        """Return the counts so far."""
        return replace(self._counts, held_records=len(self._held), open=len(self._clips))

    def _is_behind(self, clip: _Clip, now_ns: int) -> bool:
        """Return whether a clip is over: after its span, or when the clock was set back to before it."""
        return not clip.begun_ns - self._before_ns <= now_ns <= clip.ends_ns

    def _forget(self, now_ns: int) -> None:
        """Drop the oldest records: by age (also after the clock jumped back), or by size."""
        held, arrived_ns, counts = self._held, self._arrived_ns, self._counts
        first_ns, last_ns = now_ns - self._before_ns, now_ns + self._before_ns
        while held and (
            not first_ns <= arrived_ns[0] <= last_ns
            or len(held) > self._held_records
            or counts.held_bytes > self._held_bytes
        ):
            arrived_ns.popleft()
            topic, data, _ = record = held.popleft()
            counts.held_bytes -= len(data)
            if self._topics[topic].name in _PHASE_TOPICS:
                self._phase[topic] = record

    def _give(self, clip: _Clip, records: EncodedRecords, times_ns: Sequence[int]) -> None:
        """Give a clip the records of its span, whose end is told by times of telemetry."""
        if clip.ended:
            return
        behind = (index for index, now_ns in enumerate(times_ns) if self._is_behind(clip, now_ns))
        stop = next(behind, len(records))
        clip.ended = stop < len(records)
        room = max(2 * self._held_records - len(clip.waiting), 0)
        clip.waiting.extend(records[: min(stop, room)])
        self._counts.dropped += max(stop - room, 0)

    def _advance(self, clip: _Clip, max_records: int) -> int:
        """Write up to so many of a clip's records and complete it after the last; return how many."""
        try:
            count = self._write(clip, max_records)
            if clip.tries and not clip.ended and not clip.waiting and clip.log is not None:
                clip.log.flush()
                clip.tries = 0
                self._recover()
            if clip.ended and not clip.waiting:
                self._complete(clip)
        except (OSError, StorageError) as error:
            self._counts.failed = str(error)
            self._postpone(clip)
            return 0
        return count

    def _write(self, clip: _Clip, max_records: int) -> int:
        count = 0
        while clip.waiting and count < max_records:
            log = clip.log = clip.log or self._start(clip)
            records = EncodedRecords.of(islice(clip.waiting, max_records - count))
            # Near the end of a full clip fewer and fewer fit.
            while len(records) > 1 and log.size_with(records) > self._clip_bytes:
                records = records[: len(records) // 2]
            for _ in records.topics:
                clip.waiting.popleft()
            if clip.done is not None:
                clip.done += records
                clip.done_bytes += sum(map(len, records.data))
                if clip.done_bytes > self._held_bytes:
                    clip.done = None
            log.add(log.recordable(records))
            count += len(records)
            if log.size > self._clip_bytes:
                self._counts.dropped += len(clip.waiting)
                clip.waiting.clear()
                clip.ended = True
        return count

    def _start(self, clip: _Clip) -> RecordFile:
        metadata = clip.metadata | {"alarm_ids": ",".join(clip.alarms)}
        return RecordFile(clip.path, self._topics, metadata, self._profile_files)

    def _complete(self, clip: _Clip) -> None:
        """Finish a clip's file and delete old ones for it."""
        if clip.log is not None:
            clip.log.close()
        self._clips.remove(clip)
        self._counts.written += 1
        self._recover()
        self._make_room(clip)

    def _recover(self) -> None:
        """Clear the error if the disk takes clips again and refuses no other one."""
        if not any(other.tries for other in self._clips):
            self._counts.failed = None

    def _postpone(self, clip: _Clip) -> None:
        """Begin a clip's file again later, as long as all its records are at hand."""
        clip.tries += 1
        if clip.done is None or clip.tries > MAX_TRIES:
            self._give_up(clip)
            return
        if clip.log is not None:
            with contextlib.suppress(OSError):
                clip.log.close()
            with contextlib.suppress(OSError):
                clip.path.unlink()
        clip.waiting.extendleft(reversed(clip.done))
        clip.log, clip.done, clip.done_bytes = None, [], 0
        clip.retry_ns = (self._now_ns or 0) + round(RETRY_S * 1e9)

    def _give_up(self, clip: _Clip) -> None:
        """End a clip with the records that the disk took."""
        self._clips.remove(clip)
        self._counts.failures += 1
        if clip.log is not None:
            with contextlib.suppress(OSError):
                clip.log.close()
            if not clip.log.written:
                with contextlib.suppress(OSError):
                    clip.path.unlink()
        self._make_room(clip)

    def _make_room(self, clip: _Clip) -> None:
        self._retention.make_room(keep={clip.path, *(other.path for other in self._clips)})
