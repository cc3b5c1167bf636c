"""The battery's resistance against what was learned, and how long its charge lasts."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from simulated_chain import GATE, OHM, Fault, flight, profile_of, request

from adapters.batch import Batch
from adapters.errors import TelemetryError
from adapters.logs.recordings import packed
from adapters.message import Message
from adapters.sample import Samples, joined_samples
from monitor.display import battery_text
from monitor.fitting.fitted import Fitted
from monitor.profile import Profile
from monitor.vehicles.multirotor.battery import BatteryInputs, fit_battery
from replay.player import play

PARAMETERS = {"ohm": 0.02, "doubt": 0.001, "charge": 18_000.0}
quad = partial(flight, esc_hz=0.0, climbs=1.0)


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    found = fit_battery(request(*(list(packed(quad(seed, 45.0, sag_v=0.5 * seed))) for seed in (1, 2))), GATE)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def profile(fitted: Fitted) -> Profile:
    return profile_of(fitted)


def test_flights_tell_resistance_and_charge(fitted: Fitted) -> None:
    assert fitted.findings["ohm"] == pytest.approx(OHM, rel=0.05)
    assert fitted.findings["charge_as"] == pytest.approx(5.0 * 3600.0, rel=0.2)
    assert fitted.alarms[0].rule.threshold == 0.4


def test_a_resistance_that_doubles_is_an_alarm_that_says_what_is_left(profile: Profile) -> None:
    raised, *_ = play(profile, quad(9, 32.0, Fault("battery", 0, 1.0, onset_s=20.0))).events
    assert (raised.channel, raised.state) == ("battery", "raised")
    assert 0.0 < raised.vehicle_time_ms / 1000 - 25.0 < 10.0
    assert raised.relative is not None and 0.4 < raised.relative < 1.1
    assert raised.message.startswith("battery has ")
    assert "% more resistance than usual: " in raised.message
    assert raised.message.endswith(" min left at this current")


def in_cells(log: Iterable[Message]) -> Iterator[Message]:
    """Yield a flight whose battery reports each of its four cells, another battery beside it, the whole seldom."""
    for number, one in enumerate(log):
        if one.name == "SYS_STATUS":
            cell = one.fields["voltage_battery"] // 4
            cells = [cell, cell, cell, one.fields["voltage_battery"] - 3 * cell, *[65_535] * 6]
            fields = {name: one.fields[name] for name in ("current_battery", "battery_remaining")}
            yield replace(one, name="BATTERY_STATUS", fields={"id": 0, "voltages": cells, **fields})
            yield replace(one, name="BATTERY_STATUS", fields={"id": 1, "voltages": [5_000] * 10, **fields})
        if one.name != "SYS_STATUS" or number % 5 == 0:
            yield one


def test_cells_that_are_reported_more_often_than_the_battery_are_added_up(fitted: Fitted) -> None:
    log = list(packed(in_cells(quad(1, 45.0, sag_v=0.5))))
    of_cells = fit_battery(request(log), GATE)
    assert of_cells is not None
    assert of_cells.findings["ohm"] == pytest.approx(OHM, rel=0.05)
    assert of_cells.findings["rate_hz"] == fitted.findings["rate_hz"]
    profile = Profile("quad", "multirotor", 0, GATE, 2.0, (of_cells.profile(),), (), {}, "")
    raised, *_ = play(profile, in_cells(quad(9, 32.0, Fault("battery", 0, 1.0, onset_s=20.0)))).events
    assert (raised.channel, raised.state) == ("battery", "raised")
    assert "milliohms" in raised.message


def test_a_resistance_may_be_more_than_twice_the_usual_one(profile: Profile) -> None:
    events = play(profile, quad(9, 45.0, Fault("battery", 0, 3.0, onset_s=20.0))).events
    assert any(re.match("battery has [12][0-9]{2} % more resistance than usual: ", one.message) for one in events)


def test_half_as_much_resistance_more_is_an_alarm_of_its_size(profile: Profile) -> None:
    raised, *_ = play(profile, quad(9, 60.0, Fault("battery", 0, 0.5, onset_s=20.0))).events
    assert (raised.channel, raised.state) == ("battery", "raised")
    assert 0.0 < raised.vehicle_time_ms / 1000 - 25.0 < 30.0
    assert raised.peak is not None and 0.4 < raised.peak < 0.7


def test_a_battery_that_runs_down_is_no_fault(profile: Profile) -> None:
    assert not play(profile, quad(11, 60.0, sag_v=2.5)).events


def test_without_current_or_voltage_that_gives_way_there_is_no_observer() -> None:
    log = list(quad(1, 30.0))

    def of(**known: int) -> list[Batch]:
        changed = (replace(one, fields={**one.fields, **known}) if one.name == "SYS_STATUS" else one for one in log)
        return list(packed(changed))

    assert fit_battery(request(of(current_battery=-1)), GATE) is None
    assert fit_battery(request(of(voltage_battery=12_600)), GATE) is None
    assert fit_battery(request(list(packed(one for one in log if one.name != "SYS_STATUS"))), GATE) is None


def raw_samples(n: int) -> Samples:
    rng = np.random.default_rng(1)
    times_ns = np.arange(n, dtype=np.int64) * 100_000_000
    amps = 15.0 + rng.normal(0.0, 3.0, n)
    flags = {"restart": np.arange(n) % 97 == 0, "complete": np.ones(n, bool), "measured": np.ones(n, bool)}
    return Samples(
        index=np.arange(n, dtype=np.int64),
        vehicle_time_ns=times_ns,
        time_ns=times_ns,
        u=np.column_stack([16.0 - 0.05 * amps, amps, np.full(n, 0.5), np.zeros(n)]),
        y=np.empty((n, 0)),
        known_ns=times_ns,
        lost=np.zeros((n, 4), bool),
        **flags,
    )


def test_samples_hold_the_resistance_and_do_not_depend_on_cuts() -> None:
    raw = raw_samples(200)
    whole = BatteryInputs(PARAMETERS, 10.0, 10.0).run(raw).samples
    assert whole.u[90, 1] == pytest.approx(0.05, rel=0.02)
    assert whole.y[90, 0] == pytest.approx(2.5, rel=0.02)
    assert whole.u[90, 3] == pytest.approx(0.5 * 18_000.0 / whole.u[90, 2])
    assert whole.y[97, 0] == 1.0
    transform = BatteryInputs(PARAMETERS, 10.0, 10.0)
    cut = joined_samples([transform.run(raw.part(*ends)).samples for ends in pairwise([0, 0, 1, 2, 96, 97, 98, 200])])
    assert np.array_equal(cut.u, whole.u)
    assert np.array_equal(cut.y, whole.y)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"ohm": None}, "'ohm' is missing"),
        ({"weight": 1.0}, "'weight' is unknown"),
        ({"doubt": 0.0}, "'doubt' is not above 0"),
        ({"memory_s": 0.0}, "'memory_s' is 0; from 1 to 1000"),
    ],
)
def test_parameters_that_cannot_be_are_refused(change: dict[str, float | None], said: str) -> None:
    parameters = {name: value for name, value in {**PARAMETERS, **change}.items() if value is not None}
    with pytest.raises(TelemetryError, match=said):
        BatteryInputs(parameters, 10.0, 10.0)
    with pytest.raises(TelemetryError, match="samples at 5 Hz"):
        BatteryInputs(PARAMETERS, 10.0, 5.0)


@pytest.mark.parametrize(
    ("left_s", "said"),
    [(0.0, "0.64 V at 20 A"), (45.0, "; 45 s left"), (200.0, "; 3 min 20 s left"), (1000.0, "; 16 min left")],
)
def test_what_is_left_is_said_as_people_do(left_s: float, said: str) -> None:
    assert said in battery_text(0.032, 20.0, left_s)
