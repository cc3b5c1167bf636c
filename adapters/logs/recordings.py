"""Opens a recording of any known kind as messages: a file by its suffix, a folder as the files of one session."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from adapters.batch import BATCH_MESSAGES, Batch, messages, pack
from adapters.errors import TelemetryError
from adapters.logs.compressed import COMPRESSED
from adapters.logs.damage import Damage, scan_damage
from adapters.message import Message

if TYPE_CHECKING:
    from adapters.encoding.record import Record
    from adapters.logs.log_mapping import LogMapping

T = TypeVar("T")

RecordingKind = Literal["tlog", "mcap", "ulog", "dataflash"]

# Metadata key under which an MCAP file that was converted from an onboard log names the kind of log.
ONBOARD_LOG = "onboard_log"

ALARM_TOPIC = "/fauio/alarm_json"

_TYPICAL_RECORD_BYTES = 52
"""Bytes of a log per message: 52 in telemetry logs of the shipped flights, 59 in logs of PX4."""

_KINDS: Mapping[str, RecordingKind] = {".tlog": "tlog", ".mcap": "mcap", ".ulg": "ulog", ".bin": "dataflash"}
_SCANNERS: Mapping[RecordingKind, tuple[str, str]] = {
    "tlog": ("adapters.logs.tlog", "TlogReader"),
    "ulog": ("adapters.logs.ulog", "UlogReader"),
    "dataflash": ("adapters.logs.dataflash", "DataflashReader"),
}
"""Readers of logs that are searched record by record, imported when they are used."""
_SESSION_FILE = re.compile(r"(?P<vehicle>.+)-\d{8}T\d{6}Z-\d+", re.ASCII)
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"
# a ROS 2 bag is a folder: its description, and files numbered without leading zeros
_BAG_DESCRIPTION = "metadata.yaml"
_BAG_FILE = re.compile(r"(?P<vehicle>.+)_(?P<number>\d{1,9})", re.ASCII)


def recording_kind(path: str | os.PathLike[str]) -> RecordingKind:
    """Return the kind of a recording, a file or a folder of files.

    Raises
    ------
    TelemetryError
        The suffix is none of ``.tlog``, ``.mcap``, ``.ulg`` (PX4) and ``.bin`` (ArduPilot), plain or followed by
        ``.xz`` or ``.gz``; there is no such file, or a pointer of Git LFS instead; or a folder that is not a recorded
        session (:func:`session_files`).
    """
    file = Path(path)
    if file.is_dir():
        session_files(file)
        return "mcap"
    kind = _KINDS.get(uncompressed(file).suffix.lower())
    if kind is None:
        known = ", ".join([*_KINDS][:-1]) + f" or {[*_KINDS][-1]}"
        raise TelemetryError(f"{path}: unknown kind of recording; use {known}, plain, .xz or .gz")
    if not file.is_file():
        raise TelemetryError(f"{path}: no such file")
    with contextlib.suppress(OSError), file.open("rb") as opened:
        if opened.read(len(_LFS_POINTER)) == _LFS_POINTER:
            raise TelemetryError(f"{path}: is a Git LFS pointer, not the recording; get that with 'git lfs pull'")
    return kind


def session_files(folder: str | os.PathLike[str]) -> list[Path]:
    """Return the files of a session that was recorded as ``<vehicle>-<UTC>-<number>.mcap``, in order.

    A folder with a single MCAP file of any name is a session too, and so is the folder of a ROS 2 bag
    (``<name>_<number>.mcap`` beside ``metadata.yaml``). Empty files, which a crash at their begin leaves, are skipped.

    Raises
    ------
    TelemetryError
        The folder holds no MCAP file, or files of more than one vehicle or recording.
    """
    try:
        inside = (file for file in Path(folder).iterdir() if uncompressed(file).suffix.lower() == ".mcap")
        files = sorted(file for file in inside if file.stat().st_size)
    except OSError as error:
        raise TelemetryError(f"{folder}: cannot be read: {error.strerror}") from error
    if not files:
        raise TelemetryError(f"{folder}: holds no .mcap file; give a recording or the folder of a recorded session")
    if (Path(folder) / _BAG_DESCRIPTION).is_file():
        files.sort(key=_bag_number)
        name = _BAG_FILE
    else:
        name = _SESSION_FILE
    vehicles = {_vehicle(file, name): None for file in files}
    if len(vehicles) > 1:
        names = ", ".join([*vehicles][:4]) + (", ..." if len(vehicles) > 4 else "")
        raise TelemetryError(
            f"{folder}: holds recordings of {len(vehicles)} vehicles or sessions ({names}); "
            "give one file, or put the files of one vehicle into a folder of their own"
        )
    return files


def _files(path: str | os.PathLike[str]) -> list[Path]:
    """Return a recording's files."""
    return session_files(path) if Path(path).is_dir() else [Path(path)]


