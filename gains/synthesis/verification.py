"""A gains file's certificate, verified from the file alone and in exact arithmetic.

Every number of the file is a fraction, so that the inequality of :mod:`gains.synthesis.certificate` is formed without
any rounding. That a matrix M is positive definite is shown by a witness: scaled by powers of two, M - L L^T is strictly
diagonally dominant for a triangular L of whole numbers, and therefore M = L L^T + (M - L L^T) > 0. Any such L proves
it, so that NumPy may compute it.

[L1 F; L_q F_q] inverts [T; Cb] except for rounding. The proof is for the observer with the nearest F that inverts it
exactly, from which L1 and L_q follow. The distance to that observer is part of the verdict, and so are the deviations
of N, J and the matrices that run.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from adapters.errors import FauioError, ModelError
from adapters.toml_tables import TomlFile
from gains.analysis.augment import integrators, slope_vertices
from gains.analysis.floor import floor_sqrt_mu
from gains.plants.model_file import read_plant
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.certificate import CONSISTENCY, certify, inverse_error
from gains.synthesis.compilation import compile_gains
from gains.synthesis.continuous_observer import compile_continuous, designed_observer
from gains.synthesis.design import Design, ObserverMatrices
from gains.synthesis.gains_file import Gains, read_gains

_DIGITS = 60
"""Binary digits of the witness: seven more than a double has, so that none of them is lost."""


@dataclass(frozen=True, slots=True)
class Verified:
    """The result of a verification: the bound, the floor, and the number of slope vertices (one with multipliers)."""

    path: str
    sqrt_mu: float
    floor: float | None
    proof: str
    vertices: int
    inverse_error: float

    def text(self) -> str:
        """Return the verdict as one line."""
        over = f"at each of {self.vertices} slope vertices" if self.vertices > 1 else "at its slopes"
        over = "for all slopes at once" if self.proof == "multipliers" else over
        floor = "" if self.floor is None else f", no observer below {self.floor:.6g}"
        return (
            f"{self.path}: certificate verified in exact arithmetic: sqrt(mu) = {self.sqrt_mu:.6g} {over}{floor}; what "
            "runs is what is proven\n"
        )


def verify_gains(path: str | Path) -> Verified:
    """Verify the certificate of a gains file.

    Raises
    ------
    ModelError
        The file is no gains file, contains no certificate, or one that does not hold; the message states which and why.
    """
    gains = read_gains(path)
    plant, design, floor = _claimed(gains, path)
    _check_matrices(gains, plant, design, path)
    off = inverse_error(plant, design.gains)
    system = _ExactSystem(plant, design)
    count = 1 if design.multipliers is not None else len(system.slopes)
    for vertex in range(count):
        if not all(_is_positive(matrix) for matrix in system.inequalities(vertex)):
            where = "for all slopes at once" if design.multipliers is not None else f"at slope vertex {vertex + 1}"
            raise ModelError(
                f"{path}: its certificate does not hold: the inequality for sqrt(mu) = {design.sqrt_mu:.6g} fails "
                f"{where}; the file was changed, or make it again with 'fauio design'"
            )
    proof = "vertices" if design.multipliers is None else "multipliers"
    return Verified(str(path), design.sqrt_mu, floor, proof, count, off)


def _claimed(gains: Gains, path: str | Path) -> tuple[Plant, Design, float | None]:
    """Return the plant, the design and the floor that a file claims."""
    claim = gains.report.get("certificate")
    if not isinstance(claim, Mapping) or gains.report.get("sqrt_mu") is None or not gains.L1.size:
        raise ModelError(f"{path}: a design by '{gains.method}' proves no bound; there is nothing to verify")
    if missing := [key for key in ("P", "plant") if claim.get(key) is None]:
        raise ModelError(
            f"{path}: its certificate has no '{missing[0]}', so it cannot be verified from the file alone; make the "
            "file again with 'fauio design'"
        )
    try:
        plant = read_plant(TomlFile(f"{path}: plant", claim["plant"], ModelError))
        multipliers = claim["multipliers"]
        design = Design(
            method=gains.method,
            rate_hz=plant.rate_hz,
            gains=ObserverMatrices(**{field.name: getattr(gains, field.name) for field in fields(ObserverMatrices)}),
            P=np.array(claim["P"], dtype=np.float64),
            mu=float(claim["mu"]),
            multipliers=None if multipliers is None else np.array(multipliers, dtype=np.float64),
            fault_state="error" if claim["fault_state"] == "error" else "integral",
            noise_once=claim.get("noise_once") is True,
        )
        floor = None if claim["floor"] is None else float(claim["floor"])
        sqrt_mu = float(gains.report["sqrt_mu"])
    except FauioError:
        raise
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise ModelError(
            f"{path}: its certificate is damaged ({error}); make the file again with 'fauio design'"
        ) from error
    size = len(gains.L1) + len(gains.L_i)
    sizes = {gains.states: plant.states, gains.outputs: plant.outputs, gains.inputs: plant.inputs}
    if design.P.shape != (size, size) or any(a != b for a, b in sizes.items()) or plant.fault_names != gains.faults:
        raise ModelError(f"{path}: its certificate is that of another model; make the file again with 'fauio design'")
    if not (0.0 < design.mu < np.inf and design.sqrt_mu <= sqrt_mu * (1.0 + CONSISTENCY)):
        raise ModelError(f"{path}: it reports sqrt(mu) = {sqrt_mu:.6g} and proves {design.sqrt_mu:.6g}")
    lowest = floor_sqrt_mu(plant, integrator_order=design.integrator_order, noise_once=design.noise_once).value
    if floor is not None and not abs(floor - lowest) <= 1e-6 * max(floor, lowest):
        raise ModelError(f"{path}: it reports a floor of {floor:.6g}, which is {lowest:.6g}")
    return plant, design, floor


def _check_matrices(gains: Gains, plant: Plant, design: Design, path: str | Path) -> None:
    """Refuse matrices, of the recursion or for people, that differ from the proven ones."""
    try:
        certificate = certify(plant, design)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    if not certificate.holds:
        raise ModelError(
            f"{path}: its certificate does not hold for its gains (margin {certificate.margin:.2g}, norm "
            f"{certificate.norm:.6g}, sqrt(mu) {design.sqrt_mu:.6g}); the file was changed, or make it again with "
            "'fauio design'"
        )
    if design.rate_hz is None:
        again = compile_continuous(designed_observer(plant, design), gains.rate_hz)
    else:
        again = compile_gains(plant, design, certificate)
    for name in ("step_matrix", "argument_matrix", "initial_matrix"):
        runs, proven = getattr(gains, name), getattr(again, name)
        size = np.max(np.abs(proven), axis=1, keepdims=True, initial=0.0) if proven.size else proven
        if runs.shape != proven.shape or np.any(np.abs(runs - proven) > CONSISTENCY * size):
            raise ModelError(f"{path}: '{name}' runs but is not what is proven; the file was changed")
    if gains.rate_hz != again.rate_hz or gains.nonlinearities != again.nonlinearities:
        raise ModelError(f"{path}: 'rate_hz' or 'nonlinearities' are not those that are proven; the file was changed")


def _exact(array: FloatArray) -> Any:
    """Return an array of fractions."""
    values = np.asarray(array, dtype=np.float64)
    return np.array([Fraction(x) for x in values.ravel().tolist()], dtype=object).reshape(values.shape)


class _ExactSystem:
    """The closed error system of a design in fractions; :mod:`gains.analysis.augment` has the same in floats."""

    def __init__(self, plant: Plant, design: Design) -> None:
        self.design, self.discrete = design, plant.rate_hz is not None
        self.slopes = slope_vertices(plant) if design.multipliers is None else np.zeros((1, len(plant.H)))
        n, nz, a1 = len(plant.states), len(design.gains.L1), len(plant.actuator_faults)
        nq, q = len(design.gains.L_i), len(plant.disturbances) + len(plant.noises)
        self.nz, self.a1, self.na = nz, a1, nz + nq
        driven = q + a1 if design.noise_once else 2 * q + a1
        C_b, D, E = _exact(np.hstack([plant.C, plant.D_f])), _scaled(plant.D_1, plant.noises), None
        E = np.hstack([_scaled(plant.E_1, plant.disturbances), _exact(np.zeros((n, len(plant.noises))))])
        D = np.hstack([_exact(np.zeros((len(plant.outputs), len(plant.disturbances)))), D])
        L, F = _left_inverse(plant, design.gains, C_b)
        E_f, still, steps = _exact(plant.E_f), _exact(np.zeros((self.na, self.na))), _exact(np.zeros((self.na, a1)))
        if self.discrete:
            still[nz:, nz:] = _chain(a1, nq, plant.rate_hz)
        per_step = Fraction(plant.rate_hz) if plant.rate_hz is not None else Fraction(1)
        for k, fault in enumerate(plant.actuator_faults):
            steps[self.na - a1 + k, k] = Fraction(fault.rate) / per_step
        moves, arguments = _exact(np.zeros((n, self.na))), _exact(np.zeros((len(plant.H), self.na)))
        moves[:, :n], moves[:, nz : nz + a1] = _exact(plant.A), E_f
        arguments[:, :n], arguments[:, nz : nz + a1] = _exact(plant.H), _exact(plant.H_f)
        owner = [i for i, g in enumerate(plant.nonlinearities) for _ in g.arguments]
        self.into = L @ _exact(plant.G[:, owner])
        self.arguments = arguments
        low, high = _exact(np.vstack([np.zeros((0, 2)), *(g.slopes for g in plant.nonlinearities)])).T
        self.middle, self.half = (low + high) / 2, (high - low) / 2
        self.L_p, self.L_i, K = (_exact(getattr(design.gains, name)) for name in ("L_p", "L_i", "K"))
        self.L_e = _exact(design.gains.L_e)
        self.K = K
        injection = np.vstack([K, self.L_i]) + L @ E_f @ self.L_p
        self.C = np.hstack([C_b, _exact(np.zeros((len(C_b), nq)))])
        # direct path from w to zeta~: -F D if noise counts once
        self.moved = -F @ D if design.noise_once else _exact(np.zeros((self.na, q)))
        self.D = np.hstack([D + self.C @ self.moved, _exact(np.zeros((len(C_b), driven - q)))])
        self.D_rate = np.hstack([_exact(np.zeros((len(C_b), q))), D, _exact(np.zeros((len(C_b), a1)))])
        self.open_A = L @ moves + still
        self.open_B = np.hstack([L @ E, steps] if design.noise_once else [L @ E, -F @ D, steps])
        self.A, self.B = self.open_A - injection @ self.C, self.open_B - injection @ self.D
        self.errors = _exact(plant.errors)

    def inequalities(self, vertex: int) -> list[Any]:
        """Return the matrices that have to be positive definite at a slope vertex, or with multipliers at the mean."""
        P, mu = _exact(self.design.P), Fraction(self.design.mu)
        P = (P + P.T) / 2
        multipliers = self.design.multipliers
        slopes = self.middle if multipliers is not None else _exact(self.slopes[vertex])
        A, B, (C_e, D_e) = self.A + self.into * slopes @ self.arguments, self.B, self._output()
        if self.design.fault_state == "error":
            A, B, C_e, D_e = self._published(self.into * slopes @ self.arguments)
        ne, nw = len(C_e), B.shape[1]
        squares = np.diag(self.errors**2) if len(self.errors) else np.zeros((0, 0), dtype=object)
        zero = _exact(np.zeros((self.na, ne)))
        if not self.discrete:
            PA, PB = P @ A, P @ B
            rows = [[-PA - PA.T, -PB, -C_e.T], [-PB.T, _diagonal([mu] * nw), -D_e.T], [-C_e, -D_e, squares]]
            return [P, np.block(rows)]
        bound = [mu] * nw
        remainder = P
        if multipliers is not None:
            varying = [
                k for k, half in enumerate(self.half) if half > 0 and any(self.into[:, k]) and any(self.arguments[k])
            ]
            weights, H = _exact(multipliers[0]), self.arguments[varying]
            B = np.hstack([B, (self.into * self.half)[:, varying]])
            D_e = np.hstack([D_e, _exact(np.zeros((ne, len(varying))))])
            remainder = P - (H.T * weights) @ H
            bound += list(weights)
        PA, PB = P @ A, P @ B
        empty = _exact(np.zeros((self.na, len(bound))))
        rows = [
            [P, PA, PB, zero],
            [PA.T, remainder, empty, C_e.T],
            [PB.T, empty.T, _diagonal(bound), D_e.T],
            [zero.T, C_e, D_e, squares],
        ]
        return [np.block(rows)]

    def _output(self) -> tuple[Any, Any]:
        """Return C and D of e, not weighted: squared errors replace the identity instead."""
        C_e = _exact(np.eye(self.nz + self.a1, self.na))
        D_e = _exact(np.zeros((self.nz + self.a1, self.B.shape[1])))
        D_e[: self.nz, : self.moved.shape[1]] = self.moved[: self.nz]
        first = len(C_e) - len(self.L_e)
        C_e[first:] -= self.L_e @ self.C
        D_e[first:] -= self.L_e @ self.D
        return C_e, D_e

    def _published(self, sloped: Any) -> tuple[Any, Any, Any, Any]:
        """Return the error system with the paper's state [zeta~; fa~]."""
        nz, A, B = self.nz, self.open_A + sloped, self.open_B.copy()
        C_b = self.C[:, :nz]
        A[:nz] -= self.K @ self.C
        B[:nz] -= self.K @ self.D
        A[nz:] = -self.L_i @ self.C - self.L_p @ C_b @ A[:nz]
        B[nz:] = B[nz:] - self.L_i @ self.D - self.L_p @ (C_b @ B[:nz] + self.D_rate)
        return A, B, _exact(np.eye(self.na)), _exact(np.zeros(B.shape))


