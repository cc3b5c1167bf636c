"""Whether a sagging battery takes from what commands do, told by flights."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from simulated_chain import Fault, flight

from adapters.logs.recordings import packed
from adapters.message import Message
from monitor.fitting.fitted import FitRequest
from monitor.fitting.survey import survey
from monitor.profile import read_profile
from monitor.sampling.supply import SupplyRule
from monitor.vehicles.multirotor.fit import multirotor_gate
from monitor.vehicles.multirotor.signals import multirotor_channels
from monitor.vehicles.multirotor.voltage import fit_supply
from replay.fit import fit_profile
from replay.player import play

quad = partial(flight, esc_hz=0.0, felt=True)


def found(logs: list[list[Message]]) -> SupplyRule | None:
    surveys = tuple(survey(packed(log)) for log in logs)
    request = FitRequest("quad", [partial(packed, log) for log in logs], surveys)
    return fit_supply(request, multirotor_gate(surveys), multirotor_channels(surveys)[0])


def changed(log: Iterable[Message], volts: Callable[[float], float]) -> list[Message]:
    """Return a log in which a simulator makes up the voltage, by the time in seconds."""
    return [
        replace(one, fields={**one.fields, "voltage_battery": round(1000.0 * volts((one.received_ns % 10**12) / 1e9))})
        if one.name == "SYS_STATUS"
        else one
        for one in log
    ]


def test_flights_on_a_battery_that_sags_tell_that_commands_act_with_its_voltage() -> None:
    rule = found([list(quad(seed, 60.0, sag_v=1.25 * seed)) for seed in (1, 2)])
    assert rule is not None
    assert (rule.share, rule.volts) == (1.0, pytest.approx(15.5, abs=0.5))


def test_voltages_that_hardly_differ_or_mean_nothing_leave_commands_as_they_are() -> None:
    log = list(quad(1, 40.0))
    assert found([log]) is None
    assert found([changed(log, lambda _: 12.6)]) is None
    assert found([changed(log, lambda s: 16.2 - 0.02 * s)]) is None
    assert found([[one for one in log if one.name != "SYS_STATUS"]]) is None


@pytest.mark.long
def test_a_loss_on_an_empty_battery_is_seen_as_on_a_full_one_and_sag_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = [list(quad(seed, 90.0, sag_v=1.25 * seed)) for seed in (1, 2)]
    # what a profile will detect is measured in other tests
    monkeypatch.setattr("replay.fit._measured", lambda fitted, *_: fitted)
    fit_profile("multirotor", [partial(packed, log) for log in logs], tmp_path / "quad", "quad")
    profile = read_profile(tmp_path / "quad")
    assert profile.observers[0].supply is not None
    assert not play(profile, quad(21, 180.0, sag_v=2.5)).events
    for seed, motor in ((22, 2), (23, 3)):
        fault = Fault("prop", motor, 0.1, onset_s=80.0)
        events = play(profile, quad(seed, 90.0, fault, sag_v=2.5)).events
        raised = events[0]
        assert raised.channel == f"motor{motor}"
        assert 0.0 <= raised.vehicle_time_ms / 1000 - 85.0 < 0.3
        # the first size is that of a few samples, and says how sure it is; a second later it is known
        assert raised.relative is not None and raised.estimate is not None and raised.sd is not None
        assert raised.estimate * -0.1 / raised.relative == pytest.approx(raised.estimate, abs=2.0 * raised.sd)
        told = [event for event in events if event.vehicle_time_ms - raised.vehicle_time_ms < 1100][-1]
        # sizes that differ by less than 15 % are not told again
        assert told.relative == pytest.approx(-0.1, abs=0.015)
