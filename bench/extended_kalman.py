"""The extended Kalman filter that linearises anew in each sample: the peer of the steady-state filter that compiles."""

from __future__ import annotations

import numpy as np

from adapters.errors import ModelError
from gains.analysis.augment import slope_matrix
from gains.plants.expression import compile_expression, compile_node, derivative, parse_expression
from gains.plants.plant import FloatArray, Plant
from gains.published.kalman import filter_model


class ExtendedKalmanFilter:
    """The filter that linearises at its own estimate in every sample.

    After :meth:`step`, ``x`` (n,), ``fault`` (a1 + a2,) = [fa^; fs^] and ``residual`` (p,), the innovation, hold the
    estimate at that sample. v is taken as the command (no curves, no delays).

    Parameters
    ----------
    plant : Plant
        Continuous or discrete model.
    rate_hz : float | None
        Samples per second.

    Raises
    ------
    ModelError
        As :func:`filter_model`; or the model has input delays or curves.
    """

    def __init__(self, plant: Plant, rate_hz: float | None = None) -> None:
        self.model = filter_model(plant, rate_hz)
        discrete = self.model.plant
        if len(discrete.taps) > 1 or discrete.bends.any() or any(curve != (1.0,) for curve in discrete.curves):
            raise ModelError(f"{plant.name}: the extended Kalman filter takes models without input delays and curves")
        self._g = [compile_expression(g.expression, g.arguments) for g in discrete.nonlinearities]
        self._slopes = [
            [compile_node(derivative(parse_expression(g.expression, g.arguments), j)) for j in range(len(g.arguments))]
            for g in discrete.nonlinearities
        ]
        counts = [len(g.arguments) for g in discrete.nonlinearities]
        ends = np.cumsum([0, *counts]).tolist()
        self._spans = [slice(start, start + count) for start, count in zip(ends, counts, strict=False)]
        self._n, self._nz = len(discrete.states), len(discrete.states) + len(discrete.sensor_faults)
        self.x = np.zeros(self._n)
        self.fault = np.zeros(len(discrete.faults))
        self.residual = np.zeros(len(discrete.outputs))
        self._predicted = np.zeros(len(self.model.A))
        self._Sigma = self.model.Q.copy()

    def restart(self, y: FloatArray) -> None:
        """Forget the past: start at the state that y (p,) explains without a fault, uncertain by what matters."""
        discrete = self.model.plant
        self._predicted[:] = 0.0
        self._predicted[: self._n] = np.linalg.pinv(discrete.C) @ y
        errors = [fault.error for fault in (*discrete.sensor_faults, *discrete.actuator_faults)]
        self._Sigma = np.diag(np.concatenate([discrete.state_errors, errors]) ** 2)

    def step(self, u: FloatArray, y: FloatArray) -> None:
        """Advance by one sample: u (s,) and y (p,)."""
        model, discrete, C = self.model, self.model.plant, self.model.C
        self.residual = y - C @ self._predicted
        K = np.linalg.solve(C @ self._Sigma @ C.T + model.R, C @ self._Sigma).T
        estimate = self._predicted + K @ self.residual
        kept = np.eye(len(estimate)) - K @ C
        Sigma = kept @ self._Sigma @ kept.T + K @ model.R @ K.T
        self.x = estimate[: self._n]
        self.fault = np.concatenate([estimate[self._nz :], estimate[self._n : self._nz]])
        arguments = model.H @ estimate + discrete.H_known @ np.append(u, 1.0)
        values = np.array([g(*arguments[span]) for g, span in zip(self._g, self._spans, strict=True)])
        slopes = [d(*arguments[span]) for ds, span in zip(self._slopes, self._spans, strict=True) for d in ds]
        A = model.A + model.G @ slope_matrix(discrete, np.array(slopes)) @ model.H
        self._predicted = model.A @ estimate + model.G @ values
        self._predicted[: self._n] += discrete.B @ u + discrete.c
        self._Sigma = A @ Sigma @ A.T + model.Q
