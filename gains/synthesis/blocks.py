"""Design an observer block by block for a plant of independent blocks, and prove the whole.

Blocks share no state, output, fault, disturbance or noise. The least bound of the whole is that of its worst block, and
any gains that keep the other blocks below it are optimal: a design of the whole leaves their gains to chance. In a
design of its own each block gets its own least bound, in a small part of the time, because the solver's effort grows
with the sixth power of the size. The gains, and P, of the whole are those of the blocks on its diagonal; it is
certified like any design.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adapters.errors import InaccurateError, ModelError
from gains.analysis.augment import augment
from gains.plants.plant import Plant
from gains.synthesis.certificate import certify
from gains.synthesis.convex import design_convex
from gains.synthesis.design import Design, observer_matrices


@dataclass(frozen=True, slots=True)
class PlantBlock:
    """Indices of a block's states and outputs in the plant, and of its faults among the sensor and actuator faults."""

    states: tuple[int, ...]
    outputs: tuple[int, ...]
    sensor_faults: tuple[int, ...]
    actuator_faults: tuple[int, ...]


def blocks_of(plant: Plant) -> tuple[PlantBlock, ...]:
    """Return the blocks of a discrete plant without nonlinearities, in the order of their first states.

    Raises
    ------
    ModelError
        The plant is continuous or has nonlinearities.
    """
    from scipy.linalg import block_diag
    from scipy.sparse.csgraph import connected_components

    if plant.rate_hz is None or plant.nonlinearities:
        raise ModelError(f"{plant.name}: only discrete plants without nonlinearities are designed in blocks")
    n = len(plant.states)
    reach = np.hstack(
        [
            np.vstack([np.abs(plant.A) + np.eye(n), plant.C]),
            block_diag(np.hstack([plant.E_f, plant.E_1]), np.hstack([plant.D_f, plant.D_1])),
        ]
    )
    count, label = connected_components(np.abs(reach) @ np.abs(reach).T)

    def members(belong: NDArray[np.bool_]) -> tuple[int, ...]:
        return tuple(np.flatnonzero(belong).tolist())

    return tuple(
        PlantBlock(
            states=members(label[:n] == k),
            outputs=members(label[n:] == k),
            sensor_faults=members(plant.D_f[label[n:] == k].any(axis=0)),
            actuator_faults=members(plant.E_f[label[:n] == k].any(axis=0)),
        )
        for k in range(count)
    )


def design_blocks(plant: Plant, *, h2: float = 0.0) -> Design:
    """Design an observer for a discrete plant without nonlinearities block by block and prove it.

    Each block has a state, an output and a fault; all are designed with the same ``h2``. Fails as
    :func:`gains.synthesis.convex.design_convex` does.
    """
    started = time.perf_counter()
    blocks = blocks_of(plant)
    for block in blocks:
        if not (block.states and block.outputs and (block.sensor_faults or block.actuator_faults)):
            names = [plant.states[i] for i in block.states] + [plant.outputs[i] for i in block.outputs]
            raise ModelError(f"{plant.name}: no fault concerns {', '.join(names)}; leave them out of the model")
    designs = [design_convex(block_plant(plant, block), h2=h2) for block in blocks]
    augmentation = augment(plant)
    n, p = len(plant.states), len(plant.outputs)
    a1, a2 = len(plant.actuator_faults), len(plant.sensor_faults)
    nz = n + a2
    K, L_i, L_p = np.zeros((nz, p)), np.zeros((a1, p)), np.zeros((a1, p))
    L, F = np.zeros((nz + a1, n)), np.zeros((nz + a1, p))
    P = np.zeros((nz + a1, nz + a1))
    for block, part in zip(blocks, designs, strict=True):
        zeta = [*block.states, *(n + k for k in block.sensor_faults)]
        whole = [*zeta, *(nz + k for k in block.actuator_faults)]
        K[np.ix_(zeta, block.outputs)] = part.gains.K
        L_i[np.ix_(block.actuator_faults, block.outputs)] = part.gains.L_i
        L_p[np.ix_(block.actuator_faults, block.outputs)] = part.gains.L_p
        P[np.ix_(whole, whole)] = part.P
        own = part.gains.inverse(augment(block_plant(plant, block)))
        L[np.ix_(whole, block.states)] = np.vstack([own.L1, own.L_q])
        F[np.ix_(whole, block.outputs)] = np.vstack([own.F, own.F_q])
    augmentation = replace(augmentation, L1=L[:nz], F=F[:nz], L_q=L[nz:], F_q=F[nz:])
    design = Design(
        method="convex",
        rate_hz=plant.rate_hz,
        gains=observer_matrices(augmentation, K, L_i, L_p),
        P=P,
        mu=max(part.mu for part in designs),
        solve_s=sum(part.solve_s for part in designs),
        total_s=time.perf_counter() - started,
        notes=tuple(note for part in designs for note in part.notes),
    )
    if not certify(plant, design).holds:
        raise InaccurateError(f"{plant.name}: its blocks have certificates but the whole has none; check the scales")
    return design


def block_plant(plant: Plant, block: PlantBlock) -> Plant:
    """Return one block as a plant; it keeps all inputs."""
    states, outputs = list(block.states), list(block.outputs)
    rows = {"sensor": outputs, "actuator": states}
    own = {plant.sensor_faults[k].name for k in block.sensor_faults}
    own |= {plant.actuator_faults[k].name for k in block.actuator_faults}
    return replace(
        plant,
        name=f"{plant.name}-{plant.states[states[0]]}",
        states=tuple(plant.states[i] for i in states),
        outputs=tuple(plant.outputs[i] for i in outputs),
        A=plant.A[np.ix_(states, states)],
        B=plant.B[states],
        C=plant.C[np.ix_(outputs, states)],
        c=plant.c[states],
        G=np.zeros((len(states), 0)),
        state_errors=plant.state_errors[states],
        faults=tuple(replace(f, column=f.column[rows[f.kind]]) for f in plant.faults if f.name in own),
        disturbances=tuple(replace(w, column=w.column[states]) for w in plant.disturbances if np.any(w.column[states])),
        noises=tuple(replace(w, column=w.column[outputs]) for w in plant.noises if np.any(w.column[outputs])),
    )
