"""A batch of telemetry: consecutive messages as columns, one per field, in the order of arrival.

Work that is the same for all messages of a batch is done once. A batch holds exactly the same data as its messages one
by one: :func:`messages` returns them, :func:`pack` makes a batch from messages.
"""

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.message import Message
from adapters.source import Source

_DTYPES: Mapping[type, type[np.generic]] = {int: np.int64, float: np.float64, bool: np.bool_}

_MESSAGE_BYTES = 2000
"""Memory of a message as Python objects, bytes. Measured: 1.5 to 2.5 kB for a dozen fields."""
_USUAL_FIELDS = 100
"""Number of fields of a message whose memory is estimated field by field, more than telemetry has; beyond it only the
number of fields counts."""
_VALUE_BYTES = 100
"""Memory of a field's name and number as Python objects, bytes: 50 to 60 and 24 to 32, and the entries in a
dictionary."""
BATCH_MESSAGES: Final = 40_000
"""Messages that readers of recordings put into a batch. Measured on 69,000 messages of a telemetry log: reading them
takes 133 ms in batches of 400, 40 ms in those of 4,000, 27 ms in those of 40,000 and 400,000.
"""


class FieldPlace(NamedTuple):
    """First byte of a field in a record, kind (of NumPy) and size of its number, number of elements (0: no array)."""

    offset: int
    kind: str
    size: int
    length: int


def field_places(record: np.dtype[np.void]) -> dict[str, FieldPlace]:
    """Return the positions of a record's fields, which are numbers or lists of them."""
    places = {}
    for name, (dtype, offset, *_) in (record.fields or {}).items():
        number, shape = dtype.subdtype or (dtype, (0,))
        places[name] = FieldPlace(offset, number.kind, number.itemsize, shape[0])
    return places


class RecordFields(Mapping[str, NDArray[np.generic]]):
    """Fields of m messages in consecutive records, each decoded when it is read.

    Most fields of live telemetry are never read. ``record`` holds the messages, one record of the fields each (m,);
    ``places`` is the result of :func:`field_places` for it.
    """

    __slots__ = ("_columns", "places", "record")

    def __init__(self, record: NDArray[np.void], places: Mapping[str, FieldPlace]) -> None:
        self.record = record
        self.places = places
        self._columns: dict[str, NDArray[np.generic]] = {}

    def __getitem__(self, name: str) -> NDArray[np.generic]:
        column = self._columns.get(name)
        if column is None:
            if name not in self.places:
                raise KeyError(name)
            column = self._columns[name] = np.ascontiguousarray(self.record[name])
        return column

    def __contains__(self, name: object) -> bool:
        return name in self.places

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)


Fields = Mapping[str, NDArray[np.generic]]


class Columns(NamedTuple):
    """The m messages of one name and one sender in a batch."""

    source: Source  # as of :class:`adapters.message.Message`
    name: str
    system: int  # MAVLink ids of the sender
    component: int
    position: NDArray[np.int64]  # index of each message among all messages of the batch (m,), ascending
    received_ns: NDArray[np.int64]  # Unix times of arrival, nanoseconds (m,)
    # decoded fields in the type that they have in the packet (m,); an array field has shape (m, its length)
    fields: Fields


@dataclass(frozen=True, slots=True)
class Batch:
    """Consecutive messages of all senders, as columns."""

    count: int  # number of messages
    columns: tuple[Columns, ...]  # by name and sender; no two have the same name and sender
    # messages that cannot be columns (texts, other kinds of source), by their index in the batch
    others: Mapping[int, Message]

    @property
    def entries(self) -> Iterator[Columns | Message]:
        """The columns, then the messages that are not in columns."""
        yield from self.columns
        yield from self.others.values()

    @property
    def names(self) -> frozenset[str]:
        """Names of the messages in the batch."""
        return frozenset(entry.name for entry in self.entries)


def messages(batch: Batch) -> Iterator[Message]:
    """Yield the messages of a batch one by one, in the order of arrival."""
    following = {position: iter((message,)) for position, message in batch.others.items()}
    for columns in batch.columns:
        following |= dict.fromkeys(columns.position.tolist(), each(columns))
    for position in sorted(following):
        yield next(following[position])


def each(columns: Columns, only: Iterable[str] | None = None) -> Iterator[Message]:
    """Yield the messages of columns, with ``only`` some of their fields (None: all).

    All values of a field are converted to Python objects at once.
    """
    source, name, system, component = columns.source, columns.name, columns.system, columns.component
    names = tuple(columns.fields if only is None else (field for field in only if field in columns.fields))
    values = [columns.fields[field].tolist() for field in names]
    rows = zip(*values, strict=True) if values else repeat(())
    for received_ns, row in zip(columns.received_ns.tolist(), rows, strict=False):
        yield Message(source, name, received_ns, dict(zip(names, row, strict=True)), system, component)


