"""Commands at the battery's voltage: what came last counts, however the telemetry is cut, and nonsense never."""

from dataclasses import asdict
from itertools import pairwise

import numpy as np
import pytest

from adapters.batch import cut, pack
from adapters.errors import ProfileError
from adapters.message import Message
from adapters.source import MAVLINK
from adapters.toml_tables import TomlFile
from monitor.sampling.supply import Supply, SupplyRule, read_supply

RULE = SupplyRule(volts=16.0, share=0.5)


def status(millivolts: int) -> Message:
    return Message(MAVLINK, "SYS_STATUS", 0, {"voltage_battery": millivolts}, 1, 1)


def attitude() -> Message:
    return Message(MAVLINK, "ATTITUDE", 0, {"time_boot_ms": 1}, 1, 1)


BATCH = pack([attitude(), status(14_400), attitude(), status(65_535), attitude(), status(16_000), attitude()])


def test_a_sample_takes_the_voltage_before_it_and_the_usual_one_before_any() -> None:
    factors = Supply(RULE).factors(BATCH, np.array([0, 1, 2, 4, 6]))
    assert factors == pytest.approx([1.0, 0.95, 0.95, 0.95, 1.0])


def test_factors_do_not_depend_on_cuts() -> None:
    whole = Supply(RULE).factors(BATCH, np.arange(BATCH.count))
    supply = Supply(RULE)
    parts = [
        supply.factors(cut(BATCH, start, stop), np.arange(stop - start)) for start, stop in pairwise([0, 1, 2, 5, 7])
    ]
    assert np.array_equal(np.concatenate(parts), whole)


def test_a_rule_reads_back_as_written() -> None:
    file = TomlFile("profile.toml", {"supply": asdict(RULE)}, ProfileError)
    assert read_supply(file.root.table("supply")) == RULE
    file.check()
