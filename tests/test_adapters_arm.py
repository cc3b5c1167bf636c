"""The simulated arm: the equations, their integration, the paper's faults, and faults of one's own."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from adapters.errors import UsageError
from adapters.simulation import arm
from adapters.simulation.arm import SCENARIOS, ArmFault, ArmRun, ArmScenario, make_fault, parse_fault, simulate_arm

A = np.array([[0, 1, 0, 0], [-48.6, -1.25, 48.6, 0], [0, 0, 0, 1], [19.5, 0, -19.5, 0]])
B = np.array([0, 21.6, 0, 0])
G = np.array([0, 0, 0, -3.33])
C = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]])
E_1 = np.array([0, 0, 0, 1])
D_F = np.array([1, 0, 0])
D_1 = np.array([0.1, -0.02, 0])


@cache
def simulated(name: str) -> ArmRun:
    """Return a whole run of a scenario; nobody may change it."""
    return simulate_arm(SCENARIOS[name])


def reference(run: ArmRun, scenario: ArmScenario, k: int) -> NDArray[np.float64]:
    """Integrate from sample k to k + 1 with DOP853 and the matrices, in pieces between the jumps of f_a."""
    from scipy.integrate import solve_ivp

    faults = [fault for fault in scenario.faults if fault.channel == "f_a"]
    first, last = float(run.t[k]), float(run.t[k + 1])
    edges = sorted({edge for fault in faults for edge in (fault.start_s, fault.stop_s) if first < edge < last})
    x = run.x[k]
    for start, stop in zip([first, *edges], [*edges, last], strict=True):
        acting = [fault.signal for fault in faults if fault.start_s <= start < fault.stop_s]

        def slope(t: float, x: NDArray[np.float64], acting: list[arm.Signal] = acting) -> NDArray[np.float64]:
            torque = run.u[k, 0] + sum(signal(t) for signal in acting)
            w_1 = 0.2 * math.sin(10 * t) if scenario.disturbed else 0.0
            return A @ x + B * torque + G * math.sin(x[2]) + E_1 * w_1

        x = solve_ivp(slope, (start, stop), x, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return x


@pytest.mark.parametrize(
    ("name", "torque"),
    [
        pytest.param(name, torque, marks=() if (place % 2 == 0) == (torque == "zero") else pytest.mark.long)
        for place, name in enumerate(SCENARIOS)
        for torque in ("zero", "tracking")
    ],
)
def test_a_sample_is_integrated_to_better_than_a_billionth(name: str, torque: arm.Torque) -> None:
    scenario = SCENARIOS[name]
    run = simulated(name) if torque == "zero" else simulate_arm(scenario, 31.0, torque=torque)
    for k in (*range(0, 3000, 600), 499, 999, 1499, 1500, 1999, 2000, 2009, 2010, 2999, 3000, 3010):
        assert np.abs(reference(run, scenario, k) - run.x[k + 1]).max() < 1e-9


def test_a_jump_between_samples_acts_from_its_exact_time() -> None:
    scenario = ArmScenario((make_fault("f_a", "step", 1.00317, 1.01741, 3.0),), disturbed=False)
    run = simulate_arm(scenario, 1.1)
    for k in (99, 100, 101, 102):
        assert np.abs(reference(run, scenario, k) - run.x[k + 1]).max() < 1e-12
    assert np.abs(run.x[100]).max() == 0.0
    assert run.f_a[:, 0].tolist() == [0.0] * 101 + [3.0] + [0.0] * 8


def test_halving_the_step_changes_nothing_that_matters(monkeypatch: pytest.MonkeyPatch) -> None:
    run = simulate_arm(SCENARIOS["case2"], 12.0)
    monkeypatch.setattr(arm, "MAX_STEP_S", arm.MAX_STEP_S / 2)
    assert np.abs(simulate_arm(SCENARIOS["case2"], 12.0).x - run.x).max() < 1e-10


@pytest.mark.parametrize("name", SCENARIOS)
def test_outputs_follow_from_state_faults_and_noise(name: str) -> None:
    run = simulated(name)
    w_2 = 0.1 * np.sin(10 * run.t) * SCENARIOS[name].disturbed
    assert np.abs(run.x @ C.T + np.outer(run.f_s, D_F) + np.outer(w_2, D_1) - run.y).max() < 1e-12


def at(run: ArmRun, time_s: float) -> tuple[float, float]:
    k = round(time_s * 100)
    return float(run.f_a[k, 0]), float(run.f_s[k, 0])


def test_the_papers_faults_are_as_printed() -> None:
    first = simulated("undisturbed")
    assert at(first, 4.99) == at(first, 35.0) == (0.0, 0.0)
    assert at(first, 5.0) == (0.0, 12.5)
    assert at(first, 20.0) == (pytest.approx(3 * math.sin(10) + 2 * math.cos(100)), 5.0)
    case1 = simulated("case1")
    assert at(case1, 20.0) == (1.0, 0.0)
    assert at(case1, 20.09)[0] == pytest.approx(1.009)
    assert at(case1, 20.1) == (0.0, 0.0)
    assert at(case1, 30.0) == (0.0, 2.0)
    case2 = simulated("case2")
    assert [at(case2, t) for t in (9.99, 10.0, 20.0, 30.0, 35.0)] == [(0, 0), (2, 0), (0, 0), (0, 2), (0, 0)]
    case3 = simulated("case3")
    wave = pytest.approx(math.sin(10) + 0.2 * math.cos(100))
    assert at(case3, 20.0) == (wave, wave)
    assert at(case3, 35.0)[1] == at(case3, 40.0)[0] == 0.0


def test_the_tracking_torque_swings_the_healthy_link() -> None:
    run = simulate_arm(ArmScenario(disturbed=False), 20.0, torque="tracking")
    assert np.abs(run.x[:, 2] - 0.5 * np.sin(0.5 * run.t)).max() < 2e-3
    assert np.ptp(run.u) > 0.1
    assert not simulate_arm(ArmScenario(disturbed=False), 1.0).x.any()


@pytest.mark.parametrize(
    ("duration", "rate", "samples"), [(1.0, 100.0, 100), (0.999, 100.0, 100), (2.0, 33.0, 66), (1e-3, 1.0, 1)]
)
def test_samples_lie_before_the_end(duration: float, rate: float, samples: int) -> None:
    run = simulate_arm(ArmScenario(), duration, rate)
    assert run.t.tolist() == [k / rate for k in range(samples)]
    assert (run.u.shape, run.y.shape, run.x.shape) == ((samples, 1), (samples, 3), (samples, 4))
    assert run.f_a.shape == run.f_s.shape == (samples, 1)


def test_faults_of_simple_kinds_are_composed() -> None:
    step, ramp, sine = (parse_fault(text) for text in ("f_a:step:1:2:0.5", "f_s:ramp:1:3:-4", "f_a:sine:1:9:2:0.25"))
    assert [step.at(t) for t in (0.9, 1.0, 1.9, 2.0)] == [0.0, 0.5, 0.5, 0.0]
    assert [ramp.at(t) for t in (0.9, 1.0, 2.0, 3.0)] == [0.0, 0.0, -2.0, 0.0]
    assert [sine.at(t) for t in (1.0, 2.0)] == [0.0, 2.0]
    assert parse_fault("f_a:sine:0:9:2").at(0.5) == pytest.approx(2.0)
    both = simulate_arm(ArmScenario((step, ArmFault("f_a", 1.5, 2.0, lambda _: 1.0))), 2.0)
    assert both.f_a[[120, 160], 0].tolist() == [0.5, 1.5]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "write CHANNEL:KIND"),
        ("f_a:step:1:2", "write CHANNEL:KIND"),
        ("f_a:step:1:2:3:4:5", "write CHANNEL:KIND"),
        ("motor:step:1:2:3", "unknown channel 'motor'; use f_a or f_s"),
        ("f_a:jump:1:2:3", "unknown kind 'jump'; use step, ramp, sine"),
        ("f_a:step:one:2:3", "write CHANNEL:KIND"),
        ("f_a:step:1:inf:3", "write CHANNEL:KIND"),
        ("f_a:step:2:2:3", "before it stops"),
        ("f_a:step:-1:2:3", "start at 0 s or later"),
    ],
)
def test_a_fault_that_cannot_be_read_is_reported(text: str, said: str) -> None:
    with pytest.raises(UsageError, match=f"fault '{text}'") as caught:
        parse_fault(text)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("duration", "rate"), [(0.0, 100.0), (-1.0, 100.0), (1.0, 0.0), (math.inf, 100.0), (math.nan, 1.0)]
)
def test_a_run_needs_a_duration_and_a_rate(duration: float, rate: float) -> None:
    with pytest.raises(UsageError, match="positive duration and rate"):
        simulate_arm(ArmScenario(), duration, rate)