def one_message(columns: Columns, row: int) -> Message:
    """Return one message from its columns."""
    return Message(
        source=columns.source,
        name=columns.name,
        received_ns=int(columns.received_ns[row]),
        fields={name: values[row].tolist() for name, values in columns.fields.items()},
        system=columns.system,
        component=columns.component,
    )


def arrival_times(batch: Batch) -> NDArray[np.int64]:
    """Return the Unix time of arrival of each of n messages (n,), nanoseconds."""
    times = np.zeros(batch.count, np.int64)
    for columns in batch.columns:
        times[columns.position] = columns.received_ns
    for index, message in batch.others.items():
        times[index] = message.received_ns
    return times


def memory_bytes(batch: Batch) -> int:
    """Return the approximate memory of a batch, bytes."""
    columns = 0
    for group in batch.columns:
        fields = group.fields
        if isinstance(fields, RecordFields):
            size = fields.record.nbytes
        else:
            size = sum(values.nbytes + _VALUE_BYTES for values in fields.values())
        columns += size + group.position.nbytes + group.received_ns.nbytes
    return columns + sum(_message_bytes(message) for message in batch.others.values())


def _message_bytes(message: Message) -> int:
    """Return the approximate memory of a message, bytes; a message from a network may have any number of fields."""
    fields = message.fields
    if len(fields) <= _USUAL_FIELDS:
        texts = sum(len(value) for value in fields.values() if isinstance(value, str | bytes))
        values = sum(len(value) for value in fields.values() if isinstance(value, list | tuple | dict))
        return _MESSAGE_BYTES + texts + _VALUE_BYTES * values
    return _VALUE_BYTES * len(fields)


def cut(batch: Batch, start: int, stop: int) -> Batch:
    """Return the messages at indices start <= index < stop as a batch of their own."""
    if stop - start == batch.count:
        return batch
    columns = []
    for group in batch.columns:
        first, last = np.searchsorted(group.position, (start, stop))
        if first == last:
            continue
        part = rows_of(group, slice(int(first), int(last)))
        columns.append(part._replace(position=part.position - start))
    others = {index - start: message for index, message in batch.others.items() if start <= index < stop}
    return Batch(stop - start, tuple(columns), others)


def rows_of(columns: Columns, part: slice | NDArray[np.intp]) -> Columns:
    """Return the messages of columns at the given rows."""
    fields: Fields
    if isinstance(columns.fields, RecordFields):
        fields = RecordFields(columns.fields.record[part], columns.fields.places)
    else:
        fields = {name: values[part] for name, values in columns.fields.items()}
    return columns._replace(position=columns.position[part], received_ns=columns.received_ns[part], fields=fields)


def gathered(columns: Iterable[Columns], single: Mapping[int, Message]) -> Batch:
    """Return a batch of columns and messages, no two at the same index; unused indices are closed up.

    Columns of one name and sender are joined, or become messages if their fields differ.
    """
    kept: dict[tuple[str, int, int], Columns] = {}
    others = dict(single)
    for group in columns:
        before = kept.setdefault((group.name, group.system, group.component), group)
        if before is group:
            continue
        if _same_form(before, group):
            kept[group.name, group.system, group.component] = _in_order(_concatenated([(0, before), (0, group)]))
        else:
            others.update(zip(group.position.tolist(), each(group), strict=True))
    indices = np.concatenate([np.array([*others], np.int64), *(group.position for group in kept.values())])
    # indices may have large gaps: only their order counts
    rank = np.empty(len(indices), np.int64)
    rank[np.argsort(indices)] = np.arange(len(indices))
    closed = []
    start = len(others)
    for group in kept.values():
        closed.append(group._replace(position=rank[start : start + len(group.position)]))
        start += len(group.position)
    return Batch(len(indices), tuple(closed), dict(zip(rank.tolist(), others.values(), strict=False)))


def sender_of(entry: Columns | Message) -> int | None:
    """Return the system id of a message or of columns, or None if their source has no ids."""
    return entry.system if entry.source.has_ids else None


def of_names(batch: Batch, names: Container[str]) -> Batch:
    """Return the messages of the given names as a batch."""
    return chosen(batch, lambda entry: entry.name in names)


def chosen(batch: Batch, keeps: Callable[[Columns | Message], bool]) -> Batch:
    """Return the columns and messages for which ``keeps`` returns true, as a batch."""
    columns = [columns for columns in batch.columns if keeps(columns)]
    others = {index: message for index, message in batch.others.items() if keeps(message)}
    if len(columns) == len(batch.columns) and len(others) == len(batch.others):
        return batch
    return gathered(columns, others)


