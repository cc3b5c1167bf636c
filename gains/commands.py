"""Commands of this package: ``fauio check`` and ``fauio design``."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.command_line import option, remark, say, say_json
from adapters.errors import InaccurateError, InfeasibleError, ModelError, UsageError

if TYPE_CHECKING:
    from gains.plants.plant import Plant
    from gains.synthesis.gains_file import Gains


def design_text(report: dict[str, Any], out: Path | None) -> str:
    """Return the report that ``fauio design`` prints, with the file the gains were written to, if any."""
    continuous = report["domain"] == "continuous"
    at = "" if report["rate_hz"] is None else f" at {report['rate_hz']:g} Hz"
    where = "infinite frequency" if report["norm_hz"] is None else f"{report['norm_hz']:.3g} Hz"
    lines = [
        f"{report['model']}: {'continuous ' if continuous else ''}{report['method']} design{at}",
        *([] if report["sqrt_mu"] is None else [f"  certified sqrt(mu)  {report['sqrt_mu']:.6g}"]),
        *([] if report["floor"] is None else [f"  no observer below   {report['floor']:.6g}"]),
        *([] if report["norm"] is None else [f"  H-infinity norm     {report['norm']:.6g} at {where}"]),
        *([] if report.get("h2") is None else [f"  H2 norm at most     {report['h2']:.6g}"]),
        f"  certificate         {_proof(report['certificate'])}",
        f"  slowest pole        {report['poles_max_re']:.4g} rad/s"
        if continuous
        else f"  largest pole        {report['poles_max_abs']:.6f}",
        f"  largest gain        {report['gain_max_abs']:.4g}",
        *_bounds(report),
        f"  time                {report['solve_s']:.2f} s in the solver, {report['total_s']:.2f} s in all",
        *(f"  note                {note}" for note in report["notes"]),
    ]
    if out is not None:
        lines.append(f"  written to          {out}")
    return "\n".join(lines) + "\n"


def _bounds(report: dict[str, Any]) -> list[str]:
    """Return the largest errors of the faults, a line each."""
    from gains.synthesis.peak import bound_lines

    bounds = report.get("error_bounds")
    if not bounds:
        return []
    return [f"  at any one time     {line}" for line in bound_lines(report["faults"], bounds)]


def _proof(certificate: dict[str, Any]) -> str:
    if not certificate["holds"]:
        return "none"
    over = {"vertices": ", at every slope vertex", "multipliers": ", for all slopes at once"}
    return f"holds with margin {certificate['margin']:.2g}{over.get(certificate.get('proof', ''), '')}"


_THEOREMS = ("theorem1", "theorem2")
_BASELINES = ("gao2022", "gao2016", "chen2006", "zhang2008", "ekf")
_SCALARS = ("beta", "epsilon", "delta")
_RATE_HZ = 100.0
"""Rate of a discrete design of a continuous model without one, Hz: that of autopilots' recorded telemetry."""
_DISCRETE_OPTIONS = {
    "integrator_order": 1,
    "h2": 0.0,
    "gain_weight": None,
    "gain_bound": None,
    "vertex_free": False,
    "published_inverse": False,
    "common_p": None,
}
"""Options that a design in continuous time refuses, with their defaults."""


def add_parsers(subparsers: Any) -> None:
    """Add the commands of this package."""
    parser = subparsers.add_parser(
        "design",
        help="design certified observer gains for a plant model",
        description="Design the observer of a plant model and prove its error bound.",
        epilog="example: fauio design arm\nexample: fauio design arm-disturbed --rate 50 --json",
    )
    option(parser, "model MODEL.toml", "model file, or built in: arm, arm-disturbed")
    option(parser, "-o --out GAINS.json", "write the compiled gains", Path)
    option(
        parser,
        "--method METHOD",
        "synthesis: convex (the default); for comparison theorem1 and theorem2 (the paper's own inequalities), "
        "gao2022, gao2016, chen2006 and zhang2008 (reconstructions of earlier observers), ekf (a Kalman filter), or "
        "all of them",
        choices=["convex", *_THEOREMS, *_BASELINES, "all"],
        default="convex",
    )
    option(
        parser,
        "--rate HZ",
        "samples per second of a discrete design (default: the model's, otherwise "
        f"{_RATE_HZ:g}), or of compiling a continuous design (default: not compiled)",
        float,
    )
    option(
        parser, "--continuous", "design in continuous time; with --rate the design is compiled exactly for that rate"
    )
    parser.add_argument(
        "--decay-rates",
        type=float,
        nargs=2,
        metavar=("LOW", "HIGH"),
        help="decay rates of the estimation error of a continuous convex design, rad/s (any)",
    )
    for scalar in _SCALARS:
        option(parser, f"--{scalar} X", f"{scalar} of theorem1 and theorem2", float)
    option(
        parser,
        "--fault-rate PER_SECOND",
        "how fast actuator faults may change: a larger rate follows faster (default: the model's)",
        float,
    )
    option(parser, "--faults NAME,...", "design for these faults of the model only, as for one hypothesis of a bank")
    option(parser, "--json", "print the result as one JSON object")
    parser.set_defaults(handler=run_design)
    _add_convex_options(parser.add_argument_group("convex design"))
    _add_check(subparsers)


