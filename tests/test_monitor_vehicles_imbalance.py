"""Which propeller is out of balance, by its line in raw accelerations."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated_chain import GATE, Fault, flight, profile_of, request

from adapters.batch import Batch, of_names
from adapters.batch import messages as messages_of
from adapters.errors import ModelError, TelemetryError
from adapters.logs.recordings import packed
from adapters.sample import Samples, joined_samples
from monitor.fitting.fitted import Fitted
from monitor.profile import Profile
from monitor.vehicles.multirotor.imbalance import ImbalanceInputs, Lines, fit_imbalance
from replay.player import play

IMU_HZ, SIZE = 400.0, 200


@pytest.fixture(scope="module")
def healthy() -> list[list[Batch]]:
    return [list(packed(flight(seed, 25.0, shaken=True))) for seed in (1, 2)]


@pytest.fixture(scope="module")
def fitted(healthy: list[list[Batch]]) -> Fitted:
    found = fit_imbalance(request(*healthy), GATE)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def profile(fitted: Fitted) -> Profile:
    return profile_of(fitted)


def raw(rpm: NDArray[np.float64], amplitude: NDArray[np.float64], seed: int = 0) -> Samples:
    """Return raw samples in which each motor pulls sideways by an amplitude (motors,) at its speed (n, motors)."""
    n = len(rpm)
    angle = np.cumsum(2.0 * np.pi / 60.0 / IMU_HZ * rpm, axis=0) + np.arange(rpm.shape[1])
    force = np.random.default_rng(seed).normal([0.0, 0.0, -9.8], 0.3, (n, 3))
    force[:, 0] += np.cos(angle) @ amplitude
    force[:, 1] += np.sin(angle) @ amplitude
    index, no = np.arange(n), np.zeros(n, np.bool_)
    times_ns = index * 2_500_000
    u = np.hstack([force, rpm])
    lost = np.zeros(u.shape, np.bool_)
    return Samples(index, times_ns, times_ns, u, np.empty((n, 0)), index == 0, ~no, times_ns, ~no, lost)


@pytest.mark.parametrize("motor", [1, *(pytest.param(motor, marks=pytest.mark.long) for motor in (2, 3, 4))])
def test_a_propeller_out_of_balance_is_named_alone_with_its_size(profile: Profile, motor: int) -> None:
    events = play(profile, flight(9 + motor, 22.0, Fault("balance", motor, 3.0, onset_s=8.0), shaken=True)).events
    assert {event.channel for event in events} == {f"prop{motor}_imbalance"}
    assert 0.0 < events[0].vehicle_time_ms / 1000 - 13.0 < 6.0
    assert max(np.exp(event.peak or 0.0) for event in events) == pytest.approx(4.0, rel=0.25)
    assert events[0].message.startswith(f"prop{motor}_imbalance is ")


def test_a_healthy_flight_raises_nothing_and_its_lines_are_the_true_ones(profile: Profile, fitted: Fitted) -> None:
    assert not play(profile, flight(11, 25.0, shaken=True)).events
    assert fitted.source.transform is not None
    parameters = fitted.source.transform.parameters
    # amplitudes at full speed, at the square of 0.6 of it in hover, along x, y and four tenths of it along z
    usual = 0.36 * np.sqrt(2.16) * np.array([0.9, 1.3, 0.7, 1.1])
    assert [np.exp(parameters[f"c{n}_0"]) for n in range(1, 5)] == pytest.approx(usual, rel=0.1)


def test_motors_that_turn_alike_share_an_imbalance_and_others_do_not() -> None:
    n = 10 * SIZE
    rpm = np.tile([5400.0, 5400.0, 5700.0, 6000.0], (n, 1))
    found = Lines(4, IMU_HZ, SIZE).run(raw(rpm, np.array([2.0, 0.0, 0.0, 0.0]))).samples
    one, two, three, four = found.y[-1]
    assert one == pytest.approx(two, rel=0.05)
    assert one == pytest.approx(np.sqrt(2.0), rel=0.15)
    assert max(three, four) < 0.2


def test_speeds_that_parted_of_late_tell_motors_apart_that_turn_alike_now() -> None:
    n = 12 * SIZE
    rpm = np.tile([5400.0, 5400.0], (n, 1))
    rpm[4 * SIZE : 10 * SIZE, 1] = 5700.0
    found = Lines(2, IMU_HZ, SIZE).run(raw(rpm, np.array([2.0, 0.0]))).samples
    assert found.y[-1, 0] > 5.0 * found.y[-1, 1]


def test_lines_do_not_depend_on_how_samples_are_cut(fitted: Fitted) -> None:
    assert fitted.source.transform is not None
    rng = np.random.default_rng(3)
    samples = raw(rng.uniform(5000.0, 6000.0, (5 * SIZE, 4)), np.ones(4))
    whole, cut = (ImbalanceInputs(fitted.source.transform.parameters, IMU_HZ, 2.0) for _ in range(2))
    edges = [0, 1, 3, 190, 201, 640, 641, len(samples)]
    parts = [cut.run(samples.part(a, b)).samples for a, b in pairwise(edges)]
    joined, expected = joined_samples([part for part in parts if len(part)]), whole.run(samples).samples
    assert joined.y.tobytes() == expected.y.tobytes()
    assert joined.u.tobytes() == expected.u.tobytes()


def test_rotors_faster_than_the_accelerometer_shows_are_no_evidence() -> None:
    rpm = np.tile([5400.0, 11_100.0], (4 * SIZE, 1))
    assert Lines(2, IMU_HZ, SIZE).run(raw(rpm, np.zeros(2))).samples.lost.all()


def test_accelerations_that_come_too_seldom_are_refused_with_the_rate_that_is_needed(
    healthy: list[list[Batch]],
) -> None:
    messages = [one for batch in healthy[0] for one in messages_of(batch)]
    kept = [one for at, one in enumerate(messages) if one.name != "HIGHRES_IMU" or at % 5 == 0]
    with pytest.raises(
        ModelError, match=r"rotors turn [89]\d times a second, accelerations come at \d+ Hz.*log them at 2"
    ):
        fit_imbalance(request(list(packed(kept))), GATE)


def test_speeds_that_come_too_seldom_are_refused_and_without_any_there_is_no_observer(
    healthy: list[list[Batch]],
) -> None:
    with pytest.raises(ModelError, match=r"the unbalanced propeller cannot be identified: speeds come at 3 Hz"):
        fit_imbalance(request(list(packed(flight(1, 25.0, esc_hz=3.0, shaken=True)))), GATE)
    names = {"HIGHRES_IMU", "ATTITUDE", "SERVO_OUTPUT_RAW", "HEARTBEAT", "EXTENDED_SYS_STATE"}
    assert fit_imbalance(request([of_names(batch, names) for batch in healthy[0]]), GATE) is None
    names = names - {"HIGHRES_IMU"} | {"ESC_STATUS"}
    assert fit_imbalance(request([of_names(batch, names) for batch in healthy[0]]), GATE) is None


PARAMETERS = {"output1": 1.0, "least": 0.3, "rpm1": 5400.0, "c1_0": 0.0, "c1_1": 2.0}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"c1_1": None}, "'c1_1' is missing"),
        ({"weight": 1.0}, "'weight' is unknown"),
        ({"rpm1": 0.0}, "is not above 0"),
        ({"least": 0.0}, "is not above 0"),
    ],
)
def test_parameters_that_cannot_be_are_refused(change: dict[str, float | None], said: str) -> None:
    parameters = {name: value for name, value in {**PARAMETERS, **change}.items() if value is not None}
    with pytest.raises(TelemetryError, match=said):
        ImbalanceInputs(parameters, 400.0, 2.0)
    with pytest.raises(TelemetryError, match="cannot be grouped"):
        ImbalanceInputs(PARAMETERS, 401.0, 2.0)
