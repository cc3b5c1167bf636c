"""Published standard deviations hold what healthy flight shows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from adapters.logs.recordings import read_batches
from adapters.sample import Given
from monitor.chain import ObserverChain
from monitor.core.sampling import VehicleClock
from monitor.fitting.flights import flight_samples
from monitor.fitting.spread import fit_spread
from monitor.profile import Profile


def test_two_standard_deviations_hold_healthy_errors_19_times_of_20(quad_profile: Profile, data: Path) -> None:
    observer = replace(next(one for one in quad_profile.observers if one.name == "motors"), spread={})
    assert observer.model is not None
    flight = flight_samples(
        read_batches(data / "copter_wind_step.tlog.xz"), observer.source, observer.rate_hz, quad_profile.gate
    )
    found = fit_spread(observer, observer.model, quad_profile.gate, [flight])
    assert set(found.spread) == set(found.moves) == {channel.name for channel in observer.faults}
    measured = replace(observer, **found._asdict())
    chain = ObserverChain(measured, "quad", quad_profile.gate, VehicleClock())
    run = chain.estimate(Given(flight.samples), flight.armed)
    inside = np.abs(run.found.fault) <= 2.0 * run.noise
    assert inside[flight.armed].mean(axis=0) == pytest.approx(0.95, abs=0.02)
    # the published ones know this flight's own errors, too
    inside = np.abs(run.estimates.fault) <= 2.0 * run.estimates.sd
    held = inside[flight.armed].mean(axis=0)
    # of 14 s that are alike for seconds: gyro z has 91 %
    assert np.all((held >= 0.9) & (held <= 0.98)), held
    again = fit_spread(measured, observer.model, quad_profile.gate, [flight])
    assert list(again.spread.values()) == pytest.approx([1.0] * len(again.spread), rel=0.02)
    assert again.moves == pytest.approx(found.moves, rel=0.02)


def test_a_size_that_the_samples_hold_is_not_awaited_from_the_observer(quad_profile: Profile, data: Path) -> None:
    observer = next(one for one in quad_profile.observers if one.name == "motors")
    flight = flight_samples(
        read_batches(data / "copter_motor3_090.tlog.xz"), observer.source, observer.rate_hz, quad_profile.gate
    )
    index = next(at for at, channel in enumerate(observer.faults) if channel.name == "motor3")

    def isolated(sizes: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        chain = ObserverChain(observer, "quad", quad_profile.gate, VehicleClock())
        return chain.estimate(Given(flight.samples, sizes=sizes), flight.armed).estimates.isolated[:, index]

    own = isolated({})
    assert own.any()
    known = np.where(np.arange(len(own)) % 2 == 0, -0.5, 0.0)
    assert isolated({"motor3": known}) == pytest.approx(np.where((own != 0.0) & (known != 0.0), known, own))
