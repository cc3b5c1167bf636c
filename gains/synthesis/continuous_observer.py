"""A continuous observer with scalar nonlinearities, and its exact compilation for sampled telemetry.

    s' = A s + B_y y + B_v v + B_g g(nu) + b,     nu = C_nu s + D_nu y
    [x^; f_s^; fa^; yt] = C s + D_y y

Every continuous design is brought to this form: the paper's structure by :func:`fauio_observer`, any other directly.

Compilation (docs/theory.md, "One recursion for every design") is exact for signals that are straight lines between
samples (first-order hold). Over a period h the solution of the linear part is

    s(k+1) = Phi s(k) + X0 r(k) + X1 r(k+1) + c,      r = [y; v; g]

with all of Phi, X0, X1 and c from one matrix exponential: gains of any size stay stable, while forward Euler on
the paper's printed pole at -33 280 rad/s diverges above 60 microseconds. The runtime knows r(k+1) only one
sample later, so it carries

    st = s - X1 r,        st(k+1) = Phi (st(k) + X1 r(k)) + X0 r(k) + c

and adds X1 r(k) when the sample arrives. Only the arguments of g at that moment need g itself; they are predicted
with the last value, nu = C_nu (st + X1 [y; v; g(k-1)]) + D_nu y, and g(k-1) is one more entry of the state. A restart
starts it at zero, an error of X1 g that decays like every other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from adapters.errors import ModelError
from gains.analysis.augment import augment, slope_vertices
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.compilation import plant_fields
from gains.synthesis.gains_file import Gains


@dataclass(frozen=True, slots=True, eq=False)
class FauioGains:
    """Matrices of the paper's observer: symbols as in :mod:`gains.analysis.augment`, x' for x+."""

    K: FloatArray
    L_i: FloatArray
    L_p: FloatArray
    L1: FloatArray
    F: FloatArray
    N: FloatArray
    J: FloatArray

    @property
    def gain_max_abs(self) -> float:
        """Largest entry of K, L_i and L_p by size."""
        return float(max(np.max(np.abs(gain), initial=0.0) for gain in (self.K, self.L_i, self.L_p)))


@dataclass(frozen=True, slots=True, eq=False)
class ContinuousObserver:
    """A linear observer with scalar nonlinearities in continuous time.

    Parameters
    ----------
    plant : Plant
        The continuous plant it estimates; v is its input effect, g its nonlinearities.
    method : str
        The synthesis.
    A, B_y, B_v, B_g, b : FloatArray
        (ns, ns), (ns, p), (ns, s), (ns, m) and (ns,).
    C, D_y : FloatArray
        (nz + a1 + p, ns) and (nz + a1 + p, p): [x^; f_s^; fa^; yt].
    C_nu, D_nu : FloatArray
        Arguments of all nonlinearities, one after the other, from s and y.
    start : FloatArray
        s at a restart from y (ns, p); empty stands for zero.
    sqrt_mu : float | None
        The bound its synthesis reports, None where it reports none.
    gains : FauioGains | None
        The matrices of the paper's structure where the observer has it.
    solve_s, total_s : float
        Time in the solver and in all, seconds.
    notes : tuple[str, ...]
        What a person should know about this observer.
    """

    plant: Plant
    method: str
    A: FloatArray
    B_y: FloatArray
    B_v: FloatArray
    B_g: FloatArray
    b: FloatArray
    C: FloatArray
    D_y: FloatArray
    C_nu: FloatArray
    D_nu: FloatArray
    start: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    sqrt_mu: float | None = None
    gains: FauioGains | None = None
    solve_s: float = 0.0
    total_s: float = 0.0
    notes: tuple[str, ...] = ()


def fauio_gains(plant: Plant, K: FloatArray, L_i: FloatArray, L_p: FloatArray) -> FauioGains:
    """Return all matrices of the paper's observer for K (nz, p), L_i and L_p (a1, p)."""
    augmentation = augment(plant)
    N = augmentation.L1 @ augmentation.A_z - K @ augmentation.C_b
    return FauioGains(K, L_i, L_p, augmentation.L1, augmentation.F, N, N @ augmentation.F + K)


