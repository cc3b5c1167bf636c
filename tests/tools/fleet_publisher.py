"""Simulated monitors for displays: what they publish on Zenoh, without a vehicle behind them."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import zenoh

from adapters.sample import Samples
from monitor.bus.operators import Operators
from monitor.bus.publisher import Publisher
from monitor.estimate import Estimates, Layout
from monitor.event import AlarmEvent

MOTORS = tuple(f"motor{k}" for k in range(1, 5))
INERTIAL = ("gps_north", "gps_east", "baro")
LAYOUTS = (
    Layout("motors", 10.0, (), ("gyro_x", "gyro_y", "gyro_z"), (), MOTORS, ("fraction of full command",) * 4),
    Layout("inertial", 10.0, (), ("x", "y", "height"), (), INERTIAL, ("m",) * 3),
)
THRESHOLDS = {"motors": 0.015, "inertial": 5.0}
LATITUDE, LONGITUDE = 47.3977, 8.5456


class SimulatedMonitor:
    """One monitor: a vehicle that flies circles, whose GPS is pulled away while an alarm says so."""

    def __init__(self, session: zenoh.Session, name: str, number: int = 0, allow: Sequence[str] = ()) -> None:
        self.name = name
        self.number = number
        self.active: dict[str, AlarmEvent] = {}
        self._random = np.random.default_rng(number)
        self._publisher = Publisher(session, name, LAYOUTS)
        self._operators = Operators(session, f"fauio/{name}", allow)
        self._seq = 0
        self._texts: list[dict[str, Any]] = []

    def estimates(self, time_s: float) -> None:
        """Publish an estimate of each observer."""
        for layout in LAYOUTS:
            scale = THRESHOLDS[layout.observer]
            fault = self._random.normal(0.0, 0.15 * scale, len(layout.faults))
            isolated = np.zeros(len(fault))
            for k, channel in enumerate(layout.faults):
                if (event := self.active.get(channel)) is not None and event.estimate is not None:
                    isolated[k] = fault[k] = fault[k] + event.estimate
            times = np.array([round(time_s * 1e9)])
            lost = np.zeros((1, len(layout.outputs)), bool)
            false, true = np.zeros(1, bool), np.ones(1, bool)
            y = self._random.normal(0.0, 0.1, (1, len(layout.outputs)))
            samples = Samples(times, times, times, np.empty((1, 0)), y, false, true, times, true, lost)
            sd = np.full((1, len(fault)), 0.2 * scale)
            zero = np.zeros(1)
            self._publisher.estimates(
                Estimates(layout.observer, samples, np.empty((1, 0)), fault[None], isolated[None], y, true, sd, zero)
            )

    def status(self, time_s: float, state: str = "monitoring", **changes: Any) -> None:
        """Publish the status."""
        turn = time_s / 40.0 + self.number
        place = [LATITUDE + 3e-4 * math.sin(turn), LONGITUDE + 4e-4 * math.cos(turn), 510.0 + 5.0 * math.sin(turn / 2)]
        mode = 5 if int(time_s / 60) % 2 else 3
        self._publisher.status(
            {
                "state": state,
                "reasons": [],
                "vehicle": self.name,
                "time_ns": round(time_s * 1e9),
                "messages_per_s": 300.0 + self._random.normal(0.0, 5.0),
                "latency_ms": 3.0 + abs(self._random.normal()),
                "links": {"udpin:127.0.0.1:14550": {"lost_share": 0.002, "delay_s": 0.006, "jitter_s": 0.002}},
                "watching": {
                    layout.observer: {"share": 0.97, "last_ns": 1, "why_not": None, "sensors": {}} for layout in LAYOUTS
                },
                "channels": {
                    layout.observer: {
                        fault: {"threshold": THRESHOLDS[layout.observer], "unit": unit}
                        for fault, unit in zip(layout.faults, layout.fault_units, strict=True)
                    }
                    for layout in LAYOUTS
                },
                "facts": {
                    "heartbeat": {"type": 2, "autopilot": 3, "base_mode": 209, "custom_mode": mode},
                    "position": place,
                    "gps": place,
                    "texts": self._texts[-20:],
                },
            }
            | changes
        )

    def text(self, time_s: float, text: str, severity: int = 6) -> None:
        """Have the autopilot say something."""
        self._texts.append({"time_ns": round(time_s * 1e9), "severity": severity, "text": text})

    def alarm(self, channel: str, estimate: float, message: str, **changes: Any) -> AlarmEvent:
        """Raise an alarm."""
        observer = "motors" if channel in MOTORS else "inertial"
        now_ns = time.time_ns()
        event = AlarmEvent(
            id=f"01J{self.number:03}{now_ns:020}",
            vehicle=self.name,
            observer=observer,
            channel=channel,
            kind="actuator" if observer == "motors" else "sensor",
            state="raised",
            severity="warning",
            estimate=estimate,
            relative=2.5 * estimate if observer == "motors" else None,
            unit="fraction of full command" if observer == "motors" else "m",
            threshold=THRESHOLDS[observer],
            time_ns=now_ns,
            vehicle_time_ms=now_ns // 1_000_000,
            since_ns=now_ns,
            peak=estimate,
            message=message,
            seq=0,
        )
        return self._say(replace(event, **changes))

    def change(self, channel: str, state: Any, **changes: Any) -> AlarmEvent:
        """Say that an alarm has changed."""
        event = replace(self.active[channel], state=state, time_ns=time.time_ns(), **changes)
        self._say(event)
        if state == "cleared":
            del self.active[channel]
        return event

    def answer(self) -> list[str]:
        """Carry out the commands that wait; return their verbs."""
        done = []
        for command in self._operators.pending():
            event = next((one for one in self.active.values() if one.id == command.fields.get("id")), None)
            if event is None:
                self._operators.refuse(command, "no such alarm")
                continue
            until_ns = self._operators.message(command, time.time_ns()).fields.get("until_ns")
            states: dict[str, tuple[Any, dict[str, Any]]] = {
                "ack": ("acknowledged", {"acknowledged": True}),
                "shelve": ("shelved", {"shelved_until_ns": until_ns}),
                "unshelve": ("updated", {"shelved_until_ns": None}),
                "reset": ("cleared", {}),
            }
            state, changes = states[command.verb]
            self._operators.accept(command, self.change(event.channel, state, **changes))
            done.append(command.verb)
        return done

    def close(self) -> None:
        """Be gone."""
        self._operators.close()
        self._publisher.close()

    def _say(self, event: AlarmEvent) -> AlarmEvent:
        self._seq += 1
        event = replace(event, seq=self._seq)
        self.active[event.channel] = event
        self._publisher.event(event)
        return event