def joined(batches: Sequence[Batch]) -> Batch:
    """Return the messages of consecutive batches as one batch.

    Use it if several batches wait: a row costs less in a larger batch. If the fields or types of a name and sender
    differ between batches, only those like the first become columns; the others stay messages.
    """
    if len(batches) == 1:
        return batches[0]
    parts: dict[tuple[str, int, int], list[tuple[int, Columns]]] = {}
    others: dict[int, Message] = {}
    count = 0
    for batch in batches:
        for columns in batch.columns:
            alike = parts.setdefault((columns.name, columns.system, columns.component), [])
            if not alike or _same_form(alike[0][1], columns):
                alike.append((count, columns))
            else:
                others.update(zip((count + columns.position).tolist(), each(columns), strict=True))
        others.update((count + position, message) for position, message in batch.others.items())
        count += batch.count
    return Batch(count, tuple(_concatenated(alike) for alike in parts.values()), others)


def _same_form(first: Columns, second: Columns) -> bool:
    if isinstance(first.fields, RecordFields) and isinstance(second.fields, RecordFields):
        alike = first.fields.places is second.fields.places or first.fields.record.dtype == second.fields.record.dtype
        return first.source is second.source and alike
    return (
        first.source is second.source
        and [*first.fields] == [*second.fields]
        and all(
            values.dtype == other.dtype and values.shape[1:] == other.shape[1:]
            for values, other in zip(first.fields.values(), second.fields.values(), strict=True)
        )
    )


def _concatenated(alike: Sequence[tuple[int, Columns]]) -> Columns:
    if len(alike) == 1 and not alike[0][0]:
        return alike[0][1]
    counts = [len(columns.position) for _, columns in alike]
    return alike[0][1]._replace(
        position=np.concatenate([columns.position for _, columns in alike])
        + np.repeat(np.array([offset for offset, _ in alike]), counts),
        received_ns=np.concatenate([columns.received_ns for _, columns in alike]),
        fields=_one_after_the_other([columns.fields for _, columns in alike]),
    )


def _one_after_the_other(parts: Sequence[Fields]) -> Fields:
    first = parts[0]
    records = [fields.record for fields in parts if isinstance(fields, RecordFields)]
    if isinstance(first, RecordFields) and len(records) == len(parts):
        # As plain bytes: otherwise NumPy searches for a common type, field by field.
        content = b"".join([record.tobytes() for record in records])
        return RecordFields(np.frombuffer(content, first.record.dtype), first.places)
    return {name: np.concatenate([fields[name] for fields in parts]) for name in parts[0]}


def _in_order(columns: Columns) -> Columns:
    if (np.diff(columns.position) > 0).all():
        return columns
    return rows_of(columns, np.argsort(columns.position))


def pack(received: Sequence[Message]) -> Batch:
    """Return messages as a batch.

    Messages of a name and sender become columns of int64, float64 or bool if all have the same fields, and each field
    has numbers or lists of numbers of the same Python type and length. All others stay messages.
    """
    groups: dict[tuple[str, int, int], list[int]] = {}
    for position, message in enumerate(received):
        groups.setdefault((message.name, message.system, message.component), []).append(position)
    columns: list[Columns] = []
    others: dict[int, Message] = {}
    for positions in groups.values():
        column = _columns(positions, [received[position] for position in positions])
        if column is None:
            others.update((position, received[position]) for position in positions)
        else:
            columns.append(column)
    return Batch(len(received), tuple(columns), others)


def _columns(positions: list[int], group: list[Message]) -> Columns | None:
    first = group[0]
    names = tuple(first.fields)
    if not first.source.is_telemetry:
        return None
    if any(message.source is not first.source or tuple(message.fields) != names for message in group):
        return None
    arrays = [_numbers(values) for values in zip(*[message.fields.values() for message in group], strict=True)]
    received_ns = _numbers([message.received_ns for message in group])
    if received_ns is None:
        return None
    fields = {name: array for name, array in zip(names, arrays, strict=True) if array is not None}
    if len(fields) != len(names):
        return None
    return Columns(
        source=first.source,
        name=first.name,
        system=first.system,
        component=first.component,
        position=np.array(positions, np.int64),
        received_ns=received_ns.astype(np.int64),
        fields=fields,
    )


def _numbers(values: Sequence[Any]) -> NDArray[np.generic] | None:
    """Return an array whose rows reproduce the values exactly, or None if there is none."""
    kind = type(values[0])
    if {*map(type, values)} != {kind}:
        return None
    if kind is list:
        length = len(values[0])
        parts = [part for value in values for part in value]
        if any(len(value) != length for value in values) or (parts and type(parts[0]) not in _DTYPES):
            return None
        flat = _numbers(parts) if parts else np.empty(0)
        return None if flat is None else flat.reshape(len(values), length)
    if kind not in _DTYPES:
        return None
    try:
        return np.array(values, _DTYPES[kind])
    except OverflowError:
        return None
