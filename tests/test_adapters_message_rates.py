"""Rates asked of a vehicle that is simulated message by message, its clock included."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from packet_stream import PacketStream
from pymavlink.dialects.v20 import ardupilotmega as dialect

from adapters.batch import pack
from adapters.errors import TelemetryError
from adapters.mavlink.message_rates import RateRequests
from adapters.mavlink.signing import SignatureVerdict, SignatureVerifier, SigningKey
from adapters.message import Message
from adapters.source import MAVLINK

SECOND_NS = 1_000_000_000
START_NS = 1_795_251_917 * SECOND_NS
STEP_NS = SECOND_NS // 20


def decoded(packets: list[bytes], now_ns: int) -> list[Message]:
    return [message for packet in packets for message in PacketStream().messages(packet, now_ns)]


class Vehicle:
    """Sends HEARTBEAT at 1 Hz and other messages at rates that it obeys requests for, or not."""

    def __init__(self, rates: dict[str, float], result: int | None = dialect.MAV_RESULT_ACCEPTED) -> None:
        self.rates = {"HEARTBEAT": 1.0, **rates}
        self.result = result
        self.obeys = result == dialect.MAV_RESULT_ACCEPTED
        self.system = 1

    def sends(self, now_ns: int) -> list[Message]:
        return [
            Message(MAVLINK, name, now_ns, {}, self.system, 1)
            for name, rate in self.rates.items()
            if int((now_ns + STEP_NS) * rate // SECOND_NS) > int(now_ns * rate // SECOND_NS)
        ]

    def takes(self, command: Message, now_ns: int) -> list[Message]:
        if self.obeys:
            name = dialect.mavlink_map[int(command.fields["param1"])].msgname
            self.rates[name] = 1e6 / command.fields["param2"]
        if self.result is None:
            return []
        fields = {"command": command.fields["command"], "result": self.result}
        to = {"target_system": command.system, "target_component": command.component}
        return [Message(MAVLINK, "COMMAND_ACK", now_ns, fields | to, self.system, 1)]


def count(requests: RateRequests, message: Message) -> None:
    for columns in pack([message]).columns:
        requests.count(columns, message.received_ns)


def fly(
    requests: RateRequests, vehicle: Vehicle | None, seconds: float, start_ns: int = START_NS, ahead_ns: int = 0
) -> list[Message]:
    """Let steady time pass, Unix time being ahead of it; return what was sent to the vehicle."""
    sent = []
    for now in range(start_ns, start_ns + int(seconds * SECOND_NS), STEP_NS):
        for message in vehicle.sends(now) if vehicle else []:
            count(requests, message)
        for message in decoded(requests.requests(now, now + ahead_ns), now):
            sent.append(message)
            if vehicle and message.name == "COMMAND_LONG":
                for answer in vehicle.takes(message, now):
                    count(requests, answer)
    return sent


def asked(sent: list[Message]) -> list[tuple[int, float]]:
    return [(m.fields["param1"], m.fields["param2"]) for m in sent if m.name == "COMMAND_LONG"]


def asking(rates: dict[str, float], **options: Any) -> RateRequests:
    requests = RateRequests(**options)
    requests.ask(1, rates)
    return requests


def test_a_message_that_comes_too_slowly_is_asked_for_once_and_then_comes() -> None:
    requests = asking({"ATTITUDE": 10.0})
    sent = fly(requests, Vehicle({"ATTITUDE": 2.0}), 60.0)
    assert asked(sent) == [(30, 100_000.0)]
    (command,) = (message for message in sent if message.name == "COMMAND_LONG")
    assert (command.fields["target_system"], command.fields["target_component"]) == (1, 1)
    assert command.fields["command"] == dialect.MAV_CMD_SET_MESSAGE_INTERVAL


def test_a_rate_that_is_nearly_right_is_left_alone() -> None:
    assert asked(fly(asking({"ATTITUDE": 10.0}), Vehicle({"ATTITUDE": 8.0}), 30.0)) == []
    assert asked(fly(asking({"SYSTEM_TIME": 0.5}), Vehicle({"SYSTEM_TIME": 0.5}), 60.0)) == []


def test_a_heartbeat_of_an_onboard_computer_goes_out_every_second_heard_or_not() -> None:
    requests = asking({"ATTITUDE": 10.0})
    sent = fly(requests, None, 10.0)
    assert [message.name for message in sent] == ["HEARTBEAT"] * 10
    # Not a ground station's: that would hide the loss of the real one from the vehicle.
    assert {message.fields["type"] for message in sent} == {dialect.MAV_TYPE_ONBOARD_CONTROLLER}
    assert {(message.system, message.component) for message in sent} == {(245, 191)}


def test_a_vehicle_that_does_not_answer_is_asked_again_ever_more_rarely() -> None:
    sent = fly(asking({"ATTITUDE": 10.0}), Vehicle({}, result=None), 600.0)
    times = [message.received_ns for message in sent if message.name == "COMMAND_LONG"]
    gaps = [(later - earlier) / SECOND_NS for earlier, later in itertools.pairwise(times)]
    assert gaps == sorted(gaps)
    assert gaps[0] < 4.0
    assert 60.0 <= gaps[-1] <= 70.0


@pytest.mark.parametrize("result", [dialect.MAV_RESULT_DENIED, dialect.MAV_RESULT_UNSUPPORTED])
def test_a_refusal_ends_the_asking_for_that_message_alone(result: int) -> None:
    requests = asking({"ATTITUDE": 10.0, "SERVO_OUTPUT_RAW": 10.0})
    vehicle = Vehicle({"SERVO_OUTPUT_RAW": 10.0}, result)
    assert asked(fly(requests, vehicle, 120.0)) == [(30, 100_000.0)]
    vehicle.rates["SERVO_OUTPUT_RAW"] = 2.0
    assert asked(fly(requests, vehicle, 60.0, START_NS + 120 * SECOND_NS)) == [(36, 100_000.0)]


def test_a_rejection_for_now_is_asked_again() -> None:
    sent = fly(asking({"ATTITUDE": 10.0}), Vehicle({}, dialect.MAV_RESULT_TEMPORARILY_REJECTED), 30.0)
    assert len(asked(sent)) > 2


def test_acknowledgements_of_others_commands_and_to_others_mean_nothing() -> None:
    requests = asking({"ATTITUDE": 10.0})
    vehicle = Vehicle({}, result=None)
    assert len(asked(fly(requests, vehicle, 3.5))) == 1
    denied = {"command": dialect.MAV_CMD_SET_MESSAGE_INTERVAL, "result": dialect.MAV_RESULT_DENIED}
    for fields, system in (
        (denied | {"target_system": 255, "target_component": 190}, 1),
        (denied | {"target_system": 245, "target_component": 190}, 1),
        (denied | {"target_system": 0, "target_component": 0, "command": 400}, 1),
        (denied | {"target_system": 245, "target_component": 191}, 2),
    ):
        count(requests, Message(MAVLINK, "COMMAND_ACK", START_NS, fields, system, 1))
    assert len(asked(fly(requests, vehicle, 2.5, START_NS + 3_500_000_000))) == 1
    count(
        requests, Message(MAVLINK, "COMMAND_ACK", START_NS, denied | {"target_system": 0, "target_component": 0}, 1, 1)
    )
    assert asked(fly(requests, vehicle, 60.0, START_NS + 6 * SECOND_NS)) == []


def test_one_request_at_a_time_is_open_so_that_its_answer_is_known() -> None:
    requests = asking({"ATTITUDE": 10.0, "SERVO_OUTPUT_RAW": 10.0})
    sent = fly(requests, Vehicle({}, result=None), 6.0)
    times = [message.received_ns for message in sent if message.name == "COMMAND_LONG"]
    assert len(times) >= 2
    assert all(later - earlier >= SECOND_NS for earlier, later in itertools.pairwise(times))


def test_after_a_reboot_the_vehicle_is_asked_again() -> None:
    requests = asking({"ATTITUDE": 10.0})
    assert len(asked(fly(requests, Vehicle({}), 30.0))) == 1
    assert asked(fly(requests, None, 20.0, START_NS + 30 * SECOND_NS)) == []
    assert len(asked(fly(requests, Vehicle({}), 30.0, START_NS + 50 * SECOND_NS))) == 1


def test_silence_of_the_link_is_not_taken_for_a_low_rate() -> None:
    requests = asking({"ATTITUDE": 10.0})
    vehicle = Vehicle({"ATTITUDE": 10.0})
    sent = []
    for outage in range(5):
        start = START_NS + outage * 20 * SECOND_NS
        sent += fly(requests, vehicle, 10.0, start) + fly(requests, None, 10.0, start + 10 * SECOND_NS)
    assert len(asked(sent)) <= 1


@pytest.mark.parametrize("hours", [-1, 1])
def test_a_clock_that_is_set_changes_nothing(hours: int) -> None:
    requests, plain = asking({"ATTITUDE": 10.0}), asking({"ATTITUDE": 10.0})
    for start_s, ahead in ((0, 0), (100, hours)):
        at_ns = START_NS + start_s * SECOND_NS
        sent = fly(requests, Vehicle({}, result=None), 100.0, at_ns, ahead * 3600 * SECOND_NS)
        assert sent == fly(plain, Vehicle({}, result=None), 100.0, at_ns)


def test_several_vehicles_are_asked_by_one_sender_with_one_sequence() -> None:
    requests = RateRequests()
    requests.ask(1, {"ATTITUDE": 10.0})
    requests.ask(2, {"ATTITUDE": 20.0}, component=7)
    packets = []
    for now in range(START_NS, START_NS + 5 * SECOND_NS, STEP_NS):
        count(requests, Message(MAVLINK, "HEARTBEAT", now, {"type": 2}, 1, 1))
        count(requests, Message(MAVLINK, "HEARTBEAT", now, {"type": 2}, 2, 7))
        packets += requests.requests(now, now)
    assert [packet[4] for packet in packets] == list(range(len(packets)))
    to = {
        (m.fields["target_system"], m.fields["target_component"], m.fields["param2"])
        for m in decoded(packets, 0)
        if m.name == "COMMAND_LONG"
    }
    assert to == {(1, 1, 100_000.0), (2, 7, 50_000.0)}


def test_with_a_key_all_that_is_sent_is_signed() -> None:
    key = SigningKey(b"k" * 32)
    requests = asking({"ATTITUDE": 10.0}, key=key)
    verifier = SignatureVerifier(key)
    for now in range(START_NS, START_NS + 5 * SECOND_NS, STEP_NS):
        count(requests, Message(MAVLINK, "HEARTBEAT", now, {"type": 2}, 1, 1))
        for packet in requests.requests(now, now):
            assert verifier.check(packet, now) is SignatureVerdict.VALID


@pytest.mark.parametrize(
    ("system", "rates", "said"),
    [
        (1, {"ALTITUDEE": 1.0}, "ALTITUDEE: no such MAVLink message"),
        (1, {"ATTITUDE": 0.0}, "ATTITUDE: 0.0 is not above 0"),
        (1, {"ATTITUDE": float("nan")}, "nan is not above 0"),
        (1, {"ATTITUDE": 1e9}, "at most 1000 Hz"),
        (0, {"ATTITUDE": 1.0}, "ids are 1 to 255"),
        (256, {"ATTITUDE": 1.0}, "ids are 1 to 255"),
    ],
)
def test_what_cannot_be_asked_is_reported(system: int, rates: dict[str, float], said: str) -> None:
    with pytest.raises(TelemetryError, match=said):
        RateRequests().ask(system, rates)
