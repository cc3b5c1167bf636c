"""Spoofed GPS in the control invariants' logs of BaileySri, detectors at the threshold that no healthy flight reaches.

    python bench/leaderboard/spoofing.py FOLDER [--json]

FOLDER is ``src/choi`` of BaileySri's Practical-Software-Defense-for-GPS-Spoofing-on-a-Hobby-UAV-Offline (GitHub): the
north axis of ArduPilot's position controller, at 10 Hz, in five healthy flights and three attacks. Nothing of it is in
this repository. Position and velocity are those of the estimator, which a spoofed GPS leads away; the acceleration is
that of the IMU, which it does not. Each flight is judged by what the healthy parts of the others teach: fauio by a
profile (``fauio fit --vehicle custom``) with a model of that kinematics and the thresholds of the fit, the rivals by
what position and velocity changed by beyond velocity and acceleration. Control invariants (Choi et al., CCS 2018; our
own implementation) follow the measured position from the wanted one.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import alfa
import numpy as np
from numpy.typing import NDArray

import fauio
from replay.fit import fit_profile

Floats = NDArray[np.float64]

ATTACKS = {"Flight (3)": 328.596249, "Flight (4)": 413.945026, "onestep_loiter_2m": 262.990960}
"""Seconds since boot at which the authors' notebook has each attack begin."""
HEALTHY = "Matlab_scripts/logs"
GAP_S = 0.5
"""Chosen: five missed rows; what changed over a gap is not known well enough."""
FADE = 20
"""Rows over which means run: the two seconds of the Kalman filters of ``alfa.py``."""
SPAN_S, LAGS = 11.0, 3
"""Of the control invariants: the window of the authors, and the order of the model."""
MODEL = """
name = "north"
states = ["position", "velocity"]
inputs = ["acceleration"]
outputs = ["position", "velocity"]
A = { position = { velocity = 1.0 } }
B = { velocity = { acceleration = "share" } }
C = { position = { position = 1.0 }, velocity = { velocity = 1.0 } }
parameters = { share = { start = 1.0, min = 0.5, max = 1.5 } }
phase = { require_armed = false }
fault = [
    { name = "position", kind = "actuator", into = "position", rate = 5.0, unit = "m/s" },
    { name = "velocity", kind = "actuator", into = "velocity", rate = 5.0, unit = "m/s2" },
]
[channels]
acceleration = { message = "DEBUG_FLOAT_ARRAY", field = "data[0]" }
position = { message = "DEBUG_FLOAT_ARRAY", field = "data[1]" }
velocity = { message = "DEBUG_FLOAT_ARRAY", field = "data[2]" }
"""


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """A flight: times since boot (n,), and wanted position, position, velocity, acceleration north (n, 4)."""

    name: str
    time_s: Floats
    values: Floats

    @property
    def attack_s(self) -> float:
        """The begin of its attack, seconds since boot; infinite without one."""
        return ATTACKS.get(self.name, math.inf)

    @property
    def healthy(self) -> Flight:
        """The part before its attack."""
        before = self.time_s < self.attack_s
        return replace(self, time_s=self.time_s[before], values=self.values[before])


def read_flight(path: Path) -> Flight:
    """Read a table; the rows before the last gap of a minute are of another flight."""
    lines = path.read_text(encoding="utf-8-sig").replace("PSCN,", "").splitlines()
    names = lines[0].split(",")
    columns = [names.index(name) for name in ("TimeUS", "TPN", "PN", "VN", "AN")]
    rows = np.array(
        [[float(line.split(",")[k]) for k in columns] for line in lines[1:] if line.count(",") >= max(columns)]
    )
    rows = rows[np.append(True, np.diff(rows[:, 0]) > 0)]
    begin = np.max(np.flatnonzero(np.diff(rows[:, 0]) > 60e6) + 1, initial=0)
    return Flight(path.stem, rows[begin:, 0] / 1e6, rows[begin:, 1:])


def batch(flight: Flight) -> fauio.Batch:
    """Return what a vehicle with these numbers would send, on the times since boot."""
    return fauio.pack(
        [
            fauio.Message(
                fauio.MAVLINK,
                "DEBUG_FLOAT_ARRAY",
                round(at * 1e9),
                {"time_usec": round(at * 1e6), "array_id": 0, "name": "north", "data": [an, pn, vn]},
                1,
                1,
            )
            for at, (_, pn, vn, an) in zip(flight.time_s.tolist(), flight.values.tolist(), strict=True)
        ]
    )


def alarms(healthy: Sequence[Flight], flight: Flight) -> list[float]:
    """Return when a profile of healthy flights alarms of position or velocity, seconds since boot."""
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "north.toml"
        model.write_text(MODEL)
        logs = [lambda one=one: [batch(one)] for one in healthy]
        fit_profile("custom", logs, Path(folder) / "north", "north", model, capability=False)  # type: ignore[arg-type]
        events = fauio.replay(Path(folder) / "north", [batch(flight)]).events
    return [event.time_ns / 1e9 for event in events if event.state == "raised" and event.kind == "actuator"]


def residuals(flight: Flight) -> Floats:
    """Return what position and velocity changed by beyond velocity and acceleration, to each row (n, 2)."""
    steps = np.diff(flight.time_s)[:, None]
    _, position, velocity, acceleration = flight.values.T
    moved = np.stack([position, velocity], axis=1)
    drive = np.stack([velocity, acceleration], axis=1)
    beyond = np.diff(moved, axis=0) - steps * (drive[1:] + drive[:-1]) / 2
    return np.vstack([np.zeros(2), np.where(steps < GAP_S, beyond, 0.0)])


