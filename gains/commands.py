"""Commands of this package: ``fauio design``."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gains.errors import InaccurateError, InfeasibleError, ModelError

if TYPE_CHECKING:
    from gains.plant import Plant


def add_parsers(subparsers: Any) -> None:
    """Add the commands of this package."""
    parser = subparsers.add_parser(
        "design",
        help="design certified observer gains for a plant model",
        description="Design the observer of a plant model and prove its error bound.",
        epilog="example: fauio design arm-disturbed --rate 100 --json",
    )
    parser.add_argument("model", metavar="MODEL.toml", help="model file, or built in: arm, arm-disturbed")
    parser.add_argument("-o", "--out", type=Path, metavar="GAINS.json", help="write the compiled gains")
    parser.add_argument("--method", choices=["convex"], default="convex", help="synthesis (convex)")
    parser.add_argument("--rate", type=float, metavar="HZ", help="samples per second; a continuous model needs it")
    parser.add_argument(
        "--pole-radius",
        type=float,
        default=1.0,
        metavar="R",
        help="largest size of a pole of the estimation error, in (0, 1]: less settles faster (1)",
    )
    parser.add_argument(
        "--fault-rate",
        type=float,
        metavar="PER_SECOND",
        help="how fast the actuator faults may move: more follows faster (what the model says)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    parser.set_defaults(handler=run_design)


def run_design(args: argparse.Namespace) -> int:
    """Run ``fauio design``."""
    from dataclasses import replace

    from gains.model_file import load_model, model_hash

    model = load_model(args.model)
    plant = model
    if args.fault_rate is not None:
        if not 0.0 < args.fault_rate < math.inf:
            raise ModelError(f"{model.name}: a fault rate of {args.fault_rate} per second is not positive")
        rated = (replace(fault, rate=args.fault_rate) for fault in model.faults)
        plant = replace(model, faults=tuple(rated))
    try:
        found = _design(plant, args, model_hash(model))
    except InfeasibleError as error:
        if args.json:
            _print_json(_failure(plant, args, error))
        raise
    if args.json:
        _print_json(found)
    else:
        sys.stdout.write(_text(found, args.out))
    return 0


def _design(plant: Plant, args: argparse.Namespace, model_hash: str) -> dict[str, Any]:
    """Design, certify, write the file that was asked for and return the report."""
    from dataclasses import replace

    from gains.certificate import certify, report
    from gains.compilation import compile_gains
    from gains.gains_file import write_gains
    from gains.synthesis import design_convex

    design = design_convex(plant, args.rate, pole_radius=args.pole_radius)
    certificate = certify(plant, design)
    if args.out is not None:
        # Whoever runs the gains checks the hash of the model file, which --fault-rate does not change.
        write_gains(replace(compile_gains(plant, design, certificate), model_hash=model_hash), args.out)
    return report(plant, design, certificate)


def _failure(plant: Plant, args: argparse.Namespace, error: InfeasibleError) -> dict[str, Any]:
    """Return the report of a design that does not exist."""
    return {
        "model": plant.name,
        "method": args.method,
        "domain": "discrete",
        "rate_hz": plant.rate_hz if args.rate is None else args.rate,
        "status": "inaccurate" if isinstance(error, InaccurateError) else "infeasible",
        "sqrt_mu": None,
        "norm": None,
        "poles_max_abs": None,
        "gain_max_abs": None,
        "certificate": {"holds": False, "margin": None},
        "solve_s": None,
        "total_s": None,
        "reason": str(error),
    }


def _text(found: dict[str, Any], out: Path | None) -> str:
    lines = [
        f"{found['model']}: {found['method']} design at {found['rate_hz']:g} Hz",
        f"  certified sqrt(mu)  {found['sqrt_mu']:.6g}",
        f"  H-infinity norm     {found['norm']:.6g} at {found['norm_hz']:.3g} Hz",
        f"  certificate         holds with margin {found['certificate']['margin']:.2g}",
        f"  largest pole        {found['poles_max_abs']:.6f}",
        f"  largest gain        {found['gain_max_abs']:.4g}",
        f"  time                {found['solve_s']:.2f} s in the solver, {found['total_s']:.2f} s in all",
        *(f"  note                {note}" for note in found["notes"]),
    ]
    if out is not None:
        lines.append(f"  written to          {out}")
    return "\n".join(lines) + "\n"


def _print_json(found: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(found) + "\n")
