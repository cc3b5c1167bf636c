"""The CrazyPAD flights (a quadcopter of 30 g with cut or taped propellers, or weights), each a whole flight of 15 s.

    python bench/leaderboard/crazypad.py FOLDER [--json]

FOLDER is ``data/controller_data`` of https://github.com/AerialRoboticsUUST/CrazyPAD: logs of the vehicle's memory card
at 100 Hz with commanded thrust and torques, body rates and vertical acceleration. Nothing of it is in this repository.
Two vehicles flew, E8 and E9. A flight becomes the MAVLink messages that its numbers stand for; the autopilot's own
mixer makes motor commands of thrust and torques.

A profile is fitted on the normal flights of a vehicle and watches its others; each normal flight is watched with a
profile of the other normal ones. The rivals score each motor of a flight (how far its mean command is above its mean in
the normal flights; GLR and CUSUM of its command; a bank of Kalman filters), the threshold the largest that a normal
flight left out reaches, so that they have no false alarm. A cut propeller is found if an alarm names its motor, alone
if no other is named.
"""

from __future__ import annotations

import argparse
import json
import re
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import fauio

Floats = NDArray[np.float64]
FULL = 65535.0
"""Full command."""
TICK = 10
"""Samples of a tick of the Kalman filters: 0.1 s, longer than motors lag."""
WANDERS = 0.005
"""How far a loss goes in a tick by those filters, as a share: 5 % in 10 s."""
FLYING_M = 0.3
"""Height from which on it flies; the flights hover at half a metre."""
PLACES = ((0.032, 0.032, -0.05), (-0.032, 0.032, 0.05), (-0.032, -0.032, -0.05), (0.032, -0.032, 0.05))
"""Metres to the front and right, and torque for thrust, of motors 1 to 4, as PX4's parameters place rotors."""
MIXER = np.array([[1.0, -0.5, 0.5, 1.0], [1.0, -0.5, -0.5, -1.0], [1.0, 0.5, -0.5, 1.0], [1.0, 0.5, 0.5, -1.0]])
"""Motor commands (4) of thrust, roll, pitch and yaw commands, as the firmware mixes them."""
COLUMNS = {
    "controls": ("cmd_thrust", "cmd_roll", "cmd_pitch", "cmd_yaw"),
    "rates": ("r_roll", "r_pitch", "r_yaw"),
}


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """A flight: motor commands (n, 4) as shares of full command, body rates (n, 3), acceleration up in g (n,)."""

    name: str
    vehicle: str
    times_ns: NDArray[np.int64]
    commands: Floats
    rates: Floats
    up: Floats
    flying: NDArray[np.bool_]

    @property
    def cut(self) -> dict[str, float]:
        """Return what the propellers of motors lack, by the folder's name: millimetres of both blades together."""
        found: dict[str, float] = {}
        if "cut" in self.name:
            for motor, sizes in re.findall(r"[Mm](\d)((?:_[\d.]+(?:мм|mm))+)", self.name):
                found[f"motor{motor}"] = sum(size for size in map(float, re.findall(r"[\d.]+", sizes)) if size < 10.0)
        return found

    def hover(self) -> Floats:
        """Return the mean command of each motor in flight (4,)."""
        return self.commands[self.flying].mean(axis=0)


