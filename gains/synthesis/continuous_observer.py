"""A continuous observer with scalar nonlinearities, and its exact compilation for sampled telemetry.

    s' = A s + B_y y + M (B v + G g(H x^) + c)
    [x^; f_s^; fa^; yt] = C s + D_y y

Every continuous design is written in this form: the paper's structure by :func:`fauio_observer`, any other directly.

Compilation (docs/theory.md, "One recursion for every design") is exact for signals that are straight lines between
samples (first-order hold). Over a period h the solution of the linear part is

    s(k+1) = Phi s(k) + X0 r(k) + X1 r(k+1) + c,      r = [y; v; g]

with all of Phi, X0, X1 and c from one matrix exponential: gains of any size stay stable, while forward Euler on
the paper's printed pole at -33 280 rad/s diverges above 60 microseconds. The runtime knows r(k+1) only one
sample later, so it carries

    st = s - X1 r,        st(k+1) = Phi (st(k) + X1 r(k)) + X0 r(k) + c

and adds X1 r(k) when the sample arrives. Only the arguments of g at that moment need g itself; they are predicted with
the last value, s = st + X1 [y; v; g(k-1)], and g(k-1) is one more entry of the state. A restart sets that entry to
zero, an error of X1 g that decays like every other.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from adapters.errors import ModelError
from gains.analysis.augment import augment, slope_matrix, slope_vertices
from gains.plants.discretise import transition
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.compilation import common_fields
from gains.synthesis.design import Design, ObserverMatrices, design_figures, observer_matrices
from gains.synthesis.gains_file import Gains


@dataclass(frozen=True, slots=True, eq=False)
class ContinuousObserver:
    """A linear observer with scalar nonlinearities in continuous time."""

    plant: Plant  # the continuous plant that it observes; v is its input effect, g its nonlinearities
    method: str  # name of the synthesis
    step: FloatArray  # [A, B_y] (ns, ns + p)
    output: FloatArray  # [C, D_y] (nz + a1 + p, ns + p): [x^; f_s^; fa^; yt]
    into: FloatArray  # M (ns, n): how the inputs of the plant's states drive s
    start: FloatArray  # s at a restart from y (ns, p)
    sqrt_mu: float | None = None  # the bound that its synthesis reports, None if it reports none
    matrices: ObserverMatrices | None = None  # the matrices of the paper's structure, if the observer has it
    solve_s: float = 0.0  # time in the solver, seconds
    notes: tuple[str, ...] = ()  # remarks about this observer for people

    @property
    def A(self) -> FloatArray:
        """Dynamics of s without inputs (ns, ns)."""
        return self.step[:, : len(self.step)]

    @property
    def B_y(self) -> FloatArray:
        """Effect of the outputs on s (ns, p)."""
        return self.step[:, len(self.step) :]


def fauio_observer(
    plant: Plant,
    K: FloatArray,
    L_i: FloatArray,
    L_p: FloatArray,
    method: str,
    inverse: ObserverMatrices | None = None,
) -> ContinuousObserver:
    """Return the observer of the paper's structure for a continuous plant and given gains, as yet without a bound.

    eta' = N eta + J y + L1 (B v + c + G g(x^) + E_f fa^),  zeta^ = eta + F y,  yt = y - Cb zeta^
    q'   = L_i yt + L_q x^',  fa^ = q + F_q y + L_p yt;  s = [eta; q],

    with the left inverse of ``inverse``, or the pseudo-inverse without it. The paper's law fa^' = beta L2 (yt + yt') is
    L_p = L_i = beta L2, integrated once so that nothing is differentiated. K is (nz, p), L_i and L_p are (a1, p).
    """
    check_continuous(plant)
    augmentation = augment(plant)
    if inverse is not None:
        augmentation = inverse.inverse(augmentation)
    matrices = observer_matrices(augmentation, K, L_i, L_p)
    p, a1 = len(plant.outputs), len(plant.actuator_faults)
    nz = len(plant.states) + len(plant.sensor_faults)
    eta, q, y = np.split(np.eye(nz + a1 + p), [nz, nz + a1])
    # zeta^ = eta + F y, yt = y - Cb zeta^, fa^ = q + F_q y + L_p yt, as rows that multiply [eta; q; y]
    zeta = eta + matrices.F @ y
    yt = y - augmentation.C_b @ zeta
    fa = q + augmentation.F_q @ y + L_p @ yt
    into = np.vstack([augmentation.L1, augmentation.L_q])
    moved = augmentation.A_z @ zeta + plant.E_f @ fa
    return ContinuousObserver(
        plant=plant,
        method=method,
        # eta' without known inputs and nonlinearities, and q'
        step=np.vstack([augmentation.L1 @ moved + K @ yt, augmentation.L_q @ moved + L_i @ yt]),
        output=np.vstack([zeta, fa, yt]),
        into=into,
        start=into @ np.linalg.pinv(plant.C),
        matrices=matrices,
    )


def designed_observer(plant: Plant, design: Design) -> ContinuousObserver:
    """Return the observer of a continuous design."""
    gains = design.gains
    observer = fauio_observer(plant, gains.K, gains.L_i, gains.L_p, design.method, gains)
    return replace(observer, sqrt_mu=design.sqrt_mu, solve_s=design.solve_s, notes=design.notes)


def check_continuous(plant: Plant) -> None:
    """Refuse a discrete plant with a ModelError."""
    if plant.domain != "continuous":
        raise ModelError(f"{plant.name}: the model is discrete; a continuous design needs a continuous model")


def compile_continuous(observer: ContinuousObserver, rate_hz: float, report: Mapping[str, Any] | None = None) -> Gains:
    """Return the observer as the recursion that runs at ``rate_hz``; the default report has its bound alone.

    Raises
    ------
    ModelError
        The rate is not positive, or the observer is unstable at that rate for a slope of the nonlinearities.
    """
    plant = observer.plant
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise ModelError(f"{plant.name}: a rate of {rate_hz} Hz is not positive")
    recursion = _recursion(observer, 1.0 / rate_hz)
    growth = _largest_pole(plant, recursion)
    if not growth < 1.0:
        raise ModelError(
            f"{plant.name}: the {observer.method} observer is unstable at {rate_hz:g} Hz (pole of size {growth:.3g} "
            "with the nonlinearity sampled that slowly): take a higher rate"
        )
    if report is None:
        report = design_figures(plant.name, observer.method, "continuous", rate_hz, sqrt_mu=observer.sqrt_mu)
    return Gains(
        **common_fields(plant, observer.matrices),
        method=observer.method,
        domain="continuous",
        rate_hz=float(rate_hz),
        step_matrix=recursion.step,
        argument_matrix=recursion.arguments,
        initial_matrix=recursion.initial,
        report=dict(report),
    )


class _Recursion(NamedTuple):
    """Matrices of the sampled observer; its state is [st; g(k-1)]."""

    step: FloatArray
    arguments: FloatArray
    initial: FloatArray


def _recursion(observer: ContinuousObserver, period: float) -> _Recursion:
    """Return the sampled observer (module docstring)."""
    plant = observer.plant
    (ns, p), s, m = observer.start.shape, len(plant.inputs), len(plant.nonlinearities)
    Phi, X0, X1, constant = _first_order_hold(observer, period)
    select = np.eye(ns + m + s + p + 1 + m)
    held, g_before, v, y, one, g = np.split(select, np.cumsum([ns, m, s, p, 1]))
    now, before = np.vstack([y, v, g]), np.vstack([y, v, g_before])
    state = held + X1 @ now  # s = st + X1 r(k), complete when the sample has arrived
    step = [Phi @ state + X0 @ now + np.outer(constant, one), g, observer.output @ np.vstack([state, y])]
    # nu = H x^, with g of the previous sample
    arguments = plant.H @ observer.output[: len(plant.states)] @ np.vstack([held + X1 @ before, y])
    initial = np.zeros((ns + m, s + p + 1))
    initial[:ns, :s] = -X1[:, p : p + s]
    initial[:ns, s : s + p] = observer.start - X1[:, :p]
    return _Recursion(np.vstack(step), arguments[:, : len(select) - m], initial)


def _first_order_hold(
    observer: ContinuousObserver, period: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return Phi, X0, X1 and c of s(k+1) = Phi s(k) + X0 r(k) + X1 r(k+1) + c for r = [y; v; g]."""
    plant, ns = observer.plant, len(observer.step)
    # step is [A, B_y]; then M B, M G and M c
    held = np.hstack([observer.step[:, ns:], *(observer.into @ part for part in (plant.B, plant.G, plant.c[:, None]))])
    nr = held.shape[1] - 1
    blocks = transition(observer.step[:, :ns], held, period, f"{plant.name}: the observer", nr)
    Phi, X, constant, X1 = np.split(blocks, [ns, ns + nr, ns + nr + 1], axis=1)
    return Phi, X - X1, X1, constant[:, 0]


def _largest_pole(plant: Plant, recursion: _Recursion) -> float:
    """Return the size of the largest pole of the recursion over the slope vertices."""
    ns, m = len(recursion.initial), len(plant.nonlinearities)
    step, arguments = recursion.step[:ns], recursion.arguments[:, :ns]
    Delta = slope_matrix(plant, slope_vertices(plant))
    closed = step[:, :ns] + step[:, step.shape[1] - m :] @ Delta @ arguments
    return float(np.max(np.abs(np.linalg.eigvals(closed)), initial=0.0))
