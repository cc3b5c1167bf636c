"""Which messages feed planes and rovers: choices, fallbacks, rates, and what is said where one is missing."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest

from adapters.errors import TelemetryError
from monitor.fitting.effect_signals import EffectSignals
from monitor.fitting.survey import MOTOR_MESSAGE, MotorOutput, Survey
from monitor.vehicles.plane.signals import plane_signals
from monitor.vehicles.plane.signals import preview as plane_preview
from monitor.vehicles.plane.transform import SurfaceInputs
from monitor.vehicles.rover.signals import rover_signals
from monitor.vehicles.rover.transform import DriveInputs

RATES = {"ATTITUDE": 100.0, "SERVO_OUTPUT_RAW": 100.2, "HIGHRES_IMU": 99.8, "LOCAL_POSITION_NED": 50.0}
FULL = Survey({"VFR_HUD": 100, **dict.fromkeys(RATES, 1000)}, RATES, {})


def with_rates(**rates: float) -> Survey:
    return replace(FULL, rate_hz={name: rate for name, rate in (RATES | rates).items() if rate})


def test_every_signal_has_its_channel_in_the_transforms_order() -> None:
    assert tuple(channel.name for channel in plane_signals([FULL]).channels) == SurfaceInputs.signals
    assert tuple(channel.name for channel in rover_signals([FULL]).channels) == DriveInputs.signals


def test_pulses_become_deflections() -> None:
    plane = {channel.name: channel for channel in plane_signals([FULL]).channels}
    rover = {channel.name: channel for channel in rover_signals([FULL]).channels}
    pulses = {f"servo{n}_raw": pulse for n, pulse in ((1, 1750), (2, 1000), (3, 1400), (4, 2000))}
    found = [plane[name].value(pulses) for name in ("aileron", "elevator", "throttle", "rudder")]
    assert found == pytest.approx([0.5, -1.0, 0.4, 1.0])
    assert [rover[name].value(pulses) for name in ("steering", "throttle")] == pytest.approx([0.5, -0.2])


PX4 = {"CA_AIRFRAME": 1.0, "CA_SV_CS0_TYPE": 2.0, "CA_SV_CS1_TYPE": 3.0, "CA_SV_CS2_TYPE": 4.0}
FOUR = (201, 202, 203, 101)
ELEVONS = {"SERVO1_FUNCTION": 77.0, "SERVO2_FUNCTION": 78.0, "SERVO3_FUNCTION": 70.0, "SERVO4_FUNCTION": 0.0}
TAIL = PX4 | {"CA_SV_CS1_TYPE": 7.0, "CA_SV_CS2_TYPE": 8.0}


def outputs_of(driver: str, functions: Sequence[int]) -> dict[str, float]:
    return {f"{driver}{n}": float(function) for n, function in enumerate(functions, 1)}


def plane_outputs(parameters: Mapping[str, float], px4: bool = True) -> dict[str, str | int]:
    survey = replace(FULL, parameters=parameters, px4=px4)
    return {channel.name: channel.path[0] for channel in plane_signals([survey]).channels[:4]}


def named(aileron: int, elevator: int, throttle: int, rudder: int) -> dict[str, str]:
    order = {"aileron": aileron, "elevator": elevator, "throttle": throttle, "rudder": rudder}
    return {name: f"servo{number}_raw" for name, number in order.items()}


@pytest.mark.parametrize("driver", ["PWM_MAIN_FUNC", "HIL_ACT_FUNC"])
def test_outputs_of_a_px4_plane_are_what_its_parameters_say(driver: str) -> None:
    assert plane_outputs(PX4 | outputs_of(driver, FOUR)) == named(1, 2, 4, 3)
    turned = {"CA_SV_CS0_TYPE": 4.0, "CA_SV_CS2_TYPE": 15.0}
    assert plane_outputs(PX4 | turned | outputs_of(driver, FOUR)) == named(3, 2, 4, 1)


@pytest.mark.parametrize(
    ("airframe", "order"),
    [(10041.0, (1, 2, 4, 3)), (1101.0, (1, 2, 4, 3)), (1030.0, (6, 8, 5, 3)), (2100.0, (1, 2, 3, 4))],
)
def test_a_px4_link_that_holds_no_more_than_its_airframe_tells(airframe: float, order: tuple[int, ...]) -> None:
    assert plane_outputs({"SYS_AUTOSTART": airframe}) == named(*order)
    assert plane_outputs({"SYS_AUTOSTART": 10041.0, "PWM_MAIN_FUNC4": 0.0, "PWM_MAIN_FUNC7": 101.0}) == named(
        1, 2, 7, 3
    )


def test_the_driver_that_drives_most_counts() -> None:
    assert plane_outputs(PX4 | {"PWM_MAIN_FUNC5": 101.0} | outputs_of("PWM_AUX_FUNC", FOUR)) == named(1, 2, 4, 3)


def test_the_throttle_of_a_px4_vtol_is_the_motor_that_pushes() -> None:
    vtol = {"CA_AIRFRAME": 2.0, "CA_ROTOR4_AX": 1.0, "CA_ROTOR4_AZ": 0.0}
    functions = outputs_of("PWM_MAIN_FUNC", (101, 102, 103, 104, 105, 201, 202, 203))
    assert plane_outputs(PX4 | vtol | functions) == named(6, 7, 5, 8)


def test_commands_of_px4_need_no_functions() -> None:
    moved = MotorOutput(1500.0, 1500.0, 1200, 1800, 0.0, True)
    survey = replace(FULL, parameters=PX4, px4=True, onboard=True, outputs=dict.fromkeys((1, 9, 10, 11), moved))
    channels = {channel.name: channel for channel in plane_signals([survey]).channels}
    pulses = {f"servo{n}_raw": pulse for n, pulse in ((1, 1400), (9, 1750), (10, 1000), (11, 2000))}
    found = [channels[name].value(pulses) for name in ("throttle", "aileron", "elevator", "rudder")]
    assert found == pytest.approx([0.4, 0.5, -1.0, 1.0])


def test_outputs_that_never_move_do_not_make_a_log_of_px4_one_of_commands() -> None:
    moved, unused = MotorOutput(1500.0, 1500.0, 1200, 1800, 0.0, True), MotorOutput(900.0, 0.0, 900, 900, 0.0, False)
    outputs = dict.fromkeys((1, 2, 3, 4), moved) | dict.fromkeys(range(5, 17), unused)
    parameters = PX4 | outputs_of("PWM_MAIN_FUNC", FOUR)
    survey = replace(FULL, parameters=parameters, px4=True, onboard=True, outputs=outputs)
    assert {channel.name: channel.path[0] for channel in plane_signals([survey]).channels}["throttle"] == "servo4_raw"


def test_outputs_of_an_ardupilot_plane_are_what_its_parameters_say() -> None:
    functions = {"SERVO1_FUNCTION": 70.0, "SERVO2_FUNCTION": 4.0, "SERVO5_FUNCTION": 19.0, "SERVO6_FUNCTION": 21.0}
    assert plane_outputs(functions, px4=False) == named(2, 5, 1, 6)


def test_outputs_of_ardupilot_whose_parameters_were_lost_are_the_usual_ones() -> None:
    assert plane_outputs({"SERVO2_FUNCTION": 19.0}, px4=False) == named(1, 2, 3, 4)


def test_outputs_of_a_px4_rover_are_what_its_parameters_say() -> None:
    parameters = {"CA_AIRFRAME": 5.0, "PWM_MAIN_FUNC2": 201.0, "PWM_MAIN_FUNC7": 101.0}
    channels = rover_signals([replace(FULL, parameters=parameters, px4=True)]).channels
    assert [channel.path[0] for channel in channels[:2]] == ["servo2_raw", "servo7_raw"]


@pytest.mark.parametrize(
    ("parameters", "px4", "said"),
    [
        ({"SYS_AUTOSTART": 4001.0}, True, "no parameter of PX4 in the logs says which output drives what"),
        (ELEVONS | {"SERVO2_FUNCTION": 0.0, "SERVO3_FUNCTION": 0.0}, False, "no output .* aileron or elevator"),
    ],
)
def test_outputs_that_are_not_known_are_refused(parameters: Mapping[str, float], px4: bool, said: str) -> None:
    with pytest.raises(TelemetryError, match=said):
        plane_outputs(parameters, px4)


@pytest.mark.parametrize(
    ("parameters", "outputs_hz"), [(PX4 | outputs_of("PWM_MAIN_FUNC", FOUR), 10.0), (TAIL, 50.0), ({}, 50.0)]
)
def test_a_log_of_px4_also_has_what_the_controllers_ask_for(parameters: Mapping[str, float], outputs_hz: float) -> None:
    rates = RATES | {"SERVO_OUTPUT_RAW": outputs_hz, "ACTUATOR_CONTROL_TARGET": 50.0}
    log = replace(FULL, rate_hz=rates, parameters=parameters, px4=True, onboard=True)
    plane = plane_signals([log])
    asked = {channel.name: channel.value({"controls": [0.1, 0.2, 0.3, 0.4, 0.5]}) for channel in plane.channels[:4]}
    assert asked == {"aileron": 0.1, "elevator": 0.2, "rudder": 0.3, "throttle": 0.5}
    assert plane.rate_hz == 50.0


def test_outputs_that_come_as_often_as_the_controls_are_preferred() -> None:
    rates = RATES | {"ACTUATOR_CONTROL_TARGET": 100.0}
    parameters = PX4 | outputs_of("PWM_MAIN_FUNC", FOUR)
    log = replace(FULL, rate_hz=rates, parameters=parameters, px4=True, onboard=True)
    assert {channel.message for channel in plane_signals([log]).channels[:4]} == {"SERVO_OUTPUT_RAW"}


def shares(signals: EffectSignals, pulses: Mapping[int, int]) -> dict[str, float | None]:
    fields = {f"servo{n}_raw": pulse for n, pulse in pulses.items()}
    return {channel.name: channel.value(fields) for channel in signals.channels if channel.message == MOTOR_MESSAGE}


def test_elevons_of_ardupilot_are_taken_as_their_servos_turn() -> None:
    servos = {"SERVO2_REVERSED": 1.0, "SERVO1_TRIM": 1450.0, "SERVO1_MIN": 1050.0, "SERVO1_MAX": 1850.0}
    signals = plane_signals([replace(FULL, parameters=ELEVONS | servos)])
    found = shares(signals, {1: 1550, 2: 1400, 3: 1300, 4: 1999})
    assert found == pytest.approx({"elevon_left": 0.25, "elevon_right": 0.2, "throttle": 0.3, "rudder": 0.0})
    assert (signals.parameters, signals.undriven) == ({"elevons": 1.0}, {"rudder"})
    preview = plane_preview(replace(FULL, parameters=ELEVONS))
    assert preview.watches == ("aileron", "elevator", "throttle")


@pytest.mark.parametrize("damaged", [float("nan"), float("inf"), 1e300])
def test_damaged_parameters_of_an_output_are_those_that_are_usual(damaged: float) -> None:
    servos = dict.fromkeys(("SERVO1_REVERSED", "SERVO1_TRIM", "SERVO1_MIN", "SERVO2_MAX"), damaged)
    found = shares(plane_signals([replace(FULL, parameters=ELEVONS | servos)]), {1: 1600, 2: 1400, 3: 1300, 4: 1500})
    assert (found["elevon_left"], found["elevon_right"]) == pytest.approx((0.2, -0.2))
    turned = TAIL | outputs_of("PWM_MAIN_FUNC", FOUR) | {"PWM_MAIN_REV": damaged}
    assert plane_signals([replace(FULL, parameters=turned, px4=True)]).parameters == {"v_tail": 1.0}


@pytest.mark.parametrize("turned", [0.0, 4.0])
def test_a_v_tail_of_px4_is_taken_as_its_servos_turn(turned: float) -> None:
    signals = plane_signals(
        [replace(FULL, parameters=TAIL | outputs_of("PWM_MAIN_FUNC", FOUR) | {"PWM_MAIN_REV": turned}, px4=True)]
    )
    found = shares(signals, {1: 1750, 2: 1600, 3: 1400, 4: 1300})
    right = 0.2 if turned else -0.2
    assert found == pytest.approx({"aileron": 0.5, "tail_left": 0.2, "throttle": 0.3, "tail_right": right})
    assert signals.parameters == {"v_tail": 1.0}


@pytest.mark.parametrize(
    ("parameters", "px4"),
    [
        ({"SERVO1_FUNCTION": 73.0, "SERVO3_FUNCTION": 74.0}, False),
        ({"CA_AIRFRAME": 6.0, "PWM_MAIN_FUNC3": 101.0, "PWM_MAIN_FUNC1": 102.0}, True),
    ],
)
def test_wheels_of_two_sides_steer_by_their_difference_at_every_speed(
    parameters: Mapping[str, float], px4: bool
) -> None:
    signals = rover_signals([replace(FULL, parameters=parameters, px4=px4)])
    assert shares(signals, {1: 1750, 3: 1600}) == pytest.approx({"wheels_left": 0.5, "wheels_right": 0.2})
    assert signals.parameters == {"sides": 1.0, "differential": 1.0}


def test_a_rover_with_a_servo_and_two_motors_is_steered_by_the_servo() -> None:
    parameters = {"CA_AIRFRAME": 5.0} | outputs_of("PWM_MAIN_FUNC", (201, 101, 102))
    channels = rover_signals([replace(FULL, parameters=parameters, px4=True)]).channels
    assert [(channel.name, channel.path[0]) for channel in channels[:2]] == [
        ("steering", "servo1_raw"),
        ("throttle", "servo2_raw"),
    ]


def test_an_actuator_without_an_output_is_not_watched_and_the_others_are() -> None:
    signals = plane_signals([replace(FULL, parameters={"SERVO1_FUNCTION": 4.0, "SERVO4_FUNCTION": 0.0})])
    assert signals.undriven == {"rudder"}


def test_angles_wrap() -> None:
    wrapping = {channel.name for channel in plane_signals([FULL]).channels if channel.period}
    assert wrapping == {"roll", "pitch"}
    assert {channel.name for channel in rover_signals([FULL]).channels if channel.period} == {"yaw"}


def test_other_messages_stand_in() -> None:
    poor = with_rates(HIGHRES_IMU=0.0, RAW_IMU=50.0, LOCAL_POSITION_NED=0.0, GLOBAL_POSITION_INT=10.0)
    channels = {channel.name: channel for channel in rover_signals([poor]).channels}
    assert channels["forward_acceleration"].message == "RAW_IMU"
    assert channels["forward_acceleration"].value({"xacc": 1000}) == pytest.approx(9.80665)
    assert channels["velocity_north"].value({"vx": 250}) == pytest.approx(2.5)


@pytest.mark.parametrize(("slowest", "rate"), [(100.0, 100.0), (92.0, 100.0), (60.0, 50.0), (25.4, 25.0), (9.5, 10.0)])
def test_the_slowest_message_sets_the_rate(slowest: float, rate: float) -> None:
    assert rover_signals([FULL, with_rates(SERVO_OUTPUT_RAW=slowest)]).rate_hz == rate


@pytest.mark.parametrize("name", ["ATTITUDE", "SERVO_OUTPUT_RAW", "HIGHRES_IMU", "LOCAL_POSITION_NED"])
def test_a_missing_message_is_named(name: str) -> None:
    with pytest.raises(TelemetryError, match=f"record .*{name}"):
        rover_signals([FULL, with_rates(**{name: 0.0})])


def test_a_message_that_comes_too_seldom_is_named() -> None:
    with pytest.raises(TelemetryError, match=r"ATTITUDE comes 4\.0 times a second"):
        plane_signals([with_rates(ATTITUDE=4.0)])


def test_a_plane_needs_airspeed() -> None:
    with pytest.raises(TelemetryError, match="VFR_HUD"):
        plane_signals([FULL, replace(FULL, counts={})])
