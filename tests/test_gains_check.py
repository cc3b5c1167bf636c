"""A person learns what can be estimated, why the rest cannot, and what would mend it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gains_samples import hexacopter, integrator_with_drift, multirotor, random_plant
from hypothesis import given, settings
from hypothesis import strategies as st

import fauio
from adapters.errors import ModelError
from gains.analysis.check import check_plant, check_report, check_text
from gains.analysis.estimability import check_existence
from gains.plants.model_file import builtin_model, write_model
from gains.plants.plant import Fault, FloatArray, Plant


def messages(plant: Plant) -> list[str]:
    return [problem["message"] for problem in check_report(check_plant(plant))["problems"]]


def conditions(plant: Plant) -> set[str]:
    return {problem["condition"] for problem in check_report(check_plant(plant))["problems"]}


def tracker(faults: tuple[Fault, ...], C: FloatArray, outputs: tuple[str, ...]) -> Plant:
    """Return a mass with a motor: position, velocity."""
    return Plant(
        name="tracker",
        states=("position", "velocity"),
        inputs=("force",),
        outputs=outputs,
        A=np.array([[0.0, 1.0], [0.0, -0.5]]),
        B=np.array([[0.0], [1.0]]),
        C=C,
        faults=faults,
    )


@pytest.mark.parametrize("rate", [None, 10.0, 1000.0])
@pytest.mark.parametrize("name", ["arm", "arm-disturbed"])
def test_both_faults_of_the_arm_can_be_estimated(name: str, rate: float | None) -> None:
    check = check_plant(builtin_model(name), rate)
    assert check.estimable
    assert check.estimability.sets == (("motor", "encoder"),)
    assert (check.pairs, check.late, check.explanations) == ((), (), ())


def test_an_attacked_position_needs_another_sensor_or_a_leak() -> None:
    assert messages(integrator_with_drift()) == [
        "gps_offset cannot be told from position drift: no other position sensor; add one, or a leak of 1/60 s"
    ]
    continuous = tracker((Fault("gps_offset", "sensor", np.array([1.0, 0])),), np.eye(2), ("gps", "speed"))
    assert messages(continuous) == messages(integrator_with_drift())


def test_what_is_proposed_mends_it() -> None:
    plant = integrator_with_drift()
    assert check_plant(replace(plant, A=plant.A - np.diag([1.0 / 600.0, 0.0]))).estimable
    fault = Fault("gps_offset", "sensor", np.array([1.0, 0, 0]))
    second = replace(plant, outputs=("gps", "speedometer", "lidar"), C=np.eye(3, 2), noises=(), faults=(fault,))
    second = replace(second, C=np.array([[1.0, 0], [0, 1.0], [1.0, 0]]))
    assert check_plant(second).estimable


def test_an_attack_on_all_sensors_of_an_oscillation_names_its_frequency() -> None:
    plant = tracker((Fault("gps_offset", "sensor", np.array([1.0])),), np.array([[1.0, 0.0]]), ("gps",))
    plant = replace(plant, A=np.array([[0.0, 1.0], [-39.478417604357434, 0.0]]))
    (message,) = messages(plant)
    assert message.startswith("gps_offset cannot be told from velocity and position oscillation at 1 Hz: no other sen")
    assert "add a sensor of position or velocity" in message


def test_the_hexacopter_can_have_most_sets_of_four_motors() -> None:
    check = check_plant(hexacopter())
    assert not check.estimable
    assert len(check.estimability.sets) == 12
    assert {len(found) for found in check.estimability.sets} == {4}
    opposite = {("motor1", "motor2", "motor4", "motor5"), ("motor2", "motor3", "motor5", "motor6")}
    opposite.add(("motor1", "motor3", "motor4", "motor6"))
    assert {problem.faults for problem in check.estimability.problems} == opposite
    assert check.pairs == ()
    assert "6 faults for 4 outputs: at most 4 can be estimated together" in check_text(check)


def test_every_set_reported_can_be_designed_for() -> None:
    plant = hexacopter()
    for found in check_plant(plant).estimability.sets:
        part = replace(plant, faults=tuple(fault for fault in plant.faults if fault.name in found))
        assert check_existence(part) == ()


def test_many_faults_are_explained_in_part_with_a_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gains.analysis.estimability.LARGEST_TEST_COUNT", 100)
    rng = np.random.default_rng(0)
    n = 6
    faults = tuple(Fault(f"f{i}", "actuator", rng.normal(size=n)) for i in range(12))
    states = tuple(f"x{i}" for i in range(n))
    plant = Plant("many", states, (), states, -np.eye(n), np.zeros((n, 0)), np.eye(n), faults=faults)
    check = check_plant(plant)
    assert not check.estimability.complete
    assert not check.estimable
    assert {len(found) for found in check.estimability.sets} == {6}
    (problem,) = check.estimability.problems
    assert len(problem.faults) == 7
    assert "the search was stopped" in check_text(check)


def test_pairs_are_alike_at_every_frequency_or_only_when_constant() -> None:
    alike = multirotor()
    alike = replace(alike, faults=(*alike.faults[:1], Fault("twin", "actuator", 2.0 * alike.B[:, 0])))
    (pair,) = check_plant(alike).pairs
    assert (pair.faults, pair.strength) == (("motor1", "twin"), "strong")
    assert messages(alike) == ["motor1 and twin cannot be told apart: they do the same; leave one out"]
    faults = (Fault("f", "actuator", np.array([1.0, 0, 0])), Fault("g", "actuator", np.array([0, 1.0, 0])))
    A = np.array([[-1.0, 0, 0], [0, -2.0, 0], [1.0, 0, -1.0]])
    C = np.array([[1.0, 2.0, 0], [1.0, 2.0, 0]])
    merged = Plant("merged", ("quick", "lazy", "mean"), (), ("a", "b"), A, np.zeros((3, 0)), C, faults=faults)
    assert [pair.strength for pair in check_plant(merged).pairs] == ["strong"]
    weak = replace(merged, C=np.array([[1.0, 2.0, 0], [1.0, 0, -1.0]]))
    (pair,) = check_plant(weak).pairs
    assert pair.strength == "weak"
    (message,) = messages(weak)
    assert message.startswith(
        "f and g cannot be told apart once they are constant; add a sensor of quick, lazy or mean"
    )


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.integers(0, 2), st.integers(0, 1), st.floats(0, 4))
def test_random_plants_that_meet_the_conditions_are_estimable(seed: int, a1: int, a2: int, decades: float) -> None:
    if a1 + a2:
        assert check_plant(random_plant(seed, a1, a2, decades=decades)).estimable


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.floats(0, 3))
def test_random_plants_whose_constant_faults_cancel_fail_condition_two(seed: int, decades: float) -> None:
    rng = np.random.default_rng(seed)
    plant = random_plant(seed, 2, 0, decades=decades)
    if len(plant.states) < 3:
        return
    steady = np.linalg.solve(np.eye(len(plant.A)) - plant.A, plant.E_f @ rng.normal(size=2))
    weights = steady / plant.state_errors**2
    C = plant.C - np.outer(plant.C @ steady, weights) / np.sum((steady / plant.state_errors) ** 2)
    assert conditions(replace(plant, C=C)) == {"condition II"}


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.floats(1.0, 1.3), st.floats(0, 3))
def test_random_plants_whose_attack_hides_a_mode_that_stays_fail_detectability(
    seed: int, pole: float, decades: float
) -> None:
    plant = random_plant(seed, 0, 1, decades=decades)
    values, vectors = np.linalg.eig(plant.A)
    real = [i for i in range(len(values)) if values[i].imag == 0.0]
    if not real:
        return
    mode, left = vectors[:, real[0]].real, np.linalg.inv(vectors)[real[0]].real
    A = plant.A + (pole - values[real[0]].real) * np.outer(mode, left)
    C = plant.C - np.outer(plant.C @ mode, left)
    C += np.outer(plant.D_f[:, 0], left)
    assert conditions(replace(plant, A=A, C=C)) == {"detectability of (L1 A_z, Cb)"}


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.sampled_from(["actuator", "sensor"]))
def test_random_plants_with_a_repeated_direction_fail_its_rank(seed: int, kind: str) -> None:
    plant = random_plant(seed, int(kind == "actuator"), int(kind == "sensor"))
    twin = replace(plant.faults[0], name="twin", column=-3.0 * plant.faults[0].column)
    symbol = "E_f" if kind == "actuator" else "D_f"
    assert conditions(replace(plant, faults=(*plant.faults, twin))) == {f"rank of {symbol}"}


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 100_000))
def test_the_check_agrees_with_the_synthesis_on_plants_full_of_coincidences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, p = rng.integers(1, 5), rng.integers(1, 5)
    columns = [rng.integers(-1, 2, n).astype(float) for _ in range(rng.integers(0, 3))]
    faults = [Fault(f"m{i}", "actuator", column) for i, column in enumerate(columns) if column.any()]
    columns = [rng.integers(-1, 2, p).astype(float) for _ in range(rng.integers(1, 3))]
    faults += [Fault(f"s{i}", "sensor", column) for i, column in enumerate(columns) if column.any()]
    if not faults:
        return
    A, C = 0.5 * rng.integers(-1, 2, (n, n)), rng.integers(-1, 2, (p, n)).astype(float)
    names = tuple(f"x{i}" for i in range(n)), tuple(f"y{i}" for i in range(p))
    plant = Plant("coincidence", names[0], (), names[1], A, np.zeros((n, 0)), C, faults=tuple(faults))
    check = check_plant(plant)
    json.dumps(check_report(check), allow_nan=False)
    assert check_text(check).startswith("coincidence: ")
    try:
        check_existence(plant)
    except ValueError:
        assert not check.estimable
    else:
        assert check.estimable


def test_a_sensor_that_only_repeats_the_attack_shows_nothing() -> None:
    attack = Fault("attack", "sensor", np.array([1.0, -1.0]))
    plant = Plant(
        "twice", ("x",), (), ("a", "b"), np.zeros((1, 1)), np.zeros((1, 0)), np.array([[1.1], [-1.1]]), faults=(attack,)
    )
    assert conditions(plant) == {"detectability of (L1 A_z, Cb)"}


def test_a_hidden_mode_of_the_plant_itself_is_said_first() -> None:
    plant = tracker((Fault("motor", "actuator", input="force"),), np.array([[0.0, 1.0]]), ("speed",))
    check = check_plant(plant)
    assert check.estimability.sets == ()
    assert messages(plant)[0].startswith(
        "position shows in no output although drift there does not decay; add a sensor of position, or a leak"
    )


def test_zeros_are_reported_with_what_moves_and_how_fast() -> None:
    plant = tracker((Fault("gps_offset", "sensor", np.array([1.0, 0])),), np.eye(2), ("gps", "speed"))
    plant = replace(plant, A=plant.A - np.diag([0.1, 0.0]))
    check = check_plant(plant)
    (zero,) = check.zeros
    assert (zero.of, zero.faults, zero.states) == ("sensor faults", ("gps_offset",), ("position",))
    assert zero.s == pytest.approx(-0.1)
    assert "gps_offset and position move unseen together: decays with time constant 10 s" in check_text(check)
    (sampled,) = check_plant(plant, 50.0).zeros
    assert sampled.s == pytest.approx(-0.1, rel=1e-6)


def test_the_zero_of_a_motor_is_found_and_does_not_forbid_it() -> None:
    plant = tracker((Fault("motor", "actuator", input="force"),), np.array([[2.0, -1.0]]), ("mix",))
    check = check_plant(plant)
    assert check.estimable
    assert [zero.s for zero in check.zeros] == [pytest.approx(2.0)]
    assert check.zeros[0].of == "all faults"


def test_a_fault_that_reaches_its_sensor_by_detour_is_seen_late() -> None:
    plant = tracker((Fault("motor", "actuator", input="force"),), np.array([[1.0, 0.0]]), ("gps",))
    assert check_plant(plant).late == ("motor",)
    assert "seen late     motor" in check_text(check_plant(plant))


def test_the_structure_matrix_tells_steady_ramp_change_and_none_apart() -> None:
    plant = tracker(
        (Fault("motor", "actuator", input="force"), Fault("gps_offset", "sensor", np.array([1.0, 0, 0]))),
        np.array([[1.0, 0], [0, 1.0], [0, 0]]),
        ("gps", "speed", "nothing"),
    )
    structure = check_plant(plant).structure
    assert structure["motor"] == {"gps": "ramp", "speed": "steady", "nothing": "none"}
    assert structure["gps_offset"] == {"gps": "steady", "speed": "none", "nothing": "none"}
    jolt = replace(plant, C=np.array([[0, -0.5], [0, 1.0], [0, 0]]), A=np.array([[0.0, 1.0], [-1.0, -0.5]]))
    assert check_plant(jolt).structure["motor"]["speed"] == "change"


def test_a_plant_without_faults_is_refused() -> None:
    with pytest.raises(ModelError, match="nothing to estimate"):
        check_plant(replace(multirotor(), faults=()))


def test_the_command_prints_for_people_and_says_by_its_status_whether_all_is_well(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fauio.main(["check", "arm"]) == 0
    assert capsys.readouterr().out.startswith("arm: 2 faults, 3 outputs: all can be estimated together\n")
    write_model(hexacopter(), tmp_path / "hexacopter.toml")
    assert fauio.main(["check", str(tmp_path / "hexacopter.toml")]) == 3
    captured = capsys.readouterr()
    assert captured.out.startswith("hexacopter at 100 Hz: 6 faults, 4 outputs: not all can be estimated together\n")
    assert captured.err == ""
    assert fauio.main(["check", "arm", "--rate", "100", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["model"], found["rate_hz"], found["estimable"]) == ("arm", 100.0, True)


def test_a_design_for_dependent_motors_is_still_one_line_and_exit_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_model(hexacopter(), tmp_path / "hexacopter.toml")
    assert fauio.main(["design", str(tmp_path / "hexacopter.toml")]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("fauio: hexacopter: fault 'motor5': its direction (E_f) is a combination of")
    assert captured.err.count("\n") == 1
