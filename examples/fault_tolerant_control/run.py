"""Closed loop with and without the monitor's estimate in it, under the faults of the paper: a table and a picture.

python run.py                    # over Zenoh with the daemon, as fast as the answers come
python run.py --speed 1          # the same in real time
python run.py --fast             # in one process, without a network
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from arm_controller import Compensation, Controller, Limits, feedback_gain
from closed_loop import ACTUATOR, PERIOD_S, SENSOR, Plant, Run, alone, close_loop, in_process
from numpy.typing import NDArray

from adapters.simulation.arm import SCENARIOS, tracking_reference
from fauio import load_model

CASES = ("case1", "case2", "case3")
DURATION_S = 50.0
# The observer is armed 8.35 s after its start; the paper's first fault acts at 10 s.
SETTLED_S = 10.0
# A little more than the paper's faults, which reach 2 N m and 2 rad.
MOTOR = Limits(size=3.0, rate=100.0, sd=0.5)
ENCODER = Limits(size=3.0, rate=300.0, sd=0.2)
# Gravity over link inertia: what the link that hangs adds to its stiffness.
_GRAVITY = 3.33
_AFTER_JUMP_S = 0.1
_JUMP = 0.2

WITHOUT, INTEGRAL, MOTOR_ONLY, BOTH = "nothing", "integral action", "motor", "motor and encoder"


def gain(*, integral: bool = False) -> NDArray[np.float64]:
    """Return the controller's gain for the arm that hangs."""
    plant = load_model("arm")
    A = np.array(plant.A)
    A[3, 2] -= _GRAVITY
    return feedback_gain(A, np.array(plant.B), PERIOD_S, integral=integral)


def controller(against: str) -> Controller:
    """Return the controller with what it does against faults."""
    return Controller(
        gain(integral=against == INTEGRAL),
        tracking_reference,
        PERIOD_S,
        Compensation(ACTUATOR, MOTOR) if against in (MOTOR_ONLY, BOTH) else None,
        Compensation(SENSOR, ENCODER) if against == BOTH else None,
    )


def run_case(case: str, duration_s: float, monitored: Callable[[Plant, Controller], Run]) -> dict[str, Run]:
    """Run a case of the paper with each way to deal with it, and healthy; ``monitored`` has the monitor in the loop."""
    healthy, faulty = (Plant(SCENARIOS[name], duration_s) for name in ("healthy", case))
    return {
        "healthy": close_loop(healthy, alone(controller(WITHOUT))),
        WITHOUT: close_loop(faulty, alone(controller(WITHOUT))),
        INTEGRAL: close_loop(faulty, alone(controller(INTEGRAL))),
        MOTOR_ONLY: monitored(faulty, controller(MOTOR_ONLY)),
        BOTH: monitored(faulty, controller(BOTH)),
    }


def over_zenoh(speed: float | None) -> Callable[[Plant, Controller], Run]:
    """Return what runs a plant with arm, controller and daemon on Zenoh, and says how the loop did."""

    def monitored(plant: Plant, law: Controller) -> Run:
        from live_loop import Loop

        with tempfile.TemporaryDirectory() as folder, Loop(law, Path(folder), speed) as loop:
            run = close_loop(plant, loop.exchange)
        median, late = 1e3 * np.percentile(loop.answered_s, [50.0, 99.0])
        loss = f"{loop.late} of {len(run.t)} commands late"
        print(f"  measurement to command {median:.1f} ms (median), {late:.1f} ms (99 %); {loss}", file=sys.stderr)
        return run

    return monitored


def rms(values: NDArray[np.float64]) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def figures(runs: Mapping[str, Run]) -> dict[str, float]:
    """Return RMS tracking errors (rad) and how far the estimates were off (N m, rad), from 10 s on."""
    settled = runs[BOTH].t >= SETTLED_S
    found = {name: rms(run.error[settled]) for name, run in runs.items()}
    run = runs[BOTH]
    for name, truth, estimate in (
        (ACTUATOR, run.actuator, run.actuator_estimate),
        (SENSOR, run.sensor, run.sensor_estimate),
    ):
        heard = settled & np.isfinite(estimate)
        found[f"{name} off"] = rms((estimate - truth)[heard])
        found[f"{name} off, between jumps"] = rms((estimate - truth)[heard & ~_just_jumped(truth)])
    return found


def _just_jumped(truth: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which samples are less than 0.1 s behind a jump of the fault."""
    jumps = np.abs(np.diff(truth, prepend=truth[0])) > _JUMP
    behind = np.ones(round(_AFTER_JUMP_S / PERIOD_S))
    return np.convolve(jumps, behind)[: len(truth)] > 0


def main() -> int:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--fast", action="store_true", help="one process, no network; the same numbers")
    parser.add_argument("--speed", type=float, metavar="X", help="times real time (as fast as the answers come)")
    parser.add_argument("--case", choices=CASES, action="append", help="of the paper; may be repeated (all)")
    parser.add_argument("--duration", type=float, default=DURATION_S, metavar="S", help="seconds of each run (50)")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="draw it; OUT-dark.png is written beside it")
    parser.add_argument("--json", action="store_true", help="one JSON object, by case")
    args = parser.parse_args()
    in_one = args.fast

    def fast(plant: Plant, law: Controller) -> Run:
        return close_loop(plant, in_process(law))

    cases = args.case or list(CASES)
    runs = {case: run_case(case, args.duration, fast if in_one else over_zenoh(args.speed)) for case in cases}
    found = {case: figures(some) for case, some in runs.items()}
    if args.json:
        print(json.dumps(found))
    else:
        _print_table(found)
    if args.plot:
        from loop_figure import draw

        shown = {case: runs[case] for case in cases if case != "case1" or len(cases) == 1}
        draw(args.plot, shown, dark=False)
        draw(args.plot.with_stem(f"{args.plot.stem}-dark"), shown, dark=True)
    return 0


def _print_table(found: Mapping[str, Mapping[str, float]]) -> None:
    print(f"RMS tracking error of the link from {SETTLED_S:g} s on, rad; against faults the controller has:")
    columns = ("healthy", WITHOUT, INTEGRAL, MOTOR_ONLY, BOTH)
    print(" " * 6, *(f"{name:>18}" for name in columns))
    for case, sizes in found.items():
        print(case, *(f"{sizes[name]:18.5f}" for name in columns))
    print("RMS by which the published estimates were off; in brackets 0.1 s and more after a jump:")
    for case, sizes in found.items():
        shown = (
            f"{name} {sizes[f'{name} off']:.4f} ({sizes[f'{name} off, between jumps']:.4f}) {unit}"
            for name, unit in ((ACTUATOR, "N m"), (SENSOR, "rad"))
        )
        print(case, *shown, sep="   ")


if __name__ == "__main__":
    raise SystemExit(main())
