"""The flights that a profile stores, so that one can be added without the recordings of the others.

PROFILE/flights/fit.json       kind, rate, and the flights in order: file, name, span of arrival, number of messages
PROFILE/flights/fitted.toml    profile.toml as the fit wrote it: differences from it are a person's edits
PROFILE/flights/NNNN.npz       one flight: the messages that the observers and the phase of flight come from, as columns
"""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from adapters.batch import Batch, Columns, joined, of_names, one_message
from adapters.errors import ProfileError
from adapters.message import Message
from adapters.output_file import json_text, write_file
from adapters.source import SOURCES
from adapters.toml_tables import toml_text
from monitor.alarms.alarm import MEASURED
from monitor.fitting.fitted import BatchSource

FOLDER, FITTED, MODEL = "flights", "fitted.toml", "model.toml"
_LIST, _FORMAT = "fit.json", 1
"""The list of flights, and the version of its layout: a reader refuses any other version."""
_MOST_BYTES = 128_000_000
"""Largest size of all kept flights together. Chosen: 40 to 80 flights of four minutes at 100 Hz; the oldest are deleted
first."""
_FILE = re.compile(r"\d{4,9}\.npz")
_ABOUT = "about"
_ANEW = "fit the profile anew to all its logs"
_CALIBRATED = ("isolation", "effectiveness", "transform", "sees", *MEASURED)
"""Keys of profile.toml that a fit always measures anew."""


class Extent(NamedTuple):
    """The identity of a recording.

    When the first and the last message arrived, Unix nanoseconds, the number of messages, and a checksum of the last
    message of each name.
    """

    first_ns: int
    last_ns: int
    messages: int
    checksum: int = 0


@dataclass(frozen=True, slots=True)
class KeptFlight:
    """A flight that a profile keeps; ``digest`` is the SHA-256 of its file."""

    file: str
    name: str
    span: Extent
    flight_bytes: int
    digest: str

    def batches(self, folder: Path) -> Iterable[Batch]:
        """Read it."""
        path = folder / FOLDER / self.file
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ProfileError(f"{path}: cannot be read ({error}); {_ANEW}") from error
        if sha256(data).hexdigest() != self.digest:
            raise ProfileError(f"{path}: was damaged or changed after the fit; {_ANEW}")
        with np.load(BytesIO(data), allow_pickle=False) as arrays:
            yield _batch({name: arrays[name] for name in arrays.files})

    @classmethod
    def of_json(cls, listed: Mapping[str, Any]) -> KeptFlight:
        """Read a flight of the list."""
        span = Extent(*map(int, listed["span"]))
        kept = cls(listed["file"], str(listed["name"]), span, int(listed["bytes"]), listed["sha256"])
        if not _FILE.fullmatch(kept.file):
            raise ValueError(f"{kept.file!r} is no name of a flight")
        return kept

    def to_json(self) -> dict[str, Any]:
        """Return the flight's entry in the list."""
        return {
            "file": self.file,
            "name": self.name,
            "span": list(self.span),
            "bytes": self.flight_bytes,
            "sha256": self.digest,
        }


@dataclass(frozen=True, slots=True)
class KeptFit:
    """The stored inputs of a profile's fit.

    ``rate_hz`` is the rate that was asked for, ``written`` profile.toml as written.
    """

    rate_hz: float | None
    flights: tuple[KeptFlight, ...]
    written: Mapping[str, Any]


def read_kept(folder: Path) -> KeptFit:
    """Read what a profile stores of its fit.

    Raises
    ------
    ProfileError
        It stores nothing, or its files cannot be read.
    """
    path = folder / FOLDER / _LIST
    try:
        content = json.loads(path.read_bytes())
        if content["format"] != _FORMAT:
            raise ProfileError(f"{path}: 'format' is not {_FORMAT}; {_ANEW}")
        flights = tuple(KeptFlight.of_json(listed) for listed in content["flights"])
        rate_hz = None if content["rate_hz"] is None else float(content["rate_hz"])
        written = tomllib.loads((folder / FOLDER / FITTED).read_text(encoding="utf-8"))
        return KeptFit(rate_hz, flights, written)
    except FileNotFoundError as error:
        raise ProfileError(
            f"{folder}: keeps no flights of its fit; fit it anew to all its logs, then --update adds to them"
        ) from error
    except ProfileError:
        raise
    except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
        raise ProfileError(f"{path}: cannot be read ({error!r}); {_ANEW}") from error


def kept_model(folder: Path) -> Path | None:
    """Return the stored model file with free parameters; None if the kind needs none."""
    path = folder / FOLDER / MODEL
    return path if path.is_file() else None


def extent_of(log: BatchSource) -> Extent:
    """Read a whole recording for its identity."""
    first_ns = last_ns = count = 0
    last: dict[tuple[str, int, int], Message] = {}
    for batch in log():
        arrivals = [int(at) for columns in batch.columns for at in columns.received_ns[[0, -1]]]
        arrivals += [message.received_ns for message in batch.others.values()]
        if arrivals:
            first_ns = min(arrivals) if not count else first_ns
            last_ns = max(last_ns, *arrivals)
            count += batch.count
        for message in (*(one_message(columns, -1) for columns in batch.columns), *batch.others.values()):
            last[message.name, message.system, message.component] = message
    said = repr(sorted((key, message.fields) for key, message in last.items()))
    return Extent(first_ns, last_ns, count, crc32(said.encode()))