def _left_inverse(plant: Plant, gains: ObserverMatrices, C_b: Any) -> tuple[Any, Any]:
    """Return [L1; L_q] and [F; F_q]: the nearest ones that invert [T; Cb] exactly."""
    n, nz, nq = len(plant.states), len(gains.L1), len(gains.L_i)
    F = np.vstack([_exact(gains.F), _exact(gains.F_q if gains.F_q.size else np.zeros((nq, gains.F.shape[1])))])
    wanted, D_f = _exact(np.eye(nz + nq, nz)), C_b[:, n:]
    if nz > n:
        F = F + (wanted[:, n:] - F @ D_f) @ _solved(D_f.T @ D_f, D_f.T)
    return (wanted - F @ C_b)[:, :n], F


def _solved(matrix: Any, right: Any) -> Any:
    """Return matrix^-1 right in fractions; the matrix is positive definite."""
    rows = np.hstack([matrix, right])
    for k in range(len(rows)):
        rows[k] = rows[k] / rows[k, k]
        for i in range(len(rows)):
            if i != k:
                rows[i] = rows[i] - rows[i, k] * rows[k]
    return rows[:, len(rows) :]


def _scaled(columns: FloatArray, signals: Any) -> Any:
    return _exact(columns) * _exact(np.array([signal.scale for signal in signals]))


