"""Banks: the hypothesis that explains the data names the fault, and gives way when the fault has gone."""

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.sample import Given, Samples
from gains.identification.segment import Segment
from gains.plants.plant import Disturbance, Fault, Noise, Plant
from gains.synthesis.bank import compile_bank, design_bank
from gains.synthesis.gains_file import Gains
from monitor.core.bank import Choice, Washout
from monitor.estimation.affine import AffineObserver
from monitor.estimation.bank import Bank, EstimatorRun, washout_inverse, whitening
from monitor.estimation.isolation_rule import BankRule
from monitor.fitting.calibrate import bank_rule
from monitor.vehicles.multirotor.identify import MultirotorFit, multirotor_plant

DIRECTIONS = ((1.0, 0.0), (0.0, 1.0), (-0.7, 0.7))
NAMES = ("left", "right", "both")


def plant() -> Plant:
    """Return two leaky states, both measured, and three faults that depend on each other."""
    identity = np.eye(2)
    return Plant(
        name="three-in-two",
        domain="discrete",
        rate_hz=100.0,
        states=("a", "b"),
        inputs=("drive",),
        outputs=("a", "b"),
        A=0.95 * identity,
        B=np.array([[0.1], [0.1]]),
        C=identity,
        faults=tuple(
            Fault(name, "actuator", np.array(direction), rate=1.0)
            for name, direction in zip(NAMES, DIRECTIONS, strict=True)
        ),
        disturbances=tuple(Disturbance(f"w{i}", identity[:, i], 0.01) for i in range(2)),
        noises=tuple(Noise(f"n{i}", identity[:, i], 0.01) for i in range(2)),
    )


MOTORS = ("motor1", "motor2", "motor3", "motor4")
HOVER = 0.5