def _add_convex_options(parser: argparse._ArgumentGroup) -> None:
    """Add what only the convex design knows: where poles may lie, what gains cost, what is proven."""
    option(
        parser,
        "--pole-radius R",
        "largest absolute pole of the estimation error, in (0, 1]: a smaller one settles faster (1)",
        float,
        default=1.0,
    )
    parser.add_argument(
        "--integrator-order",
        type=int,
        choices=[1, 2],
        default=1,
        help="2 follows ramps of actuator faults without lag; their rates are then per second squared (1)",
    )
    option(
        parser,
        "--h2 ALPHA",
        "from 0, the best worst-case bound, to 1, the least error under white noise (0)",
        float,
        default=0.0,
    )
    option(
        parser,
        "--gain-weight RHO",
        "price of large gains: a smaller price lets the estimates follow harmless noise (0.001)",
        float,
    )
    option(parser, "--gain-bound X", "largest entry of the gains K, L_i and L_p (any)", float)
    option(
        parser,
        "--vertex-free",
        "prove all slopes at once instead of each combination of their bounds (default: if these are too many)",
    )
    option(
        parser,
        "--published-inverse",
        "use the paper's pseudo-inverse for L1 and F instead of designing them with the gains",
    )
    option(
        parser,
        "--noise-once",
        "bound the error against disturbances and noise only, without their next values (continuous: their "
        "derivatives), which count noise twice",
    )
    option(
        parser,
        "--common-p GAINS.json",
        "keep the Lyapunov matrix of an earlier design of this model and rate, so that the gains may be "
        "exchanged at run time",
        Path,
    )


def run_design(args: argparse.Namespace) -> int:
    """Run ``fauio design``."""
    from dataclasses import replace

    from gains.plants.model_file import load_model, model_hash

    model = load_model(args.model)
    plant = model
    if args.fault_rate is not None:
        if not 0.0 < args.fault_rate < math.inf:
            raise UsageError(f"{model.name}: a fault rate of {args.fault_rate} per second is not positive")
        rated = (replace(fault, rate=args.fault_rate) for fault in model.faults)
        plant = replace(model, faults=tuple(rated))
    if args.faults is not None:
        plant = _only(plant, args.faults)
    if args.method == "all":
        return _compare(plant, args)
    if args.rate is None and plant.rate_hz is None and not _continuous(args):
        args.rate = _RATE_HZ
        remark(
            f"{plant.name}: designed for {_RATE_HZ:g} samples per second; --rate HZ sets another rate, "
            "--continuous needs none"
        )
    try:
        report, gains = _design(plant, args)
    except InfeasibleError as error:
        if args.json:
            say_json(_failure(plant, args, error))
        raise
    if args.out is not None and gains is not None:
        from gains.synthesis.gains_file import write_gains

        # The monitor compares the hash with that of the model file, which --fault-rate does not change.
        write_gains(replace(gains, model_hash=model_hash(model)), args.out)
    if args.json:
        say_json(report)
    else:
        sys.stdout.write(design_text(report, args.out))
    return 0


def _only(plant: Plant, names: str) -> Plant:
    """Return the plant with the named faults only."""
    from gains.analysis.estimability import restricted

    wanted = tuple(name.strip() for name in names.split(","))
    known = [fault.name for fault in plant.faults]
    if strange := [name for name in wanted if name not in known]:
        raise UsageError(f"{plant.name}: --faults names '{strange[0]}'; the model has {', '.join(known)}")
    return restricted(plant, wanted)