def _chain(a1: int, nq: int, rate_hz: float | None) -> Any:
    """Return the dynamics of q without inputs, with 1 / rate_hz as a fraction."""
    chain = _exact(integrators(a1, nq // a1 if a1 else 1, 1.0))
    chain[:a1, a1:] = chain[:a1, a1:] / Fraction(rate_hz or 1.0)
    return chain


def _diagonal(entries: list[Fraction]) -> Any:
    square = _exact(np.zeros((len(entries), len(entries))))
    square[range(len(entries)), range(len(entries))] = entries
    return square


def _is_positive(matrix: Any) -> bool:
    """Return whether a witness proves that a symmetric matrix of fractions is positive definite."""
    size = len(matrix)
    if any(matrix[k, k] <= 0 for k in range(size)):
        return False
    # powers of two that bring the diagonal near one: exact, and they do not change definiteness
    scale = [Fraction(2) ** (-round(np.log2(float(matrix[k, k])) / 2.0)) for k in range(size)]
    scaled = matrix * np.array(scale, dtype=object) * np.array(scale, dtype=object)[:, None]
    rounded = scaled.astype(np.float64)
    least = float(np.linalg.eigvalsh(0.5 * (rounded + rounded.T))[0])
    if not least > 0.0:
        return False
    try:
        factor = np.linalg.cholesky(0.5 * (rounded + rounded.T) - 0.5 * least * np.eye(size))
    except np.linalg.LinAlgError:
        return False
    whole = np.array([round(Fraction(x) * 2**_DIGITS) for x in factor.ravel().tolist()], dtype=object).reshape(
        size, size
    )
    rest = scaled * 4**_DIGITS - whole @ whole.T
    return all(2 * abs(rest[k, k]) * (rest[k, k] > 0) > sum(abs(x) for x in rest[k]) for k in range(size))