def read_flight(path: Path) -> Flight:
    """Read a log: names and types of events, then the events."""
    data = path.read_bytes()
    version, kinds = struct.unpack_from("<HH", data, 1)
    at = 5
    layouts: dict[int, tuple[str, list[str], struct.Struct]] = {}
    for _ in range(kinds):
        (kind,) = struct.unpack_from("<H", data, at)
        name, at = _text(data, at + 2)
        (count,) = struct.unpack_from("<H", data, at)
        at += 2
        fields = []
        for _ in range(count):
            field, at = _text(data, at)
            fields.append(field)
        layouts[kind] = name, [field[:-3] for field in fields], struct.Struct("<" + "".join(f[-2] for f in fields))
    head = struct.Struct("<HI" if version == 1 else "<HQ")
    unit_ns = 1_000_000 if version == 1 else 1_000
    times, rows = [], []
    names: list[str] = []
    while at + head.size <= len(data) - 4:
        kind, stamp = head.unpack_from(data, at)
        name, fields, body = layouts[kind]
        at += head.size
        if name == "fixedFrequency":
            names = fields
            times.append(stamp * unit_ns)
            rows.append(body.unpack_from(data, at))
        at += body.size
    column = dict(zip(names, np.array(rows).T, strict=True))
    controls = np.stack([column[f"controller.{name}"] for name in COLUMNS["controls"]], axis=1)
    return Flight(
        name=path.parent.name,
        vehicle=path.name[:2],
        times_ns=np.array(times, np.int64),
        commands=np.clip(controls @ MIXER.T / FULL, 0.0, 1.0),
        rates=np.stack([column[f"controller.{name}"] for name in COLUMNS["rates"]], axis=1) * [1.0, 1.0, -1.0],
        up=column["controller.accelz"],
        flying=column["stateEstimate.z"] > FLYING_M,
    )


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(0, at)
    return data[at:end].decode(), end + 1


