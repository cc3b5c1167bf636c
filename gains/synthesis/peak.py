"""Largest errors of a discrete design channel by channel, in users' units, for signals of their stated sizes.

sqrt(mu) bounds the energy of all errors together by that of everything unknown. A user wants another figure: how far
can this estimate be off at any one time, if no gust and no noise is larger than the model says and the faults move no
faster? For the error system at the mean slopes that is a sum of sizes of an impulse response (the l1 norm): signals of
size one move output i by at most sum_k |(C A^k B)_ij|, and some signals do.

Slopes that vary are p = delta q, |delta_i| <= 1, from the arguments q of the error to its states. With S the sums
between (w, p) and (e, q) the largest arguments obey |q| <= S_qw |w| + S_qp |q|, so that

    |e| <= (S_ew + S_ep (I - S_qp)^-1 S_qw) |w|        where the spectral radius of S_qp is below one

for slopes that vary in any way from sample to sample; if the spectral radius is not below one, there is no bound.

Noise counts once: with the error coordinates zeta~ + F D w only w itself drives the error, not w and w+.
"""

import itertools
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from adapters.toml_tables import is_number
from gains.analysis.augment import augment, error_model
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.design import Design

_FORGOTTEN = 1e-6
"""Share of the largest error of each kind at which the sums end. The remainder is bounded and added."""
_LONGEST = 200_000
"""Largest number of samples that are summed: 33 minutes at 100 Hz. An error that lasts longer gets no bound."""
_TOGETHER = 64
"""Samples that are summed by one product. Measured on an error that lasts 5 s at 100 Hz: 1 takes five times as long,
more than 64 are no faster."""
_SHARE, _SHOWN = 1e-5, 0.01
"""Shares of a bound from which a cause is listed, above the remainder of the sums, and from which it is printed."""


def peak_bounds(plant: Plant, design: Design) -> dict[str, Any] | None:
    """Return the largest error of each fault and state of a sampled plant, and its causes; None without a bound.

    Each channel has ``at_most`` and ``unit``, and ``from``, the error that each disturbance or noise of its scale, and
    each actuator fault that moves at its rate, causes alone.
    """
    augmentation = design.gains.inverse(augment(plant, design.integrator_order))
    model = error_model(plant, augmentation, design.integrator_order, sampled=True)
    gains = design.gains
    injection = model.injection(gains.K, gains.L_i, gains.L_p)
    A, B = model.mean - injection @ model.C, model.B - injection @ model.D
    C, D = (matrix / model.weights[:, None] for matrix in model.output(gains.L_e))
    k, ne = len(model.H), len(model.weights)
    q = len(plant.disturbances) + len(plant.noises)
    C, D = np.vstack([C, model.H]), np.vstack([D, np.zeros((k, D.shape[1]))])
    # [w; df_a; p] in place of [w; w+; df_a], the error moved by F D w
    moved = -model.B[:, q : 2 * q]
    into = np.hstack([B[:, :q] - A @ moved, B[:, 2 * q :], model.G])
    direct = np.hstack([D[:, :q] - C @ moved, D[:, 2 * q :], np.zeros((len(C), k))])
    sums = _summed(A, into, C, model.sizes)
    if sums is None:
        return None
    sums = sums + np.abs(direct)
    loop = sums[ne:, -k:] if k else np.zeros((0, 0))
    if k and not np.max(np.abs(np.linalg.eigvals(loop))) < 1.0:
        return None
    parts = sums[:ne, : sums.shape[1] - k]
    if k:
        parts = parts + sums[:ne, -k:] @ np.linalg.solve(np.eye(k) - loop, sums[ne:, :-k])
    order = "" if design.integrator_order == 1 else "'s rate"
    sizes = [(signal.name, f"up to {signal.scale:.3g}") for signal in plant.disturbances]
    sizes += [(signal.name, f"up to {signal.scale:.3g}") for signal in plant.noises]
    sizes += [(f"{fault.name}{order}", f"moving by {fault.rate:.3g} a second") for fault in plant.actuator_faults]
    named = [(name, "") for name in plant.states]
    named += [(fault.name, fault.unit) for fault in (*plant.sensor_faults, *plant.actuator_faults)]
    return {
        name: {
            "at_most": float(np.sum(row)),
            "unit": unit,
            "from": {
                f"{cause} {size}": float(part)
                for (cause, size), part in zip(sizes, row, strict=True)
                if part > _SHARE * np.sum(row)
            },
        }
        for (name, unit), row in zip(named, parts, strict=True)
    }


def _summed(A: FloatArray, B: FloatArray, C: FloatArray, sizes: FloatArray) -> FloatArray | None:
    """Return a bound of sum_k |C A^k B| that is exact to ``_FORGOTTEN``; None if it takes too long."""
    A, B, C = A * sizes / sizes[:, None], B / sizes[:, None], C * sizes
    step, power, row_sums = np.eye(len(A)), 0, np.zeros(len(C))
    while power == 0 or np.max(np.sum(np.abs(step), axis=1)) >= 0.5:
        row_sums += np.sum(np.abs(C @ step), axis=1)
        step, power = A @ step, power + 1
        if power > _LONGEST or not np.all(np.isfinite(step)):
            return None
    together = min(power, _TOGETHER)
    rows = np.vstack([*itertools.accumulate(range(1, together), lambda block, _: block @ A, initial=C)])
    leap = np.linalg.matrix_power(A, together)
    total, X = np.zeros((len(C), B.shape[1])), B
    for _ in range(_LONGEST // together + 1):
        total += np.sum(np.abs(rows @ X).reshape(together, *total.shape), axis=0)
        X = leap @ X
        # after ``power`` steps no more than half of what is left remains
        left = 2.0 * row_sums[:, None] * np.max(np.abs(X), axis=0, initial=0.0)
        if np.all(left <= _FORGOTTEN * np.max(total, axis=1, keepdims=True, initial=0.0)):
            return np.asarray(total + left)
    return None


def largest_bounds(reports: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Return how far the estimate of each fault is off at most, by any of several designs, as those of a bank.

    Faults for which one of the designs that estimate them proves no bound are left out. ``reports`` are those of gains
    files, of any origin.
    """
    largest: dict[str, float] = {}
    for report in reports:
        bounds = report.get("error_bounds")
        for name in report.get("faults") or ():
            entry = bounds.get(name) if isinstance(bounds, Mapping) else None
            error: Any = entry.get("at_most") if isinstance(entry, Mapping) else None
            largest[name] = max(largest.get(name, 0.0), float(error) if is_number(error) else np.inf)
    return {name: error for name, error in largest.items() if error < np.inf}


def bound_lines(faults: Iterable[str], bounds: Mapping[str, Any]) -> list[str]:
    """Return the largest errors of the faults as text for the report."""
    lines = []
    for name in faults:
        unit = f" {bounds[name]['unit']}" if bounds[name]["unit"] else ""
        causes = sorted(bounds[name]["from"].items(), key=lambda item: -item[1])
        large = [(cause, part) for cause, part in causes if part >= _SHOWN * bounds[name]["at_most"]]
        shown = ", ".join(f"{part:.3g} from {cause}" for cause, part in large)
        lines.append(f"{name}: error at most {bounds[name]['at_most']:.3g}{unit}" + (f" ({shown})" if shown else ""))
    return lines
