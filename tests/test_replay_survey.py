"""Which servo outputs of a recording are motors, and what their values mean."""

import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from adapters.batch import Batch, Columns, pack
from adapters.errors import TelemetryError
from adapters.logs.recordings import packed, read_batches
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.fitting.fitted import FitRequest
from monitor.fitting.survey import Survey, of_one_vehicle, survey
from monitor.vehicles.kinds import fit_messages
from monitor.vehicles.multirotor.fit import fit_multirotor
from monitor.vehicles.multirotor.signals import CommandRange, hover_pulse, motor_commands

FLIGHTS = ("copter_healthy_square.tlog.xz", "copter_healthy_vel_gusty.tlog.xz")


def outputs_over_time(values: Mapping[int, Sequence[int]]) -> Survey:
    """Return the survey of a flight whose servo outputs had these values, one after the other."""
    count = max(map(len, values.values()))
    return survey(
        packed(
            Message(
                MAVLINK,
                "SERVO_OUTPUT_RAW",
                10_000_000 * at,
                {"time_usec": 10_000 * (at + 1), "port": 0} | {f"servo{n}_raw": v[at] for n, v in values.items()},
                1,
                1,
            )
            for at in range(count)
        )
    )


def moving(low: int, high: int, phase: int = 0, count: int = 500) -> list[int]:
    middle, half = (low + high) / 2, (high - low) / 2
    return [round(middle + half * math.sin(0.1 * at + phase)) for at in range(count)]


def test_pulses_that_move_are_motors_of_1000_to_2000_microseconds() -> None:
    switched = {5: [1000] * 500, 6: [0] * 500, 7: [1100] * 200 + [1900] * 300}
    found = outputs_over_time({n: moving(1300, 1700, n) for n in (1, 2, 3, 4)} | switched)
    assert motor_commands([found]) == CommandRange((1, 2, 3, 4), 1000.0, 2000.0)
    assert not found.idle
    assert outputs_over_time(switched).idle


@pytest.mark.parametrize(
    ("low", "high", "stop", "full"),
    [
        (150, 1000, 150.0, 1000.0),
        (500, 800, 150.0, 1000.0),
        (50, 740, 0.0, 1000.0),
        (50, 1999, 0.0, 2000.0),
        (900, 6100, 0.0, 10000.0),
    ],
)
def test_speeds_of_motors_are_recognised_and_their_range_is_gazebos_or_round(
    low: int, high: int, stop: float, full: float
) -> None:
    speeds = {n: moving(low, high, n) for n in (1, 2, 3, 4)}
    still = {5: [900] * 500, 6: [1000] * 500, 7: [0] * 500, 8: [900] * 5 + [1000] * 495, 9: moving(1200, 1800)}
    commands = motor_commands([outputs_over_time(speeds | still)])
    assert commands == CommandRange((1, 2, 3, 4), stop, full)
    assert not commands.pulses


@pytest.mark.parametrize(
    ("parameters", "said"), [({"FRAME_CLASS": 6.0}, "is a helicopter"), ({"Q_ENABLE": 1.0}, "rotors and wings")]
)
def test_what_has_no_rotors_that_are_known_is_refused_in_one_line(parameters: Mapping[str, float], said: str) -> None:
    found = outputs_over_time({n: moving(1300, 1700, n) for n in (1, 2, 3, 4)})
    with pytest.raises(TelemetryError, match=f"{said}.*--vehicle inertial"):
        motor_commands([replace(found, parameters=parameters)])


def test_motors_of_a_plane_that_hovers_at_times_are_the_outputs_that_its_parameters_say() -> None:
    stopped = {n: [1000] * 490 + moving(1300, 1700, n, 10) for n in (5, 6, 7, 8)}
    found = outputs_over_time({n: moving(1300, 1700, n) for n in (1, 2, 3, 4)} | stopped)
    functions = {f"SERVO{n}_FUNCTION": float(28 + n) for n in (5, 6, 7, 8)}
    commands = motor_commands([replace(found, parameters={"Q_ENABLE": 1.0} | functions)])
    assert commands == CommandRange((5, 6, 7, 8), 1000.0, 2000.0)
    assert hover_pulse([replace(found, parameters={"Q_ENABLE": 1.0})], commands) > 1300


def test_pulses_of_a_vehicle_that_stayed_on_the_ground_are_not_taken_for_speeds() -> None:
    idle = {n: [1000 + at % 20 for at in range(490)] + moving(1300, 1700, n, 10) for n in (1, 2, 3, 4)}
    with pytest.raises(TelemetryError, match="0 outputs that move in flight"):
        motor_commands([outputs_over_time(idle)])


