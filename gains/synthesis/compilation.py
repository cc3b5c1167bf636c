"""Compile a design to the one affine map that runs: delays, offset and nonlinearities folded in.

With s = [eta; q; v(k-1); ...; v(k-L)] and vb = h_0 v + h_1 v(k-1) + ... the observer of :mod:`gains.analysis.augment`
reads

    zeta^ = eta + F y                         yt  = y - Cb zeta^                      fa^ = q^ + L_p yt
    eta+  = N eta + J y + L1 (B vb + c + G g + E_f fa^)                               q^  = q + F_q y
    q+    = q^ + L_q (A x^ + B vb + c + G g + E_f fa^) + L_i yt                       nu  = H x^ + H_v vb + h + H_f q^

where v is [v; r] and B is B_r if the plant has bends. Every line is linear in z = [s; v; y; 1; g] and is computed as a
product with rows that select parts of z.
What is published of zeta^ is zeta^ + L_z yt if there is an L_z. Integrators of order 2 have q = [q1; q2],
fa^ = q1^ + L_p yt and q1+ = q1^ + T q2^ + ...
"""

import json
import math
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from adapters.errors import InaccurateError, ModelError
from gains.analysis.augment import augment, integrators
from gains.analysis.floor import floor_sqrt_mu
from gains.plants.discretise import discretise
from gains.plants.model_file import model_document, model_hash
from gains.plants.plant import FloatArray, Plant, padded_curves
from gains.synthesis.certificate import CONSISTENCY, Certificate, design_report, inverse_error
from gains.synthesis.design import Design, ObserverMatrices
from gains.synthesis.gains_file import Gains, ScalarNonlinearity


def compile_gains(plant: Plant, design: Design, certificate: Certificate) -> Gains:
    """Return the compiled gains of a certified design; their report contains what was verified.

    Raises
    ------
    InaccurateError
        The certificate does not hold: such gains must not be used.
    """
    if not certificate.holds:
        raise InaccurateError(f"{plant.name}: the gains' certificate does not hold; they must not be used")
    rate_hz, observer = float(design.rate_hz or 0.0), design.gains
    discrete = discretise(plant, rate_hz)
    inverse = observer.inverse(augment(discrete, design.integrator_order))
    C_b = inverse.C_b
    nz, a1 = len(observer.K), len(plant.actuator_faults)
    z = selection(discrete, nz + a1 * design.integrator_order)
    eta, q = z.own[:nz], z.own[nz:] + inverse.F_q @ z.y
    zeta = eta + observer.F @ z.y
    yt = z.y - C_b @ zeta
    fa = q[:a1] + observer.L_p @ yt
    driven = z.drive(discrete) + discrete.E_f @ fa
    published = zeta + observer.L_z @ yt if observer.L_z.size else zeta
    moved = [
        observer.N @ eta + observer.J @ z.y + observer.L1 @ driven,
        integrators(a1, design.integrator_order, rate_hz) @ q
        + inverse.L_q @ (inverse.A_z @ zeta + driven)
        + observer.L_i @ yt,
    ]
    # a restart assumes x = C^+ y without faults, hence eta = L1 x (zeta~ = L1 x - eta = 0) and q = L_q x
    start = np.zeros((len(z.own), len(plant.outputs)))
    start[:] = np.vstack([inverse.L1, inverse.L_q]) @ np.linalg.pinv(discrete.C)
    return Gains(
        **common_fields(plant, observer),
        **recursion(
            discrete, z, np.vstack(moved), np.vstack([published, fa, yt]), start, zeta[: len(discrete.states)], q[:a1]
        ),
        method=design.method,
        domain="discrete",
        rate_hz=rate_hz,
        report=provable(design_report(plant, design, certificate), discrete, design),
    )


class Selection(NamedTuple):
    """Rows that select the parts of z = [own; past; v; y; 1; g], past = [v(k-1); ...]: each equation is a product."""

    own: FloatArray
    past: FloatArray
    v: FloatArray
    y: FloatArray
    one: FloatArray
    g: FloatArray

    def drive(self, plant: Plant) -> FloatArray:
        """Return B vb + c + G g: the known inputs of the states of a discrete plant."""
        return np.asarray(plant.B_r @ self.effect(plant) + plant.c[:, None] * self.one + plant.G @ self.g)

    def effect(self, plant: Plant) -> FloatArray:
        """Return vb."""
        taps = np.kron(plant.taps, np.eye(len(self.v)))
        return np.asarray(taps @ np.vstack([self.v, self.past]), dtype=np.float64)


def selection(plant: Plant, own: int) -> Selection:
    """Return the rows for an observer of a discrete plant with this number of states of its own."""
    s = plant.B_r.shape[1]
    sizes = [own, s * (len(plant.taps) - 1), s, len(plant.outputs), 1, len(plant.nonlinearities)]
    return Selection(*np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1]))


