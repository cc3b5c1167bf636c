"""What a recording says was injected, as courses that estimates should follow."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loopback import START_NS
from synthetic_run import LAYOUT, trace

from adapters.logs.mcap_log import MessageLogWriter
from adapters.message import Message
from adapters.source import MAVLINK
from replay.attacks.attack import Attack
from replay.attacks.inject import known_truth

RUN = trace(600)
GPS = replace(RUN, layout=replace(LAYOUT, faults=("gps_north", "motor1", "x", "y"), inputs=("motor1", "b", "c", "d")))
NUMBERS = {"size": None, "rate": None, "acceleration": None}


def fault(target: str, kind: str, **numbers: float) -> dict[str, Any]:
    """Return an entry of a truth, from 2 to 4 s."""
    return {
        "kind": kind,
        "target": target,
        "numbers": NUMBERS | numbers,
        "on": {"time_boot_ms": 2000},
        "off": {"time_boot_ms": 3999},
    }


def recording(folder: Path, text: str) -> Path:
    """Return a recording with a truth in its metadata."""
    with MessageLogWriter(folder / "log.mcap") as writer:
        writer.write(Message(MAVLINK, "HEARTBEAT", START_NS, {}, 1, 1))
        writer.add_metadata("truth", {"json": text})
    return folder / "log.mcap"


def courses(folder: Path, *faults: dict[str, Any]) -> dict[str, Any]:
    return known_truth(recording(folder, json.dumps({"faults": faults})), [RUN, GPS])


def test_biases_and_ramps_on_a_channel_add_up_while_they_act(tmp_path: Path) -> None:
    found = courses(tmp_path, fault("gps_north", "bias", size=8.0), fault("gps_north", "ramp", rate=1.0, size=1.5))
    times_s, sizes = found["gps_north"]
    at = {second: sizes[np.searchsorted(times_s, second)] for second in (1.0, 2.5, 3.8, 4.2)}
    assert at == {1.0: 0.0, 2.5: pytest.approx(8.5), 3.8: pytest.approx(9.5), 4.2: 0.0}


def test_a_spoof_follows_its_course(tmp_path: Path) -> None:
    times_s, sizes = courses(tmp_path, fault("gps_north", "spoof", rate=2.0))["gps_north"]
    position, _ = Attack("gps_north", "spoof", 2_000_000_000, 4_000_000_000, rate=2.0).spoof()
    assert sizes[np.searchsorted(times_s, 3.0)] == pytest.approx(position(3_000_000_000))


def test_a_loss_is_a_share_of_the_command(tmp_path: Path) -> None:
    times_s, sizes = courses(tmp_path, fault("motor1", "loss", size=0.1))["motor1"]
    acts = (times_s >= 2.0) & (times_s < 4.0)
    assert (sizes[~acts] == 0.0).all()
    # of the two observers that estimate it, the second has the command
    assert sizes[acts] == pytest.approx(-0.1 * GPS.u[acts, 0])


@pytest.mark.parametrize("text", ["", "no json", "[]", '{"faults": 3}', '{"faults": [3, {}, {"target": "gps_north"}]}'])
def test_what_cannot_be_read_is_not_known(tmp_path: Path, text: str) -> None:
    assert known_truth(recording(tmp_path, text), [GPS]) == {}


def test_kinds_without_a_course_and_channels_that_nobody_estimates_are_not_known(tmp_path: Path) -> None:
    assert courses(tmp_path, fault("gps_north", "freeze"), fault("airspeed", "bias", size=3.0)) == {}


def test_other_recordings_have_no_truth(tmp_path: Path) -> None:
    (tmp_path / "a.tlog").write_bytes(b"")
    assert known_truth(tmp_path / "a.tlog", [GPS]) == {}