def messages(flight: Flight) -> Iterator[fauio.Message]:
    """Yield what an autopilot with these numbers would send."""
    start_ns = 1_700_000_000_000_000_000
    geometry = [("CA_ROTOR_COUNT", 4.0)]
    for number, place in enumerate(PLACES):
        geometry += [(f"CA_ROTOR{number}_{key}", value) for key, value in zip(("PX", "PY", "KM"), place, strict=True)]

    def message(name: str, at_ns: int, **fields: object) -> fauio.Message:
        return fauio.Message(fauio.MAVLINK, name, start_ns + at_ns, fields, 1, 1)

    pulses = np.round(1000.0 + 1000.0 * flight.commands).astype(int)
    for k, time_ns in enumerate((flight.times_ns - flight.times_ns[0] + 5_000_000_000).tolist()):
        servos = {f"servo{number}_raw": int(pulse) for number, pulse in enumerate(pulses[k], start=1)}
        rates = dict(zip(("rollspeed", "pitchspeed", "yawspeed"), flight.rates[k].tolist(), strict=True))
        yield message("SERVO_OUTPUT_RAW", time_ns, time_usec=time_ns // 1000, port=0, **servos)
        yield message("ATTITUDE", time_ns, time_boot_ms=time_ns // 1_000_000, roll=0.0, pitch=0.0, yaw=0.0, **rates)
        yield message("HIGHRES_IMU", time_ns, time_usec=time_ns // 1000, zacc=-9.81 * float(flight.up[k]))
        if k < len(geometry):
            yield message("PARAM_VALUE", time_ns, param_id=geometry[k][0], param_value=geometry[k][1], param_type=9)
        if k % 50 == 0:
            armed = 128 if flight.commands[k].any() else 0
            yield message("HEARTBEAT", time_ns, type=2, autopilot=12, base_mode=armed)
            yield message("EXTENDED_SYS_STATE", time_ns, landed_state=2 if flight.flying[k] else 1)


def fitted(normal: Sequence[Flight]) -> fauio.Profile:
    """Return the profile of normal flights."""
    from adapters.batch import pack
    from replay.fit import fit_profile

    def batches(flight: Flight) -> Iterator[fauio.Batch]:
        yield pack(list(messages(flight)))

    with tempfile.TemporaryDirectory() as folder:
        logs = [lambda flight=flight: batches(flight) for flight in normal]
        fit_profile("multirotor", logs, Path(folder) / "profile", normal[0].vehicle)  # type: ignore[arg-type]
        return fauio.read_profile(Path(folder) / "profile")


def named_by_profile(normal: Sequence[Flight], watched: Sequence[Flight]) -> list[set[str]]:
    """Return the motors that alarms name in each flight, with a profile of normal ones."""
    from replay.player import play

    profile = fitted(normal)
    return [
        {event.channel for event in play(profile, messages(flight)).events if event.state == "raised"}
        for flight in watched
    ]


Score = Callable[[Sequence[Flight], Flight], Floats]
"""What a rival makes of a flight beside normal ones: a number for each motor (4,), the larger the more wrong."""


def named_by(score: Score) -> Callable[[Sequence[Flight], Sequence[Flight]], list[set[str]]]:
    """Return who names the motor with the largest score, where no normal flight that was left out has as much."""

    def named(normal: Sequence[Flight], watched: Sequence[Flight]) -> list[set[str]]:
        left_out = [score([other for other in normal if other is not flight], flight).max() for flight in normal]
        scores = [score(normal, flight) for flight in watched]
        return [{f"motor{1 + int(one.argmax())}"} if one.max() > max(left_out) else set() for one in scores]

    return named


def named_by_size(normal: Sequence[Flight], watched: Sequence[Flight]) -> list[set[str]]:
    """Return the motors whose mean estimated loss is above the largest in a normal flight that was left out."""

    def losses(profile: fauio.Profile, flight: Flight) -> Floats:
        outputs = fauio.Pipeline(profile).run(fauio.pack(list(messages(flight))))
        rows = [one for one in outputs if isinstance(one, fauio.Estimates) and one.observer == "motors"]
        return -np.concatenate([one.isolated[one.armed] for one in rows]).mean(axis=0)

    profile = fitted(normal)
    left_out = [losses(fitted([one for one in normal if one is not flight]), flight).max() for flight in normal]
    found = [losses(profile, flight) for flight in watched]
    return [{f"motor{1 + int(one.argmax())}"} if one.max() > max(left_out) else set() for one in found]


def mean_command(normal: Sequence[Flight], flight: Flight) -> Floats:
    """How far the mean command of each motor is above that of normal flights."""
    return np.asarray(flight.hover() - np.mean([other.hover() for other in normal], axis=0))


def cusum(normal: Sequence[Flight], flight: Flight) -> Floats:
    """Largest cumulative sum of each motor's command above normal, with a drift of half a deviation."""
    sums, most = np.zeros(4), np.zeros(4)
    for row in _scaled(normal, flight):
        sums = np.maximum(sums + row - 0.5, 0.0)
        most = np.maximum(most, sums)
    return most


def glr(normal: Sequence[Flight], flight: Flight) -> Floats:
    """Largest likelihood of a mean that went up, over windows that double, as if commands were white."""
    total = np.cumsum(np.vstack([np.zeros(4), _scaled(normal, flight)]), axis=0)
    lengths = [2**k for k in range(4, int(np.log2(len(total) - 1)) + 1)]
    return np.max([((total[n:] - total[:-n]) / np.sqrt(n)).max(axis=0) for n in lengths], axis=0)


def _scaled(normal: Sequence[Flight], flight: Flight) -> Floats:
    usual = np.concatenate([one.commands[one.flying] for one in normal])
    return np.asarray((flight.commands[flight.flying] - usual.mean(axis=0)) / usual.std(axis=0))


def kalman(normal: Sequence[Flight], flight: Flight) -> Floats:
    """How much likelier a weak motor is than none, by a bank of Kalman filters with a loss as a state of each.

    The model is that of least squares over normal flights: rates after a tick of 0.1 s by rates and mean commands.
    """
    ticks = [_ticks(one) for one in normal]
    known = np.concatenate([np.hstack([y[:-1], u[:-1], np.ones((len(y) - 1, 1))]) for y, u in ticks])
    after = np.concatenate([y[1:] for y, _ in ticks])
    model = np.linalg.lstsq(known, after, rcond=None)[0].T
    a, b, c = model[:, :3], model[:, 3:7], model[:, 7]
    noise = np.cov((after - known @ model.T).T)
    usual = np.mean([one.hover() for one in normal], axis=0)
    y, u = _ticks(flight)
    healthy = _likelihood(y, u, a, b, c, noise, np.zeros((3, 1)))
    weak = [_likelihood(y, u, a, b, c, noise, -b[:, [k]] * usual[k]) for k in range(4)]
    return np.array(weak) - healthy


def _ticks(flight: Flight) -> tuple[Floats, Floats]:
    """Return rates at and mean commands from each tick on (m, 3), (m, 4)."""
    rates, commands = flight.rates[flight.flying], flight.commands[flight.flying]
    count = len(rates) // TICK
    return rates[: count * TICK : TICK], commands[: count * TICK].reshape(count, TICK, 4).mean(axis=1)


def _likelihood(y: Floats, u: Floats, a: Floats, b: Floats, c: Floats, noise: Floats, effect: Floats) -> float:
    """Return the log-likelihood of rates by a steady Kalman filter whose last state is a loss of some effect."""
    step = np.block([[a, effect], [np.zeros((1, 3)), np.ones((1, 1))]])
    drift = np.zeros((4, 4))
    drift[:3, :3], drift[3, 3] = noise, WANDERS**2 if effect.any() else 1e-12
    seen = np.eye(3, 4)
    spread = drift.copy()
    for _ in range(500):
        gain = spread @ seen.T @ np.linalg.inv(seen @ spread @ seen.T + noise)
        spread = step @ (spread - gain @ seen @ spread) @ step.T + drift
    innovation = seen @ spread @ seen.T + noise
    weight, size = np.linalg.inv(innovation), float(np.linalg.slogdet(innovation)[1])
    state, total = np.append(y[0], 0.0), 0.0
    for row in range(len(y) - 1):
        state = step @ state + np.append(b @ u[row] + c, 0.0)
        off = y[row + 1] - state[:3]
        total -= 0.5 * (float(off @ weight @ off) + size)
        state = state + gain @ off
    return total


def scored(flights: Sequence[Flight], named: Sequence[set[str]], least_mm: float, most_mm: float) -> dict[str, int]:
    """Count flights whose largest cut lies between two lengths: found, alone, wrong."""
    rows = [
        (flight.cut, motors)
        for flight, motors in zip(flights, named, strict=True)
        if flight.cut and least_mm <= max(flight.cut.values()) < most_mm
    ]
    return {
        "flights": len(rows),
        "found": sum(bool(motors & set(cut)) for cut, motors in rows),
        "alone": sum(bool(motors) and motors <= set(cut) for cut, motors in rows),
        "others": sum(bool(motors - set(cut)) for cut, motors in rows),
    }


def _counted(named: Sequence[set[str]]) -> str:
    return f"{sum(map(bool, named))} of {len(named)}"


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="data/controller_data of the set")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    paths = sorted(path for path in options.folder.glob("*/E[89]_log*") if not path.suffix)
    if not paths:
        print(f"crazypad: {options.folder} holds no E8_log00 and so on; give data/controller_data", file=sys.stderr)
        return 2
    flights = [read_flight(path) for path in paths]
    rivals = {"mean command": mean_command, "GLR": glr, "CUSUM": cusum, "Kalman bank": kalman}
    detectors = {
        "fauio": named_by_profile,
        "its estimates": named_by_size,
        **{name: named_by(score) for name, score in rivals.items()},
    }
    result: dict[str, object] = {}
    for detector, names in detectors.items():
        of_all: list[tuple[Flight, set[str]]] = []
        false: list[set[str]] = []
        for vehicle in ("E8", "E9"):
            normal = [one for one in flights if one.vehicle == vehicle and one.name == "normal_flight"]
            others = [one for one in flights if one.vehicle == vehicle and one.name != "normal_flight"]
            of_all += zip(others, names(normal, others), strict=True)
            if names is named_by_profile:
                false += [names([one for one in normal if one is not flight], [flight])[0] for flight in normal]
        watched, named = zip(*of_all, strict=True)
        result[detector] = {
            "cut, mm": {
                f"{least:g} to {most:g}": scored(watched, named, least, most)
                for least, most in ((0.0, 2.0), (2.0, 4.0), (4.0, 6.0), (6.0, 9.0))
            },
            "normal flights left out with an alarm": _counted(false),
            **{
                f"{what} flights with an alarm": _counted([motors for flight, motors in of_all if what in flight.name])
                for what in ("tape", "weight")
            },
        }
    print(json.dumps(result) if options.json else json.dumps(result, indent=2, ensure_ascii=False))
    return 0


if __name__ == "__main__":
    sys.exit(main())