def _compare(plant: Plant, args: argparse.Namespace) -> int:
    """Design with every method and print a line (or JSON line) for each, with the reason if it is infeasible."""
    if args.out is not None:
        raise UsageError(f"{plant.name}: -o takes the gains of one method; leave out --method all")
    if not args.json:
        say(f"{'method':<22}{'sqrt(mu)':>12}{'norm':>12}{'floor':>12}  status")
    runs = [("convex", False), ("convex", True), *((method, True) for method in (*_THEOREMS, *_BASELINES))]
    for method, continuous in runs:
        if method == "convex" and not continuous and args.rate is None and plant.rate_hz is None:
            continue
        case = argparse.Namespace(**{**vars(args), "method": method, "continuous": continuous})
        try:
            report, _ = _design(plant, case)
        except (InfeasibleError, ModelError) as error:
            report = _failure(plant, case, error)
        if args.json:
            say_json(report)
            continue
        name = f"{method}, {report['domain']}" if method == "convex" else method
        figures = "".join(
            f"{'-' if report[key] is None else format(report[key], '.5g'):>12}" for key in ("sqrt_mu", "norm", "floor")
        )
        say(f"{name:<22}{figures}  {report.get('reason') or report['status']}")
    return 0


def _add_check(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "check",
        help="report which faults of a plant model its sensors can estimate, and why not the others; or verify "
        "the certificate of a gains file",
        description="Report which of the declared faults can be estimated together with the declared sensors, which "
        "cannot, why, and what would help. Exit status: 0 all of them together, 3 not all (the report is printed), "
        "2 bad input. For a gains file (.json), verify the certificate from the file alone, in exact arithmetic. Exit "
        "status: 0 it holds, 2 it does not.",
        epilog="example: fauio check arm\nexample: fauio check gains.json",
    )
    option(
        parser,
        "model MODEL.toml|GAINS.json",
        "model file, or built in: arm, arm-disturbed; or gains, whose certificate is verified",
    )
    option(parser, "--rate HZ", "sample a continuous model at this rate", float)
    option(parser, "--json", "print the findings as one JSON object")
    parser.set_defaults(handler=run_check)


def run_check(args: argparse.Namespace) -> int:
    """Run ``fauio check``."""
    from dataclasses import asdict

    from gains.analysis.check import check_plant, check_report, check_text
    from gains.plants.model_file import load_model

    if args.model.endswith(".json"):
        from gains.synthesis.verification import verify_gains

        if args.rate is not None:
            raise UsageError(f"{args.model}: gains have their own rate; leave out --rate")
        verified = verify_gains(args.model)
        if args.json:
            say_json({"status": "verified", **asdict(verified)})
        else:
            sys.stdout.write(verified.text())
        return 0
    check = check_plant(load_model(args.model), args.rate)
    if args.json:
        say_json(check_report(check))
    else:
        sys.stdout.write(check_text(check))
    return 0 if check.estimable else InfeasibleError.exit_status


def _design(plant: Plant, args: argparse.Namespace) -> tuple[dict[str, Any], Gains | None]:
    """Design and certify; return the report, and the compiled gains if there is a rate to compile them for."""
    if args.method in _BASELINES or _continuous(args):
        for option, default in _DISCRETE_OPTIONS.items():
            if getattr(args, option) != default:
                raise UsageError(f"{plant.name}: --{option.replace('_', '-')} belongs to the discrete convex synthesis")
    if args.out is not None and args.rate is None and _continuous(args):
        raise UsageError(f"{plant.name}: gains that run need a rate in samples per second (--rate)")
    if args.method in _BASELINES:
        from gains.published.catalogue import design_baseline

        gains, report = design_baseline(plant, args.method, args.rate)
    elif _continuous(args):
        report, gains = _design_continuous(plant, args)
    else:
        report, gains = _design_discrete(plant, args)
    return report | {"floor": _floor(plant, report), "reason": None}, gains


def _continuous(args: argparse.Namespace) -> bool:
    """Return whether a design in continuous time is requested: only the convex design and the filter know another."""
    return args.continuous or args.method not in ("convex", "ekf")


