"""Sends a telemetry log over UDP as if live: ``python -m adapters.simulation.tlog_sender FLIGHT udp:HOST:PORT``."""

import argparse
import os
import sys
from collections.abc import Iterator, Sequence

from adapters.command_line import option
from adapters.errors import FauioError
from adapters.logs.tlog import TlogReader
from adapters.mavlink.mavlink_message import MAGIC_2, mavlink_types, message_number, packet_sender, packet_signed
from adapters.simulation.pacing import send_paced


def send_tlog(path: str | os.PathLike[str], url: str, speed: float = 1.0, *, renumber: bool = False) -> int:
    """Send a log's packets, unchanged, to ``udp:HOST:PORT`` at ``speed`` times real time; return their number.

    With ``renumber`` the sequence numbers are consecutive: packets that were left out of the log on purpose do not
    count as lost on the link.

    Raises
    ------
    TelemetryError
        The log cannot be read, the URL is not understood, or the speed is not positive.
    """
    packets = TlogReader(path).packets()
    return send_paced(_renumbered(packets) if renumber else packets, url, speed)


def _renumbered(packets: Iterator[tuple[int, bytes]]) -> Iterator[tuple[int, bytes]]:
    """Yield packets with consecutive sequence numbers of their senders; signed and unknown ones are unchanged."""
    counts: dict[tuple[int, int], int] = {}
    for received_ns, packet in packets:
        kind = mavlink_types().get(message_number(packet))
        if kind is None or packet_signed(packet):
            yield received_ns, packet
            continue
        sender = packet_sender(packet)
        counts[sender] = (counts.get(sender, -1) + 1) % 256
        place, head = (4, 10) if packet[0] == MAGIC_2 else (2, 6)
        body = packet[:place] + bytes([counts[sender]]) + packet[place + 1 : head + packet[1]]
        yield received_ns, body + kind.checksum(body).to_bytes(2, "little")


def main(argv: Sequence[str] | None = None) -> int:
    """Run from the command line; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m adapters.simulation.tlog_sender", description=__doc__)
    parser.add_argument("log", help="telemetry log (.tlog, .tlog.xz, .tlog.gz)")
    parser.add_argument("to", help="udp:HOST:PORT")
    parser.add_argument("--speed", type=float, default=1.0, help="times real time (default 1)")
    option(parser, "--renumber", "give packets consecutive sequence numbers")
    args = parser.parse_args(argv)
    try:
        count = send_tlog(args.log, args.to, args.speed, renumber=args.renumber)
    except FauioError as error:
        print(f"tlog_sender: {error}", file=sys.stderr)  # noqa: T201 - the command line speaks here
        return error.exit_status
    print(f"{count} packets sent", file=sys.stderr)  # noqa: T201 - the command line speaks here
    return 0


if __name__ == "__main__":
    sys.exit(main())