def fauio_observer(
    plant: Plant,
    K: FloatArray,
    L_i: FloatArray,
    L_p: FloatArray,
    method: str,
    *,
    sqrt_mu: float | None = None,
    solve_s: float = 0.0,
    total_s: float = 0.0,
    notes: tuple[str, ...] = (),
) -> ContinuousObserver:
    """Return the observer of the paper's structure for given gains.

    eta' = N eta + J y + L1 (B v + c + G g(x^) + E_f fa^),  zeta^ = eta + F y,  yt = y - Cb zeta^
    q'   = L_i yt,  fa^ = q + L_p yt;  s = [eta; q]. The paper's law fa^' = beta L2 (yt + yt') is
    L_p = L_i = beta L2, integrated once so that nothing is differentiated.

    Parameters
    ----------
    plant : Plant
        Continuous model.
    K, L_i, L_p : FloatArray
        (nz, p), (a1, p) and (a1, p).
    method : str
        Name of the synthesis.
    sqrt_mu, solve_s, total_s, notes
        As in :class:`ContinuousObserver`.

    Raises
    ------
    ModelError
        The model is discrete.
    """
    check_continuous(plant)
    C_b = augment(plant).C_b
    gains = fauio_gains(plant, K, L_i, L_p)
    n, p, a1 = len(plant.states), len(plant.outputs), len(plant.actuator_faults)
    nz = n + len(plant.sensor_faults)
    select = np.eye(nz + a1 + p)
    eta, q, y = select[:nz], select[nz : nz + a1], select[nz + a1 :]
    # zeta^ = eta + F y, yt = y - Cb zeta^, fa^ = q + L_p yt, as rows that multiply [eta; q; y]
    zeta = eta + gains.F @ y
    yt = y - C_b @ zeta
    fa = q + L_p @ yt
    # eta' without what is driven from outside, and q'
    step = np.vstack([gains.N @ eta + gains.J @ y + gains.L1 @ plant.E_f @ fa, L_i @ yt])
    output = np.vstack([zeta, fa, yt])
    rows = np.vstack([np.zeros((0, n)), *(g.rows for g in plant.nonlinearities)])
    arguments = rows @ zeta[:n]

    def driven(matrix: FloatArray) -> FloatArray:
        return np.vstack([gains.L1 @ matrix, np.zeros((a1, matrix.shape[1]))])

    ns = nz + a1
    return ContinuousObserver(
        plant=plant,
        method=method,
        A=step[:, :ns],
        B_y=step[:, ns:],
        B_v=driven(plant.B),
        B_g=driven(plant.G),
        b=driven(plant.c[:, None])[:, 0],
        C=output[:, :ns],
        D_y=output[:, ns:],
        C_nu=arguments[:, :ns],
        D_nu=arguments[:, ns:],
        start=driven(np.asarray(np.linalg.pinv(plant.C), dtype=np.float64)),
        sqrt_mu=sqrt_mu,
        gains=gains,
        solve_s=solve_s,
        total_s=total_s,
        notes=notes,
    )


def check_continuous(plant: Plant) -> None:
    """Refuse a discrete plant.

    Raises
    ------
    ModelError
        The model is discrete.
    """
    if plant.domain != "continuous":
        raise ModelError(f"{plant.name}: the model is discrete; a continuous design needs a continuous model")


def compile_continuous(observer: ContinuousObserver, rate_hz: float, report: Mapping[str, Any] | None = None) -> Gains:
    """Return the observer as the recursion that runs at ``rate_hz``.

    Parameters
    ----------
    observer : ContinuousObserver
        The observer.
    rate_hz : float
        Samples per second.
    report : Mapping[str, Any] | None
        What was verified about the design; None reports the synthesis' own bound alone.

    Raises
    ------
    ModelError
        The rate is not positive, or the observer is unstable at it for a slope of the nonlinearities.
    InfeasibleError
        Too many slopes vary.
    """
    plant = observer.plant
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise ModelError(f"{plant.name}: a rate of {rate_hz} Hz is not positive")
    recursion = _recursion(observer, 1.0 / rate_hz)
    growth = _largest_pole(observer, recursion)
    if not growth < 1.0:
        raise ModelError(
            f"{plant.name}: the {observer.method} observer is unstable at {rate_hz:g} Hz (pole of size {growth:.3g} "
            "with the nonlinearity sampled that slowly): take a higher rate"
        )
    nothing = np.zeros((0, 0))
    gains = observer.gains or FauioGains(nothing, nothing, nothing, nothing, nothing, nothing, nothing)
    stated = {
        "model": plant.name,
        "method": observer.method,
        "domain": "continuous",
        "rate_hz": rate_hz,
        "sqrt_mu": observer.sqrt_mu,
        "solve_s": observer.solve_s,
        "total_s": observer.total_s,
        "notes": list(observer.notes),
    }
    return Gains(
        **plant_fields(plant, plant.taps),
        method=observer.method,
        domain="continuous",
        rate_hz=float(rate_hz),
        step_matrix=recursion.step,
        argument_matrix=recursion.arguments,
        initial_matrix=recursion.initial,
        K=gains.K,
        L_i=gains.L_i,
        L_p=gains.L_p,
        L1=gains.L1,
        F=gains.F,
        N=gains.N,
        J=gains.J,
        report=dict(stated if report is None else report),
    )


