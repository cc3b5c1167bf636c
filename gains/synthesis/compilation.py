"""Compile a design to the one affine map that runs: delays, offset and nonlinearities folded in.

With s = [eta; q; v(k-1); ...; v(k-L)] and vb = h_0 v + h_1 v(k-1) + ... the observer of :mod:`gains.analysis.augment`
reads

    zeta^ = eta + F y                         yt  = y - Cb zeta^                      fa^ = q + L_p yt
    eta+  = N eta + J y + L1 (B vb + c + G g + E_f fa^)                               q+  = q + L_i yt

and every line is linear in z = [s; v; y; 1; g]: the rows below are written as products with selections of z.
Integrators of order 2 have q = [q1; q2], fa^ = q1 + L_p yt and q1+ = q1 + T q2 + ...
"""

from __future__ import annotations

from typing import Any

import numpy as np

from adapters.errors import InaccurateError, ModelError
from gains.analysis.augment import augment, integrators
from gains.plants.discretise import discretise
from gains.plants.model_file import model_hash
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.certificate import Certificate, design_report
from gains.synthesis.design import Design
from gains.synthesis.gains_file import Gains, ScalarNonlinearity


def compile_gains(plant: Plant, design: Design, certificate: Certificate) -> Gains:
    """Return the compiled gains of a certified design.

    Parameters
    ----------
    plant : Plant
        The model the design was made for, continuous or discrete.
    design : Design
        Its gains.
    certificate : Certificate
        What was verified about them; goes into the report.

    Raises
    ------
    InaccurateError
        The certificate does not hold: such gains are not for use.
    """
    if not certificate.holds:
        raise InaccurateError(f"{plant.name}: the gains' certificate does not hold; they are not for use")
    discrete = discretise(plant, design.rate_hz)
    C_b = augment(discrete).C_b
    n, s, p = len(plant.states), len(plant.inputs), len(plant.outputs)
    a1, m = len(plant.actuator_faults), len(plant.nonlinearities)
    nz, delays = n + len(plant.sensor_faults), len(discrete.taps) - 1
    nq = a1 * design.integrator_order
    ns = nz + nq + s * delays
    # z = [s; v; y; 1; g]: products with these rows select its parts, so each line below reads as its equation.
    select = np.eye(ns + s + p + 1 + m)
    eta, q = select[:nz], select[nz : nz + nq]
    past = [select[nz + nq + d * s : nz + nq + (d + 1) * s] for d in range(delays)]
    v, y = select[ns : ns + s], select[ns + s : ns + s + p]
    one, g = select[ns + s + p], select[ns + s + p + 1 :]
    # zeta^ = eta + F y, yt = y - Cb zeta^, fa^ = q + L_p yt
    zeta = eta + design.F @ y
    yt = y - C_b @ zeta
    fa = q[:a1] + design.L_p @ yt
    # eta+ = N eta + J y + L1 (B vb + c + G g + E_f fa^), q+ = q + L_i yt; then what is estimated
    effect = sum((h * v_d for h, v_d in zip(discrete.taps, [v, *past], strict=True)), start=np.zeros_like(v))
    force = discrete.B @ effect + np.outer(discrete.c, one) + discrete.G @ g + discrete.E_f @ fa
    step = [
        design.N @ eta + design.J @ y + design.L1 @ force,
        integrators(a1, design.integrator_order, design.rate_hz) @ q + design.L_i @ yt,
        *[v, *past][:delays],
        zeta,
        fa,
        yt,
    ]
    # Arguments of g, H x^: they know all of z but g itself.
    rows = [nonlinearity.rows for nonlinearity in plant.nonlinearities]
    arguments = np.vstack([*rows, np.zeros((0, n))]) @ zeta[:n, : ns + s + p + 1]
    return Gains(
        **plant_fields(plant, discrete.taps),
        method=design.method,
        domain="discrete",
        rate_hz=design.rate_hz,
        step_matrix=np.vstack(step),
        argument_matrix=arguments,
        initial_matrix=_initial_matrix(discrete, design, nq, delays),
        K=design.K,
        L_i=design.L_i,
        L_p=design.L_p,
        L1=design.L1,
        F=design.F,
        N=design.N,
        J=design.J,
        report=_provable(design_report(plant, design, certificate), design),
    )


