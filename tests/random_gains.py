"""Observers with random matrices, for what holds for any: the runtime asks no more of gains than their shapes."""

import numpy as np

from gains.plants.plant import FloatArray
from gains.synthesis.gains_file import Gains, ScalarNonlinearity


def random_gains(
    seed: int,
    states: int = 4,
    outputs: int = 3,
    faults: int = 2,
    *,
    inputs: int = 1,
    radius: float = 0.9,
    nonlinearities: tuple[str, ...] = (),
    coupling: float = 0.05,
) -> Gains:
    """Return an observer of ``states`` + ``faults`` internal states whose largest pole has the size ``radius``.

    ``nonlinearities`` are expressions of v; ``coupling`` is how strongly they drive the states.
    """
    rng = np.random.default_rng(seed)
    ns, s, p, a1, m = states + faults, inputs, outputs, faults - faults // 2, len(nonlinearities)
    step = rng.normal(size=(ns + states + faults + p, ns + s + p + 1 + m)) / np.sqrt(ns)
    step[:ns, :ns] *= radius / np.max(np.abs(np.linalg.eigvals(step[:ns, :ns])))
    step[:ns, ns + s + p + 1 :] *= coupling
    nothing: FloatArray = np.zeros((0, 0))
    return Gains(
        model="random",
        model_hash="",
        method="random",
        domain="discrete",
        rate_hz=100.0,
        states=tuple(f"x{i}" for i in range(states)),
        inputs=tuple(f"u{i}" for i in range(s)),
        outputs=tuple(f"y{i}" for i in range(p)),
        faults=tuple(f"f{i}" for i in range(faults)),
        fault_kinds=("actuator",) * a1 + ("sensor",) * (faults - a1),
        fault_units=("",) * faults,
        fault_inputs=(None,) * faults,
        input_taps=(1.0,),
        input_curves=np.column_stack([np.ones(s), 0.1 * np.arange(s)]),
        input_bends=np.zeros((0, 0)),
        nonlinearities=tuple(ScalarNonlinearity(text, ("v",)) for text in nonlinearities),
        step_matrix=step,
        argument_matrix=rng.normal(size=(m, ns + s + p + 1)) / np.sqrt(ns),
        initial_matrix=rng.normal(size=(ns, s + p + 1)),
        K=nothing,
        L_i=nothing,
        L_p=nothing,
        L1=nothing,
        L_q=nothing,
        L_z=nothing,
        F_q=nothing,
        F=nothing,
        N=nothing,
        J=nothing,
        report={},
    )