def recursion(
    plant: Plant,
    z: Selection,
    moved: FloatArray,
    outputs: FloatArray,
    start: FloatArray,
    x: FloatArray,
    q: FloatArray,
) -> dict[str, Any]:
    """Return the compiled matrices of a discrete plant's observer.

    ``moved`` and ``outputs`` multiply z and give the observer's own states one sample later and [x^; f_s^; fa^; yt];
    ``start`` (own, p) its own states at a restart, from y; ``x`` and ``q`` the states and actuator faults in the
    arguments of the nonlinearities.
    """
    s, delays = len(z.v), len(plant.taps) - 1
    initial = np.zeros((len(z.own) + len(z.past), s + start.shape[1] + 1))
    initial[: len(z.own), s:-1] = start
    initial[len(z.own) :, :s] = np.tile(np.eye(s), (delays, 1))
    nu = plant.H @ x + plant.H_known @ np.vstack([z.effect(plant)[: len(plant.inputs)], z.one]) + plant.H_f @ q
    return {
        "step_matrix": np.vstack([moved, np.vstack([z.v, z.past])[: len(z.past)], outputs]),
        # the arguments depend on all of z except g itself
        "argument_matrix": nu[:, : z.g.shape[1] - len(z.g)],
        "initial_matrix": initial,
    }


def common_fields(plant: Plant, matrices: ObserverMatrices | None) -> dict[str, Any]:
    """Return the entries of compiled gains that describe their plant, for every synthesis; actuator faults come first.

    ``matrices`` are those for people, None if the observer has another structure.
    """
    faults = (*plant.actuator_faults, *plant.sensor_faults)
    nothing = np.zeros((0, 0))
    return {
        **{field.name: getattr(matrices, field.name, nothing) for field in fields(ObserverMatrices)},
        "model": plant.name,
        "model_hash": model_hash(plant),
        "states": plant.states,
        "inputs": plant.inputs,
        "outputs": plant.outputs,
        "faults": plant.fault_names,
        "fault_kinds": ("actuator",) * len(plant.actuator_faults) + ("sensor",) * len(plant.sensor_faults),
        "fault_units": tuple(fault.unit for fault in faults),
        "fault_inputs": tuple(None if fault.input is None else plant.inputs.index(fault.input) for fault in faults),
        "input_taps": plant.taps,
        "input_curves": padded_curves(plant.curves),
        "input_bends": np.vstack([np.zeros((0, plant.bends.shape[2])), *plant.bends[plant.bent]]),
        "nonlinearities": tuple(ScalarNonlinearity(g.expression, g.arguments) for g in plant.nonlinearities),
    }


def common_matrix(
    plant: Plant, rate_hz: float | None, gains: Gains, source: str
) -> tuple[FloatArray, ObserverMatrices]:
    """Return the Lyapunov matrix of an earlier design, and its observer, for another one that may be exchanged with it.

    ``source`` names the origin of the earlier gains in error messages.

    Raises
    ------
    ModelError
        The gains contain no such matrix, or their error system is not that of this model at this rate.
    """
    rate_hz = plant.rate_hz if rate_hz is None else rate_hz
    for what, here, there in (
        ("list of states is", plant.states, gains.states),
        ("list of outputs is", plant.outputs, gains.outputs),
        ("list of faults is", plant.fault_names, gains.faults),
        ("rate is", rate_hz, gains.rate_hz),
    ):
        if here != there:
            raise ModelError(f"{source}: its {what} not that of {plant.name}: the designs cannot share a proof")
    matrices = ObserverMatrices(**{field.name: getattr(gains, field.name) for field in fields(ObserverMatrices)})
    if not matrices.L1.size or inverse_error(discretise(plant, gains.rate_hz), matrices) > CONSISTENCY:
        raise ModelError(f"{source}: its sensors or errors that matter are not those of {plant.name}")
    certificate = gains.report.get("certificate")
    try:
        P = np.array(certificate["P"], dtype=np.float64)  # type: ignore[index]  # what is no table fails here
    except (TypeError, KeyError, ValueError) as error:
        raise ModelError(f"{source}: its certificate has no 'P'; make the file again with 'fauio design'") from error
    if P.ndim != 2 or P.shape != P.T.shape or not np.all(np.isfinite(P)) or np.linalg.eigvalsh(P)[0] <= 0.0:
        raise ModelError(f"{source}: 'P' of its certificate is not a positive definite matrix")
    return P, matrices


def provable(summary: dict[str, Any], plant: Plant, design: Design) -> dict[str, Any]:
    """Return the report of a design with all that its proof needs (:mod:`gains.synthesis.verification`).

    These are the plant of the design, P, mu, the multipliers of the slopes if any, and the bound that no observer of
    the plant can beat.
    """
    floor = floor_sqrt_mu(plant, integrator_order=design.integrator_order, noise_once=design.noise_once).value
    proof = {
        "mu": design.mu,
        "floor": floor if math.isfinite(floor) else None,
        "fault_state": design.fault_state,
        "noise_once": design.noise_once,
        "P": design.P.tolist(),
        "multipliers": None if design.multipliers is None else design.multipliers.tolist(),
        "plant": json.loads(json.dumps(model_document(plant))),  # lists for tuples, as a file reads back
    }
    return {**summary, "certificate": {**summary["certificate"], **proof}}