class Motors:
    """The bank of a quadrotor's motors, with all pairs of them, and flights with losses of some."""

    def __init__(self, rate_hz: float, axes: int) -> None:
        B = np.array([[-0.8, 0.8, 0.8, -0.8], [0.8, -0.8, 0.8, -0.8], [0.05, 0.05, -0.05, -0.05], [-4.0] * 4])[:axes]
        noise = np.array([2e-3, 2e-3, 1e-3, 0.1])[:axes]
        fit = MultirotorFit(
            rate_hz=rate_hz,
            a=np.full(3, 0.9),
            B=B,
            c=-B @ np.full(4, HOVER),
            taps=np.ones(1),
            square=0.0,
            bends=np.zeros((axes, 4, 2)),
            residual_std=noise,
            samples=10_000,
        )
        whole = multirotor_plant(fit, "quad", MOTORS, gyros=False)
        self.rate_hz, self.B, self.noise = rate_hz, B, noise
        self.gains = compile_bank(whole, design_bank(whole, rate_hz, together=tuple(combinations(MOTORS, 2))))
        u, y = self.flown([], 2000)
        self.rule = bank_rule(self.gains, [Segment(u, y)], smoothing_s=5.0 / rate_hz)

    def flown(
        self, losses: list[tuple[int, float, int, int]], rows: int, noise: float = 0.3
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return commands and outputs of a flight with losses of motors, shares of their commands, in some rows."""
        rng, noises = np.random.default_rng(3), noise * self.noise
        share = np.zeros((rows, 4))
        for motor, lost, start, end in losses:
            share[start:end, motor] = lost
        u = HOVER + 0.02 * rng.normal(size=(rows, 4))
        y, x = np.empty((rows, len(self.B))), np.zeros(len(self.B))
        keep = np.array([0.9, 0.9, 0.9, 0.0])[: len(self.B)]
        for k in range(rows):
            y[k] = x + noises * rng.normal(size=len(x))
            x = keep * x + self.B @ (u[k] * (1.0 - share[k]) - HOVER) + noises * rng.normal(size=len(x))
        return u, y

    def evidence(self, losses: list[tuple[int, float, int, int]], rows: int) -> np.ndarray:
        """Return the share of its command that each motor is said to have lost (rows, 4)."""
        return -self.run(*self.flown(losses, rows)).evidence / HOVER

    def run(self, u: np.ndarray, y: np.ndarray) -> EstimatorRun:
        bank = Bank(AffineObserver(self.gains), self.rule, MOTORS, {})
        return bank.run(Given(replace(samples_of(y, restart=True), u=u)), np.ones(len(y), np.bool_))


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((100.0, 4), marks=pytest.mark.long, id="100_hz"),
        pytest.param((5.0, 3), id="commands_at_10_hz"),
    ],
)
def motors(request: pytest.FixtureRequest) -> Motors:
    return Motors(*request.param)


@pytest.fixture(scope="module")
def gains() -> tuple[Gains, ...]:
    whole = plant()
    return compile_bank(whole, design_bank(whole))


def bank_of(gains: tuple[Gains, ...]) -> Bank:
    rule = BankRule(0.05, 0.2, 4.0, 25.0, tuple(one.faults for one in gains), (1e-5 * np.eye(2),) * 3, (False,) * 3)
    return Bank(AffineObserver(gains), rule, NAMES, {})


def samples_of(y: np.ndarray, restart: bool = False) -> Samples:
    """Return samples without a command, the first of them a restart or not."""
    index, flags = np.arange(len(y)), np.ones(len(y), np.bool_)
    none = np.zeros((len(y), 1 + y.shape[1]), np.bool_)
    return Samples(index, index, index, np.zeros((len(y), 1)), y, restart & (index == 0), flags, index, flags, none)


def run(bank: Bank, x: np.ndarray, fault: np.ndarray, seed: int) -> tuple[EstimatorRun, np.ndarray]:
    """Step bank and plant from x for 1.5 s with a constant fault vector (2,) and return the last x."""
    rng = np.random.default_rng(seed)
    y = np.empty((150, 2))
    for k in range(150):
        y[k] = x + rng.normal(0.0, 1e-3, 2)
        x = 0.95 * x + fault + rng.normal(0.0, 1e-3, 2)
    return bank.run(Given(samples_of(y)), np.ones(len(y), np.bool_)), x


@given(which=st.integers(0, 2), size=st.floats(0.2, 2.0), seed=st.integers(0, 99))
def test_the_right_fault_is_named_with_its_size_and_let_go(
    gains: tuple[Gains, ...], which: int, size: float, seed: int
) -> None:
    bank = bank_of(gains)
    during, x = run(bank, np.zeros(2), size * np.array(DIRECTIONS[which]), seed)
    assert during.unexplained[-1] == 0.0
    assert during.evidence[-1, which] == pytest.approx(size, rel=0.05, abs=0.02)
    assert not np.delete(during.evidence[-1], which).any()
    after, _ = run(bank, x, np.zeros(2), seed)
    assert np.abs(after.evidence[-1]).max() < 0.05


@pytest.mark.parametrize(("first", "second"), tuple(combinations(range(4), 2)))
def test_of_any_two_motors_each_loss_has_its_size_and_ends_with_its_cause(
    motors: Motors, first: int, second: int
) -> None:
    settles = 60
    together = [(first, 0.1, 200, 500), (second, 0.1, 200, 500)]
    one_after_the_other = [(first, 0.15, 700, 1300), (second, 0.1, 900, 1100), (second, 0.2, 1100, 1500)]
    said = motors.evidence(together + one_after_the_other, 1700)
    changes = [0, 200, 500, 700, 900, 1100, 1300, 1500, 1700]
    sizes = [(0.0, 0.0), (0.1, 0.1), (0.0, 0.0), (0.15, 0.0), (0.15, 0.1), (0.15, 0.2), (0.0, 0.2), (0.0, 0.0)]
    for (start, end), size in zip(pairwise(changes), sizes, strict=True):
        expected = np.zeros(4)
        expected[[first, second]] = size
        assert np.abs(said[start + settles : end] - expected).max() < 0.03


@pytest.mark.parametrize(("first", "second"), [(0, 1), (2, 3)])
def test_two_losses_are_evidence_where_noise_leaves_open_which_single_motor_it_would_be(
    motors: Motors, first: int, second: int
) -> None:
    u, y = motors.flown([(first, 0.07, 300, 600), (second, 0.07, 300, 600)], 600, noise=1.5)
    counted = motors.run(u, y).counted[360:]
    assert counted.all()


def test_what_no_hypothesis_explains_names_no_fault(gains: tuple[Gains, ...]) -> None:
    estimates, _ = run(bank_of(gains), np.zeros(2), np.array([1.0, 1.0]), 0)
    assert estimates.unexplained[-1] > 4.0
    assert not estimates.evidence[-1].any()
    assert not estimates.counted[-1].any()


def test_each_fault_is_estimated_under_its_own_hypothesis(gains: tuple[Gains, ...]) -> None:
    estimates, _ = run(bank_of(gains), np.zeros(2), np.array([0.5, 0.0]), 1)
    assert estimates.fault[-1, 0] == pytest.approx(0.5, abs=0.01)
    assert abs(estimates.fault[-1, 1]) < 0.1


def test_a_restart_forgets_the_fault(gains: tuple[Gains, ...]) -> None:
    bank = bank_of(gains)
    run(bank, np.zeros(2), np.array([0.5, 0.0]), 1)
    after = bank.run(Given(samples_of(np.zeros((1, 2)), restart=True)), np.ones(1, np.bool_))
    assert np.abs(after.evidence).max() < 1e-6
    assert np.abs(after.smoothed).max() < 1e-6


def test_whitening_leaves_out_directions_without_variance() -> None:
    covariances = [np.diag([4.0, 0.0]), np.array([[2.0, 1.0], [1.0, 2.0]])]
    W = whitening(covariances)
    assert W[0].T @ W[0] == pytest.approx(np.diag([0.25, 0.0]))
    assert W[1].T @ W[1] == pytest.approx(np.linalg.inv(covariances[1]))


class Choices:
    """A choice among hypotheses of one fault each, and of two, whose J and estimates are given row by row."""

    FAULTS = (("left",), ("right",), ("left", "right"))

    def __init__(
        self,
        penalty: float = 25.0,
        usual: float = 0.0,
        keep: float = 0.0,
        washed: Washout | None = None,
        lasting: float = 1.0,
        calm: float = 0.0,
    ) -> None:
        # One output, without smoothing: J is the square of the residual.
        self._choice = Choice(
            whitening=np.ones((3, 1, 1)),
            lasting=np.full((3, 1, 1), lasting),
            spans=[0, 1, 2, 4],
            channel=[0, 1, 0, 1],
            shown=[0, 1],
            scaling=[True] * 4,
            groups=[np.array([0, 1]), np.array([2])],
            own=np.array([[True, False], [False, True], [True, True]]),
            edges=[],
            washouts=[] if washed is None else [(0, washed)],
            keep=keep,
            floor=9.0,
            share=0.04,
            penalty=penalty,
            usual=usual,
            follow=0.01,
            calm=np.array([[0.0], [0.0], [calm]]),
            calm_rows=10,
        )

    def run(
        self,
        J: list[list[float]],
        fault: tuple[float, ...] | np.ndarray = (-1.0, -2.0, -3.0, -4.0),
        armed: bool = True,
        beyond: float = 1.0,
        corrected: np.ndarray | None = None,
        restart: np.ndarray | None = None,
        resumed: np.ndarray | None = None,
        y: tuple[float, ...] | None = None,
    ) -> EstimatorRun:
        count = len(J)
        flags = np.ones(count, np.uint8)
        x = np.tile(np.arange(3.0), (count, 1))[:, :, None]
        residual = np.sqrt(np.array(J))[:, :, None]
        faults = np.broadcast_to(fault, (count, 4))
        begins, larger = 0 * flags if restart is None else restart, np.full(count, beyond)
        return EstimatorRun(
            *self._choice.run(
                x,
                faults,
                residual,
                np.zeros((count, 1)) if y is None else np.array(y)[:, None],
                flags,
                flags,
                begins,
                armed * flags,
                larger,
                corrected,
                resumed,
            )
        )


def test_a_hypothesis_for_calm_is_believed_after_calm_where_it_explains_what_lasts() -> None:
    choices, J = Choices(lasting=8.0, calm=0.3), [[8.0, 8.0, 0.1]] * 200
    rows = choices.run(J, y=(*[0.5] * 100, *[0.1] * 100)).x[:, 0]
    assert (rows[:109] < 2.0).all()
    assert (rows[109:] == 2.0).all()
    # What it explains goes on in a turn; one that nothing else explains, but did not last, is no evidence for it.
    assert (choices.run(J, y=(0.5,) * 200).x[:, 0] == 2.0).all()
    sudden = Choices(calm=0.3).run([[1.0, 1.0, 1.0]] * 100 + [[90.0, 90.0, 0.1]] * 5)
    assert (sudden.x[:, 0] < 2.0).all()
    assert (sudden.unexplained[100:] > 3.0).all()


@pytest.mark.parametrize(
    ("J", "believed"),
    [
        ([[100.0, 1.0, 1.0]], 1),  # the one that explains
        ([[100.0, 100.0, 1.0]], 2),  # two faults where one does not explain
        ([[4.0, 1.0, 0.1]], 1),  # fewest faults, then the smallest J
        ([[1.0, 100.0, 1.0], [4.0, 3.0, 1.0]], 0),  # not clearly better: the one believed stays
        ([[1.0, 100.0, 1.0], [4.0, 1.0, 1.0]], 1),  # clearly better
        ([[1000.0, 30.0, 6.0]], 1),  # what model error makes of a fault that large
        ([[1000.0, 30.0, 1.0]], 2),  # two faults that explain far better than model error lets one of them
        ([[50.0, 40.0, 45.0]], 1),  # none explains: the least wrong is shown
    ],
)
def test_the_hypothesis_believed(J: list[list[float]], believed: int) -> None:
    assert Choices().run(J).x[-1, 0] == believed


def test_a_second_loss_that_is_small_beside_the_first_may_be_model_error() -> None:
    assert Choices().run([[1000.0, 30.0, 1.0]], (-1.0, -2.0, -0.4, -2.0)).x[-1, 0] == 1.0
    assert Choices().run([[1000.0, 30.0, 1.0]], (-1.0, -2.0, -0.6, -2.0)).x[-1, 0] == 2.0


def test_two_losses_that_are_small_beside_manoeuvres_are_named_by_what_lasts() -> None:
    both = [[4.0, 3.9, 0.2]] * 300
    assert Choices(lasting=2.0).run(both).x[-1, 0] < 2.0
    run = Choices(lasting=4.0).run(both)
    assert run.x[0, 0] < 2.0
    assert run.x[-1, 0] == 2.0
    # one of them explains what lasts as well as both
    assert Choices(lasting=4.0).run([[4.0, 0.3, 0.2]] * 300).x[-1, 0] == 1.0


def test_a_channel_has_a_rival_until_what_was_measured_tells_the_two_apart() -> None:
    rival = Choices().run([[2.0, 1.0, 1.0]] * 50 + [[30.0, 1.0, 1.0]] * 50).rival
    assert rival[40].tolist() == [-1, 0]
    assert rival[-1].tolist() == [-1, -1]
    assert Choices().run([[20.0, 1.0, 0.5]] * 50).rival[-1].tolist() == [-1, -1]
    # what lasts tells, too
    assert Choices(lasting=4.0).run([[4.0, 1.0, 0.5]] * 300).rival[-1].tolist() == [-1, -1]


def test_means_of_white_residuals_have_a_smaller_covariance_that_seconds_of_flight_do_not_tell() -> None:
    quad = Motors(5.0, 3)
    short = bank_rule(quad.gains, [Segment(*quad.flown([], 20))], smoothing_s=1.0)
    assert np.array(short.lasting) == pytest.approx(np.array(short.covariances))
    for mean, one in zip(quad.rule.lasting, quad.rule.covariances, strict=True):
        assert np.trace(mean) < 0.5 * np.trace(one)


def test_two_actuators_that_would_deliver_more_are_never_believed() -> None:
    assert Choices().run([[100.0, 100.0, 1.0]], (-1.0, -2.0, 3.0, -4.0)).unexplained[-1] > 0.0


def test_an_actuator_that_would_deliver_more_is_believed_only_where_it_explains_far_more() -> None:
    assert Choices().run([[1.0, 4.0, 1.0]], (1.0, -2.0, 0.0, 0.0)).x[-1, 0] == 1.0
    assert Choices(penalty=0.0).run([[1.0, 4.0, 1.0]], (1.0, -2.0, 0.0, 0.0)).x[-1, 0] == 0.0


def test_a_loss_and_a_gain_of_opposite_effect_are_told_apart_by_what_lasts() -> None:
    signs = (-1.0, 2.0, 0.0, 0.0)
    more = Choices().run([[60.0, 20.0, 2000.0]], signs)
    assert more.x[-1, 0] == 1.0
    assert more.counted.all()
    assert more.evidence[-1].tolist() == [0.0, 2.0]
    either = Choices().run([[30.0, 20.0, 2000.0]], signs)
    assert either.x[-1, 0] == 0.0
    assert not either.counted.any()
    for less in ([20.0, 30.0, 2000.0], [23.0, 20.0, 2000.0]):
        run = Choices().run([less], signs)
        assert run.x[-1, 0] == 0.0
        assert run.counted.all()
    # a gust of the weak axis does not change the name
    gust = [[1.0, 40.0, 2000.0]] * 100 + [[60.0, 20.0, 2000.0]] * 10
    assert (Choices(keep=0.8).run(gust, signs).x[:, 0] == 0.0).all()


@pytest.mark.parametrize(("noise", "told"), [(0.06, True), (1.0, False)])
def test_a_small_gain_is_told_from_a_loss_by_what_lasts_over_the_noise_of_now_and_neither_is_named_before(
    noise: float, told: bool
) -> None:
    calm = [[noise, noise, noise]] * 500
    run = Choices(usual=1.0).run([*calm, *[[8.0, 0.1 + noise, 2000.0]] * 100], (-1.0, 2.0, 0.0, 0.0))
    assert run.counted[:500].all()
    assert not run.counted[500].any()
    assert run.counted[-1].all() == told
    assert (run.evidence[-1].tolist() == [0.0, 2.0]) == told


def test_the_score_of_what_is_not_explained_is_the_root_of_the_smallest_J() -> None:
    run = Choices().run([[50.0, 36.0, 45.0], [np.nan, 1e3, 1e3], [1.0, 1.0, 1.0]])
    assert run.unexplained[0] == pytest.approx(6.0)
    assert np.isnan(run.unexplained[1])
    assert run.unexplained[2] == 0.0


@pytest.mark.parametrize("corrected", [True, False])
def test_the_residual_of_a_row_that_was_corrected_says_nothing(corrected: bool) -> None:
    J = [[1.0, 100.0, 1.0]] * 10 + [[1e6, 1e6, 1e6]] + [[1.0, 100.0, 1.0]] * 5
    run = Choices(keep=0.7).run(J, corrected=np.arange(16) == 10 if corrected else None)
    assert (run.unexplained[10:] == 0.0).all() == corrected


def test_residuals_that_stay_larger_than_those_that_were_fitted_are_the_new_measure() -> None:
    rising = [[8.0, 9.0, 8.5]] * 400 + [[20.0, 24.0, 22.0]] * 1000
    assert Choices().run(rising).unexplained[-1] == pytest.approx(np.sqrt(20.0))
    run = Choices(usual=1.0).run(rising)
    assert (run.unexplained == 0.0).all()
    assert run.level[399] == pytest.approx(8.0, rel=0.05)
    assert run.level[-1] == pytest.approx(20.0, rel=0.01)


def test_calm_lowers_the_level_but_no_score_and_nothing_is_learnt_where_nothing_is_evidence() -> None:
    calm = Choices(usual=2.0).run([[0.1, 0.2, 0.1]] * 1000 + [[40.0, 44.0, 42.0]])
    assert calm.level[-1] == pytest.approx(0.05, rel=0.1)
    assert calm.unexplained[-1] == pytest.approx(np.sqrt(40.0))
    assert (Choices(usual=2.0).run([[8.0, 8.5, 9.0]] * 1000, armed=False).level == 1.0).all()


def test_what_nothing_explains_does_not_hide_itself() -> None:
    for J in (40.0, 4000.0, np.nan):
        run = Choices(usual=2.0).run([[J, J, J]] * 1000)
        assert np.array_equal(run.unexplained, np.full(1000, np.sqrt(J)), equal_nan=True)
        assert (run.level == 1.0).all()


def test_outside_of_the_fitted_flights_only_so_much_larger_estimates_are_given_back() -> None:
    explained = [[0.0, 1.0, 1.0]] * 100
    given = [
        Choices(washed=washout_inverse(1.0, 10.0, 1.5)).run(explained, beyond=beyond).evidence[-1, 0]
        for beyond in (1.0, 2.0)
    ]
    assert given[0] < -8.0
    assert given[1] == -1.0


@pytest.mark.parametrize("by", [0, 1])
def test_what_another_fault_explained_is_not_restored_as_a_washed_out_one(by: int) -> None:
    """Of 8 m, washed out within 30 s at 10 Hz, the first 90 s are believed to be left's or right's."""
    left, right = [0.1, 100.0, 100.0], [100.0, 0.1, 100.0]
    size = np.outer(8.0 * np.exp(-np.arange(1000) / 300.0), np.ones(4))
    run = Choices(washed=washout_inverse(30.0, 10.0, 1.5)).run([*[right if by else left] * 900, *[left] * 100], size)
    # what is below half of the threshold is not restored
    assert run.evidence[-1, 0] == pytest.approx(size[-1, 0] if by else 8.0, abs=0.75)


@pytest.mark.parametrize("unseen", [200, 400])
@pytest.mark.parametrize("resumed", [True, False])
def test_a_faded_fault_is_kept_over_a_gap_until_it_ends_or_is_let_go_as_not_known(unseen: int, resumed: bool) -> None:
    """8 m, washed out within 30 s at 10 Hz; in the gap it grows to 10 m."""
    faded = np.exp(-np.arange(200) / 300.0)
    size = np.concatenate([-8.0 * faded, np.zeros(unseen), 10.0 * faded])
    restart = np.arange(len(size)) == 200
    run = Choices(washed=washout_inverse(30.0, 10.0, 1.5)).run(
        [[0.0, 1.0, 1.0]] * len(size),
        np.column_stack([size, *np.zeros((3, len(size)))]),
        restart=restart,
        resumed=restart & resumed,
    )
    if not resumed:
        assert not run.evidence[200 : 200 + unseen, 0].any()
        assert not run.let_go.any()
        return
    assert run.evidence[199 : 199 + min(unseen, 300), 0] == pytest.approx(-8.0, abs=0.1)
    assert run.let_go[200 : 200 + unseen, 0].any() == (unseen > 300)
    assert run.let_go[499:600, 0].all() == (unseen > 300)
    assert not run.evidence[200 + unseen + 15 :, 0].any()
    assert not run.let_go[-1, 0]