Score = Callable[[Flight], Floats]


def residual_energy(healthy: Sequence[Flight]) -> Score:
    """Mean square of the residuals over two seconds."""
    scaled = _scaled(healthy)
    return lambda flight: alfa.running_mean(np.square(scaled(flight)).mean(axis=1), FADE)


def glr(healthy: Sequence[Flight]) -> Score:
    """Likelihood of a shifted mean of the residuals."""
    scaled = _scaled(healthy)
    return lambda flight: alfa.shift(scaled(flight))


def cusum(healthy: Sequence[Flight]) -> Score:
    """Largest two-sided cumulative sum of the residuals, with a drift of half a deviation."""
    scaled = _scaled(healthy)
    return lambda flight: alfa.sums(scaled(flight))


def kalman_bank(healthy: Sequence[Flight]) -> Score:
    """Largest bias by two Kalman filters, in deviations: of what position, and what velocity, change by."""
    joined = np.concatenate([residuals(one) for one in healthy])
    centre, noise = joined.mean(axis=0), np.cov(joined.T)
    return lambda flight: alfa.biases(residuals(flight) - centre, noise, 1.0 / FADE)


def _scaled(healthy: Sequence[Flight]) -> Score:
    joined = np.concatenate([residuals(one) for one in healthy])
    return lambda flight: np.asarray((residuals(flight) - joined.mean(axis=0)) / joined.std(axis=0))


def control_invariants(healthy: Sequence[Flight]) -> Score:
    """Mean square distance of the position from the one that follows from the wanted ones, since a window's begin."""
    known = [_lagged(one) for one in healthy]
    model = np.linalg.lstsq(*(np.concatenate(part) for part in zip(*known, strict=True)), rcond=None)[0]

    def score(flight: Flight) -> Floats:
        wanted, measured = flight.values[:, 0], flight.values[:, 1]
        follows, scores, begin = measured.copy(), np.zeros(len(measured)), 0
        for row in range(LAGS, len(measured)):
            if (
                flight.time_s[row] - flight.time_s[begin] > SPAN_S
                or flight.time_s[row] - flight.time_s[row - 1] > GAP_S
            ):
                begin, follows[row - LAGS : row] = row, measured[row - LAGS : row]
            follows[row] = np.concatenate([follows[row - LAGS : row], wanted[row - LAGS : row]]) @ model
            scores[row] = np.mean(np.square(follows[begin : row + 1] - measured[begin : row + 1]))
        return scores

    return score


def _lagged(flight: Flight) -> tuple[Floats, Floats]:
    wanted, measured = flight.values[:, 0], flight.values[:, 1]
    windows = [np.lib.stride_tricks.sliding_window_view(part, LAGS)[:-1] for part in (measured, wanted)]
    return np.hstack(windows), measured[LAGS:]


RIVALS: dict[str, Callable[[Sequence[Flight]], Score]] = {
    "residual energy": residual_energy, "GLR": glr, "CUSUM": cusum, "Kalman bank": kalman_bank,
    "control invariants": control_invariants,
}  # fmt: skip


def rival_alarms(rival: Callable[[Sequence[Flight]], Score]) -> Callable[[Sequence[Flight], Flight], list[float]]:
    """Return when a rival's score first exceeds what each healthy flight reaches by what the others teach."""

    def alarms_of(healthy: Sequence[Flight], flight: Flight) -> list[float]:
        left_out = [rival([other for other in healthy if other is not one])(one).max() for one in healthy]
        over = np.flatnonzero(rival(healthy)(flight) > max(left_out))
        # two alarms within ten seconds are one
        return [float(flight.time_s[row]) for k, row in enumerate(over) if not k or row - over[k - 1] > 10 * FADE / 2]

    return alarms_of


def main(words: Sequence[str] | None = None) -> int:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(words)
    paths = [*sorted((args.folder / HEALTHY).glob("*.csv")), *sorted(args.folder.glob("*.csv"))]
    flights = [read_flight(path) for path in paths]
    if not any(flight.attack_s < math.inf for flight in flights):
        sys.stderr.write(f"{args.folder}: holds no attack; give the folder 'src/choi' of the set\n")
        return 2
    detectors = {"fauio": alarms, **{name: rival_alarms(rival) for name, rival in RIVALS.items()}}
    for name, find in detectors.items():
        figures = compared(flights, find)
        sys.stdout.write(json.dumps({"detector": name, **figures}) + "\n" if args.json else f"{name:<18} {figures}\n")
    return 0


def compared(
    flights: Sequence[Flight], find: Callable[[Sequence[Flight], Flight], list[float]]
) -> dict[str, float | None]:
    """Return the delay of each attack (None: missed), and false alarms an hour with their 95 % bound."""
    figures: dict[str, float | None] = {}
    false, seconds = 0, 0.0
    for flight in flights:
        times = np.array(find([other.healthy for other in flights if other is not flight], flight))
        if flight.attack_s < math.inf:
            after = times[times >= flight.attack_s] - flight.attack_s
            figures[flight.name] = round(float(after[0]), 2) if len(after) else None
        false += int((times < flight.attack_s).sum())
        seconds += flight.healthy.time_s[-1] - flight.healthy.time_s[0]
    hours = seconds / 3600
    bound = float(alfa.poisson_bound(false) / hours)
    return figures | {"false_alarms_per_hour": round(float(false / hours), 1), "false_alarms_bound": round(bound, 1)}


if __name__ == "__main__":
    sys.exit(main())
