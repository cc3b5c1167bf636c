"""Opens a recording of any known kind as messages: a file by its suffix, a folder as the files of one session."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Literal

from adapters.block import Block, pack
from adapters.errors import TelemetryError
from adapters.message import Message

RecordingKind = Literal["tlog", "mcap", "ulog", "dataflash"]

BLOCK_MESSAGES = 20_000

_TYPICAL_RECORD_BYTES = 52
# Under this key of its metadata an MCAP file that was converted from an onboard log says which kind that was.
ONBOARD_LOG = "onboard_log"

_KINDS: Mapping[str, RecordingKind] = {".tlog": "tlog", ".mcap": "mcap", ".ulg": "ulog", ".bin": "dataflash"}
_COMPRESSED = (".xz", ".gz")
_SESSION_FILE = re.compile(r"(?P<vehicle>.+)-\d{8}T\d{6}Z-\d+", re.ASCII)


def recording_kind(path: str | os.PathLike[str]) -> RecordingKind:
    """Return what kind of recording a file, or a folder of files, is.

    Raises
    ------
    TelemetryError
        The suffix is none of ``.tlog``, ``.mcap``, ``.ulg`` (PX4) and ``.bin`` (ArduPilot), plain or with ``.xz`` or
        ``.gz`` behind; there is no such file; or a folder that is no recorded session (:func:`session_files`).
    """
    file = Path(path)
    if file.is_dir():
        session_files(file)
        return "mcap"
    kind = _KINDS.get(_plain(file).suffix.lower())
    if kind is None:
        known = ", ".join([*_KINDS][:-1]) + f" or {[*_KINDS][-1]}"
        raise TelemetryError(f"{path}: unknown kind of recording; use {known}, plain or with .xz or .gz behind")
    if not file.is_file():
        raise TelemetryError(f"{path}: no such file")
    return kind


def session_files(folder: str | os.PathLike[str]) -> list[Path]:
    """Return the files of a session that was recorded as ``<vehicle>-<UTC>-<number>.mcap``, in order.

    A folder with a single MCAP file of any name is a session too. Empty files, begun in the moment of a crash, are
    passed over.

    Raises
    ------
    TelemetryError
        The folder holds no MCAP file, or files of more than one vehicle or recording.
    """
    try:
        files = sorted(
            file for file in Path(folder).iterdir() if _plain(file).suffix.lower() == ".mcap" and file.stat().st_size
        )
    except OSError as error:
        raise TelemetryError(f"{folder}: cannot be read: {error.strerror}") from error
    if not files:
        raise TelemetryError(f"{folder}: holds no .mcap file; give a recording or the folder of a recorded session")
    found = {_vehicle(file): None for file in files}
    if len(found) > 1:
        names = ", ".join([*found][:4]) + (", ..." if len(found) > 4 else "")
        raise TelemetryError(
            f"{folder}: holds recordings of {len(found)} vehicles or sessions ({names}); "
            "give one file, or put the files of one vehicle into a folder of their own"
        )
    return files


def read_recording(
    path: str | os.PathLike[str],
    only: Collection[str] | None = None,
    mapping: str | os.PathLike[str] | None = None,
) -> Iterator[Message]:
    """Return the messages of a recording in the order they arrived, those of an onboard log as telemetry too.

    Onboard logs of PX4 and ArduPilot, and what was converted from them, yield their own records and the MAVLink
    messages that these stand for (:mod:`adapters.log_mapping`).

    Parameters
    ----------
    path : str | PathLike
        The recording, or the folder of a session: its files one after the other.
    only : Collection[str] | None
        Names of the messages wanted; None wants all.
    mapping : str | PathLike | None
        TOML file that says for some messages from which records of an onboard log they come; the others, and all
        where there is none, are guessed.

    Raises
    ------
    TelemetryError
        See :func:`recording_kind`; the mapping cannot be used; on iteration, where a file holds nothing of its kind.
    """
    source = onboard_source(path)
    if source is None:
        return read_records(path, only)
    from adapters.log_mapping import builtin_mapping, read_mapping
    from adapters.log_telemetry import telemetry

    tables = builtin_mapping(source) if mapping is None else read_mapping(mapping, source)
    records = None if only is None else tables.topics(only) | frozenset(only)
    return telemetry(read_records(path, records), tables, only)


def onboard_source(path: str | os.PathLike[str]) -> str | None:
    """Return which onboard log a recording is or was converted from: ``"ulog"``, ``"dataflash"``, None for none.

    Raises
    ------
    TelemetryError
        See :func:`recording_kind`.
    """
    kind = recording_kind(path)
    if kind in ("ulog", "dataflash"):
        return kind
    said = _said_ahead(path).get(ONBOARD_LOG)
    return said if said in ("ulog", "dataflash") else None


def read_records(path: str | os.PathLike[str], only: Collection[str] | None = None) -> Iterator[Message]:
    """Return the messages of a recording as they stand there; raises as :func:`read_recording`."""
    kind = recording_kind(path)
    if kind == "tlog":
        from adapters.tlog import read_tlog

        return read_tlog(path, only)
    if kind == "ulog":
        from adapters.ulog import read_ulog

        return read_ulog(path, only)
    if kind == "dataflash":
        from adapters.dataflash import read_dataflash

        return read_dataflash(path, only)
    from adapters.mcap_log import read_mcap_messages

    files = session_files(path) if Path(path).is_dir() else [Path(path)]
    return (message for file in files for message in read_mcap_messages(file) if only is None or message.name in only)


def read_blocks(
    path: str | os.PathLike[str], only: Collection[str] | None = None, block_messages: int = BLOCK_MESSAGES
) -> Iterator[Block]:
    """Return the messages of a recording in blocks: those of :func:`read_recording`, in the same order.

    Parameters
    ----------
    path : str | PathLike
        The recording, or the folder of a session.
    only : Collection[str] | None
        Names of the messages wanted; None wants all.
    block_messages : int
        How far to read ahead: about as many messages, wanted or not, of a telemetry log; as many wanted ones of
        other recordings.

    Raises
    ------
    TelemetryError
        As :func:`read_recording`.
    """
    if recording_kind(path) == "tlog":
        from adapters.tlog_columns import TlogBlocks

        return iter(TlogBlocks(path, only, block_messages * _TYPICAL_RECORD_BYTES))
    return _packed(read_recording(path, only), block_messages)


def _packed(messages: Iterator[Message], count: int) -> Iterator[Block]:
    while stretch := list(islice(messages, count)):
        yield pack(stretch)


def recorded_vehicle(path: str | os.PathLike[str]) -> str | None:
    """Return the name under which a monitor recorded its vehicle, None where no monitor made the recording.

    Raises
    ------
    TelemetryError
        See :func:`recording_kind`.
    """
    return _said_ahead(path).get("vehicle")


def _said_ahead(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return what an MCAP file says about itself ahead of its data; nothing of other recordings."""
    if recording_kind(path) != "mcap":
        return {}
    from adapters.mcap_log import read_mcap_metadata

    first = session_files(path)[0] if Path(path).is_dir() else path
    return read_mcap_metadata(first, ahead_only=True).get("fauio", {})


def _plain(file: Path) -> Path:
    """Return a file's name without the suffix of its compression."""
    return file.with_suffix("") if file.suffix.lower() in _COMPRESSED else file


def _vehicle(file: Path) -> str:
    """Return whose session a file belongs to; one of another name is a session of its own."""
    stem = _plain(file).stem
    found = _SESSION_FILE.fullmatch(stem)
    return found["vehicle"] if found else stem
