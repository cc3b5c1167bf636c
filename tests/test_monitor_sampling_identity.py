"""What messages say of the vehicle they are of, and when that is another one than a profile's."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.message import Message
from adapters.source import DATAFLASH, MAVLINK, ULOG, ZENOH
from monitor.sampling.identity import Identity, Reports, common_identity

QUAD = Identity("quadrotor", "ardupilotmega", "quad/x", 4)


def heartbeat(kind: object, autopilot: object = 3) -> Message:
    return Message(MAVLINK, "HEARTBEAT", 0, {"type": kind, "autopilot": autopilot, "base_mode": 0}, 1, 1)


def parm(name: object, value: object) -> Message:
    return Message(DATAFLASH, "PARM", 0, {"TimeUS": 0, "Name": name, "Value": value})


def firmware(text: object) -> Message:
    return Message(DATAFLASH, "MSG", 0, {"TimeUS": 0, "Message": text})


def ulog(key: str, value: object) -> Message:
    return Message(ULOG, "log/parameter", 0, {"key": key, "type": "int32_t", "value": value})


def param_value(name: str, value: float, kind: int) -> Message:
    return Message(MAVLINK, "PARAM_VALUE", 0, {"param_id": name, "param_value": value, "param_type": kind}, 1, 1)


def said(*messages: Message) -> Identity:
    reports = Reports()
    for message in messages:
        reports = reports.after(message)
    return reports.identity


def test_a_heartbeat_says_type_and_autopilot() -> None:
    assert said(heartbeat(2)) == Identity("quadrotor", "ardupilotmega")
    assert said(heartbeat(1, 12)) == Identity("fixed wing", "px4")
    assert said(heartbeat(13), heartbeat(0)).vehicle_type == "hexarotor"  # "generic" knows less, not otherwise


@pytest.mark.parametrize("message", [heartbeat(6), heartbeat(2, 8), heartbeat(None), heartbeat("2"), heartbeat(True)])
def test_ground_stations_and_nonsense_say_nothing(message: Message) -> None:
    assert said(message) in (Identity(), Identity(autopilot="ardupilotmega"))


def test_an_ardupilot_log_says_its_frame_by_parameters() -> None:
    head = [firmware("ArduCopter V4.7.0-dev (90700977)"), heartbeat(0)]
    assert said(*head, parm("FRAME_CLASS", 1.0), parm("FRAME_TYPE", 1.0)) == QUAD
    assert said(parm("FRAME_TYPE", 0.0), parm("FRAME_CLASS", 2.0), *head) == Identity(
        "hexarotor", "ardupilotmega", "hexa/plus", 6
    )
    assert said(*head, parm("FRAME_CLASS", 7.0), parm("FRAME_TYPE", 1.0)).frame == "tri"
    assert said(*head, parm("FRAME_CLASS", 15.0)) == Identity(autopilot="ardupilotmega")


def test_logs_of_old_copters_say_their_frame_in_words() -> None:
    head = [heartbeat(0), firmware("APM:Copter V3.4.4-rc1 (65ffe9d7)"), parm("FRAME", 1.0)]
    assert said(*head, firmware("Frame: QUAD")) == Identity("quadrotor", "ardupilotmega", "", 4)
    assert said(*head, firmware("Frame: OCTA_QUAD")).vehicle_type == ""
    assert said(*head, firmware("Frame:")) == Identity(autopilot="ardupilotmega")
    assert said(firmware("ArduCopter V4.5.1"), parm("FRAME_CLASS", 2.0), firmware("Frame: QUAD/X")).motors == 6


def test_a_submarine_says_so() -> None:
    assert said(firmware("ArduSub V4.1.0 (f2af3c7e)")) == Identity("submarine")


def test_frame_classes_of_rovers_and_planes_are_none_of_copters() -> None:
    assert said(firmware("ArduRover V4.5.1"), parm("FRAME_CLASS", 1.0)) == Identity("ground rover")
    assert said(firmware("ArduRover V4.5.1"), parm("FRAME_CLASS", 2.0)) == Identity("surface boat")
    assert said(firmware("ArduPlane V4.5.1"), parm("Q_ENABLE", 0.0)) == Identity("fixed wing")
    assert said(firmware("ArduPlane V4.5.1"), parm("Q_ENABLE", 1.0)) == Identity()
    assert said(heartbeat(10), param_value("FRAME_CLASS", 1.0, 2)) == Identity("ground rover", "ardupilotmega")


def test_parameters_on_a_link_say_the_same_as_in_a_log() -> None:
    bits = struct.unpack("<f", struct.pack("<i", 6))[0]
    assert said(heartbeat(2), param_value("FRAME_CLASS", 1.0, 2), param_value("FRAME_TYPE", 1.0, 2)) == QUAD
    assert said(heartbeat(13, 12), param_value("CA_ROTOR_COUNT", bits, 6)) == Identity("hexarotor", "px4", "", 6)
    assert said(heartbeat(13, 12), ulog("CA_ROTOR_COUNT", 6.0)) == Identity("hexarotor", "px4", "", 6)
    assert said(ulog("MAV_TYPE", 2.0)) == Identity("quadrotor")


def test_only_what_both_know_can_differ() -> None:
    assert QUAD.contradiction(QUAD) is None
    assert QUAD.contradiction(Identity()) is None
    assert Identity().contradiction(QUAD) is None
    assert Identity("quadrotor", motors=4).contradiction(QUAD) is None
    plus = Identity("quadrotor", "px4", "quad/plus", 4)
    assert plus.contradiction(QUAD) == (
        "another vehicle than the profile's: it says it is a quadrotor with px4, a quad/plus frame, the profile was "
        "fitted to a quadrotor with ardupilotmega, a quad/x frame"
    )
    assert Identity(motors=6).difference(QUAD) == ("a vehicle with 6 motors", "a quadrotor with 4 motors")


def test_a_profile_of_several_recordings_keeps_what_none_contradicts() -> None:
    log, link = QUAD, Identity("quadrotor", "ardupilotmega")
    assert common_identity([log, link]) == QUAD
    assert common_identity([log, Identity("hexarotor", "ardupilotmega")]) == Identity("", "ardupilotmega", "quad/x", 4)
    assert common_identity([]) == Identity()


anything = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.lists(st.integers(), max_size=2)


@given(
    st.lists(
        st.builds(
            lambda source, name, fields: Message(source, name, 0, fields, 1, 1),
            st.sampled_from([MAVLINK, DATAFLASH, ULOG, ZENOH]),
            st.sampled_from(sorted(Reports.interests)),
            st.dictionaries(
                st.sampled_from(
                    ["type", "autopilot", "param_id", "param_value", "param_type", "Name", "Value", "Message", "key"]
                ),
                anything | st.sampled_from(["FRAME_CLASS", "CA_ROTOR_COUNT", "ArduCopter V4"]),
            ),
        ),
        max_size=8,
    )
)
def test_whatever_arrives_an_identity_can_be_told(messages: list[Message]) -> None:
    found = said(*messages)
    assert found.contradiction(found) is None
    assert 0 <= found.motors <= 32


def test_only_an_onboard_log_s_records_are_believed_as_such() -> None:
    fields = {"Name": "FRAME_CLASS", "Value": 2.0}
    assert said(heartbeat(2), Message(DATAFLASH, "PARM", 0, fields)).motors == 6
    assert said(heartbeat(2), Message(ZENOH, "PARM", 0, fields)).motors == 0
