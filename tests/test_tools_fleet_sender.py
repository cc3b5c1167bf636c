"""Several recorded vehicles at once: own system ids, nothing lost, flights that begin anew, other processes too."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from array import array
from collections import Counter
from pathlib import Path

import fleet_sender
import pytest
from fleet_sender import Signer, fleet_packets, main, read_flight, send_fleet
from loopback import until
from packet_edit import stamp_ns_of
from packet_stream import packet_sequence

from adapters.batch import messages as each
from adapters.errors import TelemetryError
from adapters.logs.recordings import read_recording
from adapters.mavlink.mavlink_link import MavlinkLink
from adapters.mavlink.mavlink_message import packet_sender
from adapters.mavlink.signing import SigningGuard, SigningKey
from adapters.message import Message

ROOT = Path(__file__).parent.parent
FLIGHT = ROOT / "tests" / "data" / "copter_5s.tlog.xz"
MOTOR = ROOT / "tests" / "data" / "copter_motor3_090.tlog.xz"
KEY = SigningKey(bytes(range(32)))


def contents(messages: list[Message]) -> list[tuple[str, str]]:
    return [(message.name, repr(dict(message.fields))) for message in messages]


def test_a_flight_is_what_the_vehicle_of_a_log_sent() -> None:
    flight = read_flight(FLIGHT, 9)
    recorded = [message for message in read_recording(FLIGHT) if message.system == 1]
    assert len(flight.packets) == len(recorded)
    assert {packet_sender(packet)[0] for _, packet in flight.packets} == {9}
    assert flight.packets[0][0] == 0


def test_a_flight_begins_anew_until_the_time_is_over() -> None:
    flights = [read_flight(MOTOR, 1, 0.0, 1.0), read_flight(MOTOR, 2, 1.0, 1.5)]
    sent = list(fleet_packets(flights, 2.2))
    dues = [due_ns for due_ns, _ in sent]
    assert dues == sorted(dues)
    assert 2.1e9 < dues[-1] < 2.2e9
    for flight in flights:
        own = [packet for _, (system, packet) in sent if system == flight.system]
        assert len(own) > 2 * len(flight.packets)
        assert [packet_sequence(packet) for packet in own] == [k % 256 for k in range(len(own))]
        assert own[len(flight.packets)][10:-2] == own[0][10:-2]
        assert min(filter(None, map(stamp_ns_of, own))) < 600_000_000


def test_a_link_receives_all_of_all_vehicles(port: int) -> None:
    flights = [read_flight(FLIGHT, system) for system in (4, 5, 6)]
    sent: dict[int, array[int]] = {}
    with MavlinkLink(f"udpin:127.0.0.1:{port}", SigningGuard(KEY)) as link:

        def send() -> None:
            sent.update(send_fleet(fleet_packets(flights), f"udp:127.0.0.1:{port}", 5.0, signer=Signer(KEY)))

        sender = threading.Thread(target=send)
        sender.start()
        received: list[Message] = []
        sending = arriving = True
        while sending or arriving:
            sending = sender.is_alive()
            arrived = [*each(link.receive(0.2))]
            received += arrived
            arriving = bool(arrived)
        assert link.statistics().lost == 0
    recorded = contents([message for message in read_recording(FLIGHT) if message.system == 1])
    for system in (4, 5, 6):
        assert contents([message for message in received if message.system == system]) == recorded
        times = sent[system]
        assert len(times) == len(recorded)
        assert list(times) == sorted(times)


def test_another_process_counts_what_it_sent_when_it_is_stopped(port: int, tmp_path: Path) -> None:
    command = [sys.executable, fleet_sender.__file__, f"udp:127.0.0.1:{port}"]
    options = ["--seconds", "600", "--times", str(tmp_path), "--stop", "0.5"]
    with MavlinkLink(f"udpin:127.0.0.1:{port}") as link:
        process = subprocess.Popen(
            [*command, f"1={MOTOR}", f"2={MOTOR}", *options], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        received: Counter[int] = Counter()

        def listen() -> bool:
            received.update(message.system for message in [*each(link.receive(0.2))])
            return received.total() > 500

        until(listen)
        process.send_signal(signal.SIGTERM)
        counts = json.loads(process.communicate()[0])
        while messages := [*each(link.receive(0.2))]:
            received.update(message.system for message in messages)
        assert link.statistics().lost == 0
    assert process.returncode == 0
    assert counts == {"1": received[1], "2": received[2]}
    assert {path.name: path.stat().st_size // 8 for path in tmp_path.iterdir()} == {
        "1.sent": received[1],
        "2.sent": received[2],
    }


@pytest.mark.parametrize(
    "args",
    [
        ["udp:127.0.0.1:9", "1=none.tlog"],
        ["udp:127.0.0.1:9", str(MOTOR)],
        ["udp:127.0.0.1:9", f"300={MOTOR}"],
        ["udp:127.0.0.1:9", f"1={MOTOR}", "--start", "100"],
        ["udp:127.0.0.1:9", f"1={MOTOR}", "--speed", "0"],
        ["udp:127.0.0.1:9", f"1={MOTOR}", "--key", "none.key"],
        ["tcp:127.0.0.1:9", f"1={MOTOR}"],
    ],
)
def test_what_cannot_be_sent_is_reported_in_one_line(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(args) == 2
    said = capsys.readouterr().err
    assert said.startswith("fleet_sender: ")
    assert said.count("\n") == 1


def test_time_stamps_of_signatures_increase_while_the_clock_stands_still() -> None:
    flight = read_flight(MOTOR, 1, 0.0, 0.1)
    signer = Signer(KEY, lambda: 1_795_251_917_265_689_600)
    stamps = [int.from_bytes(signer(packet)[-12:-6], "little") for _, packet in flight.packets]
    assert stamps == list(range(stamps[0], stamps[0] + len(stamps)))


def test_an_unknown_host_is_reported() -> None:
    with pytest.raises(TelemetryError, match="cannot be resolved"):
        send_fleet([], "udp:no-such-host.invalid:9")