class Recording:
    """The messages of a recording in the order they arrived, and then what of it could not be read.

    Iterate over it once. A file of a session that holds nothing of its kind is skipped if others do.

    Parameters
    ----------
    path : str | PathLike
        The recording, or the folder of a session: its files one after the other.
    only : Collection[str] | None
        Names of the messages wanted; None wants all.
    mapping : str | PathLike | None
        TOML file that names for some messages the records of an onboard log that fill them; without it, and for all
        other messages, the records are chosen automatically.
    types : Collection[str]
        ROS 2 types whose topics are wanted beside ``only`` (:class:`adapters.logs.mcap_reader.MessageLogReader`).

    Raises
    ------
    TelemetryError
        See :func:`recording_kind`; the mapping cannot be used; on iteration, if no file holds anything of its kind.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        only: Collection[str] | None = None,
        mapping: str | os.PathLike[str] | None = None,
        types: Collection[str] = (),
    ) -> None:
        self._kind = recording_kind(path)
        self._tables = _tables(path, mapping)
        self._files = _files(path)
        self._only = only
        self._types = types
        self._damage: list[Damage] = []
        self._topics: dict[str, str] = {}

    def __iter__(self) -> Iterator[Message]:
        """Return the messages one by one, as :meth:`batches` holds them."""
        return (message for batch in self.batches() for message in messages(batch))

    def batches(self, count: int = BATCH_MESSAGES) -> Iterator[Batch]:
        """Return the messages; of an onboard log (PX4, ArduPilot, or converted from one) as telemetry too.

        ``count`` says how far to read ahead: about as many messages, wanted or not, of logs; as many wanted ones of
        MCAP files.
        """
        if self._tables is None:
            return self._read(self._only, count)
        from adapters.logs.log_telemetry import telemetry

        wanted = None if self._only is None else self._tables.topics(self._only) | frozenset(self._only)
        return telemetry(self._read(wanted, count), self._tables, self._only, self._anew, self._topics)

    @property
    def topics(self) -> Mapping[str, str]:
        """Names of the onboard log's records that made the messages read so far, by the message's name."""
        return self._topics

    def _anew(self, only: Collection[str]) -> Iterator[Batch]:
        for file in self._files:
            with contextlib.suppress(TelemetryError):
                yield from _open(self._kind, file, only, BATCH_MESSAGES)[0]

    def records(self, count: int = BATCH_MESSAGES) -> Iterator[Batch]:
        """Return the messages as they are in the files, without telemetry made of them."""
        return self._read(self._only, count)

    def entries(self) -> Iterator[Batch | Record]:
        """Return the records for a copy: of MCAP with schema, bytes and times unchanged, otherwise messages."""
        if self._kind != "mcap":
            return self._read(self._only, BATCH_MESSAGES)
        from adapters.logs.mcap_reader import MessageLogReader

        readers = ((file, MessageLogReader(file, self._only)) for file in self._files)
        return self._through((file, reader.records(), reader.damage) for file, reader in readers)

    def _read(self, only: Collection[str] | None, count: int) -> Iterator[Batch]:
        return self._through((file, *_open(self._kind, file, only, count, self._types)) for file in self._files)

    def _through(self, opened: Iterable[tuple[Path, Iterable[T], Callable[[], Damage | None]]]) -> Iterator[T]:
        """Yield the contents of the files, one file after the other, and note what could not be read."""
        unread = 0
        for file, items, damage in opened:
            try:
                yield from items
            except TelemetryError as error:
                unread += 1
                if unread == len(self._files):
                    raise
                self._damage.append(Damage(file.name, (str(error).removeprefix(f"{file}: "),), 0))
            else:
                damaged = damage()
                self._damage.extend([damaged] if damaged else [])

    def damage(self) -> tuple[Damage, ...]:
        """Return what could not be read of the files that were read to their end."""
        return tuple(self._damage)


def _open(
    kind: RecordingKind, file: Path, only: Collection[str] | None, count: int, types: Collection[str] = ()
) -> tuple[Iterable[Batch], Callable[[], Damage | None]]:
    """Return the batches of one file, and a function that reports afterwards what is missing."""
    if kind == "mcap":
        from adapters.logs.mcap_reader import MessageLogReader

        mcap = MessageLogReader(file, only, types)
        return mcap.batches(count), mcap.damage
    module, name = _SCANNERS[kind]
    reader = getattr(import_module(module), name)(file, only, read_ahead_bytes=count * _TYPICAL_RECORD_BYTES)
    return reader, lambda: scan_damage(file.name, reader.statistics())


def _tables(path: str | os.PathLike[str], mapping: str | os.PathLike[str] | None) -> LogMapping | None:
    """Return the tables that translate an onboard log's records, or None if the recording is not an onboard log."""
    from adapters.logs.log_mapping import ONBOARD_SOURCES, builtin_mapping, read_mapping

    source = onboard_source(path)
    if mapping is None:
        return None if source is None else builtin_mapping(source)
    tables = read_mapping(mapping, source or ONBOARD_SOURCES[0])  # its mistakes are reported whatever the recording is
    return tables if source else None


