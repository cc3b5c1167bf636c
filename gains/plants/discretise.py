"""Exact sampling of a continuous plant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adapters.errors import ModelError
from gains.plants.plant import Plant


def discretise(plant: Plant, rate_hz: float) -> Plant:
    """Return a continuous plant sampled at ``rate_hz`` with a zero-order hold; a discrete one of that rate as it is.

    The matrix exponential of [[A, X], [0, 0]] / rate_hz, X = [B, G, E_f, E_1, c], is exact for signals held
    over the sample. Holding the nonlinearity g(x(k)) is the one approximation. The sensor equations stay.

    Raises
    ------
    ModelError
        The rate is not positive, or the model is discrete with another rate.
    """
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise ModelError(f"{plant.name}: a rate of {rate_hz} Hz is not positive")
    if plant.domain == "discrete":
        if plant.rate_hz != rate_hz:
            raise ModelError(
                f"{plant.name}: the model is discrete at {plant.rate_hz:g} Hz and cannot run at "
                f"{rate_hz:g} Hz: leave the rate out or give a continuous model"
            )
        return plant
    from scipy.linalg import expm

    n = len(plant.states)
    blocks = [plant.B, plant.G, plant.E_f, plant.E_1, plant.c[:, None]]
    held = np.hstack(blocks)
    exponent = np.zeros((n + held.shape[1],) * 2)
    exponent[:n] = np.hstack([plant.A, held])
    with np.errstate(all="ignore"):  # overflow is reported below
        transition = expm(exponent / rate_hz)[:n]
    if not np.all(np.isfinite(transition)):
        raise ModelError(f"{plant.name}: the model grows without bound within a sample of {1.0 / rate_hz:g} s")
    B, G, E_f, E_1, c = np.split(transition[:, n:], np.cumsum([block.shape[1] for block in blocks])[:-1], axis=1)
    columns = dict(zip((fault.name for fault in plant.actuator_faults), E_f.T, strict=True))
    for fault in plant.actuator_faults:
        if fault.input is not None:
            columns[fault.name] = B[:, plant.inputs.index(fault.input)]
    return replace(
        plant,
        domain="discrete",
        rate_hz=float(rate_hz),
        A=transition[:, :n],
        B=B,
        G=G,
        c=c[:, 0],
        faults=tuple(replace(fault, column=columns.get(fault.name, fault.column)) for fault in plant.faults),
        disturbances=tuple(replace(w, column=E_1[:, i]) for i, w in enumerate(plant.disturbances)),
    )
