"""The effectiveness part of a profile reads back as written; every mistake is one line that names file and key."""

import re
from typing import Any

import pytest

from adapters.errors import ProfileError
from adapters.toml_tables import TomlFile
from monitor.estimation.effectiveness import EffectivenessRule, effectiveness_table, read_effectiveness

INPUTS = ("steering", "throttle", "speed")
FAULTS = {"steering": 0, "throttle": 1, "gyro": None}
RULE = EffectivenessRule(
    noise=0.01,
    inflation=3.0,
    lag_s=0.04,
    loss_doubt=0.02,
    offset_doubt=0.0,
    certainty=5.5,
    least_loss=0.1,
    memories_s=(0.5, 2.0, 5.0),
    full="speed",
)


def read(content: dict[str, Any], *, bank: bool = False) -> dict[str, EffectivenessRule]:
    file = TomlFile("p.toml", {"effectiveness": content}, ProfileError)
    rules = read_effectiveness(file.root.table("effectiveness"), FAULTS, INPUTS, bank=bank)
    file.check()
    return rules


def test_rules_read_back_as_written() -> None:
    plain = EffectivenessRule(0.01, 1.0, 0.0, 0.0, 0.0, 5.0)
    rules = {"steering": RULE, "throttle": plain}
    assert read({name: effectiveness_table(rule) for name, rule in rules.items()}) == rules


def test_what_is_not_said_is_the_default() -> None:
    table = {"noise": 0.01, "inflation": 1.0, "lag_s": 0.0, "loss_doubt": 0.0, "offset_doubt": 0.0, "certainty": 5.0}
    assert read({"throttle": table}) == {"throttle": EffectivenessRule(0.01, 1.0, 0.0, 0.0, 0.0, 5.0)}


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"noise": 0.0}, "'effectiveness.steering.noise' is 0; it must be at least 1e-12"),
        ({"inflation": 0.5}, "inflation' is 0.5"),
        ({"certainty": "high"}, 'certainty\' is "high", which is not a number'),
        ({"memories_s": []}, "memories_s' is empty"),
        ({"memories_s": [0.0, 1.0]}, "memories_s[0]' is 0; it must be more than 0"),
        ({"memories_s": [1.0, 0.25]}, "memories_s' does not grow"),
        ({"memories_s": 1.0}, "memories_s' is 1, which is not a list"),
        ({"full": "airspeed"}, "full' is 'airspeed'; no such input; there are steering, throttle, speed"),
        ({"hold": 3.0}, "'effectiveness.steering.hold' is not a key of this table"),
    ],
)
def test_a_mistake_is_named_with_file_and_key(change: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ProfileError, match=re.escape(complaint)) as caught:
        read({"steering": effectiveness_table(RULE) | change})
    assert str(caught.value).startswith("p.toml: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["gyro", "rudder"])
def test_only_a_fault_that_scales_an_input_can_be_read_so(name: str) -> None:
    with pytest.raises(ProfileError, match="no fault of that name scales an input; those that do: steering, throttle"):
        read({name: effectiveness_table(RULE)})


def test_a_bank_is_refused() -> None:
    with pytest.raises(ProfileError, match="a bank's estimates"):
        read({"steering": effectiveness_table(RULE)}, bank=True)