def test_what_every_output_did_is_said_where_none_is_a_motor() -> None:
    found = outputs_over_time({1: [1000] * 50, 2: [900] * 5 + [1000] * 45, 3: [0] * 50, 4: moving(1300, 1700, 0, 50)})
    with pytest.raises(TelemetryError) as said:
        motor_commands([found])
    assert "servo1 always 1000, servo2 900 to 1000, servo4 1300 to 1700;" in str(said.value)
    assert "record a flight" in str(said.value)
    with pytest.raises(TelemetryError, match="Seen while armed: nothing but zero;"):
        motor_commands([outputs_over_time({1: [0] * 50})])


def as_speeds(batches: Iterator[Batch]) -> Iterator[Batch]:
    """Yield a flight with its pulses of 1000 to 2000 us as speeds of 150 to 1000."""
    for batch in batches:
        yield replace(batch, columns=tuple(map(_with_speeds, batch.columns)))


def _with_speeds(columns: Columns) -> Columns:
    if columns.name != "SERVO_OUTPUT_RAW":
        return columns
    pulses = {name: np.asarray(columns.fields[name], np.int64) for name in (f"servo{n}_raw" for n in range(1, 5))}
    speeds = {name: np.where(p, np.round(150 + 0.85 * (p - 1000)), 0).astype(np.int64) for name, p in pulses.items()}
    return columns._replace(fields={**columns.fields, **speeds})


@pytest.mark.long
def test_a_quadrotor_that_sends_speeds_is_fitted_and_the_range_is_stated(data: Path, quad_folder: Path) -> None:
    def log(path: Path) -> Iterator[Batch]:
        return as_speeds(of_one_vehicle(read_batches(path, fit_messages())))

    logs = [partial(log, data / name) for name in FLIGHTS]
    surveys = [survey(one()) for one in logs]
    fitted, _ = fit_multirotor(FitRequest("quad", logs, surveys))
    channel = fitted.source.inputs[0]
    assert (channel.scale, channel.offset) == pytest.approx((1 / 850, -150 / 850))
    assert fitted.findings["command_range"] == {"none": 150.0, "full": 1000.0}
    assert "motor commands are no pulses of 1000 to 2000 us but " in fitted.text()[1]
    assert "150 is taken as no command, 1000 as full command" in fitted.text()[1]
    assert max(fitted.findings["axis_relative_error"].values()) < 0.05
    pulses = tomllib.loads((quad_folder / "profile.toml").read_text())["observers"]["motors"]
    assert set(pulses["alarms"]) == {found.rule.channel for found in fitted.alarms}


def test_pulses_are_mapped_as_in_the_profile_that_comes_along(quad_folder: Path) -> None:
    came = Path(__file__).parent.parent / "replay" / "data" / "quad"
    channels = [
        tomllib.loads((folder / "profile.toml").read_text())["observers"]["motors"]["inputs"]
        for folder in (came, quad_folder)
    ]
    for inputs in channels:
        for channel in inputs.values():
            # the mean command, which differs from flight to flight
            channel.pop("stopped_as", None)
    assert channels[0] == channels[1]
    assert "command_range" not in (quad_folder / "fit.json").read_text()


def states(*armed: bool | None) -> Iterator[Batch]:
    """Yield motors that move for a second in each of these states, each ahead of the heartbeat that says so."""
    for second, state in enumerate(armed):
        if state is not None:
            fields = {"type": 2, "autopilot": 12, "base_mode": 128 * state}
            yield pack([Message(MAVLINK, "HEARTBEAT", second, fields, 1, 1)])
        for at in range(20):
            fields = {"time_usec": 1_000_000 * (second + 1) + 50_000 * at, "port": 0, "servo1_raw": 1500 + at}
            yield pack([Message(MAVLINK, "SERVO_OUTPUT_RAW", second, fields, 1, 1)])


def test_outputs_before_the_first_heartbeat_are_none_while_armed() -> None:
    found = survey(states(None, False))
    assert found.never_armed
    assert found.outputs == {}
    assert "SERVO_OUTPUT_RAW" in found.examples
    with pytest.raises(TelemetryError, match="never armed"):
        motor_commands([found])
    assert survey(states(None, True)).outputs[1].low == 1500
    assert not survey(states(None)).never_armed
    assert survey(states(None)).outputs[1].high == 1519


def test_the_autopilot_and_the_kind_of_recording_are_known() -> None:
    assert survey(states(True)).px4
    assert not survey(states(None)).px4
    assert not survey(states(True)).onboard


def test_a_time_field_that_is_an_array_is_no_time() -> None:
    index = np.arange(3)
    odd = Columns(MAVLINK, "ODD", 1, 1, index, index, {"time_usec": np.ones((3, 2), np.uint64)})
    assert survey([Batch(3, (odd,), {})]).rate_hz == {}
