"""Which samples the effectiveness estimators hear, and what is known in between."""

import numpy as np

from adapters.sample import Sample
from monitor.effectiveness import Effectiveness, EffectivenessRule
from monitor.effectiveness_stage import EffectivenessStage
from monitor.profile import FaultChannel

RULE = EffectivenessRule(
    noise=0.01, inflation=1.0, lag_s=0.0, loss_doubt=0.0, offset_doubt=0.0, certainty=5.0, full="speed"
)
FAULTS = (
    FaultChannel("gyro", "sensor", "rad/s", None),
    FaultChannel("throttle", "actuator", "", 1),
    FaultChannel("steering", "actuator", "", 0),
)
STEERING = 2
STEP_NS = 20_000_000


class Clocked:
    """A stage and the time of its next sample."""

    def __init__(self) -> None:
        self.stage = EffectivenessStage({"steering": RULE}, FAULTS, ("steering", "throttle", "speed"), 50.0)
        self.now_ns = 0

    @property
    def sizes(self) -> dict[int, float]:
        return self.stage.sizes


def feed(
    one: Clocked,
    count: int,
    *,
    command: float = 0.3,
    loss: float = 0.0,
    speed: float = 1.0,
    armed: bool = True,
    restart: bool = False,
) -> Effectiveness | None:
    """Feed samples, the first marked ``restart``; return what is known of the steering after the last."""
    found: dict[int, Effectiveness] = {}
    for k in range(count):
        u = np.array([command, 0.5, speed])
        sample = Sample(k, one.now_ns, one.now_ns, u, np.zeros(1), restart and k == 0, True)
        one.now_ns += STEP_NS
        found = one.stage.judge(sample, np.array([9.0, 9.0, -loss * command]), armed)
        assert set(found) <= {STEERING}
    return found.get(STEERING)


def test_only_faults_with_a_rule_are_judged() -> None:
    one = Clocked()
    assert feed(one, 50, loss=0.5) is not None
    assert set(one.sizes) == {STEERING}
    assert one.sizes[STEERING] < -0.05


def test_the_effect_of_a_full_deflection_is_an_input() -> None:
    slow, fast = Clocked(), Clocked()
    feed(slow, 50, loss=0.5)
    feed(fast, 50, loss=0.5, speed=2.0)
    assert np.isclose(slow.sizes[STEERING], 2.0 * fast.sizes[STEERING])


def test_a_bridged_sample_is_not_heard_but_costs_nothing_that_was_learned() -> None:
    one = Clocked()
    feed(one, 50, loss=0.5)
    assert feed(one, 2, loss=-9.0, armed=False) is None
    after = feed(one, 1, loss=0.5)
    assert after is not None
    assert np.isclose(after.loss, 0.5)
    assert after.evidence


def test_after_a_long_time_without_evidence_all_begins_anew() -> None:
    one = Clocked()
    feed(one, 50, loss=0.5)
    feed(one, 60, loss=0.5, armed=False)
    assert one.sizes[STEERING] == 0.0
    after = feed(one, 1)
    assert after is not None
    assert after.loss == 0.0


def test_a_restart_forgets() -> None:
    one = Clocked()
    feed(one, 50, loss=0.5)
    after = feed(one, 1, restart=True)
    assert after is not None
    assert after.loss == 0.0


def test_an_accusation_that_cannot_be_confirmed_keeps_its_size() -> None:
    one = Clocked()
    feed(one, 50, loss=0.5)
    held = []
    for _ in range(150):
        verdict = feed(one, 1, command=0.0)
        assert verdict is not None
        held.append((verdict.evidence, one.sizes[STEERING]))
    assert all(size != 0.0 for evidence, size in held if evidence is None)


def test_absurd_numbers_from_a_network_are_no_evidence() -> None:
    one = Clocked()
    feed(one, 50, loss=0.5)
    for absurd in (1e200, float("inf"), float("nan"), -1e7):
        assert feed(one, 1, command=absurd) is None
        assert feed(one, 1, speed=absurd) is None
    assert feed(one, 50, loss=0.5) is not None
    assert one.sizes[STEERING] < -0.05
