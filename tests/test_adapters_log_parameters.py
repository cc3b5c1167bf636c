"""The vehicle's parameters in each kind of recording, and in the survey of one."""

import struct
from pathlib import Path

import pytest
from dataflash_writer import DataflashWriter
from ulog_writer import UlogWriter

from adapters.logs.log_parameters import parameter
from adapters.logs.recordings import packed, read_batches
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.fitting.survey import of_one_vehicle, survey
from monitor.vehicles.kinds import fit_messages


def mavlink(name: str, system: int = 1, **fields: object) -> Message:
    return Message(MAVLINK, name, 1_000, fields, system, 1)


def value(name: str, number: float, kind: int = 9, system: int = 1) -> Message:
    return mavlink("PARAM_VALUE", system, param_id=name, param_value=number, param_type=kind)


def heartbeat(autopilot: int) -> Message:
    return mavlink("HEARTBEAT", type=2, autopilot=autopilot, base_mode=129)


def test_parameters_at_the_head_of_a_px4_log_reach_the_survey_of_its_vehicle(tmp_path: Path) -> None:
    log = UlogWriter()
    log.parameter("CA_ROTOR_COUNT", 4)
    log.parameter("CA_ROTOR0_KM", -0.05)
    log.define("vehicle_attitude", "uint64_t timestamp;float rollspeed;float pitchspeed;float yawspeed;float[4] q")
    number = log.subscribe("vehicle_attitude")
    for time_us in (20_000, 40_000):
        log.add(number, "vehicle_attitude", {"timestamp": time_us, "q": (1.0, 0.0, 0.0, 0.0)})
    log.parameter("CA_ROTOR_COUNT", 6)
    found = survey(of_one_vehicle(read_batches(log.write(tmp_path / "a.ulg"), fit_messages())))
    assert found.parameters == {"CA_ROTOR_COUNT": 6.0, "CA_ROTOR0_KM": pytest.approx(-0.05)}


def test_parameters_of_an_ardupilot_log_reach_the_survey_of_its_vehicle(tmp_path: Path) -> None:
    log = DataflashWriter()
    log.define("PARM", "QNff", "TimeUS,Name,Value,Default")
    log.add("PARM", 1_000, "FRAME_CLASS", 2.0, 0.0)
    log.define("RCOU", "QHHHH", "TimeUS,C1,C2,C3,C4")
    log.add("RCOU", 2_000, 1500, 1500, 1500, 1500)
    found = survey(of_one_vehicle(read_batches(log.write(tmp_path / "a.bin"), fit_messages())))
    assert found.parameters == {"FRAME_CLASS": 2.0}


@pytest.mark.parametrize("autopilot", [3, 12])
def test_integers_of_mavlink_parameters_are_read_as_the_autopilot_sends_them(autopilot: int) -> None:
    (bits,) = struct.unpack("<f", struct.pack("<i", 4))
    sent = [
        value("COUNT", bits if autopilot == 12 else 4.0, 6),
        value("EXPO", 0.65),
        value("OTHERS", 1.0, system=7),
        mavlink("ATTITUDE", time_boot_ms=1),
        heartbeat(autopilot),
        value("EXPO", 0.5),
    ]
    assert survey(of_one_vehicle(packed(sent))).parameters == {"COUNT": 4.0, "EXPO": 0.5}


def test_a_parameter_without_name_or_number_is_none() -> None:
    assert parameter(value("", 1.0)) is None
    assert parameter(mavlink("PARAM_VALUE", param_id="A")) is None
    assert parameter(mavlink("PARAM_VALUE", param_id="A", param_value=10**400)) is None
    assert parameter(mavlink("PARAM_VALUE", param_id="A", param_value=1e300, param_type=6), px4=True) is None
    assert parameter(mavlink("PARAM_VALUE", param_id=4, param_value=1.0, param_type=[])) is None
