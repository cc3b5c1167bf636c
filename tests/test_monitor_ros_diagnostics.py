"""/diagnostics for ROS 2: another implementation of CDR reads it, on the key and with the attachment of rmw_zenoh."""

from __future__ import annotations

import hashlib
import json
import queue
from dataclasses import replace
from typing import Any

import pytest
import zenoh
from loopback import Endpoint
from mcap_ros2._dynamic import generate_dynamic
from zenoh import ext

from monitor.service.health import ChannelHealth, Health, ObserverHealth, ProcessHealth, VehicleHealth
from monitor.service.ros_diagnostics import (
    TYPE,
    TYPE_HASH,
    Diagnostic,
    RosDiagnostics,
    diagnostics,
    diagnostics_payload,
)

NOW_NS = 1_795_404_602_641_000_007
DEFINITION = """std_msgs/Header header
diagnostic_msgs/DiagnosticStatus[] status
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: diagnostic_msgs/DiagnosticStatus
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values
================================================================================
MSG: diagnostic_msgs/KeyValue
string key
string value
"""
MOTOR = ChannelHealth("motors", "motor1", "fraction of full command", -0.03, 0.018, "critical")
HEALTH = Health(
    ProcessHealth(),
    vehicles=(
        VehicleHealth(
            "copter-1",
            "monitoring",
            observers=(ObserverHealth("motors", share=0.5),),
            channels=(MOTOR, ChannelHealth("motors", "gyro_x", "rad/s", 0.0, 0.1), ChannelHealth("link", "telemetry")),
        ),
        VehicleHealth("rover", "blind", blind="drive: no GPS for 5 s"),
    ),
)


def test_what_a_motor_lost_is_said_as_its_alarm_says_it() -> None:
    motor = replace(MOTOR, usual_command=0.5)
    vehicle = VehicleHealth("copter-1", "monitoring", channels=(motor,))
    *_, status = diagnostics(Health(ProcessHealth(), vehicles=(vehicle,)))
    assert status.message == "motor1 -6 % of thrust"


def decoded(payload: bytes) -> Any:
    return generate_dynamic("diagnostic_msgs/DiagnosticArray", DEFINITION)["diagnostic_msgs/DiagnosticArray"](payload)


def test_each_vehicle_and_each_observer_has_a_status() -> None:
    array = decoded(diagnostics_payload(diagnostics(HEALTH), NOW_NS))
    assert (array.header.stamp.sec, array.header.stamp.nanosec) == divmod(NOW_NS, 10**9)
    assert [(one.level, one.name, one.message, one.hardware_id) for one in array.status] == [
        (0, "fauio: copter-1", "monitoring", "copter-1"),
        (2, "fauio: copter-1 motors", "motor1 -3 % of full thrust", "copter-1"),
        (0, "fauio: copter-1 link", "no alarm", "copter-1"),
        (2, "fauio: rover", "blind: drive: no GPS for 5 s", "rover"),
    ]
    assert [(one.key, one.value) for one in array.status[1].values] == [
        ("motor1", "-3 % of full thrust"),
        ("gyro_x", "+0 degrees/s"),
    ]


@pytest.mark.parametrize("name", ["", "a", "abc", "motör", "\ud800", "nul\0inside"])
def test_any_text_is_encoded(name: str) -> None:
    array = decoded(diagnostics_payload(iter([Diagnostic(1, name, name, "x", [(name, name)])] * 2), NOW_NS))
    shown = name.replace("\0", "").replace("\ud800", "\\ud800")
    assert [one.name for one in array.status] == [shown] * 2
    assert array.status[1].values[0].value == shown


def test_the_hash_is_that_of_the_type_by_rep_2011() -> None:
    def fields(kind: str, *members: tuple[str, int, str]) -> dict[str, Any]:
        types = [
            {"name": name, "type": dict(zip(NAMES, (code, 0, 0, nested), strict=True))}
            for name, code, nested in members
        ]
        return {"type_name": kind, "fields": types}

    NAMES = ("type_id", "capacity", "string_capacity", "nested_type_name")
    nested, int32, uint32, byte, text, sequence = 1, 6, 7, 16, 17, 144
    array = fields(
        "diagnostic_msgs/msg/DiagnosticArray",
        ("header", nested, "std_msgs/msg/Header"),
        ("status", nested + sequence, "diagnostic_msgs/msg/DiagnosticStatus"),
    )
    others = [
        fields("builtin_interfaces/msg/Time", ("sec", int32, ""), ("nanosec", uint32, "")),
        fields(
            "diagnostic_msgs/msg/DiagnosticStatus",
            ("level", byte, ""),
            ("name", text, ""),
            ("message", text, ""),
            ("hardware_id", text, ""),
            ("values", nested + sequence, "diagnostic_msgs/msg/KeyValue"),
        ),
        fields("diagnostic_msgs/msg/KeyValue", ("key", text, ""), ("value", text, "")),
        fields("std_msgs/msg/Header", ("stamp", nested, "builtin_interfaces/msg/Time"), ("frame_id", text, "")),
    ]
    description = json.dumps({"type_description": array, "referenced_type_descriptions": others})
    assert f"RIHS01_{hashlib.sha256(description.encode()).hexdigest()}" == TYPE_HASH


def test_a_subscriber_of_rmw_zenoh_gets_it_with_number_time_and_sender(endpoint: Endpoint) -> None:
    samples: queue.Queue[zenoh.Sample] = queue.Queue()
    subscriber = endpoint.session.declare_subscriber(f"3/diagnostics/{TYPE}/{TYPE_HASH}", samples.put)
    publisher = RosDiagnostics(endpoint.session, 3)
    tokens = [str(reply.ok.key_expr) for reply in endpoint.session.liveliness().get("@ros2_lv/3/**") if reply.ok]
    assert sorted(token.split("/")[5] for token in tokens) == ["MP", "NN"]
    for _ in range(2):
        publisher.publish(HEALTH, NOW_NS)
    first, second = samples.get(timeout=10.0), samples.get(timeout=10.0)
    kinds = tuple[str, ext.Int64, str, ext.Int64, str, bytes]
    heads = [ext.z_deserialize(kinds, one.attachment) for one in (first, second) if one.attachment is not None]
    assert [head[:5] for head in heads] == [
        ("sequence_number", count, "source_timestamp", NOW_NS, "source_gid") for count in (1, 2)
    ]
    assert heads[0][5] == heads[1][5]
    assert len(heads[0][5]) == 16
    assert len(decoded(second.payload.to_bytes()).status) == 4
    publisher.close()
    subscriber.undeclare()
