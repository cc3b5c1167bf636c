"""Speeds and currents of motors: which controller is whose, what they follow, and faults told apart by name."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from conftest import plain_fits
from simulated_chain import Fault, flight

from adapters.errors import ModelError, TelemetryError
from adapters.logs.recordings import packed
from adapters.message import Message
from adapters.sample import Given, Samples, joined_samples
from monitor.event import AlarmEvent
from monitor.fitting.fitted import FitRequest
from monitor.fitting.survey import survey
from monitor.profile import Profile, read_profile
from monitor.sampling.gate import GateRule
from monitor.vehicles.multirotor.esc import fit_esc
from monitor.vehicles.multirotor.fit import fit_props
from monitor.vehicles.multirotor.speeds import esc_signals
from monitor.vehicles.multirotor.transform import EscInputs
from replay.fit import FitReport, fit_profile
from replay.player import play

ORDER = (1, 3, 0, 2)
"""Motor, from 0, of each controller."""


@cache
def flown_at_10_hz() -> list[Message]:
    return list(flight(1, 30.0, esc_hz=10.0))


def fit(logs: list[list[Message]], folder: Path) -> FitReport:
    with plain_fits(), pytest.MonkeyPatch.context() as patch:
        # the trim is fitted in other tests
        patch.setattr("monitor.vehicles.multirotor.fit.fit_trim", lambda *_: None)
        return fit_profile("multirotor", [partial(packed, log) for log in logs], folder, "quad")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[FitReport, Profile]:
    folder = tmp_path_factory.mktemp("chain") / "quad"
    report = fit([list(flight(seed, 45.0, order=ORDER, sag_v=0.8 * seed)) for seed in (1, 2)], folder)
    return report, read_profile(folder)


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> Profile:
    folder = tmp_path_factory.mktemp("chain") / "quad"
    fit([list(flight(seed, 45.0, esc_hz=3.0)) for seed in (1, 2)], folder)
    return read_profile(folder)


def raised(profile: Profile, fault: Fault) -> list[AlarmEvent]:
    events = play(profile, flight(9, 34.0, fault, order=ORDER, sag_v=1.0)).events
    return [event for event in events if event.state == "raised"]


def seconds_after(event: AlarmEvent, fault: Fault) -> float:
    return event.vehicle_time_ms / 1000 - 5.0 - fault.onset_s


def test_the_speeds_say_which_controller_drives_which_motor(fitted: tuple[FitReport, Profile]) -> None:
    [esc] = [one for one in fitted[0].observers if one.name == "esc"]
    assert esc.findings["controllers"] == {f"rpm{motor + 1}": f"ESC_STATUS[{at}]" for at, motor in enumerate(ORDER)}
    assert esc.findings["delay_s"] + esc.findings["lag_s"] == pytest.approx(0.04 + 0.04, abs=0.015)
    assert [channel.name for channel in esc.profile().faults] == [
        f"{kind}{n}" for kind in ("esc", "motor") for n in range(1, 5)
    ]


def test_a_controller_that_applies_less_is_named_within_half_a_second(fitted: tuple[FitReport, Profile]) -> None:
    fault = Fault("esc", 2, 0.2, onset_s=30.0)
    [event] = raised(fitted[1], fault)
    assert event.channel == "esc2"
    assert 0.0 < seconds_after(event, fault) < 0.5
    assert event.message.startswith("esc2 turns its motor ")
    assert event.message.endswith(" % slower than commanded")


def test_a_propeller_that_pushes_less_at_its_speed_is_named_and_nothing_else(
    fitted: tuple[FitReport, Profile],
) -> None:
    fault = Fault("prop", 4, 0.1, onset_s=30.0)
    [event] = raised(fitted[1], fault)
    assert (event.observer, event.channel) == ("motors", "prop4")
    assert 0.0 < seconds_after(event, fault) < 0.5
    assert event.relative == pytest.approx(-0.1, abs=0.03)
    assert event.message.endswith("less than expected at its speed")


def test_a_motor_that_draws_more_at_its_speed_is_named_and_nothing_else(fitted: tuple[FitReport, Profile]) -> None:
    fault = Fault("motor", 3, 0.3, onset_s=30.0)
    [event] = raised(fitted[1], fault)
    assert (event.observer, event.channel) == ("esc", "motor3")
    assert 0.0 < seconds_after(event, fault) < 0.5
    assert event.relative == pytest.approx(0.3, abs=0.08)
    assert "more current than expected at its speed" in event.message


def test_a_healthy_flight_with_a_sagging_battery_raises_nothing(fitted: tuple[FitReport, Profile]) -> None:
    events = play(fitted[1], flight(11, 60.0, order=ORDER, sag_v=2.5)).events
    assert [event for event in events if event.state == "raised"] == []


@pytest.mark.long
@pytest.mark.parametrize(("part", "named"), [("esc", "esc3"), ("prop", "prop3")])
def test_speeds_at_3_hz_say_within_seconds_why_a_motor_delivers_less(slow: Profile, part: str, named: str) -> None:
    fault = Fault(part, 3, 0.2, onset_s=30.0)
    events = play(slow, flight(9, 45.0, fault, esc_hz=3.0)).events
    [first] = (event for event in events if event.state == "raised")
    refined = next(event for event in events if event.part)
    assert (first.observer, first.channel, refined.channel, refined.part) == ("motors", "motor3", "motor3", named)
    assert 0.0 < seconds_after(first, fault) < 1.0
    assert 0.0 < seconds_after(refined, fault) < 5.0
    assert f"; {named} " in refined.message


def test_currents_that_say_nothing_are_left_out_and_speeds_that_follow_nothing_refused() -> None:
    rng = np.random.default_rng(1)

    def disturbed(field: str, spread: float) -> FitRequest:
        log = [
            replace(one, fields={**one.fields, field: (one.fields[field] * np.exp(rng.normal(0, spread, 4))).tolist()})
            if one.name == "ESC_STATUS"
            else one
            for one in flown_at_10_hz()
        ]
        return FitRequest("quad", [lambda: packed(log)], (survey(packed(log)),))

    found = fit_esc(disturbed("current", 1.0), GateRule())
    assert found is not None
    assert [channel.name for channel in found.profile().faults] == ["esc1", "esc2", "esc3", "esc4"]
    assert found.lines[-1].startswith("currents are not watched: they follow speeds within ")
    with pytest.raises(ModelError, match="speeds of motors do not follow their commands"):
        fit_esc(disturbed("rpm", 1.0), GateRule())


def test_currents_that_never_change_are_no_measurements() -> None:
    log = [
        replace(one, fields={**one.fields, "current": [0.8] * 4}) if one.name == "ESC_STATUS" else one
        for one in flown_at_10_hz()
    ]
    found = fit_esc(FitRequest("quad", [lambda: packed(log)], (survey(packed(log)),)), GateRule())
    assert found is not None
    assert [channel.name for channel in found.profile().faults] == ["esc1", "esc2", "esc3", "esc4"]


def test_speeds_without_a_voltage_do_not_stand_in_for_commands() -> None:
    log = flown_at_10_hz()
    known = esc_signals([survey(packed(log))], 4)
    assert known is not None
    assert known.measured
    simulated = [
        replace(message, fields={**message.fields, "voltage": [0.0] * 4}) if message.name == "ESC_STATUS" else message
        for message in log
    ]
    request = FitRequest("quad", [lambda: packed(simulated)], (survey(packed(simulated)),))
    assert fit_props(request, GateRule()) is None
    found = fit_esc(request, GateRule())
    assert found is not None
    assert found.lines[1].endswith("; no voltage")


PARAMETERS = {
    **{
        "curves": 2.0,
        "output1": 1.0,
        "output2": 2.0,
        "volts": 16.0,
        "delay_s": 0.0,
        "lag_s": 0.0,
        "rpm1": 5000.0,
        "rpm2": 5000.0,
    },
    **{f"rpm{n}_c{term}": value for n in (1, 2) for term, value in enumerate((0.5, 1.0, 0.0, 0.5))},
}


def raw_samples(n: int) -> Samples:
    rng = np.random.default_rng(1)
    command, rpm, volts = rng.uniform(0.3, 0.7, (n, 2)), rng.uniform(4000.0, 6000.0, (n, 2)), np.full((n, 2), 15.2)
    times_ns = np.arange(n, dtype=np.int64) * 10_000_000
    flags = {"restart": np.arange(n) % 37 == 0, "complete": np.ones(n, bool), "measured": np.arange(n) % 11 != 5}
    return Samples(
        index=np.arange(n, dtype=np.int64),
        vehicle_time_ns=times_ns,
        time_ns=times_ns,
        u=np.hstack([command, rpm, volts]),
        y=np.empty((n, 0)),
        known_ns=times_ns,
        lost=np.zeros((n, 6), bool),
        **flags,
    )


def test_an_expectation_stands_beside_the_measurement_that_comes_one_tick_later() -> None:
    raw = raw_samples(36)
    given = EscInputs(PARAMETERS, 100.0, 50.0).run(raw).samples
    means = raw.u.reshape(-1, 2, 6).mean(axis=1)
    assert given.u == pytest.approx(0.5 + means[:, :2] * (1.0 + 1.5 * (15.2 / 16.0 - 1.0)))
    assert given.y[1:] == pytest.approx(means[:-1, 2:4] / 5000.0)


def test_a_measurement_stands_beside_what_was_expected_when_it_was_made() -> None:
    raw = raw_samples(36)
    u = raw.u.copy()
    u[:, 2:4] = u[raw.index // 10 * 10, 2:4]
    given = EscInputs(PARAMETERS, 100.0, 10.0).run(replace(raw, u=u)).samples
    assert len(given) == 3
    assert given.u == pytest.approx(0.5 + u[[0, 10, 20], :2] * (1.0 + 1.5 * (15.2 / 16.0 - 1.0)))
    assert given.y[1:] == pytest.approx(u[[0, 10], 2:4] / 5000.0)


def test_speeds_follow_command_times_voltage_and_currents_the_power_over_it() -> None:
    raw = raw_samples(36)
    u = np.hstack([raw.u[:, :4], np.full((36, 2), 8.0), raw.u[:, 4:]])
    current = {f"amps{n}_c{term}": value for n in (1, 2) for term, value in enumerate((0.1, 0.0, 0.0, 0.9))}
    parameters = {**PARAMETERS, **current, "amps1": 10.0, "amps2": 10.0, "rpm1_c2": -0.2}
    given = EscInputs(parameters, 100.0, 100.0).run(replace(raw, u=u, lost=np.zeros((36, 8), bool))).samples
    applied = raw.u[:, 0] * 15.2 / 16.0
    assert given.u[:, 0] == pytest.approx(0.5 + applied - 0.2 * applied**2 + 0.5 * raw.u[:, 0] * (15.2 / 16.0 - 1.0))
    assert given.u[:, 3] == pytest.approx(0.1 + 0.9 * (raw.u[:, 3] / 5000.0) ** 3 * 16.0 / 15.2)


def test_below_the_least_command_that_was_flown_and_until_its_lag_has_passed_nothing_is_known() -> None:
    raw = raw_samples(36)
    u = raw.u.copy()
    u[9, 1] = 0.1
    parameters = {**PARAMETERS, "least": 0.2, "lag_s": 0.02}
    given = EscInputs(parameters, 100.0, 50.0).run(replace(raw, u=u, measured=np.ones(36, bool))).samples
    # a hundredth of a second at 0.09 s is 39 % of what is expected after it, and 1 % after 3.7 lags: until 0.17 s
    assert np.flatnonzero(given.lost.any(axis=1)).tolist() == [4, 5, 6, 7, 8]
    whole = EscInputs({**parameters, "least": 0.0}, 100.0, 50.0).run(replace(raw, u=u, measured=np.ones(36, bool)))
    assert not whole.samples.lost.any()


@pytest.mark.parametrize("cut", [0, 9, 10, 20])
def test_commands_that_change_faster_than_was_flown_are_no_evidence_however_samples_are_cut(cut: int) -> None:
    raw = raw_samples(36)
    u = np.hstack([np.full((36, 2), 0.5), raw.u[:, 2:]])
    u[10:, 1] = 0.6
    raw = replace(raw, u=u, measured=np.ones(36, bool))
    # measurements come a tick later
    for fastest, rows in ((9.0, [10, 11]), (11.0, [])):
        transform = EscInputs({**PARAMETERS, "fastest": fastest}, 100.0, 100.0)
        parts = [transform.run(raw.part(*part)).samples for part in ((0, cut), (cut, 36))]
        lost = np.vstack([part.lost for part in parts])
        assert np.flatnonzero(lost.any(axis=1)).tolist() == rows


@pytest.mark.parametrize("cut", [0, 9, 10, 20])
def test_beyond_the_commands_that_were_flown_sizes_are_larger_however_samples_are_cut(cut: int) -> None:
    raw = raw_samples(36)
    u = np.hstack([np.full((36, 2), 0.5), raw.u[:, 2:]])
    u[10:15, 1] = 0.8
    raw = replace(raw, u=u, measured=np.ones(36, bool))
    transform = EscInputs({**PARAMETERS, "most": 0.6, "doubt": 100.0}, 100.0, 100.0)
    given = [transform.run(raw.part(*part)) for part in ((0, cut), (cut, 36))]
    beyond = np.concatenate([part.beyond for part in given if part.beyond is not None])
    # measurements come a tick later
    assert beyond == pytest.approx(np.where((np.arange(36) >= 10) & (np.arange(36) <= 15), 5.0, 1.0))
    assert not any(part.samples.lost.any() for part in given)


def test_what_is_lost_for_it_was_never_flown_is_told() -> None:
    raw = raw_samples(36)
    u = raw.u.copy()
    u[9, 1] = 0.1
    transform = EscInputs({**PARAMETERS, "least": 0.2}, 100.0, 100.0)
    given = transform.run(replace(raw, u=u, measured=np.ones(36, bool)))
    assert given.unflown is not None
    assert given.unflown.any()
    assert (given.unflown == given.samples.lost.all(axis=1)).all()


def test_speeds_that_come_once_a_second_are_not_judged() -> None:
    log = list(flight(1, 25.0, esc_hz=1.0))
    assert fit_esc(FitRequest("quad", [lambda: packed(log)], (survey(packed(log)),)), GateRule()) is None


def test_nothing_given_has_the_shape_of_samples() -> None:
    raw = raw_samples(36)
    transform = EscInputs(PARAMETERS, 100.0, 50.0)
    nothing, given = transform.run(raw.part(0, 0)).samples, transform.run(raw).samples
    assert len(nothing) == 0
    assert (nothing.u.shape[1], nothing.y.shape[1], nothing.lost.shape[1]) == (
        given.u.shape[1],
        given.y.shape[1],
        given.lost.shape[1],
    )


def test_samples_do_not_depend_on_cuts() -> None:
    raw = raw_samples(200)

    def parts(cuts: list[int]) -> Iterator[Given]:
        transform = EscInputs(PARAMETERS, 100.0, 50.0)
        for start, stop in pairwise(cuts):
            yield transform.run(raw.part(start, stop))

    [whole] = parts([0, 200])
    cut = joined_samples([given.samples for given in parts([0, 1, 2, 3, 50, 51, 74, 75, 76, 199, 200])])
    for name in ("index", "u", "y", "restart", "complete", "measured", "lost"):
        assert np.array_equal(getattr(cut, name), getattr(whole.samples, name)), name


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"rpm1_c2": None}, "'rpm1_c2' is missing"),
        ({"amps3": 1.0}, "'amps1' is missing"),
        ({"weight": 1.0}, "'weight' is unknown"),
        ({"curves": 1.0}, "'curves' is 1; it has to be 2"),
        ({"lag_s": -1.0}, "'lag_s' is -1; from 0 to 2"),
        ({"rpm2": 0.0}, "'rpm2' is 0; that of hover must be above 0"),
    ],
)
def test_parameters_that_cannot_be_are_refused(change: dict[str, float | None], said: str) -> None:
    parameters = {name: value for name, value in {**PARAMETERS, **change}.items() if value is not None}
    with pytest.raises(TelemetryError, match=said):
        EscInputs(parameters, 100.0, 50.0)
    with pytest.raises(TelemetryError, match="cannot be grouped"):
        EscInputs(PARAMETERS, 100.0, 30.0)
