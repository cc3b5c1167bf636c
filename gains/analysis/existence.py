"""Whether an observer can exist: detectability with the sensor faults, and with the actuator faults.

An error system can be made stable exactly when its modes that no output shows decay by themselves. The test
runs at every slope vertex and at their mean, in three steps that name what is missing:

    (A, C)          the plant without faults: a hidden mode is a mistake of the model
    (L1 A_z, Cb)    with sensor faults: no invariant zero of (A, 0; C, D_f) with |z| >= 1
    (A_a, [Cb 0])   with actuator faults too: [L1 A_z - I, L1 E_f; Cb, 0] has full column rank (condition II)

In continuous time |z| >= 1 reads Re s >= 0, and no identity is subtracted from L1 A_z. They are decided in the
plant's own coordinates, as :mod:`gains.analysis.estimability` does for any set of its faults.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapters.errors import InfeasibleError, ModelError
from gains.analysis.augment import sloped_dynamics
from gains.analysis.estimability import conditions, late_faults
from gains.analysis.hidden_modes import HiddenMode, leading
from gains.plants.plant import FloatArray, Plant, check_independence


def check_existence(plant: Plant, *, sampled: bool = False) -> tuple[str, ...]:
    """Test the existence conditions of a plant, at every slope vertex or at a sample; return what is possible but slow.

    Raises
    ------
    ModelError
        The plant itself has a mode that does not decay and that no output shows, it has no faults, or directions of
        its faults depend on each other.
    InfeasibleError
        A condition fails; the message names it and the signals that cannot be told apart. Or too many slopes vary.
    """
    faults = len(plant.faults)
    if not faults:
        raise ModelError(f"{plant.name}: 'fault' is empty; there is nothing to estimate")
    if faults > len(plant.outputs):
        raise InfeasibleError(
            f"{plant.name}: {faults} faults cannot be told apart with {len(plant.outputs)} outputs "
            "(condition II needs at least as many outputs as faults)"
        )
    check_independence(plant)
    for A, slopes in zip(*sloped_dynamics(plant, sampled=sampled), strict=True):
        for condition, modes in conditions(plant, A):
            if not modes or not modes[0].stays:
                continue
            moving = _moving(plant, modes[0], condition != "hidden mode")
            variable = "z" if plant.domain == "discrete" else "s"
            at = f" at slopes {', '.join(f'{slope:g}' for slope in slopes)}" if len(slopes) else ""
            where = f"mode at {variable} = {_complex_text(modes[0].eigenvalue)}{at}"
            if condition == "hidden mode":
                raise ModelError(f"{plant.name}: hidden mode: {moving} shows in no output ({where})")
            raise InfeasibleError(
                f"{plant.name}: {condition} fails: {moving} shows in no output ({where}); "
                "add a sensor, a leak or leave a fault out"
            )
    if late := late_faults(plant):
        names = " and ".join(f"'{name}'" for name in late)
        return (
            f"Cb L1 E_f lacks rank: {names} cannot be seen in the first sample after acting; the estimate takes longer",
        )
    return ()


def _moving(plant: Plant, mode: HiddenMode, faulty: bool) -> str:
    """Return the signals that take part in a mode, the faults before the states, each group the largest first.

    What the states move in the outputs the sensor faults cancel: D_f f_s = -C x.
    """
    x, f_a = np.split(mode.motion, [len(plant.states)])
    moving = _largest(plant.states, np.abs(x) / plant.state_errors)
    if not faulty:
        return moving
    faults = (*plant.sensor_faults, *plant.actuator_faults)[: len(plant.sensor_faults) + len(f_a)]
    motion = np.concatenate([np.linalg.pinv(plant.D_f) @ (plant.C @ x), f_a])
    sizes = np.abs(motion) / [fault.error for fault in faults]
    return " moving with ".join(filter(None, (_largest([fault.name for fault in faults], sizes), moving)))


def _largest(names: Sequence[str], sizes: FloatArray) -> str:
    return " and ".join(f"'{name}'" for name in leading(names, sizes))


def _complex_text(value: complex) -> str:
    return f"{value.real:.4g}" if abs(value.imag) < 1e-9 else f"{value.real:.4g}{value.imag:+.4g}j"
