"""A made-up run for the tests of pictures: four motors, a gap, a fault on motor1, and its alarms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from loopback import START_NS

from adapters.sample import Samples
from monitor.estimate import Estimates, Layout
from monitor.event import AlarmEvent
from monitor.trace import Trace, TraceBuilder

RATE_HZ = 100
LAYOUT = Layout(
    observer="motors",
    rate_hz=float(RATE_HZ),
    inputs=("servo1", "servo2", "servo3", "servo4"),
    outputs=("rollspeed", "pitchspeed", "yawspeed", "zacc"),
    states=("p", "q", "r"),
    faults=("motor1", "motor2", "motor3", "motor 4"),
    fault_units=("fraction of full command",) * 4,
)
THRESHOLDS = {("motors", "motor1"): 0.015, ("motors", "motor2"): 0.015, ("motors", "motor3"): 0.02}
STANDBY = replace(LAYOUT, observer="standby")
BOTH_THRESHOLDS = THRESHOLDS | {("standby", name): 0.5 for name in STANDBY.faults}


def estimates(ticks: Sequence[int], rng: np.random.Generator) -> Estimates:
    """Return the estimates at ticks of the grid; motor1 loses 0.03 from tick 1000 on."""
    index, count = np.array(ticks, np.int64), len(ticks)
    fault = rng.normal(0.0, 0.002, (count, 4))
    fault[:, 0] -= 0.03 * (index >= 1000)
    samples = Samples(
        index=index,
        vehicle_time_ns=index * 10_000_000,
        time_ns=START_NS + index * 10_000_000,
        u=rng.uniform(0.4, 0.6, (count, 4)),
        y=rng.normal(size=(count, 4)),
        restart=np.isin(index, (0, 700)),
        complete=np.full(count, True),
        known_ns=np.zeros(count, np.int64),
        measured=np.full(count, True),
        lost=np.full((count, 8), False),
    )
    return Estimates(
        observer=LAYOUT.observer,
        samples=samples,
        x=rng.normal(size=(count, 3)),
        fault=fault,
        isolated=fault * 2,
        residual=rng.normal(size=(count, 4)),
        armed=index >= 100,
        sd=np.full((count, 4), 0.002),
        coasted_s=np.zeros(count),
    )


def trace(ticks: int = 1500) -> Trace:
    """Return a run with a gap from tick 600 to 700."""
    builder = TraceBuilder(LAYOUT)
    builder.extend(estimates([tick for tick in range(ticks) if not 600 <= tick < 700], np.random.default_rng(7)))
    return builder.build()


def event(tick: int, state: str, **changes: Any) -> AlarmEvent:
    """Return an event of motor1's alarm at a tick."""
    values: dict[str, Any] = {
        "id": "01J",
        "vehicle": "copter-1",
        "observer": "motors",
        "channel": "motor1",
        "kind": "actuator",
        "state": state,
        "severity": "warning",
        "estimate": -0.03,
        "relative": -0.06,
        "unit": "fraction of full command",
        "threshold": 0.015,
        "time_ns": START_NS + tick * 10_000_000,
        "vehicle_time_ms": tick * 10,
        "since_ns": START_NS + 10_200_000_000,
        "peak": -0.03,
        "message": "motor1 delivers 6 % less than commanded",
        "seq": tick,
    }
    return AlarmEvent(**(values | changes))