class _Recursion(NamedTuple):
    """Matrices of the sampled observer; its state is [st; g(k-1)]."""

    step: FloatArray
    arguments: FloatArray
    initial: FloatArray


def _recursion(observer: ContinuousObserver, period: float) -> _Recursion:
    """Return the sampled observer (module docstring)."""
    (ns, p), s, m = observer.B_y.shape, observer.B_v.shape[1], observer.B_g.shape[1]
    Phi, X0, X1, constant = _first_order_hold(observer, period)
    select = np.eye(ns + m + s + p + 1 + m)
    held, g_before, v, y, one, g = np.split(select, np.cumsum([ns, m, s, p, 1]))
    now, before = np.vstack([y, v, g]), np.vstack([y, v, g_before])
    state = held + X1 @ now  # s = st + X1 r(k), which the sample completes
    step = [
        Phi @ state + X0 @ now + np.outer(constant, one),
        g,
        observer.C @ state + observer.D_y @ y,
    ]
    arguments = observer.C_nu @ (held + X1 @ before) + observer.D_nu @ y
    start = observer.start if observer.start.size else np.zeros((ns, p))
    initial = np.zeros((ns + m, s + p + 1))
    initial[:ns, :s] = -X1[:, p : p + s]
    initial[:ns, s : s + p] = start - X1[:, :p]
    return _Recursion(np.vstack(step), arguments[:, : len(select) - m], initial)


def _first_order_hold(
    observer: ContinuousObserver, period: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return Phi, X0, X1 and c of s(k+1) = Phi s(k) + X0 r(k) + X1 r(k+1) + c for r = [y; v; g].

    They are blocks of the matrix exponential of [[A h, B h, b h], [0, 0, I]] with r and its change as states.
    """
    from scipy.linalg import expm

    ns = len(observer.A)
    B = np.hstack([observer.B_y, observer.B_v, observer.B_g])
    nr = B.shape[1]
    exponent = np.zeros((ns + 2 * nr + 1,) * 2)
    exponent[:ns, :ns] = observer.A * period
    exponent[:ns, ns : ns + nr] = B * period
    exponent[:ns, -1] = observer.b * period
    exponent[ns : ns + nr, ns + nr : -1] = np.eye(nr)
    with np.errstate(all="ignore"):  # overflow is reported below
        blocks = expm(exponent)[:ns]
    if not np.all(np.isfinite(blocks)):
        raise ModelError(f"{observer.plant.name}: the observer grows without bound within a sample of {period:g} s")
    X1 = blocks[:, ns + nr : -1]
    return blocks[:, :ns], blocks[:, ns : ns + nr] - X1, X1, blocks[:, -1]


def _largest_pole(observer: ContinuousObserver, recursion: _Recursion) -> float:
    """Return the size of the largest pole of the recursion over the slope vertices."""
    ns = len(recursion.initial)
    m = observer.B_g.shape[1]
    step, arguments = recursion.step[:ns], recursion.arguments[:, :ns]
    slopes = slope_vertices(observer.plant)
    counts = [len(g.arguments) for g in observer.plant.nonlinearities]
    owner = np.repeat(np.eye(m), counts, axis=1)
    closed = step[:, :ns] + step[:, step.shape[1] - m :] @ (owner * slopes[:, None, :]) @ arguments
    return float(np.max(np.abs(np.linalg.eigvals(closed)), initial=0.0))
