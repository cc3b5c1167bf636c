"""Vibration against what throttle and motion let expect."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from simulated_chain import GATE, Fault, flight, profile_of, request
from test_monitor_excuse import event, excused, watched

from adapters.batch import of_names
from adapters.errors import ModelError, TelemetryError
from adapters.logs.recordings import packed
from monitor.alarms.excuse import Excuses
from monitor.fitting.fitted import Fitted
from monitor.profile import Profile
from monitor.vehicles.multirotor.vibration import VibrationInputs, fit_vibration
from replay.player import play


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    found = fit_vibration(request(*(list(packed(flight(seed, 40.0, esc_hz=1.0))) for seed in (1, 2))), GATE)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def profile(fitted: Fitted) -> Profile:
    return profile_of(fitted)


def test_a_propeller_out_of_balance_is_an_alarm_within_seconds(profile: Profile) -> None:
    fault = Fault("balance", 2, 5.0, onset_s=10.0, end_s=20.0)
    raised, *_, cleared = play(profile, flight(9, 35.0, fault, esc_hz=1.0)).events
    assert (raised.channel, raised.state, cleared.state) == ("vibration", "raised", "cleared")
    assert 0.0 < raised.vehicle_time_ms / 1000 - 5.0 - 10.0 < 5.0
    assert np.exp(raised.estimate) == pytest.approx(6.0, rel=0.3)
    assert raised.message.startswith("vibration is ")
    assert raised.message.endswith(" times the level expected in this flight")
    assert raised.display.endswith(" times")
    assert 0.0 < cleared.vehicle_time_ms / 1000 - 5.0 - 20.0 < 2.0


def test_clipped_samples_are_an_alarm_and_a_counter_that_begins_anew_is_none(profile: Profile) -> None:
    def clipped(seconds: float) -> int:
        return round(50.0 * min(max(seconds - 10.0, 0.0), 10.0)) if seconds < 30.0 else 0

    messages = (
        replace(message, fields={**message.fields, "clipping_1": clipped(message.fields["time_usec"] / 1e6 - 5.0)})
        if message.name == "VIBRATION"
        else message
        for message in flight(9, 40.0, esc_hz=1.0)
    )
    raised, *_, cleared = play(profile, messages).events
    assert (raised.observer, raised.channel, raised.state) == ("vibration", "clipping", "raised")
    assert (cleared.channel, cleared.state) == ("clipping", "cleared")
    assert 0.0 < raised.vehicle_time_ms / 1000 - 15.0 < 5.0
    assert raised.estimate == pytest.approx(50.0, rel=0.1)
    assert raised.message.startswith("accelerometers are at the end of their range ")
    assert raised.message.endswith(" samples/s: larger values are lost")
    assert cleared.vehicle_time_ms < 32_000


def test_what_shaken_accelerometers_measure_is_no_alarm_beside_the_vibration(fitted: Fitted) -> None:
    excuses = Excuses(fitted.excuses)
    shaken, height = watched(excuses, "accel_z"), watched(excuses, "baro")
    excuses.follow(event("clipping", "raised", 1.0))
    assert (excused(shaken, 9.0), excused(height, 9.0)) == (True, False)
    excuses.follow(event("clipping", "cleared", 10.0))
    assert (excused(shaken, 29.0), excused(shaken, 31.0)) == (True, False)


def test_vibration_that_clips_is_one_alarm(fitted: Fitted) -> None:
    excuses = Excuses(fitted.excuses)
    clipping = watched(excuses, "clipping")
    excuses.follow(event("clipping", "raised", 1.0))
    excuses.follow(event("clipping", "cleared", 2.0))
    assert not excused(clipping, 3.0)
    excuses.follow(event("vibration", "raised", 4.0))
    assert excused(clipping, 9.0)


def test_a_healthy_flight_raises_nothing(profile: Profile, fitted: Fitted) -> None:
    assert not play(profile, flight(11, 60.0, esc_hz=1.0)).events
    assert fitted.findings["left"] == pytest.approx(0.12, abs=0.08)


def test_the_mean_of_levels_and_rates_does_not_tell_whether_a_vehicle_flies() -> None:
    def quiet(fields: Mapping[str, Any]) -> dict[str, Any]:
        return {name: 0.05 * value if name.startswith("vibration_") else value for name, value in fields.items()}

    flown = [
        replace(message, fields=quiet(message.fields)) if message.name == "VIBRATION" else message
        for message in flight(1, 40.0, esc_hz=1.0)
        if message.name != "EXTENDED_SYS_STATE"
    ]
    found = fit_vibration(request(list(packed(flown))), replace(GATE, airborne_command=0.4))
    assert found is not None and found.flight_s > 30.0


def test_without_levels_there_is_no_observer_and_zeros_are_refused() -> None:
    flown = list(flight(1, 30.0, esc_hz=1.0))
    log = list(packed(flown))
    names = {name for batch in log for name in (columns.name for columns in batch.columns)} | {"HEARTBEAT"}
    assert fit_vibration(request([of_names(batch, names - {"VIBRATION"}) for batch in log]), GATE) is None
    zeros = dict.fromkeys(("vibration_x", "vibration_y", "vibration_z"), 0.0)
    still = (
        replace(message, fields={**message.fields, **zeros}) if message.name == "VIBRATION" else message
        for message in flown
    )
    with pytest.raises(ModelError, match="each level is zero"):
        fit_vibration(request(list(packed(still))), GATE)


PARAMETERS = {"motors": 4.0, "least": 1.0, "c0": 0.5, "c1": 1.0, "c2": 0.0, "c3": 0.0}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"c2": None}, "'c2' is missing"),
        ({"weight": 1.0}, "'weight' is unknown"),
        ({"motors": 0.0}, "'motors' is none of 1 to 16"),
        ({"least": 0.0}, "'least' not above 0"),
    ],
)
def test_parameters_that_cannot_be_are_refused(change: dict[str, float | None], said: str) -> None:
    parameters = {name: value for name, value in {**PARAMETERS, **change}.items() if value is not None}
    with pytest.raises(TelemetryError, match=said):
        VibrationInputs(parameters, 25.0, 5.0)
    with pytest.raises(TelemetryError, match="cannot be grouped"):
        VibrationInputs(PARAMETERS, 25.0, 4.0)