def read_recording(
    path: str | os.PathLike[str],
    only: Collection[str] | None = None,
    mapping: str | os.PathLike[str] | None = None,
) -> Iterator[Message]:
    """Return the messages of a recording in the order they arrived; see :class:`Recording`."""
    return iter(Recording(path, only, mapping))


def read_batches(
    path: str | os.PathLike[str], only: Collection[str] | None = None, count: int = BATCH_MESSAGES
) -> Iterator[Batch]:
    """Return the messages of a recording in batches; see :meth:`Recording.batches`."""
    return Recording(path, only).batches(count)


def packed(source: Iterable[Message], count: int = BATCH_MESSAGES) -> Iterator[Batch]:
    """Return messages in batches of ``count``, the last one shorter."""
    remaining = iter(source)
    while part := list(islice(remaining, count)):
        yield pack(part)


def onboard_source(path: str | os.PathLike[str]) -> str | None:
    """Return which onboard log a recording is or was converted from: ``"ulog"``, ``"dataflash"``, or None."""
    kind = recording_kind(path)
    if kind in ("ulog", "dataflash"):
        return kind
    source = recorded_metadata(path).get(ONBOARD_LOG)
    return source if source in ("ulog", "dataflash") else None


def recorded_alarms(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Return the alarm events that a monitor recorded, as JSON objects in their order; empty if there are none."""
    if recording_kind(path) != "mcap":
        return []
    from adapters.encoding.foreign_record import json_object
    from adapters.logs.mcap_reader import MessageLogReader

    alarms = []
    for file in _files(path):
        with contextlib.suppress(TelemetryError):
            for record in MessageLogReader(file, topic=ALARM_TOPIC).records():
                with contextlib.suppress(ValueError):
                    alarms.append(json_object(record.data))
    return alarms


def recorded_metadata(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return the metadata of our recordings that precede the data; empty for recordings of others."""
    if recording_kind(path) != "mcap":
        return {}
    from adapters.logs.mcap_reader import read_mcap_metadata

    for file in _files(path):
        with contextlib.suppress(TelemetryError):
            return read_mcap_metadata(file, ahead_only=True).get("fauio", {})
    return {}


def uncompressed(file: Path) -> Path:
    """Return a file's name without the suffix of its compression."""
    return file.with_suffix("") if file.suffix.lower() in COMPRESSED else file


def _vehicle(file: Path, name: re.Pattern[str]) -> str:
    """Return the session of a file; a file of another name is a session of its own."""
    stem = uncompressed(file).stem
    match = name.fullmatch(stem)
    return match["vehicle"] if match else stem


def _bag_number(file: Path) -> int:
    match = _BAG_FILE.fullmatch(uncompressed(file).stem)
    return int(match["number"]) if match else 0
