"""Whether an observer can exist: detectability with the sensor faults, and with the actuator faults.

An error system can be made stable exactly when its modes that no output shows decay by themselves. The test
runs at every slope vertex and at their mean, in three steps that name what is missing:

    (A, C)          the plant without faults: a hidden mode is a mistake of the model
    (L1 A_z, Cb)    with sensor faults: no invariant zero of (A, 0; C, D_f) with |z| >= 1
    (A_a, [Cb 0])   with actuator faults too: [L1 A_z - I, L1 E_f; Cb, 0] has full column rank (condition II)

In continuous time |z| >= 1 reads Re s >= 0, and no identity is subtracted from L1 A_z.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gains.augment import Augmentation, ErrorModel
from gains.errors import InfeasibleError, ModelError
from gains.hidden_modes import hidden_modes, row_norms, signal_scales
from gains.plant import FloatArray, Plant

_SEEN_TOLERANCE = 1e-6
_SHARE = 0.05


def check_existence(plant: Plant, augmentation: Augmentation, model: ErrorModel) -> tuple[str, ...]:
    """Test the existence conditions of a plant.

    Parameters
    ----------
    plant : Plant
        The plant, discrete or continuous.
    augmentation, model : Augmentation, ErrorModel
        Its augmentation and error system.

    Returns
    -------
    tuple[str, ...]
        Notes: what is possible but slow.

    Raises
    ------
    ModelError
        The plant itself has a mode that does not decay and that no output shows, or it has no faults.
    InfeasibleError
        A condition fails; the message names it and the signals that cannot be told apart.
    """
    faults = len(plant.faults)
    if not faults:
        raise ModelError(f"{plant.name}: 'fault' is empty; there is nothing to estimate")
    if faults > len(plant.outputs):
        raise InfeasibleError(
            f"{plant.name}: {faults} faults cannot be told apart with {len(plant.outputs)} outputs "
            "(condition II needs at least as many outputs as faults)"
        )
    n, nz = len(plant.states), len(augmentation.L1)
    scales = signal_scales(plant)
    for A, slopes in _vertices_and_mean(model):
        plain = np.linalg.pinv(augmentation.L1) @ A[:nz, :n]
        at = f" at slopes {', '.join(f'{slope:g}' for slope in slopes)}" if len(slopes) else ""
        for size, matrix in ((n, plain), (nz, A[:nz, :nz]), (len(A), A)):
            modes = hidden_modes(matrix, model.C[:, :size], scales[:size], plant.domain)
            if not modes or not modes[0].stays:
                continue
            mode = modes[0]
            moving = _moving(plant, mode.direction * model.weights[:size])
            variable = "z" if plant.domain == "discrete" else "s"
            where = f"mode at {variable} = {_complex_text(mode.eigenvalue)}{at}"
            if size == n:
                raise ModelError(f"{plant.name}: hidden mode: {moving} shows in no output ({where})")
            condition = "detectability of (L1 A_z, Cb)" if size == nz else "condition II"
            raise InfeasibleError(
                f"{plant.name}: {condition} fails: {moving} shows in no output ({where}); "
                "add a sensor, a leak or leave a fault out"
            )
    return _notes(plant, augmentation)


def _notes(plant: Plant, augmentation: Augmentation) -> tuple[str, ...]:
    """Name the condition that decides whether f_a is seen in the first sample after it acts."""
    if not plant.actuator_faults:
        return ()
    size = plant.state_errors
    through, into = augmentation.C_b @ augmentation.L1 * size, plant.E_f / size[:, None]
    seen = through @ into / row_norms(through)[:, None] / np.linalg.norm(into, axis=0)
    rank = int(np.linalg.matrix_rank(seen, tol=_SEEN_TOLERANCE))
    if rank == len(plant.actuator_faults):
        return ()
    return (
        f"Cb L1 E_f has rank {rank} for {len(plant.actuator_faults)} actuator faults: not all of them are "
        "seen in the first sample after they act; the estimate takes longer",
    )


def _vertices_and_mean(model: ErrorModel) -> list[tuple[FloatArray, FloatArray]]:
    """Return (A_a, slopes) at the mean and at every vertex: what holds at the vertices holds at the mean."""
    mean = [(model.A.mean(axis=0), model.slopes.mean(axis=0))]
    return mean if len(model.A) == 1 else [*mean, *zip(model.A, model.slopes, strict=True)]


def _moving(plant: Plant, direction: FloatArray) -> str:
    """Return the signals that take part in a mode, faults before states, each group the largest first."""
    n = len(plant.states)
    faults = [fault.name for fault in (*plant.sensor_faults, *plant.actuator_faults)]
    groups = [_largest(faults, direction[n:]), _largest(plant.states, direction[:n])]
    return " moving with ".join(group for group in groups if group)


def _largest(names: Sequence[str], sizes: FloatArray) -> str:
    order = [i for i in np.argsort(-sizes, kind="stable") if sizes[i] >= _SHARE * np.max(sizes) > 0.0]
    return " and ".join(f"'{names[i]}'" for i in order)


def _complex_text(value: complex) -> str:
    return f"{value.real:.4g}" if abs(value.imag) < 1e-9 else f"{value.real:.4g}{value.imag:+.4g}j"