def plant_fields(plant: Plant, taps: tuple[float, ...]) -> dict[str, Any]:
    """Return what compiled gains say about their plant, whatever the synthesis; faults of actuators come first.

    Parameters
    ----------
    plant : Plant
        The model.
    taps : tuple[float, ...]
        Delays of the inputs that are left to the runtime.
    """
    faults = (*plant.actuator_faults, *plant.sensor_faults)
    return {
        "model": plant.name,
        "model_hash": model_hash(plant),
        "states": plant.states,
        "inputs": plant.inputs,
        "outputs": plant.outputs,
        "faults": tuple(fault.name for fault in faults),
        "fault_kinds": ("actuator",) * len(plant.actuator_faults) + ("sensor",) * len(plant.sensor_faults),
        "fault_units": tuple(fault.unit for fault in faults),
        "fault_inputs": tuple(None if fault.input is None else plant.inputs.index(fault.input) for fault in faults),
        "input_taps": taps,
        "input_curves": _input_curves(plant),
        "nonlinearities": tuple(ScalarNonlinearity(g.expression, g.arguments) for g in plant.nonlinearities),
    }


def common_matrix(plant: Plant, rate_hz: float | None, gains: Gains, source: str) -> FloatArray:
    """Return the Lyapunov matrix of an earlier design, for another one whose gains may be exchanged with it.

    Parameters
    ----------
    plant, rate_hz
        Model and rate of the design to come.
    gains : Gains
        The earlier design.
    source : str
        Where it comes from, for errors.

    Raises
    ------
    ModelError
        The gains keep no such matrix, or their errors are not those of this model at this rate.
    """
    rate_hz = plant.rate_hz if rate_hz is None else rate_hz
    faults = tuple(fault.name for fault in (*plant.actuator_faults, *plant.sensor_faults))
    for what, here, there in (
        ("list of states is", plant.states, gains.states),
        ("list of outputs is", plant.outputs, gains.outputs),
        ("list of faults is", faults, gains.faults),
        ("rate is", rate_hz, gains.rate_hz),
    ):
        if here != there:
            raise ModelError(f"{source}: its {what} not that of {plant.name}: the designs cannot share a proof")
    augmentation = augment(discretise(plant, gains.rate_hz))
    if gains.F.shape != augmentation.F.shape or not np.allclose(gains.F, augmentation.F, rtol=1e-9, atol=0.0):
        raise ModelError(f"{source}: its sensors or errors that matter are not those of {plant.name}")
    certificate = gains.report.get("certificate")
    try:
        P = np.array(certificate["P"], dtype=np.float64)  # type: ignore[index]  # what is no table fails here
    except (TypeError, KeyError, ValueError) as error:
        raise ModelError(f"{source}: its certificate has no 'P'; make the file again with 'fauio design'") from error
    if P.ndim != 2 or P.shape != P.T.shape or not np.all(np.isfinite(P)) or np.linalg.eigvalsh(P)[0] <= 0.0:
        raise ModelError(f"{source}: 'P' of its certificate is not a positive definite matrix")
    return P


def _provable(summary: dict[str, Any], design: Design) -> dict[str, Any]:
    """Return the report of a design with what proves it: P and, where it has them, the multipliers of the slopes."""
    multipliers = None if design.multipliers is None else design.multipliers.tolist()
    return {**summary, "certificate": {**summary["certificate"], "P": design.P.tolist(), "multipliers": multipliers}}


def _initial_matrix(plant: Plant, design: Design, nq: int, delays: int) -> FloatArray:
    """Return the state of a restart: x = C^+ y without faults, hence eta = L1 x (zeta~ = L1 x - eta = 0)."""
    s, p = len(plant.inputs), len(plant.outputs)
    select = np.eye(s + p + 1)
    v, y = select[:s], select[s : s + p]
    return np.vstack([design.L1 @ np.linalg.pinv(plant.C) @ y, np.zeros((nq, s + p + 1)), *[v] * delays])


def _input_curves(plant: Plant) -> FloatArray:
    """Return the coefficients of the inputs' static curves as one array (s, degree)."""
    degree = max((len(curve) for curve in plant.curves), default=1)
    curves = np.zeros((len(plant.inputs), degree))
    for i, curve in enumerate(plant.curves):
        curves[i, : len(curve)] = curve
    return curves
