"""Telemetry in, recordings out and in: pymavlink, mcap's and Foxglove's own, and ours, on the same records in one run.

    python bench/peers_io.py [LOG] [--repeat N] [--json]

Writers take the same encoded records, chunks of the same size and the same compression; every file is read back with
mcap's own reader and has to hold the same records. Readers read one file, checksums verified; what they decode has to
be equal. Processor time, the best of N, all threads of a process counted.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from decode import LOG, agree, by_pymavlink, seconds
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from adapters.batch import messages
from adapters.encoding.message_record import encode
from adapters.encoding.record import Record
from adapters.logs.compressed import CompressedFile
from adapters.logs.mcap_log import CHUNK_BYTES, MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader
from adapters.logs.recordings import read_batches, read_recording

Writing = Callable[[Sequence[Record], Path], None]


def by_us(records: Sequence[Record], path: Path) -> None:
    with MessageLogWriter(path) as log:
        numbers = [log.channel(record.topic, record.encoding, record.schema) or 0 for record in records]
        log.add_all(numbers, [record.data for record in records], [record.time_ns for record in records])


def by_mcap(records: Sequence[Record], path: Path) -> None:
    channels: dict[tuple[str, str], int] = {}
    stream: BinaryIO
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start()
        for record in records:
            channel = channels.get((record.topic, record.encoding))
            if channel is None:
                schema = record.schema
                number = 0 if schema is None else writer.register_schema(schema.name, schema.encoding, schema.data)
                channel = channels[record.topic, record.encoding] = writer.register_channel(
                    record.topic, record.encoding, number
                )
            writer.add_message(channel, record.time_ns, record.data, record.time_ns)
        writer.finish()


def by_foxglove(records: Sequence[Record], path: Path) -> None:
    import foxglove
    from foxglove.mcap import MCAPWriteOptions

    context = foxglove.Context()
    options = MCAPWriteOptions(chunk_size=CHUNK_BYTES, compression_threads=0, calculate_data_section_crc=False)
    channels: dict[tuple[str, str], foxglove.Channel] = {}
    with foxglove.open_mcap(path, allow_overwrite=True, context=context, writer_options=options):
        for record in records:
            channel = channels.get((record.topic, record.encoding))
            if channel is None:
                one = record.schema
                schema = one and foxglove.Schema(name=one.name, encoding=one.encoding, data=one.data)
                channel = channels[record.topic, record.encoding] = foxglove.Channel(
                    record.topic, schema=schema, message_encoding=record.encoding, context=context
                )
            channel.log(record.data, log_time=record.time_ns)


def same_records(records: Sequence[Record], path: Path) -> None:
    """Check a file with mcap's own reader.

    Raises
    ------
    AssertionError
        It holds other records, or in another order.
    """
    with path.open("rb") as stream:
        found = NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        for record, (schema, channel, message) in zip(records, found, strict=True):
            assert (record.topic, record.encoding) == (channel.topic, channel.message_encoding)
            assert (record.data, record.time_ns) == (message.data, message.log_time)
            assert (record.schema is None) == (schema is None)
            assert schema is None or record.schema is None or record.schema.data == schema.data


def time_ordered(path: Path) -> Iterator[Any]:
    with path.open("rb") as stream:
        yield from make_reader(stream, validate_crcs=True).iter_messages()


def non_seeking(path: Path) -> Iterator[Any]:
    with path.open("rb") as stream:
        yield from NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)


def decoded(path: Path) -> Iterator[Any]:
    with path.open("rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        yield from reader.iter_decoded_messages(log_time_order=False)


def same_messages(path: Path) -> None:
    """Check that our two readers and mcap's decode the same.

    Raises
    ------
    AssertionError
        They do not.
    """
    batched = (message for batch in read_batches(path) for message in messages(batch))
    for our, packed, their in zip(MessageLogReader(path), batched, decoded(path), strict=True):
        assert repr(our) == repr(packed)
        assert our.received_ns == their.message.log_time
        for name, value in our.fields.items():
            other = getattr(their.decoded_message, name)
            assert repr(value) == repr(other if not isinstance(value, list) else list(other))


def measure(log: Path, repeat: int) -> dict[str, Any]:
    """Return messages a second of all, by what they do."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.tlog"
        path.write_bytes(b"".join(CompressedFile(log)))
        count = agree(path)
        parsing = {
            "pymavlink recv_msg": count / seconds(by_pymavlink, path, repeat),
            "ours, as messages": count / seconds(read_recording, path, repeat),
            "ours, batches": count / seconds(read_batches, path, repeat),
        }
        records = [encode(message) for message in read_recording(path)]
        writers: dict[str, Writing] = {"mcap": by_mcap, "foxglove-sdk": by_foxglove, "ours": by_us}
        writing = {}
        for name, write in writers.items():
            file = Path(folder) / f"{name}.mcap"
            best = float("inf")
            for _ in range(repeat):
                started = time.process_time()
                write(records, file)
                best = min(best, time.process_time() - started)
            same_records(records, file)
            writing[name] = len(records) / best
        file = Path(folder) / "ours.mcap"
        same_messages(file)
        readers: dict[str, Callable[[Path], Iterator[Any]]] = {
            "mcap, time-ordered, raw": time_ordered,
            "mcap, non-seeking, raw": non_seeking,
            "mcap, non-seeking, decoded": decoded,
            "ours, as messages, decoded": MessageLogReader,
            "ours, batches, decoded": read_batches,
        }
        reading = {name: len(records) / seconds(read, file, repeat) for name, read in readers.items()}
    return {
        "log": log.name,
        "messages": count,
        "telemetry log in": rows(parsing, "pymavlink recv_msg"),
        "MCAP out": rows(writing, "mcap"),
        "MCAP in": rows(reading, "mcap, non-seeking, raw"),
    }


def rows(rates: dict[str, float], base: str) -> dict[str, dict[str, float]]:
    return {name: {"messages_per_s": round(one), "ratio": round(one / rates[base], 2)} for name, one in rates.items()}


def text(found: dict[str, Any]) -> str:
    lines = [f"{found['log']}: {found['messages']:,} messages, the same in all readers and writers"]
    for what in ("telemetry log in", "MCAP out", "MCAP in"):
        base = next(name for name, row in found[what].items() if row["ratio"] == 1)
        lines += ["", f"| {what} | messages/s | times {base} |", "|---|---|---|"]
        lines += [f"| {name} | {row['messages_per_s']:,} | {row['ratio']} |" for name, row in found[what].items()]
    return "\n".join([*lines, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare readers and writers with other libraries'.")
    parser.add_argument("log", type=Path, nargs="?", default=LOG)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--json", action="store_true", help="print JSON instead of Markdown")
    arguments = parser.parse_args()
    found = measure(arguments.log, arguments.repeat)
    sys.stdout.write(json.dumps(found, indent=1) + "\n" if arguments.json else text(found))


if __name__ == "__main__":
    main()