def write_kept(
    folder: Path,
    content: Mapping[str, Any],
    rate_hz: float | None,
    known: Sequence[KeptFlight],
    added: Sequence[tuple[str, Extent, BatchSource]],
    names: Collection[str],
    source: Path | None = None,
) -> tuple[str, ...]:
    """Write the inputs of a profile's fit into its folder; return the names of flights for which there was no room.

    ``content`` is profile.toml as the fit found it, without earlier edits, ``rate_hz`` the rate that was asked for.
    ``known`` are flights that ``source`` (None: the folder itself) stores already; ``added`` are further flights with
    their spans and messages, of which only the messages of these ``names`` are stored.
    """
    place = folder / FOLDER
    place.mkdir(parents=True, exist_ok=True)
    if source is not None and source.resolve() != folder.resolve():
        for flight in known:
            shutil.copyfile(source / FOLDER / flight.file, place / flight.file)
    flights = list(known)
    number = max((int(flight.file.partition(".")[0]) for flight in known), default=0)
    for name, span, log in added:
        number += 1
        data = _flight_file(joined([*(of_names(batch, names) for batch in log())] or [Batch(0, (), {})]))
        flights.append(KeptFlight(f"{number:04d}.npz", name, span, len(data), sha256(data).hexdigest()))
        write_file(place / flights[-1].file, data)
    dropped = []
    while sum(flight.flight_bytes for flight in flights) > _MOST_BYTES and len(flights) > 1:
        dropped.append(flights.pop(0).name)
    kept = {flight.file for flight in flights}
    listed = [flight.to_json() for flight in flights]
    write_file(place / FITTED, toml_text(content))
    write_file(place / _LIST, json_text({"format": _FORMAT, "rate_hz": rate_hz, "flights": listed}))
    for path in place.glob("*.npz"):
        if path.name not in kept:
            path.unlink()
    return tuple(dropped)


_OF_MESSAGE = ("name", "received_ns", "fields", "system", "component")
"""Fields of a message that are stored, all but its source, in their order."""


def _flight_file(batch: Batch) -> bytes:
    """Return a batch as an .npz file without pickles: numbers as arrays, all else as JSON."""
    arrays: dict[str, Any] = {}
    columns = []
    for number, group in enumerate(batch.columns):
        ids = {"source": group.source.name, "name": group.name, "system": group.system, "component": group.component}
        columns.append({**ids, "fields": list(group.fields)})
        arrays[f"{number}"] = np.stack([group.position, group.received_ns])
        for place, values in enumerate(group.fields.values()):
            arrays[f"{number}.{place}"] = values
    others = [
        {key: getattr(message, key) for key in _OF_MESSAGE}
        | {"at": at, "source": message.source.name, "fields": dict(message.fields)}
        for at, message in batch.others.items()
    ]
    about = json.dumps({"count": batch.count, "columns": columns, "others": others})
    arrays[_ABOUT] = np.frombuffer(about.encode(), np.uint8)
    stream = BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _batch(arrays: Mapping[str, Any]) -> Batch:
    about = json.loads(arrays[_ABOUT].tobytes())
    columns = []
    for number, entry in enumerate(about["columns"]):
        position, received_ns = arrays[f"{number}"]
        fields = {name: arrays[f"{number}.{place}"] for place, name in enumerate(entry["fields"])}
        source = SOURCES[entry["source"]]
        columns.append(
            Columns(source, entry["name"], entry["system"], entry["component"], position, received_ns, fields)
        )
    others = {
        entry["at"]: Message(SOURCES[entry["source"]], *(entry[key] for key in _OF_MESSAGE))
        for entry in about["others"]
    }
    return Batch(about["count"], tuple(columns), others)


def with_edits(
    fitted: Mapping[str, Any], written: Mapping[str, Any], edited: Mapping[str, Any], path: str = ""
) -> tuple[dict[str, Any], list[str]]:
    """Return a profile's newly fitted table with a person's edits of the one before, and the list of these edits.

    ``written`` is the table as the fit before wrote it, ``edited`` as it is now; ``path`` is the table's name in the
    list.
    """
    found, edits = dict(fitted), list[str]()
    for key in {**written, **edited}:
        place = f"{path}{key}"
        if key in _CALIBRATED or written.get(key) == edited.get(key):
            continue
        if isinstance(now := edited.get(key), Mapping) and isinstance(before := written.get(key), Mapping):
            if isinstance(new := fitted.get(key), Mapping):
                found[key], below = with_edits(new, before, now, f"{place}.")
                edits += below
        elif key not in edited:
            if found.pop(key, None) is not None:
                edits.append(place)
        else:
            found[key] = edited[key]
            edits.append(place)
    # a threshold that a person lowered may lie below the fitted size that clears the alarm
    if isinstance(found.get("clear"), float) and found["clear"] > found.get("threshold", found["clear"]):
        found["clear"] = found["threshold"] / 2.0
    return found, edits
