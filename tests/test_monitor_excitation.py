"""How far a model is trusted: sizes of alarms follow rates and changes of commands, for a while, and no further."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from adapters.sample import Samples
from adapters.toml_tables import parse_toml, toml_value
from monitor.estimation.excitation import HOLD_S, ExcitationRule, ExcitationStage, excitation_table, read_excitation
from monitor.fitting.excitation import excited_variance

HZ = 50.0
RULE = ExcitationRule(
    outputs=("roll_rate",),
    constant=0.25,
    output=4.0,
    command=100.0,
    output_beyond=12.0,
    command_beyond=0.0,
    output_fitted=1.0,
    command_fitted=0.1,
)


def samples(y: NDArray[np.float64], u: NDArray[np.float64] | None = None) -> Samples:
    n = len(y)
    u = np.full(n, 0.5) if u is None else u
    always, times = np.ones(n, np.bool_), np.arange(n, dtype=np.int64) * round(1e9 / HZ)
    restart = np.arange(n) == 0
    nothing = np.zeros((n, 3), np.bool_)
    return Samples(
        np.arange(n), times, times, u[:, None], np.column_stack([y, y + 99.0]), restart, always, times, always, nothing
    )


def scale(of: Samples, rule: ExcitationRule = RULE, level: float = 1.0) -> NDArray[np.float64]:
    return ExcitationStage(rule, ("roll_rate", "other"), 1, HZ).run(of, np.full(len(of), level))[:, 2]


def test_at_rest_sizes_are_what_the_alarm_says() -> None:
    assert (scale(samples(np.zeros(100))) == 1.0).all()


def test_a_rate_counts_while_it_lasts_and_as_long_as_model_error_does() -> None:
    y = np.zeros(100)
    y[20:30] = -0.8
    s = scale(samples(y))
    held = round(HOLD_S * HZ)
    assert s[20 : 30 + held] == pytest.approx(np.sqrt(0.25 + 4.0 * 0.64))
    assert (s[:20] == 1.0).all()
    assert (s[31 + held :] == 1.0).all()


def test_what_no_fitted_flight_did_is_told_while_it_counts_and_of_the_whole_run() -> None:
    stage = ExcitationStage(RULE, ("roll_rate", "other"), 1, HZ)
    y = np.zeros(80)
    y[20:70] = 2.0
    of, calm = samples(y), samples(np.zeros(80))
    stage.run(calm, np.ones(80))
    assert stage.outside is None
    assert stage.furthest is None
    found = stage.run(of, np.ones(80))
    assert found[[0, 30], 3].tolist() == [1.0, 2.0]
    assert (
        stage.outside
        == "outside the fitted flights (rate 2 rad/s, fitted to 1): only faults 7.2 times as large are detected"
    )
    stage.run(calm, np.ones(80))
    assert stage.outside is None
    assert stage.furthest == (
        1.2,
        "outside the fitted flights: rate 2 rad/s, fitted to 1; only larger faults are detected there",
    )


def test_more_throttle_and_stronger_gusts_than_in_any_fitted_flight_are_told() -> None:
    stage = ExcitationStage(replace(RULE, throttle_fitted=0.6, gusts_fitted=2.0), ("roll_rate", "other"), 1, HZ)
    of = samples(np.zeros(50), np.full(50, 0.7))
    found = stage.run(of, np.full(50, 4.0))
    assert (stage.outside, stage.furthest) == (None, None)
    of = samples(np.zeros(50), np.full(50, 0.9))
    assert stage.run(of, np.full(50, 9.0))[:, 3].tolist() == found[:, 3].tolist() == [1.0] * 50
    told = "throttle 90 %, fitted to 60; gusts 3 times the usual, fitted to 2"
    assert stage.outside == f"outside the fitted flights ({told}): only faults 1.5 times as large are detected"
    assert stage.furthest == (1.0, f"outside the fitted flights: {told}; only larger faults are detected there")


def test_a_change_of_a_command_counts_though_nothing_turns_yet() -> None:
    u = np.full(100, 0.5)
    u[50:] = 0.7
    assert scale(samples(np.zeros(100), u))[50] == pytest.approx(np.sqrt(0.25 + 100.0 * 0.04))


def test_beyond_the_fitted_flights_sizes_grow_faster() -> None:
    s = scale(samples(np.array([1.0, 2.0])))
    assert s == pytest.approx(np.sqrt([0.25 + 4.0, 0.25 + 16.0 + 12.0 * 3.0]))


def test_errors_grow_with_the_level_of_the_residuals_from_what_they_are_at_rest() -> None:
    assert scale(samples(np.zeros(10)), level=3.0) == pytest.approx(1.0)
    assert scale(samples(np.zeros(10)), level=16.0) == pytest.approx(2.0)
    assert scale(samples(np.full(10, 0.5)), level=16.0) == pytest.approx(np.sqrt(16.0 * (0.25 + 1.0)))


@given(st.integers(0, 99), st.integers(0, 2**16))
def test_it_does_not_matter_how_samples_are_cut(at: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = samples(rng.normal(size=100), rng.uniform(size=100))
    stage = ExcitationStage(RULE, ("roll_rate", "other"), 1, HZ)
    parts = [stage.run(whole.part(0, at), np.ones(at))[:, 2], stage.run(whole.part(at, 100), np.ones(100 - at))[:, 2]]
    np.testing.assert_array_equal(np.concatenate(parts), scale(whole))


def test_a_restart_forgets() -> None:
    y = np.zeros(60)
    y[:10] = 3.0
    of = samples(y)
    of.restart[12] = True
    assert scale(of)[11] > 1.0
    assert (scale(of)[12:] == 1.0).all()


def test_the_variance_of_known_truth_is_found() -> None:
    rng = np.random.default_rng(4)
    causes = np.abs(rng.normal(size=(20_000, 2))) * [1.0, 0.1]
    sd = np.sqrt(1e-4 + 3e-4 * causes[:, 0] ** 2 + 5e-2 * causes[:, 1] ** 2)
    found = excited_variance(rng.normal(size=(20_000, 4)) * sd[:, None], causes)
    assert found == pytest.approx([1e-4, 3e-4, 5e-2], rel=0.1)


def test_the_variance_that_gusts_bring_is_told_from_that_of_calm_flight() -> None:
    rng = np.random.default_rng(5)
    causes, level = np.abs(rng.normal(size=(20_000, 2))) * [1.0, 0.1], np.repeat([0.1, 0.8, 3.0], [8_000, 8_000, 4_000])
    excited = 1e-4 + 3e-4 * causes[:, 0] ** 2 + 5e-2 * causes[:, 1] ** 2
    sd = np.sqrt(np.maximum(1.0, level) * excited + 1e-3 * level)
    found = excited_variance(rng.normal(size=(20_000, 4)) * sd[:, None], causes, level)
    assert found == pytest.approx([1e-4, 3e-4, 5e-2, 1e-3], rel=0.1)


def test_calm_air_makes_sizes_smaller_only_by_what_gusts_bring() -> None:
    gusty = replace(RULE, constant=2.0, residuals=4.0)
    still = samples(np.zeros(10))
    for level, square in ((0.0, 2.0), (0.25, 3.0), (1.0, 6.0), (2.0, 12.0)):
        assert scale(still, gusty, level) == pytest.approx(np.sqrt(square))


def test_the_rule_reads_back_as_it_was_written() -> None:
    text = "\n".join(f"{key} = {toml_value(value)}" for key, value in excitation_table(RULE).items())
    assert read_excitation(parse_toml("p.toml", text.encode(), ValueError).root, ("roll_rate",)) == RULE
