"""The plant of a fit for the design of an observer: delay, noise scales, and parameter uncertainty as disturbance.

A parameter that is off by its standard error drives the states by dx+/dp sigma_p; the root mean square of that over the
recordings, including correlations of the estimates, is added to the disturbance of each state (and likewise of
outputs).
"""

from dataclasses import replace

import numpy as np

from gains.identification.output_error import OutputErrorFit
from gains.identification.simulation import Stepper
from gains.plants.discretise import discretise
from gains.plants.plant import Disturbance, FloatArray, Noise, Plant, Signal

_STEP = 1e-4
"""Relative step of differences: with it rounding (1e-16 / 1e-4) and curvature (1e-4) leave four digits, and a standard
error needs one."""


def fitted_plant(fit: OutputErrorFit) -> Plant:
    """Return the fitted plant.

    Scales that the model file states are kept; missing ones, and those of undeclared noises and disturbances, are the
    most likely ones. Each is then enlarged by the uncertainty of the parameters. With a delay the plant is discrete at
    the rate of the recordings, with the delay in its taps.
    """
    plant, model = fit.signals, fit.model
    stated = fit.model.plant(fit.theta)
    states, outputs = parameter_uncertainty(fit)
    per_step = 1.0 if plant.domain == "discrete" else fit.rate_hz
    disturbances = [
        replace(w, scale=stated.disturbances[i].scale)
        if i < len(stated.disturbances) and model.declares_scale("disturbance", i)
        else w
        for i, w in enumerate(plant.disturbances)
    ]
    noises = [
        replace(w, scale=stated.noises[i].scale) if i < len(stated.noises) and model.declares_scale("noise", i) else w
        for i, w in enumerate(plant.noises)
    ]
    for i, size in enumerate(states * per_step):
        _widen(disturbances, Disturbance, f"model_{plant.states[i]}", np.eye(len(states))[i], float(size))
    for i, size in enumerate(outputs):
        _widen(noises, Noise, f"model_{plant.outputs[i]}", np.eye(len(outputs))[i], float(size))
    plant = replace(plant, disturbances=tuple(disturbances), noises=tuple(noises))
    if not fit.delay:
        return plant
    return replace(discretise(plant, fit.rate_hz), taps=(0.0,) * fit.delay + (1.0,))


def parameter_uncertainty(fit: OutputErrorFit) -> tuple[FloatArray, FloatArray]:
    """Return the typical error of x+ (n,) and of y (p,) that the uncertainty of the parameters causes."""
    theta, data = fit.theta, fit.training
    finite = [j for j in range(len(theta)) if np.isfinite(fit.covariance[j, j])]
    n, p = data.states.shape[2], data.measured.shape[2]
    if not finite:
        return np.zeros(n), np.zeros(p)
    steps = _STEP * np.maximum(np.abs(theta), [parameter.size for parameter in fit.model.parameters])
    sets = [fit.model.dynamics(theta), *(fit.model.dynamics(theta + np.diag(steps)[j]) for j in finite)]
    stepper = Stepper(sets, fit.rate_hz, fit.hold)
    drives = np.moveaxis(stepper.drives(data.u), 0, 1).reshape(len(sets), -1, n)
    x = np.broadcast_to(np.moveaxis(data.states[:, :-1], 1, 0).reshape(1, -1, n), drives.shape)
    covariance = fit.covariance[np.ix_(finite, finite)]

    def typical(after: FloatArray) -> FloatArray:
        slopes = (after[1:] - after[0]) / steps[finite, None, None]
        variance = np.einsum("jti,jl,lti->i", slopes, covariance, slopes) / slopes.shape[1]
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    return typical(stepper.step(x, drives)), typical(x @ stepper.C_T)


def _widen(signals: list[Signal], kind: type[Signal], name: str, column: FloatArray, size: float) -> None:
    """Add ``size`` in direction ``column``, in quadrature if one of the signals already has that direction."""
    if size <= 0.0:
        return
    at = int(np.argmax(column))
    for i, signal in enumerate(signals):
        if signal.column[at] and np.count_nonzero(signal.column) == 1:
            signals[i] = replace(signal, scale=float(np.hypot(signal.scale, size / signal.column[at])))
            return
    signals.append(kind(name, column, size))