def _design_discrete(plant: Plant, args: argparse.Namespace) -> tuple[dict[str, Any], Gains]:
    from gains.synthesis.certificate import certify, design_report
    from gains.synthesis.compilation import common_matrix, compile_gains
    from gains.synthesis.convex import GAIN_WEIGHT, design_convex
    from gains.synthesis.gains_file import read_gains

    if stray := [name for name in ("decay_rates", *_SCALARS) if getattr(args, name) is not None]:
        raise UsageError(f"{plant.name}: --{stray[0].replace('_', '-')} belongs to a continuous design (--continuous)")
    P, inverse = None, None
    if args.common_p is not None:
        P, inverse = common_matrix(plant, args.rate, read_gains(args.common_p), str(args.common_p))
    design = design_convex(
        plant,
        args.rate,
        pole_radius=args.pole_radius,
        gain_weight=GAIN_WEIGHT if args.gain_weight is None else args.gain_weight,
        gain_bound=args.gain_bound,
        integrator_order=args.integrator_order,
        h2=args.h2,
        vertices=False if args.vertex_free else None,
        P=P,
        inverse=inverse,
        free_inverse=not args.published_inverse,
        noise_once=args.noise_once,
    )
    certificate = certify(plant, design)
    return design_report(plant, design, certificate), compile_gains(plant, design, certificate)


def _design_continuous(plant: Plant, args: argparse.Namespace) -> tuple[dict[str, Any], Gains | None]:
    from gains.published.theorem import design_theorem
    from gains.synthesis.certificate import certify, design_report
    from gains.synthesis.compilation import provable
    from gains.synthesis.continuous_observer import compile_continuous, designed_observer
    from gains.synthesis.continuous_synthesis import design_continuous

    if args.pole_radius != 1.0:
        raise UsageError(f"{plant.name}: a pole radius belongs to a discrete design; use --decay-rates")
    scalars = {name: value for name in _SCALARS if (value := getattr(args, name)) is not None}
    if args.method == "convex":
        if scalars:
            raise UsageError(f"{plant.name}: --{next(iter(scalars))} belongs to theorem1 and theorem2")
        low, high = args.decay_rates or (0.0, math.inf)
        design = design_continuous(plant, decay=(low, high), noise_once=args.noise_once)
    elif args.decay_rates is not None or args.noise_once:
        option = "--noise-once" if args.noise_once else "--decay-rates"
        raise UsageError(f"{plant.name}: {option} belongs to the convex synthesis")
    else:
        design = design_theorem(plant, args.method, **scalars)
    report = design_report(plant, design, certify(plant, design), args.rate)
    if args.rate is None:
        return report, None
    proven = provable(report, plant, design)
    return report, compile_continuous(designed_observer(plant, design), args.rate, proven)


def _failure(plant: Plant, args: argparse.Namespace, error: ValueError) -> dict[str, Any]:
    """Return the report of a design that does not exist, with the keys of one that does."""
    from gains.synthesis.design import design_figures

    continuous = _continuous(args)
    known: dict[str, Any] = {"status": "inaccurate" if isinstance(error, InaccurateError) else "infeasible"}
    known |= dict.fromkeys(("poles_max_re", "poles_min_re") if continuous else ("poles_max_abs",))
    if args.method == "convex" and not continuous:
        known |= {"integrator_order": args.integrator_order, "h2": None, "gain_weight": args.gain_weight}
        known["error_bounds"] = None
        known["certificate"] = {"holds": False, "margin": None, "proof": None, "slopes": 0}
    if args.method not in _BASELINES:
        known["noise_once"] = args.noise_once
        known["fault_rate"] = {fault.name: fault.rate for fault in plant.actuator_faults}
        known["faults"] = list(plant.fault_names)
    elif continuous:
        del known["poles_min_re"]
    rate_hz = plant.rate_hz if args.rate is None else args.rate
    domain = "continuous" if continuous else "discrete"
    return design_figures(plant.name, args.method, domain, rate_hz, **known, floor=None, reason=str(error))


def _floor(plant: Plant, report: dict[str, Any]) -> float | None:
    """Return the sqrt(mu) that no observer of the plant can beat, or None if it is infinite."""
    from gains.analysis.floor import floor_sqrt_mu

    rate_hz = report["rate_hz"] if report["domain"] == "discrete" else None
    order, once = report.get("integrator_order", 1), report.get("noise_once", False)
    floor = floor_sqrt_mu(plant, rate_hz, order, noise_once=once)
    return floor.value if math.isfinite(floor.value) else None
